# SPDX-License-Identifier: Apache-2.0
"""The robot's clock, as estimated by a receiver of its states: the last stamp, and the rate at which stamps advance."""

from __future__ import annotations

from collections import deque

RATE_WINDOW_NS = 1_000_000_000  # local time over which the rate is measured
RATE_FACTOR_PER_STATE = 1.05  # one state may change the rate by this factor at most
CLOCK_LEAP_NS = 250_000_000  # robot time: a stamp further ahead than this is a jump of the robot's clock
RATE_UNCERTAINTY = 0.1  # share by which the rate may be wrong, where states come late now and then
RECENT_STATES = 2  # lateness is measured against the least late of these: with more of them a clock that has waited would look late for longer
SETTLING_STATES = 20  # states after which the rate is known well enough for that
PACED_NS = 80_000_000  # local time: late states must come at their own pace for this long before the robot's clock is believed to have waited
MAX_PACED_STATES = 8  # with this many such states in a row that is believed in any case
MAX_INITIAL_RATE = 10.0  # robot seconds per local second that are assumed at most until the second state has come


class Backlog:
    """
    Late states in a row: have they waited on their way, or has the robot's clock waited?

    States that have waited on their way arrive at once, or in bunches where this process
    gets little time to run. If each of them arrives at its own pace instead, the robot's
    clock has waited, as that of a simulation may, and goes on from here.

    Attributes:
        last: Stamp and arrival of the last state, if it was late; else None.
    """

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all late states, because a state came in time."""
        self.last: tuple[int, int] | None = None
        self._paced = 0  # late states in a row that came at their own pace

    def believed(self, stamp_ns: int, arrival_ns: int, clock: RobotClock) -> bool:
        """Add a late state, and return whether it is the robot's clock that has waited."""
        last, self.last = self.last, (stamp_ns, arrival_ns)
        paced = last is not None and 2 * clock.rate * (arrival_ns - last[1]) >= stamp_ns - last[0]
        self._paced = self._paced + 1 if paced else 0
        patience = min(max(1, int(PACED_NS * clock.rate / clock.period_ns)), MAX_PACED_STATES) if clock.period_ns else 1
        return self._paced >= patience


