# SPDX-License-Identifier: Apache-2.0
"""Slack of the samples: filled with pieces of work that give way to any message, as long as it is long enough for them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

from rti_mpc.contract.message import Notice, Severity

MARGIN = 2.0  # least slack over the p99 of the work: with less of it, the work is cut short too often, and others of the host wait
JUDGED_SAMPLES = 100  # of which the p99 is taken: it is the second longest time
PAUSED_SAMPLES = 1000  # without work, after which the slack is judged anew; twice as many each further time

M = TypeVar("M")


class Slack:
    """
    Slack of one controller, filled with second opinions.

    Attributes:
        enough: Whether it is long enough for them.
        taken_s: Local time that the opinion of this sample has taken so far, s.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.enough = True
        self.taken_s = 0.0
        self._clock_ns = clock_ns
        self._left_s = 0.0
        self._samples: list[tuple[float, float]] = []  # time taken and slack of each, s
        self._paused = 0  # samples that still go without
        self._pause = PAUSED_SAMPLES
        self._said = False

    def fill(self, piece: Callable[[], bool], poll: Callable[[], M | None]) -> M | None:
        """
        Do pieces of work until all is done, or a message is there.

        Args:
            piece: Does a piece, and returns whether nothing is left to be done.
            poll: Returns a message, None if there is none.

        Returns:
            The message, None if all is done.
        """
        while self.enough:
            if (message := poll()) is not None:
                return message
            began_ns = self._clock_ns()
            done = piece()
            self.taken_s += 1e-9 * (self._clock_ns() - began_ns)
            if done:
                break
        return None

    def begin(self, left_s: float, *, judged: bool) -> Notice | None:
        """
        Begin the slack of the next sample.

        Args:
            left_s: Local time until the next state, s.
            judged: Whether there was a plan to be judged in the last one.

        Returns:
            A notice that the slack is too short, the first time that it is.
        """
        last, self.taken_s, self._left_s = (self.taken_s, self._left_s), 0.0, left_s
        if not judged:
            return None
        if self._paused:
            self._paused -= 1
            self.enough = not self._paused
            return None
        self._samples.append(last)
        if len(self._samples) < 2:
            return None
        taken_s, slack_s = map(sorted, zip(*self._samples, strict=True))
        notice = self._judge(taken_s[-2], slack_s[len(slack_s) // 2])  # the second longest time only grows: there is no need to wait for the others
        if not self.enough or len(self._samples) == JUDGED_SAMPLES:
            self._samples.clear()
        return notice

    def _judge(self, p99_s: float, slack_s: float) -> Notice | None:
        """Pause if the median slack is too short for the p99 of the work."""
        if slack_s >= MARGIN * p99_s:
            return None
        self.enough, self._paused = False, self._pause
        self._pause *= 2
        if self._said:
            return None
        self._said = True
        text = f"second opinions take {1e3 * p99_s:.1f} ms (p99), and must take at most half of the slack, which is {1e3 * slack_s:.1f} ms"
        return Notice(Severity.INFO, "second_opinion_off", f"{text}: {PAUSED_SAMPLES} samples go without, then they are tried again")
