# SPDX-License-Identifier: Apache-2.0
"""
Rehearsal: shortly before a state is due, the control thread goes the way from state to command once more.

After a pause the processor's caches hold other data, and a sample takes several times as
long. Rehearsed by the thread that will answer, it finds them warm. That thread waits in
Zenoh, which has no timeout: another one sleeps until the rehearsal is due, and wakes it
by a message. A state that comes before that wakes it as ever.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from queue import SimpleQueue

from rti_mpc.contract.message import Notice, Severity

LEAD_S = 1.5e-3  # from the wake to the state that is expected: waking and rehearsing take up to 0.6 ms, and states come up to 1 ms early
LEAST_AHEAD_S = 0.25e-3  # to the state that is expected, when a rehearsal begins: no state should find it in its way
LEAST_SLACK_S = 4e-3  # with less, caches are warm still
JUDGED_SAMPLES = 100  # in a row with too little slack, before that is told


class Rehearsal:
    """
    Times of the rehearsals of one controller.

    Attributes:
        text: Whether samples are rehearsed, in words.
    """

    def __init__(
        self,
        wake: Callable[[], object],
        clock_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        """
        Begin with none due.

        Args:
            wake: Wakes the control thread.
            clock_ns: Local monotonic time.
            sleep: Sleeps for a time in s.
        """
        self.text = f"{1e3 * LEAD_S:g} ms before each sample, where the slack is {1e3 * LEAST_SLACK_S:g} ms or more"
        self._wake, self._clock_ns, self._sleep = wake, clock_ns, sleep
        self._expected_ns = 0
        self._expected: SimpleQueue[int] = SimpleQueue()
        self._short = 0  # samples in a row with too little slack

    def begin(self, left_s: float) -> Notice | None:
        """
        Begin the slack of a sample, which is `left_s` of local time, in s, until the next state.

        Returns:
            A notice that no sample is rehearsed, as slack is too short, the first time that this is so.
        """
        self._expected_ns = self._clock_ns() + round(1e9 * left_s)
        if left_s >= LEAST_SLACK_S:
            self._short = min(self._short, 0)  # below 0: it was told
            self._expected.put(self._expected_ns)
            return None
        self._short += self._short >= 0
        if self._short < JUDGED_SAMPLES:
            return None
        self._short = -1
        text = f"samples are not rehearsed: the slack must be {1e3 * LEAST_SLACK_S:g} ms or more, and is {1e3 * left_s:.1f} ms"
        return Notice(Severity.INFO, "rehearsal_off", text)

    @property
    def timely(self) -> bool:
        """Whether the expected state is near, but not too near."""
        return LEAST_AHEAD_S <= 1e-9 * (self._expected_ns - self._clock_ns()) <= 2.0 * LEAD_S

    def keep_time(self) -> None:
        """Wake the control thread before each state that is expected: the whole life of a thread."""
        while True:
            left_s = 1e-9 * (self._expected.get() - self._clock_ns()) - LEAD_S
            if left_s > 0.0:
                self._sleep(left_s)
            if self._expected.empty():  # otherwise the state has come early, and the next one is expected
                self._wake()
