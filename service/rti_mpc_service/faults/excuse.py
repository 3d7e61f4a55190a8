# SPDX-License-Identifier: Apache-2.0
"""
Excuses: the part of an incident that delays of the host alone explain, by its witness.

A time may be longer by the time for which the host held the processes up meanwhile. A
missed sample is explained if they were held up, around the time at which it was due,
for a share of a period that a host which is on time never takes. Such a sample lets
the robot's error be larger by as much as its reference moves in that period.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from rti_mpc_service.faults.measure import Incident, Measured
from rti_mpc_service.faults.promise import Promise

HELD_UP_SHARE = 0.25  # a sample takes a fiftieth of a period, and is missed when it takes a whole one
START_OF_TIME = {"brake_s": "fault_ns", "zero_s": "fault_ns", "still_s": "fault_ns", "recovery_s": "mend_ns"}  # instant from which each is counted

Between = Callable[[int, int], float]


def excuses(
    measured: Measured, missed_ns: NDArray[np.int64], incident: Incident, period_ns: int, *, held_up_ms: Between, moved_m: Between
) -> dict[str, float]:
    """
    Return by how much the host excuses each number that it may have made larger.

    Args:
        measured: The robot's reaction.
        missed_ns: Times at which the missed samples were due, shape ``(n,)``.
        incident: Times of the incident.
        period_ns: Period of the controller.
        held_up_ms: Returns for how long the host held the processes up between two instants, ms. All instants are in robot time.
        moved_m: Returns how far the robot's reference moved between two instants, in the unit of the errors.
    """
    late_ns = [at for at in missed_ns.tolist() if held_up_ms(at - period_ns, at + period_ns) > 1e-6 * HELD_UP_SHARE * period_ns]
    excused = {"missed": float(len(late_ns)), "error_m": sum(moved_m(at, at + period_ns) for at in late_ns)}
    for name, begin in START_OF_TIME.items():
        if (took_s := getattr(measured, name)) is not None:
            excused[name] = 1e-3 * held_up_ms(getattr(incident, begin), getattr(incident, begin) + round(1e9 * took_s))
    return excused


def explained(promise: Promise, measured: Measured, excused: Mapping[str, float]) -> list[str]:
    """Return, in words, what breaks a promise without the excuses but not with them."""
    broken = promise.broken(measured, excused)
    return [f"{words}, of which the host explains {excused[words.split()[0]]:.3g}" for words in promise.broken(measured) if words not in broken]
