# SPDX-License-Identifier: Apache-2.0
"""Status of a QP and mode of the controller: the two small enumerations that travel on the wire."""

from __future__ import annotations

from enum import IntEnum

DISAGREEMENT = 1e-3  # difference of two solvers' plans from which on they disagree, relative to half an input's range


class QpStatus(IntEnum):
    """
    Outcome of one QP. Mapped from the solver's own codes in `rti_mpc.rti.qp.osqp` only.

    Attributes:
        usable: Whether the iterate may be commanded and may seed the next sample.
    """

    SOLVED = 0
    INACCURATE = 1
    MAX_ITER = 2
    TIME_LIMIT = 3
    INFEASIBLE = 4
    FAILED = 5
    NONE = 6  # no QP was solved for this command

    def __init__(self, _: int) -> None:
        """Work out what every sample asks for: an attribute takes a tenth of the time of a property that compares members."""
        self.usable = self.name in ("SOLVED", "INACCURATE", "MAX_ITER")


class Mode(IntEnum):
    """
    What the controller is doing, one lane in the viewer.

    Attributes:
        planned: Whether each sample has a plan of its own, and it is certain which inputs act.
    """

    IDLE = 0  # started, no state has arrived yet
    WAITING = 1  # a state has arrived, but no reference
    TRACKING = 2  # solving along the reference
    HOLDING = 3  # the reference ended with HOLD: solving around its last row
    FALLBACK = 4  # no plan for this sample: the shifted previous plan is played
    BRAKING = 5  # ramping to standstill inside the slew limits
    STOPPED = 6  # stopped by an operator until `enable`

    def __init__(self, _: int) -> None:
        """Work out what every sample asks for."""
        self.planned = self.name in ("TRACKING", "HOLDING")
