# SPDX-License-Identifier: Apache-2.0
"""
Controller of one robot: the real-time iteration on the robot's time grid, from state and reference to command.

It reads no clock: every time is a stamp of the robot or local monotonic time that the
caller hands in. Samples lie on a grid that follows the robot (`rti_mpc.control.grid`).
Preparation fixes the time :math:`t_k` at which the next command acts, looks up the
reference from there on, shifts and linearizes. Feedback starts with the state that is
due. It integrates that state to :math:`t_k` with the inputs already sent, embeds it and
solves. Reference, plan and command all start at :math:`t_k`.

When a plan cannot be computed, or is too late, the ladder of fallbacks
(`rti_mpc.control.ladder`) replaces it. Every command passes the
`rti_mpc.control.envelope.Envelope`. After a gap the controller starts cold, and the
first command acts late enough to arrive in time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Notice, Reference, Severity, State, Telemetry
from rti_mpc.contract.schedule import BEFORE_ALL_NS
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.blockage import Blockage
from rti_mpc.control.call import Call, reported
from rti_mpc.control.delay import DelayEstimator
from rti_mpc.control.envelope import INPUT_BOUNDS, Envelope
from rti_mpc.control.fallback import Fallback
from rti_mpc.control.grid import Grid
from rti_mpc.control.grid import Timing as Timing
from rti_mpc.control.issued import NO_ENDING, Issued
from rti_mpc.control.ladder import Ladder
from rti_mpc.control.mode import ModeMachine
from rti_mpc.control.observer import Observer
from rti_mpc.control.opinions import Opinion, second_opinions
from rti_mpc.control.planner import Planner
from rti_mpc.control.prediction import Prediction
from rti_mpc.control.record import Record
from rti_mpc.control.report import Reports
from rti_mpc.control.sent import Sent
from rti_mpc.control.state_stream import Arrival, StateStream
from rti_mpc.control.stopping import Stopping
from rti_mpc.control.track import Track
from rti_mpc.control.tuning import Tuning
from rti_mpc.errors import OcpError
from rti_mpc.model.model import depends_on
from rti_mpc.rti.ocp import Ocp, rest_fault
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.way_to_rest import StopLaw

INPUTS_UNREPORTED = (
    "the robot does not report which inputs act: commands are assumed to act, and only the robot itself or a guard can handle lost ones"
)


class Controller:
    """
    The controller of one robot.

    The caller hands in each message when it arrives. A command that is returned is a
    proposal: `in_time` judges it, then the caller publishes it and calls `commit`. A
    proposal that is not committed counts as never sent. After each sample the caller
    calls `prepare`, off the path from state to command.

    Only the calls marked `reported` change what commands depend on, and `on_call` receives
    each of them. The same calls on a second controller, built alike, give the same commands.

    Attributes:
        on_call: Receiver of each call that may change a command, before it is made; None for no receiver.
        skipped: Samples skipped since start.
        ladder: Samples without a plan of their own, by what replaced it.
        np_: Parameters that a row of a reference may carry: the model's, without the disturbances that an observer estimates.
        envelope: Limits of the inputs.
        grid: Times at which commands act.

    Args:
        rti: The real-time iteration.
        timing: Delay and timeouts.
        epoch: Epoch of the commands.
        config_hash: Hash of the configuration, for the commands.
        observer: Estimator of disturbances and unmeasured states, None for none.
        stop_law: How the robot comes to rest where its inputs do not ramp to rest.
        second_opinion: Plans of another solver from one that OSQP judges, in `second_opinion`, to the next; 0: none.
        compile: Whether to compile the small functions around the real-time iteration.

    Raises:
        OcpError: The bounds exclude the input at which the robot rests.
    """

    def __init__(
        self,
        rti: Rti,
        timing: Timing,
        *,
        epoch: int = 1,
        config_hash: int = 0,
        observer: Observer | None = None,
        stop_law: StopLaw | None = None,
        second_opinion: int = 0,
        compile: bool = True,
    ) -> None:
        given.instance("timing", timing, Timing)
        ocp, model = given.instance("rti", rti, Rti).ocp, rti.ocp.model
        if wrong := rest_fault(ocp):
            raise OcpError(wrong)
        self._rti = rti
        self._stale_ns = round(1e9 * timing.stale_s)
        self._valid_ns = round(1e9 * timing.valid_s)
        self._u_rest: Array = np.array(model.u_rest)

        self.on_call: Callable[[Call], object] | None = None
        self._standing_by = False
        self._modes = ModeMachine()
        self.skipped = 0
        self.ladder = Ladder()
        self.envelope = Envelope(ocp, compile=compile)
        self._tuning = Tuning(rti, self.envelope)
        self.grid = Grid(ocp.dt, timing)
        lbu, ubu, lbdu, ubdu = (ocp.widest(name) for name in INPUT_BOUNDS)
        limits = Limits(self._u_rest, lbu, ubu, lbdu, ubdu, ocp.dt, 1e-9 * self.grid.most_ns)
        settling_s = limits.settling_s + (0.0 if stop_law is None else stop_law.rows * stop_law.period_s)
        self._states = StateStream(model, self._stale_ns, self.grid.dt_ns, settling_s, observer)
        self.np_ = model.np_ - len(self._states.d)
        self._track = Track(model, ocp.N, self.grid.dt_ns, compile=compile)
        self._sent = Sent(self._u_rest, lbdu, ubdu, self.grid.dt_ns, (lbu, ubu), model.rotations("states"))
        self._reports = Reports(self._sent, self.envelope.limits)
        self._prediction = Prediction(model, self._sent, compile=compile)
        self._x0 = self._prediction.x
        ways = None if stop_law is None else Stopping(ocp, stop_law, self.envelope.limits, self._prediction, self._valid_ns, compile=compile)
        self._ways = ways  # to rest; None: its inputs ramp to rest
        balances = stop_law is not None and stop_law.disturbances.size > 0
        braking = {Mode.STOPPED, Mode.BRAKING} if balances else set()
        self._known = braking | {mode for mode in Mode if mode.planned}  # modes in which disturbances are estimated
        self._overran = False  # whether the last sample was over its budget
        self._unreported = False  # whether it was said that the robot does not report its inputs
        self._stopped = ""  # why an operator's stop is latched
        self._issued = Issued(epoch, config_hash, self.grid.dt_ns)
        self._fallback = Fallback(self.ladder, self.envelope, self._sent, self._issued, ways, self._u_rest, self._valid_ns)
        self._record = Record(rti, self._tuning)
        self._blockage = Blockage(rti, compile=compile)
        self._opinions = second_opinions(rti, second_opinion, self.say)
        self._delay = None
        self._seen = self._states.x  # the last state as the delay is measured by it
        self._unmeasured: list[int] = []
        if timing.delay_s is None:
            measured = list(range(model.nx)) if observer is None else observer.measured
            self._delay = DelayEstimator(model, self.grid.dt_ns, self.grid.most_ns, measured=measured, compile=compile)
            if observer is not None:
                self._seen, self._unmeasured = np.zeros(model.nx), [j for j in range(model.nx) if j not in measured]
        predicting = [of.p[: self.np_] for of in (self._prediction, observer, self._delay) if of is not None]
        self._planner = Planner(
            rti,
            self._track,
            self._sent,
            self._prediction,
            self.envelope,
            self._tuning,
            self._states.d,
            tuple(predicting) if depends_on(model.rate_expr, model.p[: self.np_]) else (),
        )
        self._understudy = StateStream(model, self._stale_ns, self.grid.dt_ns, settling_s)  # judges states in rehearsals

    @property
    def mode(self) -> Mode:
        """What the controller is doing."""
        return self._modes.mode

    def say(self, notice: Notice) -> None:
        """Add a notice to the controller's own; may be called in any thread."""
        self._modes.notices.append(notice)

    def notices(self) -> list[Notice]:
        """Take the notices of mode changes and faults since the last call; may be called in any thread."""
        return self._modes.take()

    @property
    def standing_by(self) -> bool:
        """Whether the commands of another controller act, those handed to `overhear`, and not those of this one."""
        return self._standing_by

    # Incoming messages.

    @property
    def heard(self) -> bool:
        """Whether a state of the robot has come."""
        return self._states.last is not None

    def continues(self, state: State) -> bool:
        """Whether a state continues the last one, by life and sequence number, or is the first one."""
        last = self._states.last
        return (last is None or state.epoch == last.epoch) and self._states.cadence.counts(state.seq)

    @reported
    def receive_state(self, state: State, arrival_ns: int) -> Command | None:
        """
        Act on a state, if its sample is due.

        Args:
            state: Of the model's `nx`, finite.
            arrival_ns: Local monotonic time.

        Returns:
            The command to publish at once, as a proposal; None if no sample is due, and the state is only kept as the newest.

        Raises:
            OcpError: It is no `State`; one from the bus has been checked.
            ShapeError: Its vectors are not the model's.
        """
        self._check(state)
        arrival = self._states.receive(state, arrival_ns)
        if (notice := self._states.notice) is not None:
            self.say(notice)
        if arrival is not Arrival.FRESH:
            if arrival in (Arrival.REPEATED, Arrival.REFUSED, Arrival.FOREIGN, Arrival.OLD):
                return None
            if arrival is Arrival.UNTIMED:
                return self._give_up(state)
            self._forget(arrival, state)
        surprised = self._hear(state)
        if self._seen is not self._states.x:
            self._seen[:] = self._states.x
        if (lost := self._states.estimate(self._sent, known=self.mode in self._known and not surprised)) is not None:
            self.say(lost)
        if self._unmeasured:
            self._seen[self._unmeasured] = self._states.x[self._unmeasured]
        if len(self._states.d):
            self._prediction.p[self.np_ :] = self._states.d
        if surprised and self._planner.loaded and self.grid.running:
            self._planner.load(self.grid.act_ns, shift=False)
        if self.mode is Mode.IDLE:
            self._modes.enter(Mode.WAITING, "first state")
            if not len(state.u) and not self._unreported:
                self._unreported = True
                self._modes.say(Severity.WARNING, "inputs_unreported", INPUTS_UNREPORTED)
        if self._track.arriving and self._states.lives.rival is None:
            self._anchor(state)
        grid, period_ns = self.grid, self._states.clock.period_ns
        if not (self._track.loaded or self._stopped) or not self._states.cadence.known or grid.early(state.stamp_ns, period_ns):
            return None
        if (behind := grid.behind(state.stamp_ns)) or not grid.running:
            self._rejoin(state.stamp_ns, behind)
        return self._act(state) if grid.running else None

    def lay_out(self, reference: Reference) -> Array | None:
        """Do the part of `receive_reference` whose duration grows with the rows, in any thread; None if the reference will be refused."""
        return None if self._track.misfit(reference, self.np_) else self._track.lay_out(reference)

    @reported
    def receive_reference(self, reference: Reference, rows: Array | None = None) -> Reference | None:
        """
        Follow a reference from the next sample on; if no state has come yet, or a new life of the robot is heard that is not believed, from
        the next state on that counts.

        Args:
            reference: Message of a planner.
            rows: Result of `lay_out`; None to compute it here.

        Returns:
            The reference with its real stamp if it starts on arrival and is followed at once; else None. `followed` has it in any case.

        Raises:
            OcpError: It is no `Reference`; one that does not fit is refused by a notice.
        """
        given.instance("reference", reference, Reference)
        if misfit := self._track.misfit(reference, self.np_):
            self._modes.say(Severity.WARNING, "reference_refused", misfit)
            return None
        track, last, rival = self._track, self._states.last, self._states.lives.rival
        track.arriving, track.arriving_for = (reference, track.lay_out(reference) if rows is None else rows), rival
        if last is None or rival is not None:
            return None
        anchored = self._anchor(last)
        return anchored if reference.stamp_ns == STAMP_ON_ARRIVAL else None

    @reported
    def stop(self, reason: str) -> None:
        """Ramp to rest and stay there until `enable`."""
        if not self._stopped:
            self._stopped = reason
            self._modes.say(Severity.INFO, "stop", f"stop: {reason}")

    @reported
    def enable(self) -> None:
        """Release a `stop`, and start cold from the input that acts."""
        if self._stopped:
            self._stopped = ""
            self._modes.say(Severity.INFO, "enable", "released by an operator")
            if self.mode is Mode.STOPPED:
                self.grid.running = False
                self._modes.enter(Mode.WAITING, "enabled")

    @reported
    def retune(self, ocp: Ocp, version: int) -> int:
        """
        Plan with other weights and bounds, from the next sample that is not prepared yet. The ramp of a stop keeps the slew limits it was built with.

        Returns:
            Sequence number of the command of that sample.

        Raises:
            OcpError: The problem differs in more than weights and bounds.
        """
        self._tuning.change(ocp, version)
        return self._issued.seq + 1 + self._planner.loaded

    @property
    def wanted(self) -> Ocp:
        """The problem with the weights and bounds of the last `retune`."""
        return self._tuning.wanted

    @reported
    def overhear(self, command: Command) -> None:
        """Record a command of another controller that acts while this one stands by."""
        self._sent.append(command)
        if self._delay is not None:
            self._delay.sent(command)

    @reported
    def stand_by(self) -> None:
        """Stand by: compute commands that do not act, since those handed to `overhear` do."""
        self._standing_by = True

    @reported
    def lead(self, epoch: int) -> None:
        """Let the commands of this controller act from the next one on; it continues from the inputs that have acted so far."""
        self._issued.epoch, self._standing_by = epoch, False
        if self._planner.loaded:
            self._planner.load(self.grid.act_ns, shift=False)

    @reported
    def tick(self, local_ns: int) -> Command | None:
        """
        Watch for silence: propose a ramp to rest, once, when the last state has become stale.

        Args:
            local_ns: Local monotonic time.
        """
        state = self._states.last
        if state is None or not self.grid.running:
            return None
        now_ns = self._states.clock.now_ns(local_ns)
        age_ns = now_ns - state.stamp_ns
        if age_ns <= self._stale_ns:
            return None
        self.grid.running = False
        mode = Mode.STOPPED if self._stopped else Mode.BRAKING
        self._modes.enter(mode, f"no state for {1e-9 * age_ns:.3f} s", Severity.ERROR, "state_stale")
        return self._brake(state, now_ns + self.grid.delay_ns, QpStatus.NONE)

    @reported
    def in_time(self, command: Command, local_ns: int) -> Command | None:
        """
        Hold a sample to its budget: its command must be there before its first row is over.

        Args:
            command: The proposal for this sample.
            local_ns: Local monotonic time.

        Returns:
            What to publish: the command itself; None if it is too late and the robot goes on with the previous plan, or with the way to rest
            that it corrects by its states; or a ramp to rest.
        """
        self._issued.late = None
        if self._states.cadence.fault:
            return command  # its lateness is unknown, and no other command follows
        now_ns = self._states.clock.latest_ns(local_ns)
        if not self.grid.too_late(now_ns - command.stamp_ns):
            if self._overran:
                self._overran = False
                self._modes.enter(command.mode, "commands are ready in time again")
            return command
        self._overran = True
        failure = f"a command was ready {1e-9 * (now_ns - command.stamp_ns):.3f} s late"
        if self._fallback.plays_on(now_ns, counted=command.mode is Mode.FALLBACK):
            self._modes.enter(Mode.FALLBACK, f"{failure}: the previous plan is continued", Severity.WARNING, "over_budget")
            return None
        if not self._stopped:
            self._modes.enter(Mode.BRAKING, f"{failure} and no plan is left", Severity.ERROR, "over_budget")
        self._issued.late = command if command.mode.planned and now_ns < command.valid_until_ns else None
        counted = command.mode in (Mode.BRAKING, Mode.STOPPED)
        if self._ways is not None and self._ways.feeds_back:  # the last command carries its way, which newer states correct than this sample's
            if not counted:
                self.ladder.brake(at_rest=False)
            self._issued.plan, self._planner.loaded = None, False
            return None
        assert self._states.last is not None
        return self._brake(self._states.last, now_ns + self.grid.delay_ns, command.status, wanted=counted)

    @reported
    def commit(self, command: Command, left_ns: int | None = None) -> None:
        """
        Record a proposal as sent, once it has left; a standby records the one that it would have sent.

        Args:
            command: The last proposal.
            left_ns: Earliest local monotonic time at which it left; None if it answers no state, so that robot time is a guess.
        """
        self._issued.commit(command)
        if self._standing_by:
            return
        clock = self._states.clock
        self._sent.append(command, BEFORE_ALL_NS if left_ns is None or self._states.cadence.fault else clock.latest_ns(left_ns))

    # The two phases.

    @reported
    def prepare(self) -> None:
        """Prepare the next sample: fix `t_k`, look the reference up, shift, linearize and load the QP."""
        self._record.keep_plan(self._issued.seq)
        if self._opinions is not None:
            self._opinions.keep(self._issued.seq, planned=self.mode.planned and not self._standing_by)
        if self.mode.planned and self._blockage.judge():
            self.say(self._blockage.notice)
        state = self._states.last
        if not self.grid.running or state is None:
            return
        if self._delay is not None:
            self._measure_delay(self._delay, state.stamp_ns)
        self.grid.advance(state.stamp_ns, self._states.clock.period_ns)
        self._planner.loaded = False
        if self.mode.planned:
            self.ladder.failed = 0
        elif self._issued.late is None and (self.mode is not Mode.FALLBACK or not np.isfinite(self._rti.x).all()):
            return  # the next sample starts cold; after a late one it does not, as a cold one takes longest and would be late again
        self._tuning.begin()
        self._planner.load(self.grid.act_ns, shift=True)
        if self._ways is not None:
            self._ways.prepare()

    @reported
    def second_opinion(self) -> bool:
        """
        Let OSQP solve the last QP of the last sample as well: one piece of it, between `prepare` and the next state.

        The plan stays as it is, but a backup starts from the opinion. A state that comes
        before all pieces are done is handed in at once; `prepare` begins the next opinion.

        Returns:
            Whether nothing is left to be done.
        """
        return self._opinions is None or self._opinions.step()

    @reported
    def rewarm(self) -> None:
        """Let OSQP's workspaces depend on nothing but arrays that a snapshot can hold; between two samples, before each snapshot."""
        self._rti.rewarm()
        if self._opinions is not None:
            self._opinions.rewarm()

    def rehearse(self, local_ns: int) -> Command | None:
        """
        Go the way from state to command once more with the last state, shortly before the next one is due: that one then finds warm caches.

        Nothing changes on which a later call depends, so it is not `reported`: what the way
        overwrites is put back, and the state is judged by another judge.

        Args:
            local_ns: Local monotonic time.

        Returns:
            A command to be encoded and thrown away; None if the next sample does not begin with a feedback that is prepared.
        """
        state, grid = self._states.last, self.grid
        if state is None or not self._planner.loaded or self._standing_by or not self.mode.planned:
            return None
        self._check(state)
        self._understudy.receive(state, local_ns)
        due_ns = grid.act_ns - min(grid.delay_ns, grid.dt_ns - 1)  # or the first time at which `prepare` has asked for the inputs
        if len(state.u):
            self._reports.expects(state, due_ns)
        if grid.early(due_ns, self._states.clock.period_ns) or self._track.ended(grid.act_ns):
            return None
        rows = self._planner.rehearse(self._states.x, due_ns, grid.act_ns)
        self._modes.enter(self.mode, "nothing is said")
        return self._issued.build(state, grid.act_ns, grid.act_ns + self._valid_ns, self.mode, self._rti.status, rows)

    def _measure_delay(self, estimator: DelayEstimator, stamp_ns: int) -> None:
        """Learn from the state of the last sample, and let the grid follow."""
        estimator.restore_if_lost(self._sent.confirmed)
        estimator.observe(self._seen, stamp_ns)
        if self._issued.last is not None and not self._standing_by:
            estimator.sent(self._issued.last)
        self._sent.delay_ns = estimator.delay_ns
        self.grid.adapt(estimator.delay_ns)

    def _rejoin(self, stamp_ns: int, behind: int) -> None:
        """Move plan and grid to a state that the grid did not expect: a late one, or the first one after a gap."""
        self.skipped += behind
        late, act_ns = self._issued.late, stamp_ns + self.grid.delay_ns
        if late is not None and act_ns >= late.valid_until_ns:
            self._planner.loaded = False  # it would have run out: this sample starts cold
        if behind and self._issued.lasts(act_ns):
            self.grid.catch_up(behind, stamp_ns)
            if self._planner.loaded:
                for _ in range(behind - 1):
                    self._rti.shift()
                self._planner.load(self.grid.act_ns, shift=True)
            return
        if behind:
            self._modes.say(Severity.WARNING, "gap", f"no sample for {behind} periods: starting cold")
        self._planner.loaded = False
        self._issued.plan = None
        if self._ways is not None:
            self._ways.forget()
        self.ladder.failed = 0
        clock = self._states.clock
        if not self.grid.too_late(clock.late_ns + clock.doubt_ns):
            self.grid.start(stamp_ns)
        else:  # this state may have waited on its way for too long to be answered: the next one will show
            self.grid.running = False

    def _act(self, state: State) -> Command:
        """Feedback: from a due state to the command that acts at `t_k`."""
        act_ns = self.grid.act_ns
        ending = self._track.ended(act_ns)
        disputed = self._states.lives.disputed
        if self._stopped or disputed or ending is End.STOP:
            why = "two robots use this name" if disputed else "the reference ended with STOP"
            self._modes.enter(*((Mode.STOPPED, self._stopped) if self._stopped else (Mode.BRAKING, why)))
            return self._brake(state, act_ns, QpStatus.NONE, wanted=True)
        status, u = self._planner.plan(self._states.x, state.stamp_ns, act_ns)
        if u is None:
            return self._fall_back(state, status)
        self.ladder.softened += self._rti.solver is not (self._rti.active_set or self._rti.solvers[0])
        mode, reason = (Mode.TRACKING, "following the reference") if ending is None else (Mode.HOLDING, "the reference has ended")
        if not self._overran:
            self._modes.enter(mode, reason)
        valid_until_ns = min(act_ns + self._rti.ocp.N * self.grid.dt_ns, state.stamp_ns + self.grid.delay_ns + self._valid_ns)
        after = NO_ENDING
        if self._ways is not None:
            u, after = self._ways.after(u, act_ns, valid_until_ns)
        return self._issued.propose(state, act_ns, valid_until_ns, mode, status, u, plan=True, ending=after)

    # Fallbacks.

    def _fall_back(self, state: State, status: QpStatus) -> Command:
        """Replace a plan that could not be computed."""
        act_ns, failure = self.grid.act_ns, f"the QP is {status.name.lower()}"
        if self._fallback.plays_on(act_ns):
            self._modes.enter(Mode.FALLBACK, f"{failure}: the previous plan is continued", Severity.WARNING, "qp_failed")
            return self._fallback.play_on(state, act_ns, status, self._planner.reach)
        self._modes.enter(Mode.BRAKING, f"{failure} and no plan is left", Severity.ERROR, "no_plan")
        return self._brake(state, act_ns, status)

    def _brake(self, state: State, act_ns: int, status: QpStatus, *, wanted: bool = False) -> Command:
        """Propose the brake law, see `Fallback.brake`; the next sample starts cold."""
        self._planner.loaded = False
        return self._fallback.brake(state, self._states.x, act_ns, self.mode, status, wanted=wanted)

    def _give_up(self, state: State) -> Command | None:
        """
        Stop commanding a robot whose stamps are no clock: send one last command, each of whose rows is the next step to rest.

        Whichever of its rows acts, and for however long, the inputs stay inside the slew limits.
        """
        if self.mode is Mode.IDLE:
            return None
        command = None
        ramps = self._ways is None  # the way to rest of the last command is better than anything that is made without a clock
        if ramps and self._issued.last is not None and (self._sent.at(state.stamp_ns)[0] != self._u_rest).any():
            self._modes.enter(Mode.STOPPED if self._stopped else Mode.BRAKING, self._states.cadence.fault)
            valid_ns = max(1, round(self._valid_ns * min(1.0, self._states.cadence.rate)))  # as long as it should act, in the unit of the stamps
            command = self._fallback.step(state, state.stamp_ns + self.grid.delay_ns, self.mode, valid_ns)
        self._issued.plan = None
        self._overran = self._planner.loaded = self.grid.running = False
        self._modes.enter(Mode.IDLE, self._states.cadence.fault)
        return command

    @reported
    def standstill(self, local_ns: int) -> Command | None:
        """Propose a last command, to rest as fast as the slew limits allow; None if nothing was ever commanded, or the stamps are no clock."""
        state = self._states.last
        if self._issued.last is None or state is None or self._states.cadence.fault:
            return None
        return self._brake(state, self.robot_now_ns(local_ns) + self.grid.delay_ns, QpStatus.NONE, wanted=True)

    # Outgoing messages.

    @property
    def blocked(self) -> str:
        """What stops the plans short of the reference, in words; empty if nothing does."""
        return self._blockage.cause if self._blockage.blocked else ""

    @property
    def followed(self) -> Reference | None:
        """The reference that is followed, with its real stamp; None if there is none."""
        return self._track.followed

    @property
    def at_rest(self) -> bool:
        """Whether the last command that was sent is rest from its first row on, or none was ever sent."""
        return self._fallback.at_rest

    def slack_s(self, local_ns: int) -> float:
        """Return robot time, s, from a local monotonic time to the state of the next sample."""
        return 1e-9 * (self.grid.act_ns - self.grid.delay_ns - self._states.clock.now_ns(local_ns))

    @property
    def robot_rate(self) -> float:
        """Seconds of the robot per local second."""
        return self._states.clock.rate

    def robot_now_ns(self, local_ns: int) -> int:
        """Return robot time at a local monotonic time, 0 before the first state."""
        return self._states.clock.now_ns(local_ns) if self.heard else 0

    def telemetry(self, *, prepare_us: float, feedback_us: float, latency_us: float, slack_s: float, second_us: float = 0.0) -> Telemetry:
        """Return the telemetry of the last sample; the times come from the caller, who has a clock."""
        assert self._issued.last is not None
        times = prepare_us, feedback_us, latency_us, slack_s, second_us
        last, opinion = self._issued.last, Opinion() if self._opinions is None else self._opinions.last
        rows = last.u if self._ways is None else np.concatenate([last.u, self._ways.rows[len(last.u) :]])
        return self._record.telemetry(
            last, rows, self._x0, self._states.d, times, opinion, delay_s=1e-9 * self.grid.delay_ns, skipped=self.skipped, ladder=self.ladder
        )

    # Small parts.

    def _check(self, state: State) -> None:
        """Refuse what is no state of the model."""
        given.array("state.x", given.instance("state", state, State).x, self._x0.shape)
        if len(state.u):
            given.array("state.u", state.u, self._u_rest.shape)

    def _hear(self, state: State) -> bool:
        """Learn which input acts, from a report and, on a way to rest with feedback, from the state; return whether the report was not expected."""
        surprised = len(state.u) > 0 and self._reports.correct(state)
        self._sent.feed_back(state.x, state.stamp_ns)
        return surprised

    def _anchor(self, state: State) -> Reference:
        """Follow the reference that has arrived, from the last state on if it is to start on arrival."""
        anchored = self._track.anchor(state.stamp_ns)
        if self._planner.loaded and self.grid.running:
            self._planner.load(self.grid.act_ns, shift=False)
        return anchored

    def _forget(self, arrival: Arrival, state: State) -> None:
        """Forget the robot's last life; or, after a jump of its clock, all but the inputs from which it has braked since then."""
        self._issued.late = None
        if arrival is Arrival.NEW_LIFE:
            self._sent.clear()
        else:
            self._sent.brake(self._states.before_ns, state.stamp_ns)
        if arrival is not Arrival.JUMPED_AHEAD:
            self._modes.enter(Mode.IDLE, "the robot was restarted, or its clock has jumped")
            self._track.clear(state.epoch if arrival is Arrival.NEW_LIFE else None)
            self._blockage.clear()
        if self._delay is not None:
            self._delay.clear()
        if self._ways is not None:
            self._ways.forget()
        self._issued.plan = None
        self._overran = self._planner.loaded = self.grid.running = False
