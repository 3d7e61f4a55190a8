# SPDX-License-Identifier: Apache-2.0
"""Rest of a robot as `check` prints it: its class, and how long and how far a stop takes."""

from __future__ import annotations

from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rest import Rest, RestClass, assess
from rti_mpc.rti.way_to_rest import StopLaw
from rti_mpc.signals import quantity

STATES = 1000  # of operation from which a robot is stopped
LETTERS = {RestClass.HOLDS: "a", RestClass.DRIFTS: "b", RestClass.UNSTABLE: "c"}


def stop_from_everywhere(ocp: Ocp, law: StopLaw | None, *, disturbed: bool = False) -> str:
    """
    Return in one line what a stop does to a robot, from many states of operation.

    Args:
        ocp: Its problem.
        law: What its way to rest is made with; None: its inputs ramp to rest.
        disturbed: Whether an observer estimates what disturbs it.

    Raises:
        OcpError: It does not come to rest from one of them.
    """
    ends = "; its disturbances are taken to end where it stands: if they are wind or current, observer.at_rest must say so"
    return rest_line(ocp.model, law, assess(ocp, law, STATES)) + (ends if disturbed and law is None else "")


def rest_line(model: Model, law: StopLaw | None, rest: Rest) -> str:
    """Return in one line what a stop does to a robot."""
    moved = [f"{signal.name} by {quantity(value, signal.unit)}" for signal, value in zip(model.states, rest.moved, strict=True) if value > 0.0]
    way = f", which moves {', '.join(moved)} at most" if moved else ""
    carried = "its inputs ramp to rest"
    if law is not None:
        carried = f"its commands carry {law.rows} rows of {law.period_s:g} s to rest{'' if law.holds else ', and a gain that keeps it there'}"
    if rest.alone:
        carried += f": without it, {rest.alone}"
    states = f"{rest.states} states" + (", disturbed up to its observer's limits," if law is not None and law.disturbances.size else "")
    return f"a stop: at rest it {rest.kind.value} ({LETTERS[rest.kind]}); from {states} within {rest.time_s:.3g} s{way}; {carried}"
