# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import LONGEST, ROLES, Keys, most_bytes, role_of


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


@pytest.mark.parametrize("word", ["", "/a", "a/", "a//b", "a*", "**", "a$*", "a?b", "a#b", "@/a"])
@pytest.mark.parametrize("name", ["prefix", "robot"])
def test_words_zenoh_would_take_for_more_are_refused(name: str, word: str) -> None:
    with pytest.raises(ConfigError, match=name):
        Keys(**{name: word})


@pytest.mark.parametrize("role", [*ROLES, "standby.7", "standby.1048575", "viewer_2"])
def test_names_of_roles_are_roles(role: str) -> None:
    assert role_of(Keys().alive(role)) == role


@pytest.mark.parametrize("name", ["", "Ä", "standby.²", "standby.", "standby.-1", "standby." + 5000 * "9", 33 * "a", "a b", "a\n", "7", "."])
def test_other_names_are_none(name: str) -> None:
    assert role_of(f"rti_mpc/robot/alive/{name}") == ""


def test_every_stream_has_a_longest_payload_wherever_it_lies() -> None:
    keys = Keys("state/fleet", "event")
    names = {"state": "state", "anchored": "reference", "shadow_telemetry": "telemetry", "events": "event", "infos": "info", "actuation": "command"}
    for name, stream in names.items():
        assert most_bytes(getattr(keys, name)) == LONGEST[stream]
    assert most_bytes(keys.info("robot")) == LONGEST["info"]
    assert most_bytes("rti_mpc/robot/echo/ping") == LONGEST["command"]
