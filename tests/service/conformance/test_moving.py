# SPDX-License-Identifier: Apache-2.0
"""Conformance test in lockstep of robots that inputs at rest do not stop or hold: ours passes, and each that is broken fails where it should."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.approach import Increments
from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.rti.rti import Rti
from rti_mpc_service.conformance.finding import judgements
from rti_mpc_service.conformance.moving import CASES, MovingTrial
from rti_mpc_sim.settings import RobotSettings
from tests.movers import law_of, ocp_of
from tests.service.conformance.link import EPOCH, as_it_is
from tests.service.conformance.link import LockstepLink as Link
from tests.service.conformance.test_robot import for_ever


class LockstepLink(Link):
    """One of the movers, inside its limits."""

    def __init__(self, name: str, take: Callable[[Command], Command] = as_it_is, fits: bool = True, **settings: Any) -> None:
        ocp = ocp_of(name)
        limits = {"slew": np.minimum(-ocp.lbdu, ocp.ubdu) / ocp.dt, "lbu": ocp.lbu, "ubu": ocp.ubu}
        limits["increments"] = Increments(ocp.lbdu, ocp.ubdu, round(1e9 * ocp.dt))
        settings = limits | {"state_period_s": ocp.dt} | settings
        super().__init__(RobotSettings(ocp.model, np.zeros(ocp.model.nx), **settings), take, fits)


def verdicts(name: str, link: LockstepLink) -> dict[str, tuple[str, str]]:
    ocp, law = ocp_of(name), law_of(name)
    assert law is not None
    limits = Limits(np.array(ocp.model.u_rest), ocp.lbu, ocp.ubu, ocp.lbdu, ocp.ubdu, ocp.dt, rotations=ocp.model.rotations("states"))
    controller = Controller(Rti(ocp, compile=False), Timing(), stop_law=law, compile=False)
    trial = MovingTrial(link, limits, controller, law.rates, 5 << NUMBER_BITS)
    found = {judgement.case.name: (judgement.verdict, judgement.finding.seen) for judgement in judgements(CASES, trial, None)}
    trial.leave()
    return found


def broken(name: str, link: LockstepLink) -> set[str]:
    found = verdicts(name, link)
    assert {verdict for verdict, _ in found.values()} <= {"yes", "NO"}, found
    return {case for case, (verdict, _) in found.items() if verdict == "NO"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["car", "bicycle", "arm", "quadrotor"])
def test_ours_keeps_every_promise(name: str) -> None:
    found = verdicts(name, LockstepLink(name))
    assert {verdict for verdict, _ in found.values()} == {"yes"}, found


def without_gain(command: Command) -> Command:
    return replace(command, x_rest=np.zeros((0, 0)), K=np.zeros((0, 0)))


BROKEN: dict[str, tuple[dict[str, Any], set[str]]] = {
    "plays expired rows for ever": ({"take": for_ever}, {"expiry", "way", "late", "stop"}),
    "holds the first row": ({"take": lambda command: replace(command, u=np.tile(command.u[0], (len(command.u), 1)))}, {"plays"}),
    "plays a way to rest without its gain": ({"take": without_gain}, {"way", "stop"}),
    "takes commands for another life": ({"take": lambda command: replace(command, state_epoch=EPOCH), "fits": False}, {"foreign"}),
}


@pytest.mark.slow
def test_robot_that_steps_without_an_approach_fails_there_alone() -> None:
    assert broken("bicycle", LockstepLink("bicycle", increments=None)) == {"slew"}


def test_robot_that_obeys_nobody_keeps_nothing_by_standing() -> None:
    u_rest = np.array(ocp_of("car").model.u_rest)
    found = verdicts("car", LockstepLink("car", take=lambda command: replace(command, u=np.tile(u_rest, (len(command.u), 1)))))
    assert (found.pop("states")[0], found.pop("plays")[0]) == ("yes", "NO")
    assert {verdict for verdict, _ in found.values()} == {"not visible"}


@pytest.mark.slow
@pytest.mark.parametrize("what", BROKEN)
def test_broken_arm_fails_where_it_should_and_only_there(what: str) -> None:
    """It falls where nothing feeds its states back."""
    changes, expected = BROKEN[what]
    assert broken("arm", LockstepLink("arm", **changes)) == expected
