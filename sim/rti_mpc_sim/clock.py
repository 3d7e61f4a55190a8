# SPDX-License-Identifier: Apache-2.0
"""The clock of a simulated robot: monotonic time since start, times the speed."""

from __future__ import annotations

import math
import time
from threading import Event

from rti_mpc.errors import ConfigError

UNSLEPT_END_NS = 200_000  # last part of a wait, polled and not slept: sleeps end up to 0.1 ms late
MAX_SLEEP_S = 0.05  # `stop` is checked at least this often


class Clock:
    """
    Robot time, 0 when built.

    Attributes:
        speed: Seconds of robot time per second.
    """

    def __init__(self, speed: float = 1.0) -> None:
        if not (math.isfinite(speed) and speed > 0.0):
            raise ConfigError(f"speed must be finite and above 0, got {speed}")
        self.speed = speed
        self._start_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Robot time now."""
        return self.at_ns(time.monotonic_ns())

    def at_ns(self, monotonic_ns: int) -> int:
        """Robot time at a monotonic instant."""
        return int((monotonic_ns - self._start_ns) * self.speed)

    def wait(self, robot_ns: int, stop: Event) -> None:
        """Wait until a robot time, on the absolute grid of the monotonic clock, or until stopped."""
        deadline_ns = self._start_ns + math.ceil(robot_ns / self.speed)
        while not stop.is_set():
            left_ns = deadline_ns - time.monotonic_ns()
            if left_ns <= 0:
                return
            time.sleep(min(MAX_SLEEP_S, 1e-9 * max(0, left_ns - UNSLEPT_END_NS)))

    def set_back(self, robot_ns: int) -> int:
        """Set the clock back to a past robot time; return by how much wall time, in ns."""
        late_ns = time.monotonic_ns() - self._start_ns - math.ceil(robot_ns / self.speed)
        self._start_ns += late_ns
        return late_ns
