# SPDX-License-Identifier: Apache-2.0
"""
Controller of one robot: the real-time iteration on the robot's time grid, from state and reference to command.

It reads no clock: every time is a stamp of the robot or local monotonic time that the
caller hands in. Samples lie on a grid that follows the robot (`rti_mpc.control.grid`).
Preparation fixes the time :math:`t_k` at which the next command acts, looks up the
reference from there on, shifts and linearizes. Feedback starts with the state that is
due. It integrates that state to :math:`t_k` with the inputs already sent, embeds it and
solves. Reference, plan and command all start at :math:`t_k`.

Here messages come in and commands go out. The two phases have a file each,
`rti_mpc.control.preparation` and `rti_mpc.control.feedback`. When a plan cannot be
computed, or is too late, a fallback (`rti_mpc.control.fallback`) replaces it. After a gap,
or in another life of the robot (`rti_mpc.control.interruption`), the controller starts
cold, and the first command acts late enough to arrive in time. Every command passes the
`rti_mpc.control.envelope.Envelope`. The parts are built in `rti_mpc.control.assembly`.
"""

from __future__ import annotations

from collections.abc import Callable

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, Notice, Reference, Severity, State, Telemetry
from rti_mpc.contract.schedule import BEFORE_ALL_NS
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.assembly import assemble
from rti_mpc.control.call import Call, reported
from rti_mpc.control.fallback import Fallback
from rti_mpc.control.feedback import Feedback
from rti_mpc.control.grid import Timing as Timing
from rti_mpc.control.interruption import Interruption
from rti_mpc.control.observer import Observer
from rti_mpc.control.opinions import Opinion, second_opinions
from rti_mpc.control.planner import Planner
from rti_mpc.control.preparation import Preparation
from rti_mpc.control.record import Record
from rti_mpc.control.state_stream import FRESH, Arrival
from rti_mpc.control.understudy import Understudy
from rti_mpc.errors import OcpError
from rti_mpc.rti.ocp import Ocp, rest_fault
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.way_to_rest import StopLaw

