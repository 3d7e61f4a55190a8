# SPDX-License-Identifier: Apache-2.0
"""The robot's clock, as seen from here: the last stamp, and how fast stamps have lately come."""

from __future__ import annotations

WINDOW_NS = 1_000_000_000  # local time over which the rate is measured


class RobotClock:
    """
    Robot time from stamps and local monotonic arrival times.

    No clocks need to agree, and simulated time, slower or faster, works
    unchanged: timeouts are local time since arrival, times `rate`.

    Attributes:
        stamp_ns: Last stamp, robot time.
        arrival_ns: When it arrived, local monotonic time.
        rate: Robot seconds per local second; assumed low until measured, or a slow simulation would be taken for a dead robot.
        period_ns: Time between states, robot time, smoothed; 0 until two have come.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything: another life of the robot."""
        self.stamp_ns = 0
        self.arrival_ns = 0
        self.rate = 0.1
        self.period_ns = 0.0
        self._seq = 0
        self._anchor: tuple[int, int] | None = None

    def observe(self, seq: int, stamp_ns: int, arrival_ns: int) -> None:
        """Take note of a state's stamp and arrival."""
        if self._anchor is None:
            self._anchor = (stamp_ns, arrival_ns)
        elif stamp_ns > self.stamp_ns:
            period_ns = (stamp_ns - self.stamp_ns) / max(1, seq - self._seq)
            self.period_ns += (period_ns - self.period_ns) * (0.1 if self.period_ns else 1.0)
            elapsed_ns = arrival_ns - self._anchor[1]
            if elapsed_ns >= WINDOW_NS // 4:
                rate = (stamp_ns - self._anchor[0]) / elapsed_ns
                self.rate = min(max(rate, 1e-3), 1e3)
            if elapsed_ns >= WINDOW_NS:
                self._anchor = (stamp_ns, arrival_ns)
        self._seq, self.stamp_ns, self.arrival_ns = seq, stamp_ns, arrival_ns

    def now_ns(self, local_ns: int) -> int:
        """Return robot time at a local time."""
        return self.stamp_ns + round((local_ns - self.arrival_ns) * self.rate)
