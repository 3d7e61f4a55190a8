# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.streams import KNOWN_ROLES, role_of


def test_streams_lie_below_prefix_and_robot() -> None:
    keys = Keys("fleet/a", "r1")
    assert keys.state == "fleet/a/r1/state"
    assert keys.anchored == "fleet/a/r1/reference/anchored"
    assert keys.event("robot") == "fleet/a/r1/event/robot"
    assert keys.events == "fleet/a/r1/event/*"
    assert keys.infos == "fleet/a/r1/info/*"
    assert keys.alive("controller") == "fleet/a/r1/alive/controller"


def test_streams_are_distinct() -> None:
    keys = Keys()
    names = ("state", "reference", "anchored", "command", "actuation", "telemetry", "events", "infos", "request", "lives")
    assert len({getattr(keys, name) for name in names}) == len(names)


@pytest.mark.parametrize("word", ["", "/a", "a/", "a//b", "a*", "**", "a$*", "a?b", "a#b", "@/a", "..", ".", "a/../b", "../a", "a/.", "a\0b"])
@pytest.mark.parametrize("name", ["prefix", "robot"])
def test_words_that_zenoh_or_a_path_would_take_for_more_are_refused(name: str, word: str) -> None:
    with pytest.raises(ConfigError, match=name):
        Keys(**{name: word})


@pytest.mark.parametrize("role", [*KNOWN_ROLES, "standby.7", "standby.1048575", "viewer_2"])
def test_names_of_roles_are_roles(role: str) -> None:
    assert role_of(Keys().alive(role)) == role


@pytest.mark.parametrize("name", ["", "Ä", "standby.²", "standby.", "standby.-1", "standby." + 5000 * "9", 33 * "a", "a b", "a\n", "7", "."])
def test_other_names_are_none(name: str) -> None:
    assert role_of(f"rti_mpc/robot/alive/{name}") == ""


def test_a_key_knows_its_stream_wherever_it_lies() -> None:
    """Names of robots and roles do not confuse it: an event of the role `state` has the size of an event."""
    keys = Keys("state/fleet", "event")
    longest = {"state": 1 << 16, "anchored": 1 << 23, "actuation": 1 << 20, "standby_telemetry": 1 << 21, "events": 1 << 13, "infos": 1 << 16}
    assert {name: getattr(keys, name).stream.max_bytes for name in longest} == longest
    assert keys.event("state").stream.max_bytes == 1 << 13
