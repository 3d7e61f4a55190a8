# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.wire.keys import Keys


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
