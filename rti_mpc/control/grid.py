# SPDX-License-Identifier: Apache-2.0
"""
The grid in time on which commands act: it follows the robot's states.

The command of a sample acts at :math:`t_k`, the delay `d` after its state. The next
sample is due with the first state that is stamped :math:`t_k + dt - d - T/2` or later,
where `T` is the period of the states. So jitter, drift and faster states neither skip
nor double a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rti_mpc import given
from rti_mpc.errors import OcpError

MAX_LATENESS_PERIODS = 0.75  # a command may leave this long after the time at which it acts; the rest of the period is left to its transport
MAX_DELAY_PERIODS = 3  # the largest delay that is measured
DELAY_MARGIN_PERIODS = 1 / 8  # added to a measured delay
DELAY_SLEW_SAMPLES = 40  # samples that the delay takes to change by one period


@dataclass(frozen=True)
class Timing:
    """
    Delays and timeouts, in the robot's time.

    Attributes:
        delay_s: Delay from a state to the time at which its command acts, s; None to measure it.
        stale_s: Age from which a state is not used, s.
        valid_s: Time after its state, and after the delay, for which a command is valid, s.

    Raises:
        OcpError: One is no number, or out of range.
    """

    delay_s: float | None = 0.0
    stale_s: float = 0.225
    valid_s: float = 0.25

    def __post_init__(self) -> None:
        """Check the times."""
        if self.delay_s is not None and not 0.0 <= given.number("delay_s", self.delay_s) < math.inf:
            raise OcpError(f"delay_s must be a time of at least 0 s, or None, got {self.delay_s}")
        for name in ("stale_s", "valid_s"):
            if not 0.0 < given.number(name, value := getattr(self, name)) < math.inf:
                raise OcpError(f"{name} must be a time above 0 s, got {value}")


class Grid:
    """
    Times at which commands act, in ns of the robot's clock.

    Attributes:
        act_ns: Time t_k at which the next command acts; until `advance`, that of the last command.
        delay_ns: Delay d from a state to the time at which its command acts.
        dt_ns: Period of the commands.
        most_ns: Largest delay.
        running: Whether there is a grid: not before the first sample, nor after a gap.
        skipped: Samples skipped since start.
    """

    def __init__(self, dt_s: float, timing: Timing) -> None:
        self.dt_ns = round(1e9 * dt_s)
        self.delay_ns = round(1e9 * (timing.delay_s or 0.0))
        self.most_ns = self.delay_ns if timing.delay_s is not None else MAX_DELAY_PERIODS * self.dt_ns
        self.act_ns = 0
        self.running = False
        self.skipped = 0

    def early(self, stamp_ns: int, period_ns: float) -> bool:
        """Whether a state comes before the one that the next sample is due with; `period_ns` is the period of the states."""
        return self.running and self.act_ns - self.delay_ns - stamp_ns > period_ns / 2

    def too_late(self, late_ns: int) -> bool:
        """Whether a command that leaves this long after its time would arrive after its first row is over."""
        return late_ns >= MAX_LATENESS_PERIODS * self.dt_ns

    def behind(self, stamp_ns: int) -> int:
        """Return how many samples were missed when this state arrives."""
        return max(0, round((stamp_ns + self.delay_ns - self.act_ns) / self.dt_ns)) if self.running else 0

    def catch_up(self, samples: int, stamp_ns: int) -> None:
        """Skip samples that were missed; the next command acts no earlier than its state plus the delay."""
        self.act_ns = max(self.act_ns + samples * self.dt_ns, stamp_ns + self.delay_ns)

    def start(self, stamp_ns: int) -> None:
        """Start the grid at a state."""
        self.act_ns = stamp_ns + self.delay_ns
        self.running = True

    def advance(self, stamp_ns: int, period_ns: float) -> None:
        """Go on to the next sample, after one that answered this state; a state later than jitter explains does not move the grid."""
        offset_ns = stamp_ns + self.delay_ns - self.act_ns
        self.act_ns += self.dt_ns + (offset_ns if abs(offset_ns) <= period_ns / 2 else 0)

    def adapt(self, delay_ns: int) -> None:
        """Move the delay towards a measured one plus a margin, slowly enough that commands do not jump."""
        change_ns, wanted_ns = self.dt_ns // DELAY_SLEW_SAMPLES, min(max(delay_ns, 0) + int(DELAY_MARGIN_PERIODS * self.dt_ns), self.most_ns)
        self.delay_ns += min(max(wanted_ns - self.delay_ns, -change_ns), change_ns)