IDLE = Mode.IDLE  # read faster than a member of the enumeration
INPUTS_UNREPORTED = (
    "the robot does not report which inputs act: commands are assumed to act, and only the robot itself or a guard can handle lost ones"
)
UNTAKEN_NS = 2_000_000_000  # robot time of its own ramp, where commands should act, after which that is said: links lose commands for less
COMMANDS_UNTAKEN = (
    f"the robot has reported its own ramp to rest for {1e-9 * UNTAKEN_NS:.0f} s where commands should act: none reaches it, it takes none and says "
    "why, or its states lack command_epoch and command_seq, the command that their u comes from"
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
        second_opinion: Interval, in plans, at which OSQP also solves the QP of another solver's plan, in the method of this name; 0: never.
        compile: Whether to compile the small functions around the real-time iteration.

    Raises:
        OcpError: The bounds exclude the input at which the robot rests, or an argument is of the wrong kind.
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
        for name, part, kind in (("observer", observer, Observer), ("stop_law", stop_law, StopLaw)):
            if part is not None:
                given.instance(name, part, kind)
        for name, number in (("epoch", epoch), ("config_hash", config_hash)):
            given.whole(name, number, 0)
        if wrong := rest_fault(given.instance("rti", rti, Rti).ocp):
            raise OcpError(wrong)
        parts = assemble(rti, timing, epoch=epoch, config_hash=config_hash, observer=observer, stop_law=stop_law, compile=compile)
        self.on_call: Callable[[Call], object] | None = None
        self.ladder, self.envelope, self.grid = parts.ladder, parts.envelope, parts.grid
        self.np_ = rti.ocp.model.np_ - len(parts.states.d)
        self._rti, self._stale_ns = rti, parts.stale_ns
        self._modes, self._states, self._track, self._tuning, self._blockage = parts.modes, parts.states, parts.track, parts.tuning, parts.blockage
        self._sent, self._reports, self._prediction = parts.sent, parts.reports, parts.prediction
        self._delay, self._issued = parts.delay, parts.issued
        self._planner = Planner(parts)
        self._fallback = Fallback(parts, self._planner)
        self._interruption = Interruption(parts, self._planner)
        self._understudy = Understudy(parts, self._planner)
        self._record = Record(parts)
        self._opinions = second_opinions(rti, second_opinion, self.say)
        self._preparation = Preparation(parts, self._planner, self._record, self._opinions)
        self._feedback = Feedback(parts, self._planner, self._fallback)
        balances = stop_law is not None and stop_law.disturbances.size > 0
        braking = {Mode.STOPPED, Mode.BRAKING} if balances else set()
        self._known = braking | {mode for mode in Mode if mode.planned}  # modes in which disturbances are estimated
        self._unreported = False  # whether it was said that the robot does not report its inputs
        self._untaken = False  # whether it was said that the robot takes no command, and it has taken none since

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
        return self._modes.standing_by

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
        states = self._states
        states.check(state)
        arrival = states.receive(state, arrival_ns)
        if (notice := states.notice) is not None:
            self.say(notice)
        if arrival is not FRESH:
            if arrival in (Arrival.REPEATED, Arrival.REFUSED, Arrival.FOREIGN, Arrival.OLD):
                return None
            if arrival is Arrival.UNTIMED:
                return self._fallback.give_up(state)
            self._interruption.forget(arrival, state)
        surprised = self._hear(state)
        if states.estimates:
            if (lost := states.estimate(self._sent, known=self.mode in self._known and not surprised)) is not None:
                self.say(lost)
            self._prediction.p[self.np_ :] = states.d
        if surprised and self._planner.loaded and self.grid.running:
            self._planner.load(self.grid.act_ns, shift=False)
        if self._modes.mode is IDLE:
            self._modes.enter(Mode.WAITING, "first state")
            if not len(state.u) and not self._unreported:
                self._unreported = True
                self._modes.say(Severity.WARNING, "inputs_unreported", INPUTS_UNREPORTED)
        if self._track.arriving and states.lives.rival is None:
            self._anchor(state)
        grid, period_ns = self.grid, states.clock.period_ns
        if not (self._track.loaded or self._modes.stopped) or not states.cadence.known or grid.early(state.stamp_ns, period_ns):
            return None
        if (behind := grid.behind(state.stamp_ns)) or not grid.running:
            self._interruption.rejoin(state.stamp_ns, behind)
        return self._feedback.answer(state) if grid.running else None

    def lay_out(self, reference: Reference) -> Array | None:
        """Do the part of `receive_reference` whose duration grows with the rows, in any thread; None if the reference will be refused."""
        return None if self._track.misfit(reference, self.np_) else self._track.lay_out(reference)

    @reported
    def receive_reference(self, reference: Reference, rows: Array | None = None) -> Reference | None:
        """
        Follow a reference from the next sample on; if no state has come yet, or a restart of the robot has been heard but is not confirmed
        yet, from the next accepted state on.

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
        if not self._modes.stopped:
            self._modes.stopped = reason
            self._modes.say(Severity.INFO, "stop", f"stop: {reason}")

    @reported
    def enable(self) -> None:
        """Release a `stop`, and start cold from the input that acts."""
        if self._modes.stopped:
            self._modes.stopped = ""
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
    def scales(self) -> tuple[Array, Array]:
        """Scales of states and inputs, shapes ``(nx,)`` and ``(nu,)``, see `rti_mpc.rti.scale`."""
        return self._rti.scale_x, self._rti.scale_u

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
        self._modes.standing_by = True

    @reported
    def lead(self, epoch: int) -> None:
        """Let the commands of this controller act from the next one on; it continues from the inputs that have acted so far."""
        self._issued.epoch, self._modes.standing_by = epoch, False
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
        return None if now_ns - state.stamp_ns <= self._stale_ns else self._fallback.silence(state, now_ns)

    @reported
    def in_time(self, command: Command, local_ns: int) -> Command | None:
        """
        Enforce the time budget of a sample: its command must be ready before its first row is over.

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
            if self._issued.overran:
                self._issued.overran = False
                self._modes.enter(command.mode, "commands are ready in time again")
            return command
        assert self._states.last is not None
        return self._fallback.overrun(command, self._states.last, now_ns)

    @reported
    def commit(self, command: Command, left_ns: int | None = None) -> None:
        """
        Record a proposal as sent, once it has left; a standby records the one that it would have sent.

        Args:
            command: The last proposal.
            left_ns: Earliest local monotonic time at which it left; None if it answers no state, so that robot time is a guess.
        """
        self._issued.commit(command)
        if self._modes.standing_by:
            return
        clock = self._states.clock
        self._sent.append(command, BEFORE_ALL_NS if left_ns is None or self._states.cadence.fault else clock.latest_ns(left_ns))

    # The two phases.

    @reported
    def prepare(self) -> None:
        """Prepare the next sample: fix `t_k`, look the reference up, shift, linearize and load the QP."""
        self._preparation.prepare()

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
        Run the code from state to command once more with the last state, shortly before the next one is due, which then finds warm caches.

        Nothing changes on which a later call depends, so it is not `reported`: what is
        overwritten is put back, and the state is checked by a copy of the clock and of the sequence numbers.

        Args:
            local_ns: Local monotonic time.

        Returns:
            A command to be encoded and thrown away; None if the next sample does not begin with a feedback that is prepared.
        """
        return self._understudy.rehearse(local_ns)

    @reported
    def standstill(self, local_ns: int) -> Command | None:
        """Propose a last command, to rest as fast as the slew limits allow; None if nothing was ever commanded, or the stamps are no clock."""
        state = self._states.last
        if self._issued.last is None or state is None or self._states.cadence.fault:
            return None
        return self._fallback.brake(state, self.robot_now_ns(local_ns) + self.grid.delay_ns, QpStatus.NONE, wanted=True)

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
        opinion = Opinion() if self._opinions is None else self._opinions.last
        return self._record.telemetry((prepare_us, feedback_us, latency_us, slack_s, second_us), opinion)

    # Small parts.

    def _hear(self, state: State) -> bool:
        """Learn which input acts, from a report and, on a way to rest with feedback, from the state; return whether the report was not expected."""
        surprised = len(state.u) > 0 and self._reports.correct(state)
        if surprised and self._reports.untaken_ns < UNTAKEN_NS:
            self._untaken = False
        elif surprised and self.mode.planned and not self._untaken:
            self._untaken = True
            self._modes.say(Severity.WARNING, "commands_untaken", COMMANDS_UNTAKEN)
        self._sent.feed_back(state.x, state.stamp_ns)
        return surprised

    def _anchor(self, state: State) -> Reference:
        """Follow the reference that has arrived, from the last state on if it is to start on arrival."""
        anchored = self._track.anchor(state.stamp_ns)
        if self._planner.loaded and self.grid.running:
            self._planner.load(self.grid.act_ns, shift=False)
        return anchored
