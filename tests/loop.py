# SPDX-License-Identifier: Apache-2.0
"""A controller and a robot in lockstep: no clock, no network, every run the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Reference, State
from rti_mpc.contract.status import Mode
from rti_mpc.control.controller import Controller
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import Heading, Trajectory, rows
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

MS = 1_000_000
SLEW = np.array([2.5, 4.0])  # 1/s: the controller's increments per 0.1 s
STEP = np.array([0.25, 0.4])  # slew limit per 0.1 s


PIONEER = pioneer_3dx()  # one for all robots, whose plants are then built once


def robot(trajectory: Trajectory, **changes: Any) -> Lockstep:
    """The scenario's robot at its start, at rest; its plant is the model."""
    return Lockstep(RobotSettings(PIONEER, np.array([*trajectory.pose0, 0.0, 0.0]), SLEW, **changes))


@cache
def sampled(trajectory: Trajectory, period_s: float, heading: Heading) -> Array:
    """Rows of one trajectory, whose consistent heading is integrated once for all who follow it."""
    y = rows(trajectory, period_s, heading, psi0=trajectory.pose0[2])
    y.setflags(write=False)
    return y


def reference(trajectory: Trajectory, heading: Heading = "none", *, period_ms: int = 20, stamp_ns: int = 0, epoch: int = 1) -> Reference:
    y = sampled(trajectory, 1e-3 * period_ms, heading)
    return Reference(epoch, 1, stamp_ns, period_ms * MS, trajectory.end, y, np.zeros((len(y), 0)))


@dataclass
class Run:
    """What happened, one row per state: true state and acting input; and each command."""

    t_s: list[float] = field(default_factory=list)
    x: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def error_mm(self, trajectory: Trajectory) -> Array:
        """Distance of the plant's true position to the analytic reference at every state."""
        t = np.array(self.t_s)
        return 1e3 * np.hypot(*(np.array(self.x)[:, :2] - trajectory.position(t)).T)


def drive(
    controller: Controller,
    body: Lockstep,
    duration_s: float,
    *,
    latency_s: float = 0.0,
    sees: Callable[[State], State | None] = lambda state: state,
    run: Run | None = None,
    local_0_ns: int = 0,
    rate: float = 1.0,
) -> Run:
    """
    Close the loop until a robot time.

    Args:
        controller: It has its reference already.
        body: The robot.
        duration_s: Robot time to stop at.
        latency_s: From a state to the arrival of its command.
        sees: What becomes of a state on its way: itself, another one, or None for a lost one.
        run: A run to go on with.
        local_0_ns: Local time when the robot's clock is 0.
        rate: Robot seconds per local second.
    """
    run = Run() if run is None else run
    while body.now_ns < round(1e9 * duration_s):
        state = body.tick()
        run.t_s.append(1e-9 * body.now_ns)
        run.x.append(body.x.copy())
        run.u.append(body.u.copy())
        seen = sees(state)
        local_ns = local_0_ns + round(body.now_ns / rate)
        command = controller.receive_state(seen, local_ns) if seen is not None else controller.tick(local_ns)
        if command is not None:
            run.commands.append(command)
            if reason := body.accept(command, body.now_ns + round(1e9 * latency_s)):
                run.refused.append(reason)
            controller.commit(command)
            controller.prepare()
            while not controller.second_opinion():
                pass
    return run


def codes(controller: Controller) -> list[str]:
    return [notice.code for notice in controller.notices()]


def modes(run: Run) -> list[Mode]:
    return [command.mode for command in run.commands]


def assert_inside_slew(run: Run, excess: float = 1e-12) -> None:
    """What acts changes by no more than the slew limits from sample to sample, nor do the rows of any plan."""
    for inputs in (np.array(run.u).reshape(-1, 2), *(command.u for command in run.commands)):
        assert np.all(np.abs(np.diff(inputs, axis=0)) <= (1 + excess) * STEP)
