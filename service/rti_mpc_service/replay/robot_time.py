# SPDX-License-Identifier: Apache-2.0
"""Time of a recording as users give it: seconds of the robot's clock, which lines, events, tables (`robot_s`) and the viewer have, too."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rti_mpc.errors import ConfigError
from rti_mpc.wire.layout import STAMP_LIMIT_NS
from rti_mpc_service.replay.rebuild import Journaled, entries

PRINTED_NS = 1_000_000  # what is printed is rounded to this


def parse_time(text: str | None) -> float | None:
    """
    Return a time such as ``72.5s`` in s.

    Raises:
        ConfigError: It is none.
    """
    try:
        time_s = None if text is None else float(text.removesuffix("s"))
    except ValueError:
        time_s = math.nan
    if time_s is not None and not math.isfinite(time_s):
        raise ConfigError(f"a time must be in seconds of the robot's clock, such as 72.5s, got {text}")
    return time_s


def first_stamp(time_s: float | None) -> int:
    """Return the first stamp that is meant by a time, which may have been read where it was rounded; None: by none, so that any stamp is."""
    return -STAMP_LIMIT_NS if time_s is None else round(1e9 * time_s) - PRINTED_NS // 2


def check_time(option: str, time_s: float, journals: Sequence[Journaled]) -> None:
    """
    Check that a time lies between the first and the last state or command of some controllers.

    Raises:
        ConfigError: It does not.
    """
    stamps = [entry.args[0].stamp_ns for journal in journals for entry in entries(journal) if entry.name in ("receive_state", "commit")]
    if not stamps or not min(stamps) - PRINTED_NS <= first_stamp(time_s) <= max(stamps):
        span = f"from {1e-9 * min(stamps):.3f} s to {1e-9 * max(stamps):.3f} s" if stamps else "which has no state"
        raise ConfigError(f"{option} must be a time of the robot's clock in the recording, {span}, got {time_s:.3f} s")
