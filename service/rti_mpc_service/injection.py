# SPDX-License-Identifier: Apache-2.0
"""
Failures on request, for testing each rung of the fallback ladder; enabled by ``debug.inject`` of the configuration.

They happen inside the real-time iteration, as real failures do; the controller does not know of them.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti.rti import Rti

FAILURES = {
    "solver": "the first solver finds nothing: another one must, with softened bounds",
    "qp": "no solver finds anything",
    "nan_model": "the model gives NaN",
    "gradient": "the first solver takes a gradient of the cost that is too large, and its certificate with it: only the second opinion can tell",
    "over_budget": "a sample takes one and a half periods, of wall time",
}
OVER_BUDGET_PERIODS = 1.5  # duration of a sample that exceeds its budget
GRADIENT_ERROR = 1.5  # factor of the wrong gradient
MAX_FAILING_SAMPLES = 10_000  # per request


class FaultyRti(Rti):
    """A real-time iteration that fails on request."""

    _failure = ""
    _left = 0  # remaining samples that fail
    _failing = ""  # failure of the present sample; empty: none

    def inject(self, request: dict[str, Any]) -> dict[str, Any]:
        """Let the next samples fail as a request says, and return the answer."""
        failure, samples = request.get("failure"), request.get("samples", 1)
        if failure not in FAILURES:
            return {"ok": False, "error": f"failure must be one of {', '.join(FAILURES)}, got {failure!r}"}
        if type(samples) is not int or not 1 <= samples <= MAX_FAILING_SAMPLES:
            return {"ok": False, "error": f"samples must be a whole number from 1 to {MAX_FAILING_SAMPLES}, got {samples!r}"}
        self._failure, self._left = failure, samples
        return {"ok": True, "request": "inject", "failure": failure, "samples": samples}

    def _begin(self) -> None:
        """Begin a sample."""
        self._failing = self._failure if self._left else ""
        self._left = max(0, self._left - 1)

    def reset(self, x0: Array, u_prev: Array) -> None:
        """As `Rti.reset`."""
        self._begin()
        super().reset(x0, u_prev)

    def prepare(
        self, y_ref: Array, p: Array | None = None, *, shift: bool = True, u_prev: Array | None = None, u_before: Array | None = None
    ) -> None:
        """As `Rti.prepare`."""
        if shift:
            self._begin()
        super().prepare(y_ref, p, shift=shift, u_prev=u_prev, u_before=u_before)
        if self._failing == "nan_model":  # what it predicts, and whatever is linearized there, with parameters or without
            self.guess.sample["x"][1:] = np.nan
            self._linearize()
        if self._failing == "gradient":
            self._linearize()

    def _linearize(self) -> None:
        """As `Rti._linearize`; a wrong gradient is that of another reference, which nobody else sees."""
        right = self.y_ref.copy()
        if self._failing == "gradient":
            y = np.array(self.ocp.model.h().map(self.ocp.N)(self.guess.sample["x"][1:, : self.ocp.model.nx].T, self.p[1:].T)).T
            self.y_ref[:] = y + GRADIENT_ERROR * (right - y)
        super()._linearize()
        self.y_ref[:] = right

    def feedback(self, x0: Array) -> QpStatus:
        """As `Rti.feedback`."""
        if self._failing == "over_budget":
            time.sleep(OVER_BUDGET_PERIODS * self.ocp.dt)
        return super().feedback(x0)

    def solve(self) -> QpStatus:
        """As `Rti.solve`."""
        if self._failing not in ("solver", "qp"):
            return super().solve()
        if self.active_set is None:
            self.use_whole_qp()
        status = self.solve_qp() if self._failing == "solver" else QpStatus.INFEASIBLE
        if not status.usable:
            self.keep_guess()
        return status


def answer(rti: Rti, request: dict[str, Any]) -> dict[str, Any]:
    """Answer a request for failures, whether they are enabled or not."""
    if isinstance(rti, FaultyRti):
        return rti.inject(request)
    return {"ok": False, "error": "inject must be enabled in the configuration, with debug.inject = true, got false"}
