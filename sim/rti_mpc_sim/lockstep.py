# SPDX-License-Identifier: Apache-2.0
"""
Robot without clock and network: plant, actuators and sensors, advanced by the caller.

It serves to test closed loops step by step; the process `rti_mpc_sim.robot` adds a
clock and the bus::

    robot = Lockstep(settings)
    while robot.now_ns < duration_ns:
        state = robot.tick()              # what the robot sends at this instant
        command = controller(state)       # any controller
        robot.accept(command)             # arrives at once, or when told
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, State
from rti_mpc.wire.actuator import Actuator, Counters
from rti_mpc_sim.plant import plant
from rti_mpc_sim.sensor import UNREPORTED, Sensor
from rti_mpc_sim.settings import RobotSettings


class Lockstep:
    """
    One robot, from a time on, 0 by default.

    Attributes:
        now_ns: Robot time.
        epoch: Epoch of its states.
        x: True state, shape ``(nx,)``; angles do not wrap. Overwritten as time advances.
        u: Input that has acted up to now, after the lag, shape ``(nu,)``. Overwritten as time advances.
        actuator: Its actuators.
        sensor: Its sensors.
    """

    def __init__(self, settings: RobotSettings, epoch: int = 1, now_ns: int = 0) -> None:
        model = settings.model
        rotations = model.rotations("states")
        self.now_ns = now_ns
        self.epoch = epoch
        self.period_ns = settings.state_period_ns
        self.actuator = Actuator(
            np.array(model.u_rest),
            settings.slew,
            epoch,
            round(1e9 * settings.actuator_delay_s),
            (settings.lbu, settings.ubu),
            settings.increments,
            rotations,
        )
        self.sensor = Sensor(epoch, settings.noise_std, rotations, round(1e9 * settings.sensor_delay_s), settings.dropout, settings.seed)
        self._plant = plant(model, settings.x0, settings.state_period_s, settings.substeps, settings.actuator_lag_s)
        self.x: Array = self._plant.x
        self.u: Array = self._plant.u
        self._reports_inputs = settings.reports_inputs
        self._next_ns = now_ns

    @property
    def counters(self) -> Counters:
        """What became of commands."""
        return self.actuator.counters

    @property
    def due_ns(self) -> int:
        """When the robot next measures or sends a state."""
        return min(self._next_ns, self.sensor.due_ns)

    def accept(self, command: Command, arrival_ns: int | None = None) -> str:
        """Receive a command at `arrival_ns`, now if None; return the reason if it is refused, else an empty string."""
        return self.actuator.accept(command, self.now_ns if arrival_ns is None else arrival_ns)

    def advance(self, to_ns: int) -> None:
        """Integrate up to a time, separately over each interval of constant input."""
        for until_ns, u in self.actuator.play(self.now_ns, to_ns):
            self._plant.advance(u, 1e-9 * (until_ns - self.now_ns))
            self.now_ns = until_ns

    def measure(self) -> int | None:
        """Measure the state if it is due, and return its sequence number; missed times are skipped."""
        if self.now_ns < self._next_ns:
            return None
        self._next_ns = (self.now_ns // self.period_ns + 1) * self.period_ns
        return self._measure()

    def _measure(self) -> int:
        actuator = self.actuator
        acting = (actuator.u, *actuator.source) if self._reports_inputs else UNREPORTED
        seq = self.sensor.measure(self.x, self.now_ns, *acting)
        actuator.measure(self.sensor.x, self.now_ns)
        return seq

    def place(self, x: Array, now_ns: int) -> None:
        """Advance to a time, and go on from another state there, shape ``(nx,)``; what is measured then reaches nobody."""
        self.advance(now_ns)
        self._plant.place(x)
        self._measure()
        self.sensor.take(now_ns)

    def state_at(self, stamp_ns: int) -> State:
        """Advance to a time, and return the state that is measured then, whatever the period; of a robot that loses and delays no state."""
        self.advance(stamp_ns)
        self._measure()
        state = self.sensor.take(stamp_ns)
        assert state is not None
        return state

    def tick(self) -> State:
        """Advance to the next state that is not lost, and return it."""
        while True:
            self.advance(max(self.now_ns, self.due_ns))
            self.measure()
            if (state := self.sensor.take(self.now_ns)) is not None:
                return state
