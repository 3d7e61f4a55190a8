# SPDX-License-Identifier: Apache-2.0
r"""
Measurement of a robot's reaction to a fault, from its own record alone.

The record has the inputs that acted and the true positions, in robot time. A
ramp to rest that begins at :math:`t_0` inside the slew limits :math:`\dot u_{max}`
ends at

.. math::

    t_z = t_0 + \max_i |u_i(t_0)| / \dot u_{max, i} ,

so braking begins with the first step towards rest from which rest is reached about
when the slew limits allow: slowing down along a path comes before that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.schedule import RAMP_STEP_NS
from rti_mpc_service.rig.robot_log import RobotLog

STANDSTILL_SPEED_M_S = 1e-3
REST_SHARE = 1e-3  # of what rounding may do to an input, by which it deviates from rest at most: robots ramp to it exactly
MAX_RAMP_LATENESS_S = 0.02  # how far a ramp may lag behind one that began in time: two steps of 10 ms
MAX_RAMP_STRETCH = 1.5  # a ramp composed of several may take this factor longer than the slew limits need
MIN_RAMP_STEP_SHARE = 0.09  # least first step of a ramp, as a share of a period's largest change: just under a step of 10 ms in a period of 0.1 s
MAX_FRESH_AGE_S = 0.25  # age up to which a state may be answered

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Incident:
    """
    Times of a fault in robot time.

    Attributes:
        fault_ns: Just before the fault was injected.
        mend_ns: Just before it was mended.
        end_ns: End of the observation.
    """

    fault_ns: int
    mend_ns: int
    end_ns: int


@dataclass(frozen=True)
class Measured:
    """
    Reaction of a robot to a fault; None for what did not happen. Of robots that follow no path, m stands for the unit of their outputs.

    Attributes:
        speed_m_s: Speed at the fault.
        brake_s: From the fault to the first braking command.
        zero_s: From the fault to the command that is zero, and stays so until mended.
        still_s: From the fault to a true speed below 1 mm/s that stays so until mended.
        distance_m: Distance driven from the fault to the standstill, or until mended.
        stale: Number of rows in which, after rest, an input acted that answers no state that was fresh when mended.
        step_share: Largest step of an input, as a share of what it may change in a period; while braking, in any period.
        recovery_s: From mending to the first input other than rest, or to motion, whichever had ended; else to the first answered state.
        missed: Number of the controller's samples without a command for the robot, until mended.
        error_m: Largest distance from the reference until mended.
        final_error_m: Distance from the reference when mended.
    """

    speed_m_s: float
    brake_s: float | None
    zero_s: float | None
    still_s: float | None
    distance_m: float
    stale: int
    step_share: float
    recovery_s: float | None
    missed: int
    error_m: float
    final_error_m: float


def measure(log: RobotLog, position: Array, error: Array, incident: Incident, limits: Limits) -> Measured:
    """
    Measure one incident.

    Args:
        log: The robot's record. It has a row between fault and mending.
        position: Where the robot was at each stamp, shape ``(M, k)``: in the plane in m, or outputs as `rti_mpc_service.faults.motion` has them.
        error: How far from its reference it was, shape ``(M,)``.
        incident: Times of the incident.
        limits: Limits of the inputs.
    """
    t = log.stamp_ns
    broken = (t >= incident.fault_ns) & (t <= incident.mend_ns)
    seen = (t >= incident.fault_ns) & (t <= incident.end_ns)
    moving: Mask = np.any(np.abs(log.u - limits.u_rest) > REST_SHARE * limits.tolerance, axis=1)
    way: Array = np.linalg.norm(np.diff(position, axis=0, prepend=position[:1]), axis=1)
    speed: Array = way / (1e-9 * np.diff(t, prepend=t[0] - 1))

    zero = settled(~moving, broken)
    brake = None if zero is None or zero == np.argmax(broken) else braking(log, limits, int(np.argmax(broken)), zero)
    still = settled(speed < STANDSTILL_SPEED_M_S, broken)
    again = moving if zero is not None else speed > STANDSTILL_SPEED_M_S if still is not None else np.isfinite(log.latency_us)
    driven = np.flatnonzero(again & seen & (t > incident.mend_ns))

    def after(instant_ns: int, row: int | None) -> float | None:
        return None if row is None else 1e-9 * float(t[row] - instant_ns)

    return Measured(
        speed_m_s=float(speed[broken][0]),
        brake_s=after(incident.fault_ns, brake),
        zero_s=after(incident.fault_ns, zero),
        still_s=after(incident.fault_ns, still),
        distance_m=float(way[broken & (still is None or t <= t[still])].sum()),
        stale=0 if zero is None else int((moving & (t > t[zero]) & (t < fresh_ns(log, incident))).sum()),
        step_share=max(step_share(log.u[seen], limits), 0.0 if zero is None or brake is None else ramp_share(log, limits, brake, zero)),
        recovery_s=after(incident.mend_ns, int(driven[0])) if driven.size else None,
        missed=len(missed_ns(log, incident, limits.dt_s)),
        error_m=float(error[broken].max()),
        final_error_m=float(error[broken][-1]),
    )


def settled(condition: Mask, window: Mask) -> int | None:
    """Return the row from which a condition holds up to the end of a window; None if it does not hold there."""
    rows = np.flatnonzero(window)
    broken = np.flatnonzero(~condition[rows])
    if not broken.size:
        return int(rows[0])
    return None if broken[-1] == len(rows) - 1 else int(rows[broken[-1] + 1])


def braking(log: RobotLog, limits: Limits, first: int, zero: int) -> int:
    """Return the row at which the ramp to rest that ends at row `zero` begins; see the module's docstring."""
    t_s = 1e-9 * (log.stamp_ns - log.stamp_ns[zero])
    left_s = (np.abs(log.u - limits.u_rest) / limits.step).max(axis=1) * limits.dt_s
    way = np.abs(log.u - limits.u_rest)
    for row in range(max(first, 1), zero):
        share = float(((way[row - 1] - way[row]) / limits.step).max())
        if share >= MIN_RAMP_STEP_SHARE and -t_s[row - 1] <= MAX_RAMP_STRETCH * left_s[row - 1] + MAX_RAMP_LATENESS_S:
            return row
    return zero


