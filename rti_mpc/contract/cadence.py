# SPDX-License-Identifier: Apache-2.0
"""
The cadence of a robot's states: whether their sequence numbers increase, and whether their stamps advance as nanoseconds do.

Stamps in another unit look like a clock that runs a thousand times too slowly, or worse:
a command would act a thousand times too long. So nothing is commanded until stamps were
seen to advance at a rate that a simulation may have, nor when they no longer do.
"""

from __future__ import annotations

import math

from rti_mpc.contract.epoch import MAX_SEQ_GAP
from rti_mpc.contract.message import Notice, Severity

RATE_RANGE = (0.005, 200.0)  # robot seconds per local second: the range that stamps in nanoseconds may show
RATE_TOLERANCE_FACTOR = 1.1  # a measured rate may be outside the range by this factor, since arrivals jitter
RATE_WINDOW_NS = 50_000_000  # local time: a rate is measured over at least this long
STANDSTILL_NS = 1_000_000_000  # local time: stamps or numbers that stand still for this long are reported
STANDSTILL_STATES = 2  # at least this many states must have shown it
UNIT_BY_EXPONENT = {-9: "s (seconds)", -6: "ms (milliseconds)", -3: "us (microseconds)", 3: "ps (picoseconds)"}  # key: log10 of the measured rate


class Cadence:
    """
    Judge of the states of one life of a robot.

    Attributes:
        known: Whether stamps were seen to advance at a possible rate, and still do.
        fault: What is wrong with that rate, and what would be right; empty if no fault was seen.
        rate: The rate measured last, ns of the stamps per local ns; 0 before the first.
        notice: Notice about the last state; None for most states.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything, for another life of the robot."""
        self.known = False
        self.fault = ""
        self.notice: Notice | None = None
        self._seq: int | None = None
        self._counted_ns = 0  # local time of the last state whose number counted
        self._uncounted = 0  # states since then with a stamp of their own
        self._told = False  # whether it was told that stamps or numbers stand still
        self.jump()

    def jump(self) -> None:
        """Restart the measurement, because the robot's clock has gone back."""
        self.rate = 0.0
        self._side = 0  # of the range in the last window: below -1, inside 0, above 1
        self._mark: tuple[int, int] | None = None  # stamp and local time of the state that began the window
        self._moved: tuple[int, int] | None = None  # those of the last state whose stamp was another than before
        self._standing = 0  # states since then

    def counts(self, seq: int) -> bool:
        """Whether a sequence number continues the last one."""
        return self._seq is None or self._seq < seq <= self._seq + MAX_SEQ_GAP

    def observe(self, seq: int, stamp_ns: int, local_ns: int) -> bool:
        """
        Judge a state, and return whether its sequence number continues the last one, or a new numbering is accepted.

        Args:
            seq: Sequence number of the state.
            stamp_ns: Its stamp.
            local_ns: Local monotonic time.
        """
        self.notice = None
        if not self.counts(seq) and (seq == self._seq or local_ns - self._counted_ns <= STANDSTILL_NS):
            self._doubt(seq, stamp_ns, local_ns - self._counted_ns)
            return False
        self._seq, self._counted_ns, self._uncounted = seq, local_ns, 0
        self._advance(stamp_ns, local_ns)
        return True

    def _doubt(self, seq: int, stamp_ns: int, silent_ns: int) -> None:
        """Note a state whose number does not count, as none has for some local time."""
        self._uncounted += self._moved is not None and stamp_ns > self._moved[0]  # a state that is sent twice has no stamp of its own
        if self._uncounted >= STANDSTILL_STATES and silent_ns >= STANDSTILL_NS:
            text = f"seq must be above the one before in every state, got {seq} after {self._seq} for {1e-9 * silent_ns:.1f} s: nothing is commanded"
            self._tell("seq_stands_still", text)

    def _advance(self, stamp_ns: int, local_ns: int) -> None:
        if self._moved is not None and stamp_ns <= self._moved[0]:
            self._standing += 1
            still_ns = local_ns - self._moved[1]
            if self._standing >= STANDSTILL_STATES and still_ns >= STANDSTILL_NS:
                got = f"{self._standing + 1} states of {self._moved[0]} in {1e-9 * still_ns:.1f} s"
                text = f"stamps must advance as nanoseconds do, got {got}: nothing is commanded"
                self._tell("stamps_stand_still", text)
            return
        self._moved, self._standing = (stamp_ns, local_ns), 0
        if self._mark is None:
            self._mark = stamp_ns, local_ns
        elif local_ns - self._mark[1] >= RATE_WINDOW_NS:
            self._measure((stamp_ns - self._mark[0]) / (local_ns - self._mark[1]))
            self._mark = stamp_ns, local_ns

    def _measure(self, rate: float) -> None:
        """Judge the rate of a window together with that of the window before, since one window may be held up."""
        side, self.rate = (rate > RATE_RANGE[1] * RATE_TOLERANCE_FACTOR) - (rate < RATE_RANGE[0] / RATE_TOLERANCE_FACTOR), rate
        if side == 0:
            self.known, self.fault, self._told = True, "", False
        elif side == self._side and not self.fault:
            unit = UNIT_BY_EXPONENT.get(3 * round(math.log10(rate) / 3))
            looks = f"they look like {unit}, nanoseconds are expected" if unit else f"{RATE_RANGE[0]:g} to {RATE_RANGE[1]:g} are expected"
            self.known, self.fault = False, f"the robot's stamps advance {rate:.3g} ns per ns: {looks}"
            self.notice = Notice(Severity.ERROR, "stamps_not_ns", f"{self.fault}; nothing is commanded")
        self._side = side

    def _tell(self, code: str, text: str) -> None:
        if not self._told:
            self._told = True
            self.notice = Notice(Severity.ERROR, code, text)
