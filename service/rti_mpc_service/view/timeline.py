# SPDX-License-Identifier: Apache-2.0
"""Timeline: one time axis through all lives of a robot."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from operator import itemgetter

GAP_BETWEEN_LIVES_NS = 1_000_000_000  # drawn between two lives of a robot whose clock began again
MAX_TIME_NS = 2**62  # 146 years; beyond it the axis begins again, so that it never exceeds int64
MAX_AHEAD_NS = 1_000_000_000  # latest drawn time after the newest state; commands act a little after it
MAX_APART_NS = 250_000_000  # of a robot's own clock and the local time, where several robots share the latter; jitter is less
MAX_PLACED_STATES = 2048  # whose times are kept, for messages that come after them: 2 s at 1 kHz, as many as wait for a listener


class Timeline:
    """
    Places stamps on one axis, in ns.

    The axis is the robot's clock itself. Where it begins again, as the robot was restarted, or
    jumps back, what follows is appended, so that nothing is drawn over what was before.

    For several robots, whose clocks have nothing in common, it is the local time since a
    common instant: each life of a robot begins when its first state has arrived, and goes on
    by its own clock. One that runs slower or faster, waits or jumps ahead is shifted again and again,
    so that all robots end at the present.

    Such a shift counts from its state on. A message with an older stamp is placed between the states
    around that stamp, as they were placed: it is drawn beside the state that it belongs to.
    """

    def __init__(self, begun_ns: int | None = None) -> None:
        """
        Begin an axis.

        Args:
            begun_ns: Local monotonic time of the common instant; None: the axis is the robot's own clock.
        """
        self._begun_ns = begun_ns
        self._epoch: int | None = None
        self._begin_ns = 0  # on the axis
        self._latest_ns = 0
        self._offset_ns = 0  # of the newest state
        self._placed: deque[tuple[int, int]] = deque(maxlen=MAX_PLACED_STATES)  # stamps and times of the last states of this life; neither decreases

    @property
    def now_ns(self) -> int:
        """Time of the newest state."""
        return self._offset_ns + self._latest_ns

    def place_state(self, epoch: int, stamp_ns: int, local_ns: int = 0) -> int:
        """Return the time of a state that has arrived at a local time, and advance the axis to it."""
        if epoch != self._epoch or stamp_ns < self._latest_ns - MAX_APART_NS:  # a clock that jumps back, as a guard judges it, begins again
            if self._begun_ns is not None:
                self._offset_ns = self._since_begun(local_ns) - stamp_ns
            elif self._epoch is not None and stamp_ns < self._latest_ns:
                self._offset_ns += self._latest_ns + GAP_BETWEEN_LIVES_NS - stamp_ns
                self._offset_ns *= self._offset_ns + stamp_ns < MAX_TIME_NS
            self._epoch, self._begin_ns = epoch, self._offset_ns + stamp_ns
            self._placed.clear()
        elif stamp_ns <= self._latest_ns:  # it comes late, and moves nothing
            return self._time(stamp_ns)
        elif self._begun_ns is not None:
            here_ns = self._since_begun(local_ns)
            near_ns = min(max(self._offset_ns + stamp_ns, here_ns - MAX_APART_NS), here_ns + MAX_APART_NS)
            self._offset_ns = max(near_ns, self.now_ns) - stamp_ns
        self._latest_ns = stamp_ns
        self._placed.append((stamp_ns, self.now_ns))
        return self.now_ns

    def place(self, stamp_ns: int, local_ns: int = 0) -> int:
        """Return the time of another message, within the robot's present life: a late message of a former life cannot be recognized."""
        if self._epoch is None:
            return max(stamp_ns, 0) if self._begun_ns is None else self._since_begun(local_ns)
        return max(self._time(min(stamp_ns, self._latest_ns + MAX_AHEAD_NS)), self._begin_ns)

    def _time(self, stamp_ns: int) -> int:
        """Return the time of a stamp: between two states in proportion, before and after all of them by the robot's clock."""
        k = bisect_left(self._placed, stamp_ns, key=itemgetter(0))
        if 0 < k < len(self._placed):
            (stamp_before_ns, time_before_ns), (stamp_after_ns, time_after_ns) = self._placed[k - 1], self._placed[k]
            return time_before_ns + (stamp_ns - stamp_before_ns) * (time_after_ns - time_before_ns) // (stamp_after_ns - stamp_before_ns)
        nearest_stamp_ns, time_ns = self._placed[0 if k == 0 else -1]
        return time_ns + stamp_ns - nearest_stamp_ns

    def _since_begun(self, local_ns: int) -> int:
        return max(local_ns - (self._begun_ns or 0), 0)
