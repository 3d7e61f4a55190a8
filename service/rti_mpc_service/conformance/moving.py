# SPDX-License-Identifier: Apache-2.0
"""
Conformance of a robot that inputs at rest do not stop or hold: one that drifts, sinks or falls without its controller.

Commands are those by which our controller stops the robot and holds it, each with a way
to rest. A case nudges them a little, and compares the inputs that the states report with
the rows that act at their stamps, and on a way to rest with what its gain makes of the
states: :math:`u_i - K (x - x_i)`. As in `rti_mpc_service.conformance.robot`, every time is
one of the robot's own stamps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.contract.schedule import end_ns
from rti_mpc.contract.way import Way
from rti_mpc.control.controller import Controller
from rti_mpc_service.conformance import robot
from rti_mpc_service.conformance.finding import Case, Finding, Unseen
from rti_mpc_service.conformance.level import Levels, shown, slew_share
from rti_mpc_service.conformance.robot import (
    APPROACH_ROUNDING,
    FIRST_SEQ,
    LATE_NS,
    MIN_ANSWERS,
    OBEYED_PERIODS,
    STANDS_NS,
    WRONG_PERIODS,
    Link,
    seconds,
    sound,
)
from rti_mpc_service.conformance.wrong import refused, wrong

NUDGE_SHARE = 0.03  # of an input's range: a robot moves no more than it must to be judged
NEAR_SHARE = 1 / 3  # of a nudge, within which an input is as it should be
SETTLING_NS = 20_000_000_000  # robot time for a robot to come to rest
BUSY_SHARE = 0.1  # of that time, for which a host that holds us up explains that it does not
WAY_NS = 3_000_000_000  # robot time for which a way to rest is watched
SAMPLES = 9  # times within which an input may be late, at which it is looked up
ROWS = 20  # that follow the end of a command, and must not act
STILL_SHARE = 0.02  # of how fast a state changes in operation
REMEMBERED = 64  # commands: those of the longest case that is judged afterwards

Make = Callable[[Command], "Command | None"]
Forge = Callable[[Command], "Command | bytes"]


def silent(_: Command) -> None:
    """Answer nothing."""


def healthy(command: Command) -> Command:
    """Answer with what the controller says."""
    return command


class MovingTrial:
    """
    A robot that is judged, and the controller that stops and holds it.

    Attributes:
        limits: Limits of the inputs.
        levels: Their slew limits.
        dt_ns: Period of the controller.
        state: The last state of the robot.
        epoch: Epoch of the controller.
        size: How far a case moves the inputs, shape ``(nu,)``; `near`, how far they may be from where they should be.
    """

    def __init__(self, link: Link, limits: Limits, controller: Controller, rates: Array, epoch: int) -> None:
        """
        Wait for the robot's first state.

        Args:
            link: Connection to the robot.
            limits: Limits of the inputs.
            controller: One that has just been made, for this robot.
            rates: How fast the states change in operation, shape ``(nx,)``.
            epoch: Epoch of the controller.
        """
        self.limits, self.levels, self.epoch = limits, Levels.of(limits), epoch
        self.dt_ns, self.rates = round(1e9 * limits.dt_s), rates
        self.size = np.minimum(NUDGE_SHARE * (limits.ubu - limits.lbu), self.levels.step)
        self.near = NEAR_SHARE * self.size
        self._link, self._controller, self._seq = link, controller, FIRST_SEQ
        self._sent: deque[Command] = deque(maxlen=REMEMBERED)
        self._lost = ""  # why the robot cannot be moved
        controller.stop("conformance")
        controller.lead(epoch)
        self.state = self._take(silent)[-1]

    def run(self, for_ns: int, pilot: Make = silent, until: Callable[[State], bool] = lambda _: False, forge: Forge | None = None) -> list[State]:
        """
        Let the controller answer the robot for some time of it, or until a state shows something; return its states, the present one first.

        Args:
            for_ns: Robot time.
            pilot: What becomes of a command before it is sent; None: it is not sent.
            until: Ends it.
            forge: Makes what has to be refused of each command that was sent; it follows that command.
        """
        seen, last_ns = [self.state], self.state.stamp_ns + for_ns
        while self.state.stamp_ns < last_ns:
            for state in self._take(pilot, forge):
                seen.append(state)
                if until(state):
                    return seen
        return seen

    def settle(self) -> None:
        """
        Bring the robot to rest, and hold it there.

        Raises:
            Unseen: It does not come to rest, or does not report its inputs.
        """
        if not self._lost and len(self.state.u) != len(self.size):
            self._lost = "its states do not report the inputs that act"
        if self._lost:
            raise Unseen(self._lost)
        self.run(MIN_ANSWERS * self.dt_ns, healthy)
        self.run(SETTLING_NS, healthy, until=lambda _: self._controller.at_rest)
        if not self._controller.at_rest:
            raise Unseen(f"healthy commands did not bring it to rest within {seconds(SETTLING_NS)}", 1e-6 * BUSY_SHARE * SETTLING_NS)

    def tell(self, make: Callable[[Command], Command] = healthy) -> Command:
        """Send the next command, changed, twice in case one is lost, and return it; nothing is sent after it."""
        told: list[Command] = []

        def once(command: Command) -> Command | None:
            if told:
                return None
            told.append(make(command))
            return told[0]

        self.run(SETTLING_NS, once, until=lambda _: bool(told))
        if not told:
            raise Unseen(f"no state came that a command answers, for {seconds(SETTLING_NS)}")
        return self._send(told[0])

    def nudge(self, u: Array) -> Array:
        """Return how a case moves an input, shape ``(nu,)``: to where the bounds leave more room."""
        return np.where(self.limits.ubu - u >= u - self.limits.lbu, self.size, -self.size)

    def astray(self, states: Iterable[State], seen: list[State], from_ns: int) -> list[tuple[State, Array]]:
        """
        Return the states whose inputs no command that acts explains, with the input of the last command.

        Args:
            states: States to judge, with inputs.
            seen: Those by which a robot may have corrected its way to rest.
            from_ns: Time before which none is judged.
        """
        wrong_states = []
        for state in states:
            if state.stamp_ns < from_ns:
                continue
            lowest, highest, at = self._explained(state.stamp_ns, seen)
            if ((state.u < lowest - self.near) | (state.u > highest + self.near)).any():
                wrong_states.append((state, at))
        return wrong_states

    def obeyed(self, state: State, forged: Iterable[Command]) -> bool:
        """Whether the inputs of a state are those of a command that had to be refused, each of which holds its first row."""
        since_ns = state.stamp_ns - LATE_NS - 2 * self.dt_ns
        rows = [command.u[0] for command in forged if since_ns <= command.state_stamp_ns < state.stamp_ns]
        return any(bool((np.abs(state.u - row) <= self.near).all()) for row in rows)

    def give_up(self, reason: str) -> None:
        """Try no more to move the robot."""
        self._lost = reason

    def next_leader(self) -> None:
        """Go on in a higher epoch, as the controller does that takes over."""
        self.epoch += 1 << NUMBER_BITS
        self._controller.lead(self.epoch)

    def leave(self) -> None:
        """Bring the robot to rest, whatever it was told before."""
        self.next_leader()
        self.run(MIN_ANSWERS * self.dt_ns, healthy)
        self.run(SETTLING_NS, healthy, until=lambda _: self._controller.at_rest)

    def _explained(self, t_ns: int, seen: list[State]) -> tuple[Array, Array, Array]:
        """Return the lowest and the highest input that may act at a time, shape ``(nu,)`` each, and that of the last command."""
        late_ns = LATE_NS + round(1e9 * self.limits.delay_s)
        spacing_ns = round(float(np.median(np.diff([state.stamp_ns for state in seen])))) if len(seen) > 1 else self.dt_ns
        acting: list[Array] = []
        sent = list(self._sent)
        for command, after in zip(sent, [*sent[1:], None], strict=True):
            if command.stamp_ns > t_ns or (after is not None and after.stamp_ns < t_ns - late_ns - self.dt_ns):
                continue
            ends_ns = end_ns(command)
            for s_ns in np.linspace(t_ns - late_ns, t_ns, SAMPLES).astype(int).tolist():
                if s_ns < ends_ns or not len(command.u_rest):
                    acting.append(command.u[max(0, min((s_ns - command.stamp_ns) // command.period_ns, len(command.u) - 1))])
                    continue
                way = Way.of(command, ends_ns)
                assert way is not None
                felt = [state for state in seen if s_ns - late_ns - 2 * spacing_ns <= state.stamp_ns <= s_ns]
                ways = [way.corrected(state.x, state.stamp_ns, self.limits.rotations) for state in felt] or [way]
                acting += [np.clip(way.u[way.row(s_ns)] + each.correction, self.limits.lbu, self.limits.ubu) for each in ways]
        if not acting:
            return np.full_like(self.size, -np.inf), np.full_like(self.size, np.inf), self.size
        return np.min(acting, axis=0), np.max(acting, axis=0), acting[-1]

    def _take(self, pilot: Make, forge: Forge | None = None) -> list[State]:
        """Wait for states, and answer each that is due."""
        states = self._link.states()
        for state in states:
            self.state = state
            if state.x.shape != self.rates.shape or not np.isfinite(state.x).all():
                continue
            if (proposal := self._controller.receive_state(state, state.stamp_ns)) is not None:
                if (command := pilot(proposal)) is not None:
                    sent = self._send(command)
                    if forge is not None:
                        self._seq += 1
                        self._link.put(forge(sent))
                self._controller.prepare()
        return states

    def _send(self, command: Command) -> Command:
        self._seq += 1
        command = replace(command, seq=self._seq)
        self._link.put(command)
        self._controller.commit(command)
        self._sent.append(command)
        return command


def states(trial: MovingTrial) -> Finding:
    """Judge the states that come while the robot is held."""
    return sound(trial.run(STANDS_NS, healthy), trial.limits.rotations.size)


def plays(trial: MovingTrial) -> Finding:
    """Judge the rows of a plan that nothing follows, one of them nudged."""
    trial.settle()

    def nudged(command: Command) -> Command:
        u, count = command.u[0], max(2, -(-3 * LATE_NS // command.period_ns))
        rows = np.vstack([u, np.tile(u + trial.nudge(u), (count, 1)), u])
        return replace(command, u=rows, valid_until_ns=command.stamp_ns + len(rows) * command.period_ns)

    plan = trial.tell(nudged)
    seen = trial.run(end_ns(plan) - trial.state.stamp_ns)
    begin_ns = plan.stamp_ns + plan.period_ns + LATE_NS + round(1e9 * trial.limits.delay_s)
    judged = [state for state in seen if begin_ns <= state.stamp_ns < end_ns(plan)]
    if not judged:
        raise Unseen(f"no state came between the second row of a plan and its end, {seconds(end_ns(plan) - plan.stamp_ns)} after its state")
    if astray := trial.astray(judged, seen, begin_ns):
        state, at = astray[0]
        if not obeys(trial):
            trial.give_up("it does not follow healthy commands")
        text = f"{seconds(state.stamp_ns - plan.stamp_ns)} after the first row {shown(at)} should act, got {shown(state.u)}"
        return Finding(False, text, 1e-6 * LATE_NS)
    return Finding(True, "each row acted at its time")


def expiry(trial: MovingTrial) -> Finding:
    """Judge what follows the end of a command that has more rows than it is valid for."""
    trial.settle()

    def longer(command: Command) -> Command:
        over = np.tile(command.u[-1] + trial.nudge(command.u[-1]), (ROWS, 1))
        return replace(command, u=np.vstack([command.u, over]), valid_until_ns=command.stamp_ns + len(command.u) * command.period_ns)

    return after_end(trial, trial.tell(longer), STANDS_NS, "no row acted after its end, and its way to rest did")


def way_to_rest(trial: MovingTrial) -> Finding:
    """Judge a way to rest that leads a little elsewhere: by its gain, where it has one, so that the rows alone are not right."""
    trial.settle()

    def elsewhere(command: Command) -> Command:
        nudge = trial.nudge(command.u_rest[-1])
        if len(command.K):
            return replace(command, x_rest=command.x_rest + np.linalg.pinv(command.K) @ nudge)
        held = 3 - (-4 * LATE_NS // command.rest_period_ns)
        return replace(command, u_rest=np.vstack([np.tile(command.u_rest[0] + nudge, (held, 1)), command.u_rest]))

    last = trial.tell(elsewhere)
    how = "corrected by every state" if len(last.K) else "without feedback, as it has no gain"
    return after_end(trial, last, WAY_NS, f"its rows acted after the plan's end, {how}")


def after_end(trial: MovingTrial, last: Command, for_ns: int, kept: str) -> Finding:
    """Judge the inputs after the end of the last command."""
    ends_ns = end_ns(last)
    seen = trial.run(ends_ns + for_ns - trial.state.stamp_ns)
    late_ns = LATE_NS + round(1e9 * trial.limits.delay_s)
    if all(state.stamp_ns < ends_ns + late_ns for state in seen):
        raise Unseen("no state came after the end of the last command")
    if astray := trial.astray(seen, seen, ends_ns + late_ns):
        state, at = astray[0]
        text = f"{seconds(state.stamp_ns - ends_ns)} after the plan's end its way to rest is {shown(at)}, got {shown(state.u)}"
        return Finding(False, text, 1e-6 * late_ns)
    return Finding(True, kept)


def slew(trial: MovingTrial) -> Finding:
    """Judge the inputs after plans that begin far from them, as those of a controller do that knows nothing of a gap or of lost commands."""
    trial.settle()
    if not np.isfinite(trial.levels.step).any():
        return Finding(True, "its inputs have no slew limits")
    far = np.where(np.isfinite(trial.levels.step), 2.5 * trial.levels.step, 0.0)

    def jumped(command: Command) -> Command:
        u = np.clip(command.u + np.sign(trial.nudge(command.u[0])) * far, trial.limits.lbu, trial.limits.ubu)
        return replace(command, u=u)

    seen = trial.run(3 * trial.dt_ns, jumped) + trial.run(5 * trial.dt_ns, healthy)[1:]
    times = [state.stamp_ns for state in seen]
    share = slew_share(times, np.array([state.u for state in seen]), trial.levels, trial.dt_ns)
    text = f"between two states its inputs changed by {100 * share:.0f} % of what the slew limits allow in that time"
    return Finding(share <= 1.0 + APPROACH_ROUNDING, text)


def epochs(trial: MovingTrial) -> Finding:
    """Judge a takeover, and commands of the old controller after it."""
    trial.settle()
    trial.next_leader()
    if not obeys(trial):
        return Finding(False, "a controller of a higher epoch did not take over")
    return ignores("epochs")(trial)


def obeys(trial: MovingTrial) -> bool:
    """Whether the robot does what healthy commands say: a nudge, for some periods."""
    trial.settle()
    wanted: list[Array] = []

    def nudged(command: Command) -> Command:
        if not wanted:
            wanted.append(command.u[0] + trial.nudge(command.u[0]))
        return replace(command, u=np.tile(wanted[0], (len(command.u), 1)))

    count = 2 - (-3 * LATE_NS // trial.dt_ns)
    seen = trial.run(count * trial.dt_ns, nudged, until=lambda state: bool(wanted) and bool((np.abs(state.u - wanted[0]) <= trial.near).all()))
    return bool((np.abs(seen[-1].u - wanted[0]) <= trial.near).all())


def ignores(name: str) -> Callable[[MovingTrial], Finding]:
    """Return the judgement of the wrong commands of one case."""

    def judge(trial: MovingTrial) -> Finding:
        ways = wrong(name, robot=True)
        for way in ways:
            trial.settle()
            begin_ns, forged = trial.state.stamp_ns, list[Command]()

            def forge(
                sent: Command, make: Callable[[Command, Limits], Command | bytes] = way.make, forged: list[Command] = forged
            ) -> Command | bytes:
                forged.append(replace(sent, seq=sent.seq + 1, u=np.tile(sent.u[0] + trial.nudge(sent.u[0]), (len(sent.u), 1))))
                return make(forged[-1], trial.limits)

            seen = trial.run(WRONG_PERIODS * trial.dt_ns, healthy, forge=forge)
            moved = [state for state in seen if trial.obeyed(state, forged)]
            if len({(state.stamp_ns - begin_ns) // trial.dt_ns for state in moved}) >= OBEYED_PERIODS:
                return Finding(False, f"a command {way.what} moved its inputs to {shown(moved[0].u)}")
        return Finding(True, refused(ways)) if obeys(trial) else Finding(False, "after them healthy commands did not act")

    return judge


def stands(trial: MovingTrial) -> Finding:
    """Judge a stop, and the silence after it."""
    trial.settle()
    last = trial.tell()
    if (finding := after_end(trial, last, 3 * STANDS_NS, "")).kept is not True:
        return finding
    before = trial.state
    trial.run(STANDS_NS)
    away = np.abs(trial.limits.rotations.difference(trial.state.x, before.x))
    if (away > STILL_SHARE * trial.rates).any():
        return Finding(False, f"within {seconds(STANDS_NS)} of silence its states changed by {shown(away)}")
    return Finding(True, f"it stayed at rest for {seconds(4 * STANDS_NS)} without commands")


OWN: dict[str, Callable[[MovingTrial], Finding]] = {
    "states": states,
    "plays": plays,
    "expiry": expiry,
    "way": way_to_rest,
    "slew": slew,
    "epochs": epochs,
    **{name: ignores(name) for name in ("late", "foreign", "repeated", "malformed")},
    "stop": stands,
}
CASES = tuple(Case(case.name, case.promise, case.mend, OWN[case.name]) for case in robot.CASES)
