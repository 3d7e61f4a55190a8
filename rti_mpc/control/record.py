# SPDX-License-Identifier: Apache-2.0
"""Telemetry of one sample, assembled after its command has left."""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.codegen import bind
from rti_mpc.contract.message import Command, Telemetry
from rti_mpc.control.ladder import Ladder
from rti_mpc.control.opinions import Opinion
from rti_mpc.control.tuning import Tuning
from rti_mpc.rti.rti import Rti


class Record:
    """The plan behind the last command, kept before preparation overwrites it."""

    def __init__(self, rti: Rti, tuning: Tuning) -> None:
        self._rti = rti
        self._tuning = tuning
        self._seq = 0  # of the command whose plan is kept
        self._plan = (rti.x.copy(), rti.y_ref.copy(), 0.0)  # states, reference, cost
        self._version = 0  # of the parameters
        model = rti.ocp.model
        self._x0, self._u_prev, self._p, self._y = np.zeros(model.nx), np.zeros(model.nu), np.zeros(model.np_), np.zeros(model.ny)
        self._outputs = bind(model.outputs_at(), {"x": self._x0, "u": self._u_prev, "p": self._p}, {"y": self._y})

    def keep_plan(self, seq: int) -> None:
        """Keep the plan of a command, by its sequence number, unless it is kept already."""
        if self._seq != seq:
            self._plan = (self._rti.x.copy(), self._rti.y_ref.copy(), self._rti.cost)
            self._seq, self._version = seq, self._tuning.version
            self._p[:], self._u_prev[:] = self._rti.p[0], self._rti.u_prev

    def telemetry(
        self,
        command: Command,
        rows: Array,
        x0: Array,
        d: Array,
        times: tuple[float, float, float, float, float],
        opinion: Opinion,
        *,
        delay_s: float,
        skipped: int,
        ladder: Ladder,
    ) -> Telemetry:
        """
        Return the telemetry of the last command's sample.

        Args:
            command: Command of the sample, as it was sent.
            rows: All rows of its plan, shape ``(N, nu)``, also those that were not sent.
            x0: State embedded at stage 0, shape ``(nx,)``.
            d: Estimated disturbances, shape ``(nd,)``.
            times: Preparation, feedback and latency, us, slack, s, and second opinion, us.
            opinion: Second opinion about the plan before.
            delay_s: Delay from a state to the time at which its command acts, s.
            skipped: Samples skipped since start.
            ladder: Samples without a plan of their own.
        """
        self.keep_plan(command.seq)
        self._x0[:] = x0
        self._outputs()
        solver = self._rti.solver
        prepare_us, feedback_us, latency_us, slack_s, second_us = times
        return Telemetry(
            epoch=command.epoch,
            seq=command.seq,
            stamp_ns=command.stamp_ns,
            state_seq=command.state_seq,
            state_stamp_ns=command.state_stamp_ns,
            mode=command.mode,
            status=command.status,
            iterations=solver.iterations,
            res_prim=solver.res_prim,
            res_dual=solver.res_dual,
            cost=self._plan[2],
            violation=self._rti.violation,
            prepare_us=prepare_us,
            feedback_us=feedback_us,
            latency_us=latency_us,
            state_age_s=1e-9 * (command.stamp_ns - command.state_stamp_ns),
            slack_s=slack_s,
            skipped=skipped,
            fallbacks=ladder.fallbacks,
            parameter_version=self._version,
            x0=x0.copy(),
            x=self._plan[0],
            u=rows,
            y_ref=self._plan[1],
            d=d.copy(),
            delay_s=delay_s,
            softened=ladder.softened,
            shifted=ladder.shifted,
            braked=ladder.braked,
            rested=ladder.rested,
            y=self._y.copy(),
            second_seq=opinion.seq,
            second_status=opinion.status,
            second_difference=opinion.difference,
            second_iterations=opinion.iterations,
            second_us=second_us if opinion.seq else 0.0,
        )