def fresh_ns(log: RobotLog, incident: Incident) -> int:
    """Return the first stamp of a state that was fresh when mended and answered afterwards; `end_ns` if there is none."""
    arrival_ns = log.stamp_ns + 1e3 * log.latency_us
    answered = log.stamp_ns[(log.stamp_ns >= incident.mend_ns - round(1e9 * MAX_FRESH_AGE_S)) & (arrival_ns >= incident.mend_ns)]
    return int(answered[0]) if answered.size else incident.end_ns


def step_share(u: Array, limits: Limits) -> float:
    """Return the largest change from row to row, as a share of the largest allowed change in a period."""
    return float((np.abs(np.diff(u, axis=0)) / limits.step).max()) if len(u) > 1 else 0.0


def ramp_share(log: RobotLog, limits: Limits, brake: int, zero: int) -> float:
    """
    Return the largest change in any period of a ramp to rest, as a share of the largest allowed change in a period.

    The window is one step shorter than a period: a ramp sent over the bus begins with the step that became due meanwhile.
    """
    t, share = log.stamp_ns[: zero + 1], 0.0
    for row in range(max(brake - 1, 0), zero):
        last = int(np.searchsorted(t, t[row] + 1e9 * limits.dt_s - RAMP_STEP_NS, side="right")) - 1
        share = max(share, float((np.abs(log.u[last] - log.u[row]) / limits.step).max()))
    return share


def missed_ns(log: RobotLog, incident: Incident, dt_s: float) -> NDArray[np.int64]:
    """Return the robot times at which missed samples were due, between answered states, shape ``(n,)``."""
    period_ns = 1e9 * dt_s
    near = (log.stamp_ns >= incident.fault_ns - 2 * period_ns) & (log.stamp_ns <= incident.mend_ns)
    stamps = log.stamp_ns[near & np.isfinite(log.latency_us)]
    silent_ns = incident.mend_ns - (stamps[-1] if stamps.size else incident.fault_ns)  # the last sample may still be in progress
    gaps = np.append(np.round(np.diff(stamps) / period_ns), silent_ns // period_ns)
    before = stamps if stamps.size else [incident.fault_ns]
    return np.concatenate([stamp + period_ns * np.arange(1, gap) for stamp, gap in zip(before, gaps, strict=True)]).astype(np.int64)
