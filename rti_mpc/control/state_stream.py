# SPDX-License-Identifier: Apache-2.0
"""The states of one robot: its life, its clock and its state vector, with rotations written as near to those of the state before as they can be."""

from __future__ import annotations

from enum import Enum
from typing import Any

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array, bounded
from rti_mpc.contract.cadence import Cadence
from rti_mpc.contract.lives import BEGINS, OTHER, Lives
from rti_mpc.contract.message import Notice, Severity, State
from rti_mpc.contract.robot_clock import RobotClock
from rti_mpc.control.observer import Observer
from rti_mpc.control.sent import Sent
from rti_mpc.model.model import Model

MAX_STATE_MAGNITUDE = 1e9  # in any unit; a state with a larger number is refused


class Arrival(Enum):
    """Verdict on a state that has arrived."""

    FRESH = "fresh"  # may be answered
    REPEATED = "repeated"  # not newer than the last state
    FOREIGN = "foreign"  # of another robot, or of a life that is not believed yet
    UNTIMED = "untimed"  # its stamps do not advance as nanoseconds do
    REFUSED = "refused"  # not finite, or too large
    OLD = "old"  # has waited on its way
    NEW_LIFE = "new life"  # the first state after a restart of the robot
    JUMPED_AHEAD = "jumped ahead"  # the first state after the robot's clock has jumped ahead
    JUMPED_BACK = "jumped back"  # the first state after the robot's clock has gone back: earlier stamps mean nothing any more


FRESH = Arrival.FRESH  # read faster than a member of the enumeration
UNKEPT = Arrival.REPEATED, Arrival.REFUSED, Arrival.FOREIGN  # states of which nothing is kept
NOTHING_SAID = FRESH, "", ""