class RobotClock:
    """
    Robot time from stamps and local monotonic arrival times.

    Clocks need not agree, and simulated time, slower or faster, works unchanged:
    timeouts are local time since arrival, multiplied by `rate`.

    Attributes:
        stamp_ns: Stamp of the last state that was fresh, robot time.
        arrival_ns: When it arrived, local monotonic time.
        rate: Robot seconds per local second; assumed low until measured, since a slow simulation must not be taken for a dead robot.
        rate_most: Upper limit of the rate: until it is measured, the fastest that the states so far allow.
        late_ns: Lateness of the last state compared with the least late of those before it, robot time.
        doubt_ns: Possible error of `late_ns`: a clock that was not heard for a while has run faster or slower than assumed.
        leapt: Whether the last stamp was far ahead of its time, because the robot's clock has jumped.
        period_ns: Time between states, robot time, smoothed; 0 until two have come.
    """

    def __init__(self, late_ns: int = 250_000_000) -> None:
        """
        Begin with nothing known.

        Args:
            late_ns: Robot time by which a state may be late and still be fresh.
        """
        self._most_ns, self._leap_ns = late_ns, max(late_ns, CLOCK_LEAP_NS)
        self.reset()

    def reset(self) -> None:
        """Forget everything, for another life of the robot."""
        self.stamp_ns = 0
        self.arrival_ns = 0
        self.rate = 0.1
        self.rate_most = MAX_INITIAL_RATE
        self.period_ns = 0.0
        self._seq = 0
        self._anchor: tuple[int, int] | None = None
        self._late = Backlog()
        self._measured = False  # whether the rate is
        self._recent: deque[tuple[int, int]] = deque(maxlen=RECENT_STATES)  # stamps and arrivals
        self._in_a_row = 0  # states that came late by a quarter of a period and more
        self._settling = SETTLING_STATES  # states still to come
        self.late_ns = self.doubt_ns = 0
        self.leapt = False

    def jump(self) -> None:
        """Forget stamps and arrivals, because the clock has jumped; its rate is kept."""
        known = self.rate, self.rate_most, self._measured, self._settling
        self.reset()
        self.rate, self.rate_most, self._measured, self._settling = known

    def observe(self, seq: int, stamp_ns: int, arrival_ns: int) -> bool:
        """
        Update the clock by a state's stamp and arrival, and return whether the state is fresh.

        A state that comes much later than the others has waited on its way, for
        instance in the queues of a process that was stopped; or the robot's clock
        itself has waited, which `Backlog` decides.
        """
        ahead_ns = stamp_ns - self.now_ns(arrival_ns)
        since_ns = self.arrival_ns or arrival_ns
        leaps = self._measured and ahead_ns > self._leap_ns and not self.leapt
        if self._anchor is None or leaps:
            self._anchor = (stamp_ns, arrival_ns)
            self._recent.clear()
        elif -ahead_ns > self._most_ns:
            before = self._late.last
            if not self._late.believed(stamp_ns, arrival_ns, self) or before is None:
                return False
            self._recent.clear()
            since_ns = before[1]
            rate = self._rate(stamp_ns - before[0], arrival_ns - before[1])
            self.rate = (
                min(self.rate, rate) if self._measured else rate
            )  # states that were held up arrive at once, which does not mean that the clock runs faster
            self.rate_most = max(self.rate_most, self.rate)
            self._anchor = (stamp_ns, arrival_ns)
        elif stamp_ns > self.stamp_ns:
            period_ns, known_ns = (stamp_ns - self.stamp_ns) / max(1, seq - self._seq), self.period_ns
            self.period_ns = known_ns + (min(period_ns, 2.0 * known_ns) - known_ns) * 0.1 if known_ns else period_ns
            self._measure(stamp_ns, arrival_ns, *self._anchor)
        if self._late.last is not None:
            self._late.clear()
        self.leapt = leaps
        self.late_ns = self._late_ns(stamp_ns, arrival_ns)
        self.doubt_ns = round(RATE_UNCERTAINTY * self.rate * (arrival_ns - since_ns))
        if self._settling:
            self._recent.clear()
        self._recent.append((stamp_ns, arrival_ns))
        self._seq, self.stamp_ns, self.arrival_ns = seq, stamp_ns, arrival_ns
        return True

    def _measure(self, stamp_ns: int, arrival_ns: int, stamp_0_ns: int, arrival_0_ns: int) -> None:
        """Measure the rate since the anchor, a state that came in time; a single late state is not used."""
        elapsed_ns = arrival_ns - arrival_0_ns
        rate = self._rate(stamp_ns - stamp_0_ns, max(1, elapsed_ns))
        if not self._measured:
            self.rate_most = rate
        self._in_a_row = self._in_a_row + 1 if self._late_ns(stamp_ns, arrival_ns) > self.period_ns / 4 else 0
        if (0 < self._in_a_row < RECENT_STATES and not self._settling) or elapsed_ns < RATE_WINDOW_NS // 4:
            return
        if self._settling:
            self._settling -= 1
        if self._measured:
            rate = min(max(rate, self.rate / RATE_FACTOR_PER_STATE), self.rate * RATE_FACTOR_PER_STATE)
        self.rate = self.rate_most = rate
        self._measured = True
        if elapsed_ns >= RATE_WINDOW_NS:
            self._anchor = (stamp_ns, arrival_ns)

    def _late_ns(self, stamp_ns: int, arrival_ns: int) -> int:
        """Return the lateness of a state compared with the least late of those before it, robot time."""
        earliest_ns, rate = stamp_ns, self.rate
        for stamp, arrival in self._recent:
            if (expected_ns := stamp + round((arrival_ns - arrival) * rate)) > earliest_ns:
                earliest_ns = expected_ns
        return earliest_ns - stamp_ns

    def _rate(self, robot_ns: int, local_ns: int) -> float:
        return min(max(robot_ns / local_ns, 1e-3), 1e3)

    def latest_ns(self, local_ns: int) -> int:
        """Return the latest that robot time can be at a local time, if the last state came as late as it seems."""
        return self.stamp_ns + self.late_ns + round((local_ns - self.arrival_ns) * self.rate_most)

    def now_ns(self, local_ns: int) -> int:
        """Return robot time at a local time."""
        return self.stamp_ns + round((local_ns - self.arrival_ns) * self.rate)
