# SPDX-License-Identifier: Apache-2.0
"""
The guard of one robot: passes a controller's command only if it is fresh, for this robot and inside every limit.

It reads no clock: every time is a stamp of the robot or local monotonic time that the
caller hands in. A healthy command passes at once and whole, so that the robot plays the
rest of the plan if nothing follows, even after the guard itself has died. Before the
last plan ends, the guard sends the plan's own way to rest, or the ramp if it has none, in
short commands, and then commands to stand, until a controller commands again. Each of
them carries what is left of the way. Where the way needs feedback, the guard plays
:math:`u = u_i - K (x - x_i)` with every state that arrives.

It trusts neither a controller that was stopped and continues where it was, nor an old
leader, nor messages that have waited somewhere, nor a clock that jumps.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.belief import Belief
from rti_mpc.contract.cadence import Cadence
from rti_mpc.contract.epoch import MAX_SEQ_GAP, epoch_above
from rti_mpc.contract.limits import MAX_VALID_NS, Limits
from rti_mpc.contract.lives import Heard, Lives
from rti_mpc.contract.message import Command, Notice, Severity, State
from rti_mpc.contract.robot_clock import Backlog, RobotClock
from rti_mpc.contract.schedule import BEFORE_ALL_NS, RAMP_STEP_NS, end_ns, unfit
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.contract.way import Way

MAX_STATE_AHEAD_NS = 50_000_000  # local time: the state that a command answers may be this far ahead of our idea of the robot's clock
MAX_STATE_LATE_NS = 50_000_000  # local time: a state that is later than this has waited on its way, and does not show the robot's clock
CLOCK_JUMP_NS = 250_000_000  # robot time: a larger difference from the time expected is a jump of the robot's clock
LEADER_SILENCE_NS = 250_000_000  # robot time: after this long without a command in order the leader's numbers may begin anywhere
HELD_UP_NS = 250_000_000  # local time: a longer pause between two calls means that this process was held up
RAMP_LEAD_NS = 30_000_000  # local time: the ramp to rest is sent this long before it is due
RAMP_STEPS_PER_COMMAND = 10  # steps of the ramp in one command of the guard
MAX_STEPS_PER_COMMAND = 100  # steps of a way to rest in one command of the guard, which lasts until the next row of the way begins
MIN_ROW_NS = 100_000  # shortest time between rows that a message may have


class Guard:
    """
    Decisions of one guard, from its start to its end.

    The caller hands in each message when it arrives, calls `tick` regularly, and
    publishes the commands that are returned.

    Attributes:
        epoch: Epoch of its commands: never below the highest of a controller, so that a starting controller hears which one to exceed.
        notices: Notices of what it did and why; the caller takes them.
        passing: Whether a controller's plan acts.
    """

    def __init__(self, limits: Limits, *, epoch: int = 1, config_hash: int = 0) -> None:
        self.epoch = epoch
        self.notices: deque[Notice] = deque(maxlen=64)
        self.passing = False
        self._limits = limits
        self._config_hash = config_hash
        self._dt_ns = round(1e9 * limits.dt_s)
        self._delay_ns = round(1e9 * limits.delay_s)
        self._stale_ns = round(1e9 * limits.stale_s)
        self._seq = 0
        self._lives = Lives(limits.stale_s, limits.settling_s)
        self._cadence = Cadence()
        self._clock = RobotClock()
        increments = Increments(limits.lbdu, limits.ubdu, self._dt_ns)
        # The plans that were passed to the robot, and its way to rest after them.
        self._schedule = Belief(limits.u_rest, limits.slew, increments, (limits.lbu, limits.ubu), limits.rotations)
        self._state: State | None = None  # the last one that came in time
        self._heard_ns = 0  # stamp of the last state
        self._late = Backlog()
        self._awake_ns = 0  # local time of the last call
        self._open_ns = BEFORE_ALL_NS  # robot time from which commands pass
        self._leader = (0, -1)  # epoch and sequence number of the last command that was in order
        self._led_ns = BEFORE_ALL_NS  # robot time of it
        self._told_ns = BEFORE_ALL_NS  # end of the last command that the robot was sent
        self._told_rest = True  # whether that command, if it is the guard's own, leads to rest: reports may change what is believed after it was sent
        self._engaged = False  # whether this robot was ever sent a command
        self._untold = False  # whether the command to brake has still to be sent
        self._braked = ((0, 0), BEFORE_ALL_NS)  # epoch and number of the last command to brake, and its end
        self._corrected = False  # whether the correction of its way to rest by the last state has still to be sent
        self._passed: Command | None = None  # the last command that was passed
        self._stopped = False
        self._latched = ""  # why an operator's stop is latched
        self._rest_by_ns = BEFORE_ALL_NS  # robot time from which a latched guard passes only commands at rest, and no way to rest any more
        self._waits = ""  # what commands wait for, as the last notice said

    def robot_now_ns(self, local_ns: int) -> int:
        """Return robot time at a local monotonic time, 0 before the first state."""
        return 0 if self._state is None else self._clock.now_ns(local_ns)

    @property
    def heard(self) -> bool:
        """Whether a state of the robot has come."""
        return self._state is not None

    def at_rest(self, local_ns: int) -> bool:
        """
        Whether the last command leads to rest and the robot is believed to rest by its end; or the robot was never commanded.

        A robot that is heard must also have heard of braking. One that has fallen silent says nothing of that.
        """
        if self._state is None or not self._engaged:
            return True
        now_ns = self._clock.now_ns(local_ns)
        if self._left_to_itself(now_ns):
            return True
        heard = self._blind(now_ns) or not self._unheard(self._state)
        return self._told_rest and heard and self._schedule.rests(self._told_ns - 1)

    # Incoming messages.

    def receive_state(self, state: State, local_ns: int) -> None:
        """Follow the robot's clock by a state, and notice the beginning of another life."""
        self._wake(local_ns)
        whose = self._lives.judge(state.epoch, local_ns, self._clock.rate)
        if self._lives.notice is not None:
            self.notices.append(self._lives.notice)
            begin_ns = self._clock.now_ns(local_ns) + round(RAMP_LEAD_NS * self._clock.rate)  # the command to brake is sent before it is due
            self._brake(begin_ns, begin_ns)
        if whose is Heard.OTHER or not self._counts(state, local_ns, begins=whose is Heard.BEGINS):
            return
        heard_ns = self._heard_ns
        if whose is Heard.BEGINS:
            self._begin(state)
        elif state.stamp_ns <= heard_ns:
            if heard_ns - state.stamp_ns <= CLOCK_JUMP_NS:
                return
            self._jump(state, local_ns, "back")
            self._cadence.jump()
        else:
            ahead_ns = state.stamp_ns - self._clock.now_ns(local_ns)
            late = ahead_ns < -MAX_STATE_LATE_NS * self._clock.rate
            self._heard_ns = state.stamp_ns
            if not late:
                self._late.clear()
            elif not self._late.believed(state.stamp_ns, local_ns, self._clock):
                return
            else:
                self._clock.jump()
            if ahead_ns > max(CLOCK_JUMP_NS, 2.5 * self._clock.period_ns):
                self._jump(state, local_ns, "ahead")
        self._take(state, local_ns)
        if len(state.u) == len(self._limits.u_rest) and not self._unheard(state):
            self._schedule.correct(state.stamp_ns, np.clip(state.u, self._limits.lbu, self._limits.ubu), (state.command_epoch, state.command_seq))
        self._feed_back(state.x, state.stamp_ns, self._clock.now_ns(local_ns))

    def receive_command(self, command: Command, local_ns: int) -> Command | None:
        """
        Judge a command.

        Returns:
            The command to publish at once; None if it is refused.
        """
        self._wake(local_ns)
        if self._stopped:
            return None
        if self._state is None:
            self._wait("a state of the robot has arrived")
            return None
        if not (self._cadence.known or self._cadence.fault):
            self._wait("two states have shown the rate of the robot's clock")
            return None
        now_ns = self._clock.now_ns(local_ns)
        until_ns = min(end_ns(command), command.state_stamp_ns + self._delay_ns + MAX_VALID_NS)
        reason = self._objection(command, now_ns, until_ns)
        if not reason:
            self._follow(command)
            self._led_ns = now_ns
            # The way to rest of an earlier guard lasted as long as this one; a robot that reports its inputs says where it is on it.
            unreported_s = 0.0 if len(self._state.u) else self._limits.outlasts_s(command)
            if now_ns < self._open_ns + round(1e9 * unreported_s):
                self._wait("all commands of an earlier guard have expired")
                return None
        if reason:
            code, _, why = reason.partition(": ")
            text = f"command {command.seq} of epoch {command.epoch} was refused: {why or code.replace('_', ' ')}"
            self._say(Severity.WARNING, f"command_{code}", text)
            return None
        start_ns = max(command.stamp_ns, now_ns)
        u = np.clip(command.u, self._limits.lbu, self._limits.ubu)
        u_rest = np.clip(command.u_rest, self._limits.lbu, self._limits.ubu) if len(command.u_rest) else command.u_rest
        passed = self._numbered(replace(command, valid_until_ns=min(command.valid_until_ns, until_ns), u=u, u_rest=u_rest))
        passed.u = self._schedule.add(passed, start_ns, until_ns)
        if (np.abs(passed.u - u) > self._limits.tolerance).any():
            text = f"command {command.seq} of epoch {command.epoch} begins too far from the acting inputs: it is approached inside the slew limits"
            self._say(Severity.WARNING, "slew_limited", text)
        self._waits = ""
        if not self.passing:
            self.passing = True
            self._say(Severity.INFO, "guard_passing", f"commands of epoch {command.epoch} pass", change=True)
        self._engaged, self._corrected, self._told_ns, self._told_rest, self._passed = True, False, until_ns, True, passed
        self._lives.settling_s = self._limits.settling_s + self._limits.outlasts_s(passed)
        return passed

    def _wait(self, until: str) -> None:
        """Refuse a command while this guard starts, which is no fault: one notice per cause."""
        if self._waits != until:
            self._say(Severity.INFO, "guard_starting", f"commands wait until {until}")
        self._waits = until

    def tick(self, local_ns: int) -> Command | None:
        """
        Keep the robot commanded as time goes on.

        Returns:
            The next piece of the way to rest, or of standing, for the caller to publish; None while the last command lasts long enough.
        """
        self._wake(local_ns)
        if self._state is None or not self._engaged:
            return None
        if self._cadence.fault:
            return self._last_step(self._state) if self._untold else None
        now_ns = self._clock.now_ns(local_ns)
        self._schedule.forget(now_ns - 2 * self._dt_ns)
        if self.passing:
            self._watch(now_ns)
        if self._blind(now_ns):
            self._feed_back(None, now_ns, now_ns)
        if self._told_ns - now_ns > RAMP_LEAD_NS * self._clock.rate and not self._corrected:
            return None
        start_ns = now_ns if self._corrected else max(self._told_ns, now_ns)
        if self._left_to_itself(now_ns):
            return None
        way = self._schedule.way(start_ns)
        valid_ns = RAMP_STEPS_PER_COMMAND * RAMP_STEP_NS if way is None else piece_ns(way, start_ns)
        u = np.array([self._schedule.at(start_ns + i * RAMP_STEP_NS)[0] for i in range(-(-valid_ns // RAMP_STEP_NS))])
        period_ns = RAMP_STEP_NS
        if not (u - self._schedule.rest(start_ns)).any():
            if now_ns - self._state.stamp_ns > 10 * self._stale_ns:
                return None  # no robot is there that could be told to stand
            u, period_ns = u[:1], valid_ns
        return self._tell(start_ns, valid_ns, period_ns, u, self._state, None if way is None else way.ahead(start_ns + valid_ns))

    def _blind(self, now_ns: int) -> bool:
        """Whether the last state is stale."""
        return self._state is None or now_ns - self._state.stamp_ns > self._stale_ns

    def _left_to_itself(self, now_ns: int) -> bool:
        """Whether a robot that is not heard has been sent a way that needs feedback, for which it may still know its state."""
        if self._corrected or self._untold or not self._blind(now_ns):
            return False
        way = self._schedule.way(max(self._told_ns, now_ns))
        return way is not None and way.feeds_back

    def _unheard(self, state: State) -> bool:
        """Whether a report names an older command than the one to brake, which may still come: the ramp is then not to begin later."""
        brake, until_ns = self._braked
        return state.command_seq > 0 and (state.command_epoch, state.command_seq) < brake and state.stamp_ns < until_ns

    def _feed_back(self, x: Array | None, stamp_ns: int, now_ns: int) -> None:
        """Correct the way to rest by a state, or by none if the last one is stale; nothing is sent that would displace a plan about to begin."""
        corrected = self._schedule.feed_back(x, stamp_ns, now_ns)
        self._corrected |= corrected and not self._schedule.pending(now_ns)

    def _last_step(self, state: State) -> Command:
        """Return the last command to a robot whose stamps are no clock: each row is the next step to rest, whichever acts and for how long."""
        t_ns, rate = state.stamp_ns, min(1.0, self._cadence.rate)
        way = self._schedule.way(t_ns)
        next_ = self._limits.u_rest if way is None else self._schedule.at(t_ns)[0]
        u = np.tile(self._schedule.nearest(next_, t_ns), (RAMP_STEPS_PER_COMMAND, 1))
        valid_ns = max(1, round(MAX_VALID_NS * rate))  # as long as it should act, in the unit of the stamps
        if way is not None:
            way = replace(way.ahead(t_ns), period_ns=max(MIN_ROW_NS, round(way.period_ns * rate)))
        return self._tell(t_ns, valid_ns, RAMP_STEP_NS, u, state, way)

    def _tell(self, start_ns: int, valid_ns: int, period_ns: int, u: Array, state: State, way: Way | None) -> Command:
        """Return a command of the guard's own, with what is left of the way to rest after it, and note until when it lasts."""
        if self._untold:
            self._braked = (self.epoch, self._seq + 1), start_ns + valid_ns
        self._told_ns, self._untold, self._corrected = start_ns + valid_ns, False, False
        self._told_rest = way is not None or not (u[-1] - self._schedule.rest(start_ns)).any()
        left: dict[str, Any] = {} if way is None else {"rest_period_ns": way.period_ns, "u_rest": way.u, "x_rest": way.x, "K": way.K}
        return self._numbered(
            Command(
                epoch=0,
                seq=0,
                stamp_ns=start_ns,
                state_epoch=state.epoch,
                state_seq=state.seq,
                state_stamp_ns=state.stamp_ns,
                valid_until_ns=self._told_ns,
                config_hash=self._config_hash,
                mode=Mode.BRAKING,
                status=QpStatus.NONE,
                period_ns=period_ns,
                u=u,
                **left,
            )
        )

    def _watch(self, now_ns: int) -> None:
        """Brake when the last plan has ended, or moves the robot for longer than a latched stop allows."""
        ended = self._schedule.at(now_ns)[2]
        moving = not self._schedule.rests(now_ns, self._settled(now_ns))
        if ended:
            self.passing = False
            text = f"the last plan has ended: {'braking to rest' if moving else 'standing'}"
            self._say(Severity.ERROR if moving else Severity.WARNING, "guard_braking", text, change=True)
        elif moving and self._latched and now_ns >= self._rest_by_ns:
            self._brake(now_ns, now_ns)
            self._say(Severity.ERROR, "guard_braking", "the robot should stand by now, but its inputs are not at rest: braking to rest", change=True)

    def stop(self, local_ns: int) -> None:
        """Refuse all further commands: from now on the robot is commanded to ramp to rest, and to stand."""
        self._stopped = True
        if not self._cadence.fault:
            self._brake(self._clock.now_ns(local_ns), self._clock.now_ns(local_ns))

    def latch(self, reason: str, local_ns: int) -> None:
        """
        Pass only ways to rest until `enable`, and only rest once there was time to get there.

        A command with a way to rest of its own passes if it reaches the last row of that no
        later than the last plan would have, plus the time for which a command is valid. Whether
        its rows bring the robot to rest, no guard can tell.

        The last plan continues meanwhile, up to its end. The controller is expected to
        ramp to rest; if it does not, the guard does.
        """
        if not self._latched:
            self._latched = reason
            self._rest_by_ns = self._clock.now_ns(local_ns) + round(1e9 * self._limits.settling_s)
            if self._passed is not None:
                self._rest_by_ns = max(self._rest_by_ns, self._limits.settles_ns(self._passed, BEFORE_ALL_NS) + self._delay_ns + MAX_VALID_NS)
            self._say(Severity.INFO, "stop", f"stop: {reason}", change=True)

    def enable(self) -> None:
        """Release a `latch`."""
        if self._latched:
            self._latched = ""
            self._say(Severity.INFO, "enable", "released by an operator", change=True)

    # Commands.

    def _objection(self, command: Command, now_ns: int, until_ns: int) -> str:
        """Return what is wrong with a command, as a code that a reason may follow; empty if nothing is."""
        limits, epoch, seq = self._limits, *self._leader
        assert self._state is not None, "commands wait for the first state"
        if self._lives.disputed:
            return "two_robots: it is not known which of two robots it is for"
        if self._cadence.fault:
            return f"untimed: {self._cadence.fault}"
        if self._untold:
            return "held: after a jump of the clock the robot must brake first"
        if command.epoch < epoch:
            return f"fenced: epoch {epoch} has taken over"
        if command.epoch == epoch and command.seq == seq:
            return "repeated"
        if command.epoch == epoch and now_ns - self._led_ns <= LEADER_SILENCE_NS and not seq < command.seq <= seq + MAX_SEQ_GAP:
            return f"old: command {seq} has passed" if command.seq < seq else f"ahead: the last one was {seq}"
        if reason := unfit(command, len(limits.u_rest), self._state.epoch, len(self._state.x)):
            return reason
        if now_ns - self._clock.stamp_ns > max(self._stale_ns, 2.5 * self._clock.period_ns):
            return f"blind: no state for {1e-9 * (now_ns - self._clock.stamp_ns):.3f} s"
        age_ns = now_ns - command.state_stamp_ns
        if age_ns > self._delay_ns + self._stale_ns or age_ns < -MAX_STATE_AHEAD_NS * self._clock.rate:
            if age_ns < 0:
                return f"early: it answers a state {-1e-9 * age_ns:.3f} s ahead of now"
            return f"stale: it answers a state of {1e-9 * age_ns:.3f} s ago"
        if until_ns <= max(command.stamp_ns, now_ns):
            return "expired"
        if reason := limits.objection(command):
            return reason
        if self._latched and not self._comes_to_rest(command, now_ns):
            return f"stopped: {self._latched}; only ways to rest pass"
        return ""

    def _comes_to_rest(self, command: Command, now_ns: int) -> bool:
        """
        Whether the rows that would act only approach rest from the present input, and end there; long after a `latch`, whether all are rest.

        A way to rest of the command's own need not approach it evenly: it has to reach its last row in time,
        and, long after a `latch`, to be that row from now on, the one that the robot already has.
        """
        if len(command.u_rest):
            settles_ns = self._limits.settles_ns(command, now_ns)
            if now_ns < self._rest_by_ns:
                return settles_ns <= self._rest_by_ns
            here = np.abs(command.u_rest[-1] - self._schedule.rest(now_ns)) <= self._settled(now_ns) + self._limits.tolerance
            return settles_ns <= now_ns and bool(here.all())
        start_ns = max(command.stamp_ns, now_ns)
        first = (start_ns - command.stamp_ns) // command.period_ns
        before = self._limits.u_rest if now_ns >= self._rest_by_ns else self._schedule.at(start_ns - 1)[0]
        way = np.vstack([before, self._approach(command, start_ns)[first:]]) - self._limits.u_rest
        lower, upper = np.minimum(way[:-1], 0.0) - self._limits.tolerance, np.maximum(way[:-1], 0.0) + self._limits.tolerance
        return bool((np.abs(way[-1]) <= self._limits.tolerance).all() and ((way[1:] >= lower) & (way[1:] <= upper)).all())

    def _follow(self, command: Command) -> None:
        """Take the sender of a command in order as the leader: no lower epoch passes again in this life of the robot."""
        if self._leader[0] and command.epoch != self._leader[0]:
            self._say(Severity.WARNING, "source_changed", f"epoch {command.epoch} took over from {self._leader[0]}")
        self._leader = command.epoch, command.seq
        if command.epoch > self.epoch:
            self.epoch = epoch_above(command.epoch, self.epoch)  # keeps the guard's own number, so that no other guard uses this epoch

    def _approach(self, command: Command, start_ns: int) -> Array:
        """Return the rows of a command as they would act from a time on."""
        return self._schedule.approached(replace(command, u=np.clip(command.u, self._limits.lbu, self._limits.ubu)), start_ns)

    def _settled(self, now_ns: int) -> float | Array:
        """Return how far from its last row a way to rest counts as rest, shape ``(nu,)``; the ramp counts only where it has ended."""
        return 0.0 if self._schedule.way(now_ns) is None else self._limits.settled

    def _numbered(self, command: Command) -> Command:
        """Return a command with the guard's epoch and next number."""
        self._seq += 1
        return replace(command, epoch=self.epoch, seq=self._seq)

    # Times and lives.

    def _counts(self, state: State, local_ns: int, *, begins: bool) -> bool:
        """Whether a state is a new one with stamps that are a clock; when they cease to be one, the robot is sent one more step to rest."""
        if begins:
            self._cadence.reset()
        untimed = bool(self._cadence.fault)
        counts = self._cadence.observe(state.seq, state.stamp_ns, local_ns)
        if self._cadence.notice is not None:
            self.notices.append(self._cadence.notice)
        if counts and untimed != bool(self._cadence.fault):
            self._brake(state.stamp_ns, state.stamp_ns)
            self._clock.jump()
            self._take(state, local_ns)
        return counts and not (untimed or self._cadence.fault)

    def _take(self, state: State, local_ns: int) -> None:
        """Follow the clock and the life of a state."""
        self._heard_ns = state.stamp_ns
        self._clock.observe(state.seq, state.stamp_ns, local_ns)
        self._state = state

    def _wake(self, local_ns: int) -> None:
        """Report if this process was held up; messages that have waited meanwhile are judged by their age as always."""
        held_up_ns = local_ns - self._awake_ns
        if self._engaged and held_up_ns > HELD_UP_NS:  # before, nobody depends on it
            self._say(Severity.WARNING, "guard_held_up", f"the guard was held up for {1e-9 * held_up_ns:.3f} s")
        self._awake_ns = local_ns

    def _begin(self, state: State) -> None:
        """Begin with a robot, or with another life of it: then it is at rest, and any controller may be the first."""
        if self._state is None:
            self._open_ns = state.stamp_ns + round(1e9 * self._limits.settling_s)
        else:
            self._open_ns = BEFORE_ALL_NS
            self._say(Severity.WARNING, "robot_restarted", "the robot was restarted: its inputs are taken to be at rest")
        self._clock.reset()
        self._schedule.brake(self._limits.u_rest, BEFORE_ALL_NS)
        self._leader = 0, -1
        self._told_ns = BEFORE_ALL_NS
        self._braked = (0, 0), BEFORE_ALL_NS
        self._rest_by_ns = BEFORE_ALL_NS  # the robot is at rest: a latch from before passes nothing but rest
        self._engaged = self._untold = self._corrected = self.passing = False
        self._passed = None
        self._lives.settling_s = self._limits.settling_s
        self._late.clear()

    def _jump(self, state: State, local_ns: int, where: str) -> None:
        """Continue after a jump of the robot's clock: the robot brakes from the input that acts."""
        before_ns = self._clock.now_ns(local_ns)
        text = f"the robot's clock jumped {where} by {1e-9 * abs(state.stamp_ns - before_ns):.3f} s: braking"
        self._say(Severity.WARNING, "clock_jumped", text)
        self._brake(before_ns, state.stamp_ns)
        self._open_ns = BEFORE_ALL_NS
        self._clock.jump()

    def _brake(self, before_ns: int, now_ns: int) -> None:
        """Let the robot brake now from the input that acts at `before_ns`, a time that may be of the clock before a jump."""
        self._schedule.cut(before_ns, now_ns)
        self._told_ns, self._untold = now_ns, self._engaged
        self._rest_by_ns = BEFORE_ALL_NS  # it may be a time of the clock before a jump
        self.passing = False

    def _say(self, severity: Severity, code: str, text: str, *, change: bool = False) -> None:
        self.notices.append(Notice(severity, code, text, change))


def piece_ns(way: Way, start_ns: int) -> int:
    """Return how long a command with the way to rest lasts from a time on: some steps, and on to the next row, so that the rest stays in phase."""
    least_ns = RAMP_STEPS_PER_COMMAND * RAMP_STEP_NS
    rows = -((way.stamp_ns - start_ns - least_ns) // way.period_ns)  # that have begun by then
    if rows >= len(way.u):
        return least_ns
    return min(way.stamp_ns + rows * way.period_ns - start_ns, MAX_STEPS_PER_COMMAND * RAMP_STEP_NS)
