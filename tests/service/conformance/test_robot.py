# SPDX-License-Identifier: Apache-2.0
"""Conformance test of robots in lockstep: ours passes, and each that is broken fails where it should, and only there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command
from rti_mpc.wire.actuator import Actuator
from rti_mpc.wire.source import Source, Verdict
from rti_mpc_service.config.build import build_signals, guard_limits, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.conformance.finding import judgements
from rti_mpc_service.conformance.robot import CASES, Trial
from rti_mpc_service.shipped import SHIPPED
from rti_mpc_sim.settings import RobotSettings
from tests.service.conformance.link import EPOCH, MS, as_it_is
from tests.service.conformance.link import LockstepLink as Link
from tests.slow import slow_but

CONFIG = load(SHIPPED)
LIMITS = guard_limits(CONFIG, build_signals(CONFIG))


class LockstepLink(Link):
    """The shipped robot."""

    def __init__(self, take: Callable[[Command], Command] = as_it_is, fits: bool = True, **settings: Any) -> None:
        super().__init__(RobotSettings(**(robot_settings(CONFIG) | {"state_period_s": 0.05} | settings)), take, fits)


def verdicts(link: LockstepLink, limits: Limits = LIMITS) -> dict[str, str]:
    trial = Trial(link, limits, CONFIG.timing.valid_s, 5 << NUMBER_BITS)
    found = {judgement.case.name: judgement.verdict for judgement in judgements(CASES, trial, None)}
    trial.leave()
    return found


def broken(link: LockstepLink) -> set[str]:
    found = verdicts(link)
    assert set(found.values()) <= {"yes", "NO"}
    return {name for name, verdict in found.items() if verdict == "NO"}


@pytest.mark.parametrize("state_period_s", slow_but([0.01, 0.05, 0.1, 0.13], 0.01, 0.13))
def test_ours_keeps_every_promise(state_period_s: float) -> None:
    assert set(verdicts(LockstepLink(state_period_s=state_period_s)).values()) == {"yes"}


def test_robot_that_was_judged_is_at_rest() -> None:
    link = LockstepLink(take=for_ever)
    verdicts(link)
    assert not link.robot.actuator.u.any()


def for_ever(command: Command) -> Command:
    return replace(command, valid_until_ns=2**62, u=np.vstack([command.u, np.tile(command.u[-1], (900, 1))]))


BROKEN: dict[str, tuple[dict[str, Any], set[str]]] = {
    "plays expired rows for ever": ({"take": for_ever}, {"expiry", "way", "late"}),
    "steps without an approach": ({"increments": None}, {"slew"}),
    "holds the first row": ({"take": lambda command: replace(command, u=np.tile(command.u[0], (20, 1)))}, {"plays"}),
    "knows no way to rest": ({"take": lambda command: replace(command, u_rest=np.zeros((0, 2)), rest_period_ns=0)}, {"way"}),
    "takes commands for another life": (
        {"take": lambda command: replace(command, state_epoch=EPOCH, u=np.nan_to_num(command.u[:, :2], nan=0.1)), "fits": False},
        {"foreign", "malformed"},
    ),
}


@pytest.mark.parametrize("what", BROKEN)
def test_broken_robot_fails_where_it_should_and_only_there(what: str) -> None:
    changes, expected = BROKEN[what]
    assert broken(LockstepLink(**changes)) == expected


def test_robot_that_obeys_an_old_epoch_fails_there_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = Source._judge
    monkeypatch.setattr(Source, "_judge", lambda self, epoch, seq, now: Verdict.NEW if epoch != self.epoch else judged(self, epoch, seq, now))
    assert broken(LockstepLink()) == {"epochs"}


def test_robot_that_ignores_numbers_fails_there_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = Source._judge
    monkeypatch.setattr(Source, "_judge", lambda self, epoch, seq, now: Verdict.NEW if epoch == self.epoch else judged(self, epoch, seq, now))
    assert broken(LockstepLink()) == {"repeated"}


def test_robot_that_moves_again_after_a_stop_fails_there_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes two seconds of silence for the end of the stop."""
    played = Actuator.play
    moving_ns = 0

    def play(self: Actuator, from_ns: int, to_ns: int) -> Any:
        nonlocal moving_ns
        for until_ns, u in played(self, from_ns, to_ns):
            moving_ns = until_ns if self.source[0] else moving_ns
            u += 0.1 * (until_ns - moving_ns > 2000 * MS and moving_ns > 0)
            yield until_ns, u

    monkeypatch.setattr(Actuator, "play", play)
    assert broken(LockstepLink()) == {"stop"}


def test_robot_that_does_not_report_its_inputs_keeps_nothing_that_is_seen_by_them() -> None:
    found = verdicts(LockstepLink(reports_inputs=False))
    assert found.pop("states") == "yes"
    assert set(found.values()) == {"not visible"}


def test_robot_that_obeys_nobody_keeps_nothing_by_standing() -> None:
    found = verdicts(LockstepLink(take=lambda command: replace(command, u=np.zeros((20, 2)))))
    assert (found.pop("states"), found.pop("plays")) == ("yes", "NO")
    assert set(found.values()) == {"not visible"}


def test_jump_that_states_are_too_rare_to_show_is_not_visible() -> None:
    """Within 0.1 s two windows of the slew limits fit, and the bounds leave no room for a jump beyond two increments."""
    wide = replace(LIMITS, lbdu=np.full(2, -0.7), ubdu=np.full(2, 0.7))
    assert verdicts(LockstepLink(state_period_s=0.1, increments=None), wide)["slew"] == "not visible"
    assert verdicts(LockstepLink(state_period_s=0.05, increments=None), wide)["slew"] == "NO"
