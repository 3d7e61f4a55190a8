# SPDX-License-Identifier: Apache-2.0
"""
Conformance of a robot: this process takes the place of its controller, and the robot's states say what it does.

Every time is one of the robot's own stamps, so a host that holds up this process changes
no verdict. Wrong commands come beside those of a healthy controller that keeps the robot
at rest: an input that moves shows that one was obeyed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.status import Mode
from rti_mpc_service.conformance.answer import answer
from rti_mpc_service.conformance.finding import Case, Finding, Unseen
from rti_mpc_service.conformance.level import Levels, shown, slew_share
from rti_mpc_service.conformance.wrong import refused, wrong

MS = 1_000_000
PATIENCE_S = 3.0  # robot time, beyond the ramp, for a robot to do what healthy commands say
LATE_NS = 50_000_000  # robot time that a robot may act later than the contract says: a drive that renews its inputs at 20 Hz
MIN_ANSWERS = 30  # and at least so many
STANDS_NS = 1_000_000_000  # robot time for which a robot is seen to stand
WRONG_PERIODS = 6  # how often a wrong command is sent
OBEYED_PERIODS = 3  # in how many of them the inputs move, if it is obeyed: a host that holds up the healthy ones makes it one
APPROACH_ROUNDING = 0.02  # share of an increment that a drive may resolve
FIRST_SEQ = 1000  # lower numbers have passed

Pilot = Callable[[State], "Command | None"]


class Link(Protocol):
    """Connection to the robot."""

    def states(self) -> list[State]:
        """Wait for the next states, oldest first."""

    def put(self, command: Command | bytes) -> None:
        """Send a command, or bytes that are none."""


class Trial:
    """
    A robot that is judged, and the controller that judges it.

    Attributes:
        limits: Limits of the inputs.
        levels: Levels between which they are moved.
        state: The last state of the robot.
        epoch: Epoch of the controller.
    """

    def __init__(self, link: Link, limits: Limits, valid_s: float, epoch: int) -> None:
        """
        Wait for the robot's first state.

        Args:
            link: Connection to the robot.
            limits: Limits of the inputs.
            valid_s: Time after a state for which its command may act.
            epoch: Epoch of the controller.
        """
        self.limits, self.levels, self.epoch = limits, Levels.of(limits), epoch
        self.dt_ns = round(1e9 * limits.dt_s)
        self._valid_ns, self._link, self._seq = round(1e9 * valid_s), link, FIRST_SEQ
        self._lost = ""  # why the robot cannot be moved
        self._answered_ns = -(2**62)
        self.state = self._next()[-1]

    def run(self, for_ns: int, pilot: Pilot = lambda _: None, until: Callable[[State], bool] = lambda _: False) -> list[State]:
        """Let a pilot answer the robot for some time of it, or until a state shows something; return its states, the present one first."""
        seen, end_ns = [self.state], self.state.stamp_ns + for_ns
        self._answer(pilot)
        while self.state.stamp_ns < end_ns:
            for state in self._next():
                seen.append(state)
                if until(state):
                    return seen
            self._answer(pilot)
        return seen

    def command(self, u: Array, **change: object) -> Command:
        """Return the next command, an answer to the last state."""
        self._seq += 1
        healthy = answer(self.state, u, epoch=self.epoch, seq=self._seq, period_ns=self.dt_ns, valid_ns=self._valid_ns)
        return replace(healthy, **change)  # type: ignore[arg-type]

    def send(self, command: Command | bytes) -> None:
        """Send a command, or bytes that are none."""
        self._link.put(command)

    def towards(self, level: Array, **change: object) -> Pilot:
        """Return the pilot of a healthy controller that brings the inputs to a level."""
        return lambda state: self.command(self.levels.towards(state.u, level), **change)

    def reach(self, level: Array, pilot: Pilot | None = None) -> list[State]:
        """
        Bring the inputs to a level, and keep them there for two periods.

        Returns:
            The states on the way.

        Raises:
            Unseen: They do not come there, or the robot does not report them.
        """
        if not self._lost and len(self.state.u) != len(level):
            self._lost = "its states do not report the inputs that act"
        if self._lost:
            raise Unseen(self._lost)
        pilot = pilot or self.towards(level)
        most = max(MIN_ANSWERS, round((PATIENCE_S + self.limits.ramp_s) / self.limits.dt_s))
        seen = self.repeat(most, pilot, until=lambda state: self.levels.at(state.u, level))
        if not self.levels.at(self.state.u, level):
            raise Unseen(f"healthy commands to {shown(level)} did not bring its inputs there, but to {shown(self.state.u)}")
        return seen + self.repeat(2, pilot)[1:]

    def repeat(self, count: int, pilot: Pilot, until: Callable[[State], bool] = lambda _: False) -> list[State]:
        """Let a pilot answer some states, however long a host takes for it, or until one shows something; return the states meanwhile."""
        seen = [self.state]
        for _ in range(count):
            seen += self.run(self.dt_ns, pilot, until)[1:]
            if until(self.state):
                break
        return seen

    def give_up(self, reason: str) -> None:
        """Try no more to move the robot."""
        self._lost = reason

    def next_leader(self) -> None:
        """Go on in a higher epoch, as the controller does that takes over."""
        self.epoch += 1 << NUMBER_BITS

    def leave(self) -> None:
        """Bring the robot to rest, whatever it was told before."""
        self._lost = ""
        self.next_leader()
        if len(self.state.u) == len(self.levels.rest):
            self.repeat(MIN_ANSWERS, self.towards(self.levels.rest), until=lambda state: self.levels.at(state.u, self.levels.rest))

    def _answer(self, pilot: Pilot) -> None:
        """Let a pilot answer the last state, once per period."""
        if self.state.stamp_ns - self._answered_ns < 0.75 * self.dt_ns:
            return
        self._answered_ns = self.state.stamp_ns
        if (command := pilot(self.state)) is not None:
            self.send(command)

    def _next(self) -> list[State]:
        """Wait for states."""
        states = self._link.states()
        self.state = states[-1]
        return states


def seconds(ns: float) -> str:
    """Return a time as text."""
    return f"{1e-9 * ns:.2f} s"


def states(trial: Trial) -> Finding:
    """Judge the states that come while nothing is commanded."""
    return sound(trial.run(STANDS_NS), trial.limits.rotations.size)


def sound(seen: list[State], nx: int) -> Finding:
    """Judge states of a robot whose model has `nx`, by their numbers, stamps, sizes and epochs."""
    numbers, stamps = [state.seq for state in seen], [state.stamp_ns for state in seen]
    for what, values in (("numbers", numbers), ("stamps", stamps)):
        if any(after <= before for before, after in pairwise(values)):
            return Finding(False, f"the {what} of its states did not increase")
    if any(state.x.shape != (nx,) or not np.isfinite(state.x).all() for state in seen):
        return Finding(False, f"a state was not of {nx} finite numbers, the model's states")
    if len({state.epoch for state in seen}) > 1:
        return Finding(False, "states came in two epochs: two robots use this name, or it was restarted")
    return Finding(True, f"{len(seen) - 1} states in {seconds(stamps[-1] - stamps[0])} of its clock")


def plays(trial: Trial) -> Finding:
    """Judge the rows of a plan that nothing follows."""
    try:
        trial.reach(trial.levels.high)
    except Unseen as reason:
        if len(trial.state.u):
            trial.give_up("it does not follow healthy commands")
            return Finding(False, str(reason))
        raise
    levels, dt_ns = trial.levels, trial.dt_ns
    rows = np.array([levels.high + min(0.2 * k, 1.0) * (levels.rest - levels.high) for k in range(20)])
    plan = trial.command(rows)
    plan.valid_until_ns = max(plan.valid_until_ns, plan.stamp_ns + 3 * dt_ns)
    trial.send(plan)
    seen = trial.run(2 * dt_ns + plan.valid_until_ns - plan.stamp_ns)
    late_ns = LATE_NS + round(1e9 * trial.limits.delay_s)
    judged = [state for state in seen if plan.stamp_ns + dt_ns + late_ns <= state.stamp_ns < plan.valid_until_ns]
    if not judged:
        raise Unseen(f"no state came between the second row of a plan and its end, {seconds(plan.valid_until_ns - plan.stamp_ns)} after its state")
    for state in judged:
        first, last = ((at_ns - plan.stamp_ns) // dt_ns for at_ns in (state.stamp_ns - late_ns, state.stamp_ns))
        acting = rows[first : last + 1]
        if ((state.u < acting.min(axis=0) - levels.near) | (state.u > acting.max(axis=0) + levels.near)).any():
            text = f"{seconds(state.stamp_ns - plan.stamp_ns)} after the first row {shown(rows[last])} should act, got {shown(state.u)}"
            return Finding(False, text, 1e-6 * late_ns)
    return Finding(True, "each row acted at its time")


def expiry(trial: Trial) -> Finding:
    """Judge what follows the last command."""
    levels = trial.levels
    end_ns = last_heard(trial, trial.towards(levels.high))
    ramp_ns = 1e9 * float(np.max(np.abs(levels.high - levels.rest) / trial.limits.slew))
    seen = trial.run(round(ramp_ns) + STANDS_NS + end_ns - trial.state.stamp_ns)
    rests = [state.stamp_ns for state in seen if state.stamp_ns >= end_ns and levels.at(state.u, levels.rest)]
    if not rests:
        return Finding(False, f"{seconds(seen[-1].stamp_ns - end_ns)} after its end the inputs were still {shown(seen[-1].u)}")
    before = [state.stamp_ns for state in seen if state.stamp_ns < rests[0]]
    took_ns = before[-1] - end_ns  # its inputs were seen to move that long
    if took_ns > ramp_ns + LATE_NS:
        text = f"the inputs were not at rest {seconds(took_ns)} after its end, inside the slew limits they can be after {seconds(ramp_ns)}"
        return Finding(False, text, 1e-6 * (took_ns - ramp_ns - LATE_NS))
    return Finding(True, f"the inputs were at rest {seconds(max(0, rests[0] - end_ns))} after its end")


def last_heard(trial: Trial, pilot: Pilot) -> int:
    """Bring the inputs high, send one last command there, and return when it ends."""
    trial.reach(trial.levels.high, pilot)
    last = pilot(trial.state)
    assert last is not None
    trial.send(last)
    return last.valid_until_ns


def way_to_rest(trial: Trial) -> Finding:
    """Judge a way to rest that first holds the inputs, which no ramp does."""
    levels, dt_ns = trial.levels, trial.dt_ns
    held_rows = 3 - (-4 * LATE_NS // dt_ns)
    way = levels.way(levels.high, held_rows)
    end_ns = last_heard(trial, trial.towards(levels.high, u_rest=way, rest_period_ns=dt_ns))
    seen = trial.run(end_ns - trial.state.stamp_ns + len(way) * dt_ns + STANDS_NS)
    # The last command may have been lost, and the one before it ended up to two periods sooner.
    held = [state for state in seen if end_ns + LATE_NS <= state.stamp_ns <= end_ns + (held_rows - 2) * dt_ns - LATE_NS]
    if not held:
        raise Unseen("no state came while the way to rest held the inputs")
    if (away := next((state for state in held if not levels.at(state.u, levels.high)), None)) is not None:
        after = seconds(away.stamp_ns - end_ns)
        return Finding(False, f"{after} after the plan's end its way to rest holds {shown(levels.high)}, got {shown(away.u)}", 2e-6 * dt_ns)
    if not levels.at(seen[-1].u, levels.rest):
        return Finding(False, f"the inputs did not come to its last row, {shown(levels.rest)}, but to {shown(seen[-1].u)}")
    return Finding(True, "its rows acted after the plan's end")


def slew(trial: Trial) -> Finding:
    """Judge the inputs after plans that begin far from them, as those of a controller do that knows nothing of a gap or of lost commands."""
    levels = trial.levels
    trial.reach(levels.rest)
    trial.run(STANDS_NS)
    seen = trial.reach(levels.high, lambda _: trial.command(np.tile(levels.high, (20, 1))))
    seen += trial.reach(levels.low, lambda _: trial.command(np.tile(levels.low, (20, 1))))[1:]
    trial.reach(levels.rest)
    times = [state.stamp_ns for state in seen]
    jumps = np.array([levels.rest, levels.high, levels.low])
    apart_ns = round(float(np.median(np.diff(times))))
    if slew_share([0, apart_ns, 2 * apart_ns], jumps, levels, trial.dt_ns) < 1.1:
        raise Unseen(f"with states {seconds(apart_ns)} apart a jump is not told from an approach: send them more often")
    share = slew_share(times, np.array([state.u for state in seen]), levels, trial.dt_ns)
    text = f"between two states its inputs changed by {100 * share:.0f} % of what the slew limits allow in that time"
    return Finding(share <= 1.0 + APPROACH_ROUNDING, text)


def epochs(trial: Trial) -> Finding:
    """Judge a takeover, and commands of the old controller after it."""
    trial.reach(trial.levels.rest)
    trial.next_leader()
    try:
        trial.reach(trial.levels.high)
    except Unseen as reason:
        return Finding(False, f"a controller of a higher epoch did not take over: {reason}")
    return ignores("epochs")(trial)


def ignores(name: str) -> Callable[[Trial], Finding]:
    """Return the judgement of the wrong commands of one case."""

    def judge(trial: Trial) -> Finding:
        levels, ways = trial.levels, wrong(name, robot=True)
        for way in ways:
            trial.reach(levels.rest)

            def pilot(state: State, make: Callable[[Command, Limits], Command | bytes] = way.make) -> None:
                trial.send(trial.command(np.tile(levels.rest, (20, 1))))
                trial.send(make(trial.command(levels.towards(state.u, levels.high)), trial.limits))

            begin_ns = trial.state.stamp_ns
            seen = trial.repeat(WRONG_PERIODS, pilot)
            moved = [state for state in seen if not levels.at(state.u, levels.rest)]
            if len({(state.stamp_ns - begin_ns) // trial.dt_ns for state in moved}) >= OBEYED_PERIODS:
                return Finding(False, f"a command {way.what} moved its inputs to {shown(moved[0].u)}")
        try:
            trial.reach(levels.high)
        except Unseen as reason:
            return Finding(False, f"after them {reason}")
        return Finding(True, refused(ways))

    return judge


def stands(trial: Trial) -> Finding:
    """Judge a stop, and the silence after it."""
    levels = trial.levels
    trial.reach(levels.high)
    trial.reach(levels.rest, trial.towards(levels.rest, mode=Mode.STOPPED))
    seen = trial.run(STANDS_NS, trial.towards(levels.rest, mode=Mode.STOPPED)) + trial.run(3 * STANDS_NS)
    if (moved := next((state for state in seen if not levels.at(state.u, levels.rest)), None)) is not None:
        return Finding(False, f"its inputs were {shown(moved.u)} {seconds(moved.stamp_ns - seen[0].stamp_ns)} after it had come to rest")
    return Finding(True, f"its inputs stayed at rest for {seconds(seen[-1].stamp_ns - seen[0].stamp_ns)}, with commands and without")


REFUSE = "refuse it as a whole, and play on what came before"
CASES = (
    Case("states", "states come in one epoch, with numbers and stamps that increase, as many finite numbers as the model has states",
         "stamp each state with the robot's own monotonic clock in ns, and number it", states),
    Case("plays", "row i of a command acts from stamp_ns + i * period_ns on, also when no other command follows",
         "play the rows by their times, not only the first; report the inputs that act in each state", plays),
    Case("expiry", "from valid_until_ns on no row acts, and the inputs go to rest inside the slew limits",
         "give the drive a watchdog of its own that ramps to rest at valid_until_ns, and by no message", expiry),
    Case("way", "a command's own way to rest acts from the end of its plan on",
         "play the rows of u_rest after the plan, rest_period_ns apart, and ramp to rest only without them", way_to_rest),
    Case("slew", "a plan that begins far from the inputs that act, after a gap or a loss, is approached inside the slew limits",
         "limit each row by the inputs that really acted within three quarters of a period before it", slew),
    Case("epochs", "a higher epoch takes over at once, and the lower one moves nothing while the higher commands",
         "keep the highest epoch heard, and refuse lower ones until it was silent for 250 ms", epochs),
    Case("late", "a command that is over when it comes moves nothing", REFUSE, ignores("late")),
    Case("foreign", "a command for another life of the robot moves nothing",
         "begin another epoch at each start, and refuse commands whose state_epoch is not the present one", ignores("foreign")),
    Case("repeated", "a command whose number is not above the last one of its epoch moves nothing",
         "keep the last number of the epoch, and refuse what is not above it", ignores("repeated")),
    Case("malformed", "what is no command of this robot moves nothing, and ends nothing", REFUSE, ignores("malformed")),
    Case("stop", "a robot that was brought to rest stays at rest until a command moves it",
         "keep the inputs at rest once a way to rest is over", stands),
)  # fmt: skip
