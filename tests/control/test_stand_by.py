# SPDX-License-Identifier: Apache-2.0
"""A controller that stands by and takes over, and one that is retuned: in lockstep, sample by sample."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from tests.loop import MS, drive, reference, robot
from tests.problems import pioneer

DT = 100 * MS
EIGHT = eight()
STEP = np.array([0.05, 0.1])  # slew limit per dt
ROUNDING = 1e-9


def problem(**changes: Any) -> Ocp:
    return pioneer(**({"N": 10, "lbdu": -STEP, "ubdu": STEP} | changes))


@cache
def rti(role: str) -> Rti:
    """One for all of a role: a controller's first sample starts cold, whatever came before."""
    return Rti(problem(), compile=False)


def controller(role: str, delay_s: float = 0.0) -> Controller:
    one = Controller(Rti(problem(), compile=False) if role == "retuned" else rti(role), Timing(delay_s=delay_s), compile=False)
    one.receive_reference(reference(EIGHT, "consistent"))
    return one


def take_over(
    samples: int, dies_at: int, delay_s: float = 0.0, *, hears: bool = True, late: bool = False, reports: bool = False
) -> tuple[Array, list[Command]]:
    """
    Return the inputs that acted, one row per state, and the commands of the standby that took over.

    The standby receives each command of the leader after it has prepared its own next sample, as it does over a bus, the
    last one perhaps only after one more, and leads from the second state on that the leader does not answer.
    """
    leader, standby = controller("leader", delay_s), controller("standby", delay_s)
    standby.stand_by()
    body = robot(EIGHT, reports_inputs=reports)
    applied, taken = [], []
    for k in range(samples):
        state = body.tick()
        applied.append(body.u.copy())
        command = leader.receive_state(state, body.now_ns) if k < dies_at else None
        if k == dies_at + 1:
            standby.lead(2)
        own = standby.receive_state(state, body.now_ns)
        assert (own is None) == (k == 0), "the second state tells how fast the robot's clock runs"
        if own is not None:
            standby.commit(own)
        standby.prepare()
        if command is not None:
            leader.commit(command)
            leader.prepare()
            assert not body.accept(command, body.now_ns)
            if hears and not (late and k == dies_at - 1):
                standby.overhear(command)
            last = command
        elif k == dies_at and late:
            standby.overhear(last)
        elif k > dies_at:
            assert own is not None
            assert not body.accept(own, body.now_ns)
            taken.append(own)
    return np.array(applied), taken


@pytest.mark.parametrize("delay_s", [0.0, 0.13], ids=["no_delay", "delay"])
def test_take_over_is_no_bump(delay_s: float) -> None:
    """Two samples pass, in which the robot plays the leader's plan: what acts stays near what would have acted, inside the slew limits."""
    undisturbed, _ = take_over(50, 10**6, delay_s)
    applied, taken = take_over(50, 40, delay_s)
    assert (taken[0].epoch, taken[0].mode) == (2, Mode.TRACKING)
    assert np.abs(np.diff(applied, axis=0)).max(axis=0) == pytest.approx(np.abs(np.diff(undisturbed, axis=0)).max(axis=0), abs=1e-3)
    np.testing.assert_array_equal(applied[:40], undisturbed[:40])
    np.testing.assert_allclose(applied, undisturbed, rtol=0, atol=5e-3)  # the plan foresaw that much of what the states brought


def test_take_over_in_a_transient_keeps_the_slew_limits() -> None:
    """The robot starts off the path: inputs run at their slew limits when the leader dies."""
    applied, _ = take_over(10, 10**6)
    assert np.any(np.abs(np.diff(applied, axis=0)) > STEP - ROUNDING)
    for dies_at in (1, 2, 4, 6):
        applied, _ = take_over(10, dies_at, late=dies_at > 2)
        assert np.all(np.abs(np.diff(applied, axis=0)) <= STEP + ROUNDING), dies_at


def test_standby_that_hears_nothing_would_jump() -> None:
    """Shows that the test above can fail: without the leader's commands the limits are exceeded."""
    applied, _ = take_over(10, 6, hears=False)
    assert np.any(np.abs(np.diff(applied, axis=0)) > 2 * STEP)


def test_standby_that_hears_nothing_continues_from_what_the_robot_reports() -> None:
    applied, _ = take_over(10, 6, hears=False, reports=True)
    assert np.all(np.abs(np.diff(applied, axis=0)) <= STEP + ROUNDING)


# Retuned while it runs.


def test_change_acts_from_the_sample_told_and_is_told_in_telemetry() -> None:
    one, body = controller("retuned"), robot(EIGHT)
    run = drive(one, body, 2.0)
    seq = one.retune(problem(Q=[0.0, 0.0, 0.0]), 3)
    assert seq == run.commands[-1].seq + 2
    versions = {}
    for _ in range(4):
        state = body.tick()
        command = one.receive_state(state, body.now_ns)
        assert command is not None
        one.commit(command)
        one.prepare()
        versions[command.seq] = one.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0).parameter_version
        if command.seq >= seq:
            assert np.ptp(command.u, axis=0).max() < ROUNDING, "without weights on outputs nothing is to be gained by a change of inputs"
    assert versions == {seq - 1: 0, seq: 3, seq + 1: 3, seq + 2: 3}


def test_change_before_the_first_sample_acts_from_it_on() -> None:
    one, body = controller("retuned"), robot(EIGHT)
    seq = one.retune(problem(ubu=[0.1, 0.745]), 1)
    run = drive(one, body, 3.0)
    assert (seq, run.commands[0].seq) == (1, 1)
    assert max(command.u[:, 0].max() for command in run.commands) <= 0.1 + ROUNDING


def test_tighter_bounds_are_reached_within_slew_limits_as_applied() -> None:
    one, body = controller("retuned"), robot(EIGHT)
    run = drive(one, body, 3.0)
    assert np.abs(run.u[-1][0]) > 0.15
    one.retune(problem(lbu=[-0.1, -0.745], ubu=[0.1, 0.745], lbdu=[-0.03, -0.1], ubdu=[0.03, 0.1]), 1)
    drive(one, body, 6.0, run=run)
    steps = np.diff(np.array(run.u), axis=0)
    assert np.abs(steps[32:, 0]).max() <= 0.03 + ROUNDING  # the sample prepared before keeps the old ones
    assert np.abs(run.u[-1][0]) <= 0.1 + ROUNDING
    assert {command.mode for command in run.commands} == {Mode.TRACKING}


def test_stop_brakes_by_the_limits_it_was_built_with() -> None:
    """Tuned to move gently, a robot still stops as fast as it can."""
    one, body = controller("retuned"), robot(EIGHT)
    drive(one, body, 3.0)
    one.retune(problem(lbdu=[-0.01, -0.01], ubdu=[0.01, 0.01]), 1)
    run = drive(one, body, 3.5)
    speed = run.u[-1][0]
    one.stop("asked for")
    stopped = drive(one, body, 4.0)
    assert np.abs(stopped.u[2][0]) < max(0.0, np.abs(speed) - STEP[0]) + ROUNDING
