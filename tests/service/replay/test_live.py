# SPDX-License-Identifier: Apache-2.0
"""Explanation of what a running controller has just done, from what a recorder hears of it in a few seconds."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rti_mpc.contract.message import JournalKind
from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.record import record
from rti_mpc_service.replay import live
from rti_mpc_service.replay.live import PATIENCE_S
from rti_mpc_service.replay.rebuild import Journaled
from rti_mpc_service.shipped import SHIPPED
from tests.service.replay.driven import journal_of, recorded


@pytest.fixture(scope="module")
def whole() -> Journaled:
    """What is heard of a controller that takes a snapshot first."""
    return journal_of(SHIPPED, samples=12)


@pytest.fixture(scope="module")
def unbegun(whole: Journaled) -> Journaled:
    """What is heard of a controller that was too busy for a snapshot."""
    return replace(whole, messages=[message for message in whole.messages if message.kind is not JournalKind.SNAPSHOT])


@pytest.fixture(scope="module")
def silent(whole: Journaled) -> Journaled:
    """What is heard of a controller that has no reference yet: a snapshot, and no commands."""
    return replace(whole, messages=whole.messages[:1])


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Ask a running controller, of which a recorder hears one journal after the other."""

    def ask(*heard: Journaled, **choice: Any) -> None:
        left = iter(heard)
        monkeypatch.setattr(record, "main", lambda *_, out, stop: recorded(next(left), out))
        try:
            assert live.main(BusSettings(), Keys("rti_mpc", heard[0].robot), folder=Path(), **choice) == 0
        finally:
            assert not list(left), "it was listened to no more"

    return ask


def test_controller_that_was_too_busy_for_a_snapshot_at_first_is_listened_to_again(
    asked: Callable[..., None], whole: Journaled, unbegun: Journaled, silent: Journaled, capsys: pytest.CaptureFixture[str]
) -> None:
    for first in (unbegun, silent):
        asked(first, whole, as_json=True)
        said = capsys.readouterr()
        assert json.loads(said.out)["replayed"] == "0 bits differ"
        assert said.err == f"rti-mpc: no snapshot of the controller and two commands after it in 4 s, listening for {PATIENCE_S:g} s\n"


def test_controller_of_which_no_snapshot_comes_is_refused_by_what_was_waited_for(asked: Callable[..., None], unbegun: Journaled) -> None:
    waited_for = "why needs a snapshot of the running controller and two commands after it, and heard none in 15 s: without a reference it sends no"
    with pytest.raises(ConfigError, match=waited_for):
        asked(unbegun, unbegun)


def test_refusal_names_what_was_heard_and_no_file(asked: Callable[..., None], whole: Journaled) -> None:
    with pytest.raises(ConfigError, match=r"^the last 4 s of pioneer must hold the journal of a robot, controller 1, got --robot pioneer "):
        asked(whole, owner=1)
