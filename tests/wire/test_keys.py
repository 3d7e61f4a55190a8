# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
import tomllib
from contextlib import suppress
from typing import Any

import pytest
from pydantic import ValidationError

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.streams import KNOWN_ROLES, role_of
from rti_mpc_service.config.schema import Config
from rti_mpc_service.shipped import SHIPPED


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


REFUSED = ["", "/a", "a/", "a//b", "a*", "**", "a$*", "a?b", "a#b", "@/a", "..", ".", "a/../b", "../a", "a/.", "a\0b", "a b", "a\n", "ä", 5, None]


@pytest.mark.parametrize("word", REFUSED)
@pytest.mark.parametrize("name", ["prefix", "robot"])
def test_words_that_zenoh_or_a_path_would_take_for_more_are_refused(name: str, word: Any) -> None:
    with pytest.raises(ConfigError, match=f"{name} must be (a word|words) of letters, digits, .*, got {re.escape(repr(word))}"):
        Keys(**{name: word})


def test_name_is_refused_by_the_keys_where_the_robots_file_refuses_it() -> None:
    text = SHIPPED.read_text()
    for word in ["a", "A_1.b-c", "-", "a.", *(word for word in REFUSED if isinstance(word, str))]:
        for name, line in (("robot", 'robot = "pioneer"'), ("prefix", "")):
            document = tomllib.loads(text.replace(line, f"{name} = {json.dumps(word)}", 1) if line else f"{name} = {json.dumps(word)}\n{text}")
            with suppress(ConfigError):
                Keys(**{name: word})
                Config.model_validate(document)
                continue
            with pytest.raises(ValidationError, match=name):
                Config.model_validate(document)


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
