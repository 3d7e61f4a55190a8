# SPDX-License-Identifier: Apache-2.0
"""
The grid in time on which commands act: it follows the robot's states.

A sample's command acts at :math:`t_k`, `d` after its state. The next sample is
due with the first state stamped :math:`t_k + dt - d - h` or later, `h` being half
the period of the states, so that jitter, drift and faster states neither skip
nor double one.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_LATENESS_PERIODS = 0.75  # a command may leave this long after the time at which it acts; the rest of the period is left to its transport
MAX_DELAY_PERIODS = 3  # the largest delay that is measured
DELAY_MARGIN_PERIODS = 1 / 8  # added to a measured delay
DELAY_SLEW_SAMPLES = 40  # samples that the delay takes to change by one period


@dataclass(frozen=True)
class Timing:
    """
    Delays and timeouts, in the robot's time.

    Attributes:
        delay_s: From a state to the act of its command, s; None: measured.
        stale_s: Age from which a state is not used, s.
        valid_s: How long after its state, and the delay, a command may act, s.
    """

    delay_s: float | None = 0.0
    stale_s: float = 0.225
    valid_s: float = 0.25


class Grid:
    """
    When commands act. All times are the robot's, in ns.

    Attributes:
        act_ns: When the next command acts, or the last one before `advance`: t_k.
        delay_ns: From a state to the act of its command: d.
        dt_ns: Period of the commands.
        most_ns: What the delay may be at most.
        running: Whether there is a grid: not before the first sample, nor after a gap.
    """

    def __init__(self, dt_s: float, timing: Timing) -> None:
        self.dt_ns = round(1e9 * dt_s)
        self.delay_ns = round(1e9 * (timing.delay_s or 0.0))
        self.most_ns = self.delay_ns if timing.delay_s is not None else MAX_DELAY_PERIODS * self.dt_ns
        self.act_ns = 0
        self.running = False

    def early(self, stamp_ns: int, period_ns: float) -> bool:
        """Whether a state comes before the next sample's; `period_ns` is that of the states."""
        return self.running and self.act_ns - self.delay_ns - stamp_ns > period_ns / 2

    def too_late(self, late_ns: int) -> bool:
        """Whether a command that leaves by so much after its time is not there before its first row is over."""
        return late_ns >= MAX_LATENESS_PERIODS * self.dt_ns

    def behind(self, stamp_ns: int) -> int:
        """Samples that a state shows to have been missed."""
        return max(0, round((stamp_ns + self.delay_ns - self.act_ns) / self.dt_ns)) if self.running else 0

    def catch_up(self, samples: int, stamp_ns: int) -> None:
        """Leave out samples that were missed; the next command acts not before its state, and the delay."""
        self.act_ns = max(self.act_ns + samples * self.dt_ns, stamp_ns + self.delay_ns)

    def start(self, stamp_ns: int) -> None:
        """Begin anew with a state."""
        self.act_ns = stamp_ns + self.delay_ns
        self.running = True

    def advance(self, stamp_ns: int, period_ns: float) -> None:
        """Go on to the next sample, after one that answered this state; what is late beyond jitter does not move the grid."""
        offset_ns = stamp_ns + self.delay_ns - self.act_ns
        self.act_ns += self.dt_ns + (offset_ns if abs(offset_ns) <= period_ns / 2 else 0)

    def adapt(self, delay_ns: int) -> None:
        """Let the delay come nearer to a measured one, by little enough that nothing jumps; a command rather waits a little than comes too late."""
        change_ns, wanted_ns = self.dt_ns // DELAY_SLEW_SAMPLES, min(max(delay_ns, 0) + int(DELAY_MARGIN_PERIODS * self.dt_ns), self.most_ns)
        self.delay_ns += min(max(wanted_ns - self.delay_ns, -change_ns), change_ns)
