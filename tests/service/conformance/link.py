# SPDX-License-Identifier: Apache-2.0
"""A robot in lockstep, as a link for its conformance test."""

from __future__ import annotations

from collections.abc import Callable

from rti_mpc.contract.message import Command, State
from rti_mpc.contract.schedule import unfit
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.received import Received
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

MS = 1_000_000
EPOCH = 7


def as_it_is(command: Command) -> Command:
    return command


class LockstepLink:
    """A robot without a clock, to which each command takes 2 ms; `take` may change it on its way to the actuators."""

    def __init__(self, settings: RobotSettings, take: Callable[[Command], Command] = as_it_is, fits: bool = True) -> None:
        nx, nu = settings.model.nx, settings.model.nu
        self.robot = Lockstep(settings, EPOCH)
        self._take = take
        self._intake = Intake(Command, 0.25, unfit=lambda command: unfit(command, nu, EPOCH, nx) if fits else "")

    def states(self) -> list[State]:
        return [self.robot.tick()]

    def put(self, command: Command | bytes) -> None:
        payload = command if isinstance(command, bytes) else encode(command)
        taken = self._intake.accept(Received(payload, encoding(Command), "command"), self.robot.now_ns)
        if taken is not None:
            self.robot.accept(self._take(taken), self.robot.now_ns + 2 * MS)
