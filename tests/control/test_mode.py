# SPDX-License-Identifier: Apache-2.0
"""The mode machine."""

from __future__ import annotations

import pytest

from rti_mpc.contract.message import Severity
from rti_mpc.contract.status import Mode
from rti_mpc.control.mode import TRANSITIONS, ModeMachine


def machine(mode: Mode) -> ModeMachine:
    modes = ModeMachine()
    modes.mode = mode
    return modes


@pytest.mark.parametrize("mode", Mode)
def test_every_allowed_transition_is_a_notice_with_its_reason(mode: Mode) -> None:
    for following in TRANSITIONS[mode] - {mode}:
        modes = machine(mode)
        modes.enter(following, "for a reason", Severity.WARNING, "tested")
        (notice,) = modes.notices
        assert modes.mode is following
        assert (notice.severity, notice.code) == (Severity.WARNING, "tested")
        assert notice.text == f"{mode.name.lower()} to {following.name.lower()}: for a reason"


@pytest.mark.parametrize("mode", Mode)
def test_any_other_transition_is_an_error_of_ours(mode: Mode) -> None:
    for following in set(Mode) - TRANSITIONS[mode] - {mode}:
        modes = machine(mode)
        with pytest.raises(AssertionError, match=f"{mode.name} to {following.name}"):
            modes.enter(following, "for no reason")
        assert modes.mode is mode


@pytest.mark.parametrize("mode", Mode)
def test_mode_that_is_kept_says_nothing(mode: Mode) -> None:
    modes = machine(mode)
    modes.enter(mode, "again")
    assert not modes.notices


def test_stop_is_left_by_enable_or_another_life_of_the_robot_only() -> None:
    assert TRANSITIONS[Mode.STOPPED] == {Mode.WAITING, Mode.IDLE}


def test_notices_that_nobody_takes_make_room_for_later_ones() -> None:
    modes = ModeMachine()
    for i in range(1000):
        modes.say(Severity.INFO, "tested", str(i))
    assert len(modes.notices) == 64
    assert modes.notices[-1].text == "999"
