# SPDX-License-Identifier: Apache-2.0
"""Sensor of the simulated robot: noise, delay and dropout, all from one seed."""

from __future__ import annotations

from collections import deque

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import State
from rti_mpc.rotation import Rotations

UNREPORTED: tuple[Array, int, int] = (np.zeros(0), 0, 0)  # input, command epoch and number of a state that reports no inputs


class Sensor:
    """
    Measures states and hands them out when they are due.

    A state that drops out uses up its sequence number, as one lost on a real
    link would. Angles wrap to (-pi, pi], and quaternions have w >= 0, as a real robot's do.

    Attributes:
        x: What was measured last, shape ``(nx,)``; the robot itself has it at once, lost or not.
    """

    def __init__(self, epoch: int, noise_std: Array, rotations: Rotations, delay_ns: int = 0, dropout: float = 0.0, seed: int = 1) -> None:
        """
        Prepare to measure.

        Args:
            epoch: Epoch of the states.
            noise_std: Standard deviations, shape ``(nx,)``.
            rotations: Among the states.
            delay_ns: Time from measuring to handing out.
            dropout: Share of states that are lost.
            seed: Seed of noise and dropout.
        """
        self._epoch = epoch
        self._noise_std = noise_std
        self._rotations = rotations
        self._delay_ns = delay_ns
        self._dropout = dropout
        self._random = np.random.default_rng(seed)
        self.x: Array = np.zeros(len(noise_std))
        self._seq = 0
        self._on_the_way: deque[State] = deque()

    @property
    def due_ns(self) -> int:
        """When the next state on the way is due; far in the future if there is none."""
        return self._on_the_way[0].stamp_ns + self._delay_ns if self._on_the_way else 2**63

    def measure(self, x: Array, stamp_ns: int, u: Array = UNREPORTED[0], command_epoch: int = 0, command_seq: int = 0) -> int:
        """
        Measure a state and put it on its way, unless it drops out.

        Args:
            x: True state, shape ``(nx,)``.
            stamp_ns: Robot time of the measurement.
            u: Input demanded from the actuators, before their lag, shape ``(nu,)``; empty: not reported.
            command_epoch: Epoch of the command that the input comes from.
            command_seq: Sequence number of that command; 0: the robot's own ramp.

        Returns:
            The sequence number of the state.
        """
        self._seq += 1
        measured = x + self._noise_std * self._random.standard_normal(len(x))
        self._rotations.wrap(measured)
        self.x = measured
        if self._random.random() >= self._dropout:
            self._on_the_way.append(State(self._epoch, self._seq, stamp_ns, measured, u.copy(), command_epoch, command_seq))
        return self._seq

    def take(self, now_ns: int) -> State | None:
        """Hand out the oldest state that is due, if any."""
        return self._on_the_way.popleft() if self.due_ns <= now_ns else None
