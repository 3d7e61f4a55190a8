# SPDX-License-Identifier: Apache-2.0
"""Timeline: one time axis through all lives of a robot."""

from __future__ import annotations

GAP_BETWEEN_LIVES_NS = 1_000_000_000  # drawn between two lives of a robot whose clock began again
MAX_TIME_NS = 2**62  # 146 years; beyond it the axis begins again, so that it never exceeds int64
MAX_AHEAD_NS = 1_000_000_000  # latest drawn time after the newest state; commands act a little after it
MAX_APART_NS = 250_000_000  # of a robot's own clock and the local time, where several robots share the latter; jitter is less


class Timeline:
    """
    Places stamps on one axis, in ns.

    The axis is the robot's clock itself. Where it begins again, as the robot was restarted, or
    jumps back, what follows is appended, so that nothing is drawn over what was before.

    For several robots, whose clocks have nothing in common, it is the local time since a
    common instant: each life of a robot begins when its first state has arrived, and goes on
    by its own clock. One that runs slower or faster, waits or jumps ahead is shifted again and again,
    so that all robots end at the present.
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
        self._offset_ns = 0

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
            self._epoch, self._begin_ns, self._latest_ns = epoch, self._offset_ns + stamp_ns, stamp_ns
        elif self._begun_ns is not None and stamp_ns > self._latest_ns:
            here_ns = self._since_begun(local_ns)
            near_ns = min(max(self._offset_ns + stamp_ns, here_ns - MAX_APART_NS), here_ns + MAX_APART_NS)
            self._offset_ns = max(near_ns, self.now_ns) - stamp_ns
        self._latest_ns = max(self._latest_ns, stamp_ns)
        return self._offset_ns + stamp_ns

    def place(self, stamp_ns: int, local_ns: int = 0) -> int:
        """Return the time of another message, within the robot's present life: a late message of a former life cannot be recognized."""
        if self._epoch is None:
            return max(stamp_ns, 0) if self._begun_ns is None else self._since_begun(local_ns)
        return max(self._offset_ns + min(stamp_ns, self._latest_ns + MAX_AHEAD_NS), self._begin_ns)

    def _since_begun(self, local_ns: int) -> int:
        return max(local_ns - (self._begun_ns or 0), 0)
