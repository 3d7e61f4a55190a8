# SPDX-License-Identifier: Apache-2.0
"""
Plan of one sample: the QP is prepared for the time at which the command acts, and solved from the state predicted there.

The plan is brought inside the envelope of the inputs before anyone else sees it.
"""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.control.assembly import Assembly
from rti_mpc.kept import Kept

ITERATIONS_COLD = 3  # iterations of the first sample, whose guess is one state and one input at all stages


class Planner:
    """
    Planner of one robot.

    Attributes:
        loaded: Whether the QP of the next sample is prepared.
        reach: Lowest and highest first two rows of the plan, each of shape ``(2, nu)``.
    """

    def __init__(self, parts: Assembly) -> None:
        """Begin with no QP."""
        rti, track, prediction, envelope = parts.rti, parts.track, parts.prediction, parts.envelope
        self.loaded = False
        self._x0 = prediction.x
        self._rti, self._track, self._sent, self._prediction, self._envelope, self._tuning = (
            rti,
            track,
            parts.sent,
            prediction,
            envelope,
            parts.tuning,
        )
        self._d, self._robot, self._estimates = parts.states.d, parts.robot, parts.states.estimates
        self._np, self._dt_ns = rti.ocp.model.np_ - len(self._d), parts.grid.dt_ns  # the last parameters of the model are estimated disturbances
        # What nothing depends on is neither looked up nor handed on.
        self._p = track.p if rti.ocp.model.np_ else None
        self._remembers = len(rti.ocp.soft_ddu) > 0
        nu = rti.ocp.model.nu
        self.reach: tuple[Array, Array] = (np.zeros((2, nu)), np.zeros((2, nu)))
        self._kept = Kept((*rti.rehearsed, *prediction.written, *envelope.written))

    def load(self, act_ns: int, *, shift: bool) -> None:
        """Look the reference up, and load the QP of a command that acts at a time, at the last plan, shifted by a stage or as it is."""
        self._look_up(act_ns)
        self._load(act_ns, shift=shift)

    def _load(self, act_ns: int, *, shift: bool) -> None:
        """Load the QP, with the reference that was looked up."""
        self.reach = self._sent.reach(act_ns)
        u_prev = self._sent.u_prev
        u_before = self._sent.at(act_ns - 1 - self._dt_ns)[0] if self._remembers else None
        self._tuning.follow(u_prev)
        self._rti.prepare(self._track.y_ref, self._p, shift=shift, u_prev=u_prev, u_before=u_before)
        self.loaded = True

    def _look_up(self, act_ns: int) -> None:
        """Look the reference up, and with it the parameters of the robot."""
        track = self._track
        track.look_up(act_ns)
        if self._estimates:
            track.p[:, self._np :] = self._d
        for p in self._robot:
            p[:] = track.p[0, : len(p)]

    def plan(self, x: Array, stamp_ns: int, act_ns: int) -> tuple[QpStatus, Array | None]:
        """
        Return the outcome of the QP, and the plan inside its limits, shape ``(N, nu)``; None if there is no plan.

        Args:
            x: State, shape ``(nx,)``.
            stamp_ns: Its time.
            act_ns: When the plan begins to act: that of the last `load`, if one is loaded.
        """
        if not self.loaded:
            self._look_up(act_ns)
        self._prediction.predict(x, stamp_ns, act_ns)
        status = self._rti.feedback(self._x0) if self.loaded else self._feedback_cold(act_ns)
        if not status.usable:
            return status, None
        rows = self._envelope.fit(self._rti.u, self.reach)
        return status, rows if self._envelope.finite else None

    def _feedback_cold(self, act_ns: int) -> QpStatus:
        """Solve the first sample, whose reference was looked up: the guess is the present state at all stages, and is iterated on."""
        self._rti.reset(self._x0, self._sent.at(act_ns - 1)[0])
        self._tuning.begin()
        status = QpStatus.FAILED
        for _ in range(ITERATIONS_COLD):
            self._load(act_ns, shift=False)
            status = self._rti.feedback(self._x0)
        return status

    def rehearse(self, x: Array, stamp_ns: int, act_ns: int) -> Array:
        """Do what `plan` mostly does, and return rows of the same shape; whatever that overwrites is put back."""
        with self._kept:
            self._prediction.predict(x, stamp_ns, act_ns)
            self._rti.rehearse(self._x0)
            return self._envelope.fit(self._rti.u, self.reach)