class StateStream:
    """
    The states of one robot.

    Attributes:
        lives: Lives of the robot that were heard, and which of them is followed.
        cadence: Judge of sequence numbers and of the unit of the stamps.
        last: The newest state, None before the first.
        x: That state, shape ``(nx,)``, its rotations written nearest to those of the state before; or the observer's estimate of it.
        seen: That state with what is measured as it was measured; the same array as `x` unless `as_measured` is asked for.
        estimates: Whether there is an observer.
        d: Estimated disturbances, shape ``(nd,)``; empty without an observer.
        clock: The robot's clock.
        before_ns: Arrival of the newest state in robot time, by the clock as it was before that state.
        notice: Notice about the last state, None if there is nothing new to report.
    """

    def __init__(
        self, model: Model, stale_ns: int, late_ns: int, settling_s: float, observer: Observer | None = None, *, as_measured: bool = False
    ) -> None:
        """
        Begin with no state.

        Args:
            model: Model of the robot.
            stale_ns: Age from which a state is not used, robot time.
            late_ns: Robot time by which a state may be late and still be fresh.
            settling_s: Robot time for which any command may still move the robot after the state that it answers.
            observer: Estimator of disturbances, None for none.
            as_measured: Whether `seen` is needed apart from the estimate.
        """
        self.lives = Lives(1e-9 * stale_ns, settling_s)
        self.cadence = Cadence()
        self.last: State | None = None
        self.x: Array = np.zeros(model.nx)
        self._x: Any = self.x.data  # read and written faster than an array
        apart = observer is not None and as_measured
        self.seen: Array = np.zeros(model.nx) if apart else self.x
        self._unmeasured = [j for j in range(model.nx) if j not in observer.measured] if observer is not None and as_measured else []
        self.d: Array = np.zeros(0) if observer is None else observer.d
        self.clock = RobotClock(late_ns)
        self.notice: Notice | None = None
        self._said = FRESH
        self.before_ns = 0
        self._stale_ns = stale_ns
        self._observer, self.estimates = observer, observer is not None
        self._estimated_ns: int | None = None  # stamp of the state that the observer was given last
        self._rotations = model.rotations("states")
        self._x_shape, self._u_shape = (model.nx,), (model.nu,)

    def check(self, state: State) -> None:
        """
        Refuse what is no state of the model.

        Raises:
            OcpError: It is no `State`.
            ShapeError: Its vectors are not the model's.
        """
        given.array("state.x", given.instance("state", state, State).x, self._x_shape)
        if len(state.u):
            given.array("state.u", state.u, self._u_shape)

    def receive(self, state: State, arrival_ns: int) -> Arrival:
        """
        Judge and keep a state. When another life of the robot begins, the last state is forgotten.

        Args:
            state: A state with the model's `nx` numbers.
            arrival_ns: Local monotonic time.
        """
        self.before_ns = self.clock.now_ns(arrival_ns)
        self.notice = None
        arrival, code, text = self._judge(state, arrival_ns)
        if code and arrival is not self._said:
            self.notice = Notice(Severity.WARNING, code, text)
        self._said = arrival
        if arrival in UNKEPT:
            return arrival
        before, self.last = self.last, state
        written = self._x.tolist()
        self.x[:] = state.x
        self._rotations.normalize(self._x)
        if before is None:
            self._rotations.turn_up(self._x)
        else:
            self._rotations.bring_near(self._x, written)
        return arrival

    def estimate(self, sent: Sent, *, known: bool) -> Notice | None:
        """
        Replace the last state by the observer's estimate, if there is one.

        Args:
            sent: The inputs that have acted since the last estimate.
            known: Whether it is certain that they acted; otherwise the disturbances keep their values.

        Returns:
            Notice of an estimate that was lost, None if there is nothing to report.
        """
        observer, last = self._observer, self.last
        if observer is None or last is None:
            return None
        if self.seen is not self.x:
            self.seen[:] = self.x
        lost = None
        before_ns, self._estimated_ns = self._estimated_ns, last.stamp_ns  # states that were late lie between them
        if before_ns is None or not 0 < last.stamp_ns - before_ns <= self._stale_ns:
            observer.reset(self.x)
        else:
            observer.frozen = not known
            for u, span_s in sent.spans(before_ns, last.stamp_ns):
                observer.predict(u, span_s)
            self._rotations.bring_near(self.x, observer.x)  # a turn between two states is no innovation
            observer.correct(self.x)
            if not observer.finite:
                observer.reset(self.x)
                lost = Notice(Severity.WARNING, "estimate_lost", "the estimate is not finite: it begins anew at the state that was received")
        self.x[:] = observer.x
        if self._unmeasured:
            self.seen[self._unmeasured] = self.x[self._unmeasured]
        return lost

    def _judge(self, state: State, arrival_ns: int) -> tuple[Arrival, str, str]:
        """Return the verdict on a state, with the code and the text of its notice."""
        if not bounded(state.x, MAX_STATE_MAGNITUDE):
            return Arrival.REFUSED, "state_refused", f"a state must be finite and at most {MAX_STATE_MAGNITUDE:g}, got {state.x.tolist()}"
        if wrong := self._rotations.misfit(state.x):
            return Arrival.REFUSED, "state_refused", f"a state is refused: {wrong}"
        heard = self.lives.judge(state.epoch, arrival_ns, self.clock.rate)
        self.notice = self.lives.notice
        if heard is OTHER:
            return Arrival.FOREIGN, "", ""
        began = heard is BEGINS and self.last is not None
        if heard is BEGINS:
            self.last = self._estimated_ns = None
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
        judged = (Arrival.NEW_LIFE, "robot_restarted", "the robot was restarted: starting cold") if began else NOTHING_SAID
        if last is not None and state.stamp_ns <= last.stamp_ns:
            back_ns = last.stamp_ns - state.stamp_ns
            if back_ns <= self._stale_ns:
                return Arrival.REPEATED, "", ""
            judged = Arrival.JUMPED_BACK, "clock_jumped", f"the robot's clock went back {1e-9 * back_ns:.3f} s: starting cold"
            self.last = self._estimated_ns = None
            self.clock.jump()
            self.cadence.jump()
        if not self.clock.observe(state.seq, state.stamp_ns, arrival_ns):
            return Arrival.OLD, "state_old", "states were delayed on their way: they are not answered"
        if self.clock.leapt:
            text = f"the robot's clock jumped ahead {1e-9 * (state.stamp_ns - self.before_ns):.3f} s: starting cold"
            return Arrival.JUMPED_AHEAD, "clock_jumped", text
        return judged
