# SPDX-License-Identifier: Apache-2.0
"""Telemetry of one sample, assembled after its command has left."""

from __future__ import annotations

import numpy as np

from rti_mpc.codegen import bind
from rti_mpc.contract.message import Telemetry
from rti_mpc.control.assembly import Assembly
from rti_mpc.control.opinions import Opinion


class Record:
    """The plan behind the last command, kept before preparation overwrites it."""

    def __init__(self, parts: Assembly) -> None:
        rti = parts.rti
        self._rti, self._tuning, self._issued, self._ways, self._states = rti, parts.tuning, parts.issued, parts.ways, parts.states
        self._grid, self._ladder, self._embedded = parts.grid, parts.ladder, parts.prediction.x
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

    def telemetry(self, times: tuple[float, float, float, float, float], opinion: Opinion) -> Telemetry:
        """
        Return the telemetry of the last command's sample.

        Args:
            times: Preparation, feedback and latency, us, slack, s, and second opinion, us.
            opinion: Second opinion about the plan before.
        """
        command, grid, ladder = self._issued.last, self._grid, self._ladder
        assert command is not None
        rows = command.u if self._ways is None else np.concatenate([command.u, self._ways.rows[len(command.u) :]])  # also those that were not sent
        self.keep_plan(command.seq)
        self._x0[:] = self._embedded
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
            skipped=grid.skipped,
            fallbacks=ladder.fallbacks,
            parameter_version=self._version,
            x0=self._x0.copy(),
            x=self._plan[0],
            u=rows,
            y_ref=self._plan[1],
            d=self._states.d.copy(),
            delay_s=1e-9 * grid.delay_ns,
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
