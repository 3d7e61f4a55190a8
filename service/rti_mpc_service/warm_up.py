# SPDX-License-Identifier: Apache-2.0
"""Warm-up of a real-time iteration: fills caches and branch predictors before the first real sample."""

from __future__ import annotations

from rti_mpc.rti.rti import Rti

WARM_UP_SOLVES = 20  # before the first command: the first real sample must not be the first call


def warm_up(rti: Rti) -> None:
    """Solve a few samples of a robot that begins at rest and does what the plan says: one held in place would fall in its plans, out of all range."""
    x0 = rti.x_nominal.copy()
    rti.reset(x0, rti.u_prev.copy())
    for _ in range(WARM_UP_SOLVES):
        rti.prepare(rti.y_ref.copy())
        rti.feedback(x0)
        x0[:] = rti.x[1]
