# SPDX-License-Identifier: Apache-2.0
"""The robot as its states show it: its life, its clock, and where it is, with angles that do not wrap."""

from __future__ import annotations

from enum import Enum

import numpy as np

from rti_mpc.angle import whole_turns
from rti_mpc.array import Array
from rti_mpc.contract.cadence import Cadence
from rti_mpc.contract.lives import Heard, Lives
from rti_mpc.contract.message import Notice, Severity, State
from rti_mpc.contract.robot_clock import RobotClock
from rti_mpc.control.observer import Observer
from rti_mpc.control.sent import Sent
from rti_mpc.model.model import Model

MAX_STATE_MAGNITUDE = 1e9  # in any unit; a state with a larger number is refused


class Arrival(Enum):
    """What a state is to the controller."""

    FRESH = "fresh"  # to be acted on
    REPEATED = "repeated"  # not newer than the last one
    FOREIGN = "foreign"  # of another robot, or of a life that is not sure yet
    UNTIMED = "untimed"  # of a clock that is none: its stamps do not advance as nanoseconds
    REFUSED = "refused"  # no numbers of a robot
    OLD = "old"  # it has waited on its way
    NEW_LIFE = "new life"  # the first one after a restart of the robot
    JUMPED_AHEAD = "jumped ahead"  # the first one after a jump of the robot's clock
    JUMPED_BACK = "jumped back"  # likewise; whatever was to happen at a certain time will not


class StateStream:
    """
    The states of one robot.

    Attributes:
        lives: Which of the lives heard is followed, and whether two robots are there.
        cadence: Whether its states count and its stamps are nanoseconds.
        last: The newest state, None before the first.
        x: That state, shape ``(nx,)``, its angles nearest to those of the one before; or the observer's estimate of it.
        d: Estimated disturbances, shape ``(nd,)``; none without an observer.
        clock: The robot's clock.
        before_ns: When that was, by the clock before it jumped.
        notice: What is to be said of the last state, None if it is like the one before.
    """

    def __init__(self, model: Model, stale_ns: int, late_ns: int, settling_s: float, observer: Observer | None = None) -> None:
        """
        Begin with no state.

        Args:
            model: The robot's.
            stale_ns: Age from which a state is not used, robot time.
            late_ns: Robot time by which a state may be late and still be fresh.
            settling_s: How long after its state a command of anybody may still move the robot, robot time.
            observer: Estimates disturbances, if there is one.
        """
        self.lives = Lives(1e-9 * stale_ns, settling_s)
        self.cadence = Cadence()
        self.last: State | None = None
        self.x: Array = np.zeros(model.nx)
        self.d: Array = np.zeros(0) if observer is None else observer.d
        self.clock = RobotClock(late_ns)
        self.notice: Notice | None = None
        self._said = Arrival.FRESH
        self.before_ns = 0
        self._stale_ns = stale_ns
        self._observer = observer
        self._before_ns: int | None = None  # stamp of the state before the last one
        self._angles = [j for j, signal in enumerate(model.states) if signal.angle]

    def receive(self, state: State, arrival_ns: int) -> Arrival:
        """
        Take a state in. Of another life nothing of the last one is kept.

        Args:
            state: Of the model's `nx`.
            arrival_ns: Local monotonic time.
        """
        self.before_ns = self.clock.now_ns(arrival_ns)
        self.notice = None
        arrival, code, text = self._judge(state, arrival_ns)
        if code and arrival is not self._said:
            self.notice = Notice(Severity.WARNING, code, text)
        self._said = arrival
        if arrival in (Arrival.REPEATED, Arrival.REFUSED, Arrival.FOREIGN):
            return arrival
        before = self.x.copy()
        self.x[:] = state.x
        if self.last is not None:
            for j in self._angles:
                self.x[j] -= whole_turns(self.x[j] - before[j])
        self._before_ns = None if self.last is None else self.last.stamp_ns
        self.last = state
        return arrival

    def estimate(self, sent: Sent, *, known: bool) -> None:
        """
        Replace the last state by the observer's estimate, if there is one.

        Args:
            sent: The inputs that have acted since the state before.
            known: Whether they surely have; otherwise the disturbances are left as they are.
        """
        observer, last = self._observer, self.last
        if observer is None or last is None:
            return
        if self._before_ns is None or last.stamp_ns - self._before_ns > self._stale_ns:
            observer.reset(self.x)
        else:
            observer.frozen = not known
            for u, span_s in sent.spans(self._before_ns, last.stamp_ns):
                observer.predict(u, span_s)
            for j in self._angles:  # a turn between two states is no innovation
                self.x[j] -= whole_turns(self.x[j] - observer.x[j])
            observer.correct(self.x)
        self.x[:] = observer.x

    def _judge(self, state: State, arrival_ns: int) -> tuple[Arrival, str, str]:
        """Judge a state, with the code and the text of what is to be said of it."""
        if not abs(state.x).max() <= MAX_STATE_MAGNITUDE:
            return Arrival.REFUSED, "state_refused", f"a state must be finite and at most {MAX_STATE_MAGNITUDE:g}, got {state.x.tolist()}"
        heard = self.lives.hear(state.epoch, arrival_ns, self.clock.rate)
        self.notice = self.lives.notice
        if heard is Heard.OTHER:
            return Arrival.FOREIGN, "", ""
        began = heard is Heard.BEGINS and self.last is not None
        if heard is Heard.BEGINS:
            self.last = None
            self.clock.reset()
            self.cadence.reset()
        untimed = bool(self.cadence.fault)
        counts = self.cadence.observe(state.seq, state.stamp_ns, arrival_ns)
        self.notice = self.notice or self.cadence.notice
        if not counts:
            return Arrival.REPEATED, "", ""
        if self.cadence.fault:
            return Arrival.UNTIMED, "", ""
        if untimed:
            self.clock.reset()
            self.clock.observe(state.seq, state.stamp_ns, arrival_ns)
            return Arrival.JUMPED_AHEAD, "clock_known", "the robot's stamps advance as nanoseconds again: starting cold"
        last = self.last
        judged = (Arrival.NEW_LIFE, "robot_restarted", "the robot was restarted: starting anew") if began else (Arrival.FRESH, "", "")
        if last is not None and state.stamp_ns <= last.stamp_ns:
            back_ns = last.stamp_ns - state.stamp_ns
            if back_ns <= self._stale_ns:
                return Arrival.REPEATED, "", ""
            judged = Arrival.JUMPED_BACK, "clock_jumped", f"the robot's clock went back {1e-9 * back_ns:.3f} s: starting anew"
            self.last = None
            self.clock.jump()
            self.cadence.jump()
        if not self.clock.observe(state.seq, state.stamp_ns, arrival_ns):
            return Arrival.OLD, "state_old", "states have waited on their way: they are not acted on"
        if self.clock.leapt:
            text = f"the robot's clock jumped ahead {1e-9 * (state.stamp_ns - self.before_ns):.3f} s: starting cold"
            return Arrival.JUMPED_AHEAD, "clock_jumped", text
        return judged
