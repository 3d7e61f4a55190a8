# SPDX-License-Identifier: Apache-2.0
"""
State and reference in, command out: the real-time iteration on the robot's time grid.

No clock inside: every time is a stamp of the robot, or local monotonic time
handed in. Samples lie on a grid that follows the robot. Preparation fixes the
time :math:`t_k` at which the next command acts, looks the reference up from
there on, shifts and linearizes. Feedback starts with the first state stamped
:math:`t_k - d - h` or later, `d` being the delay from state to actuation and
`h` half the period of the states; it integrates that state to :math:`t_k` with
the inputs already sent, embeds it and solves. Reference, plan and command all
start at :math:`t_k`.

A plan that cannot be made is replaced, rung by rung: the shifted previous plan,
at most `FALLBACKS` samples; then a ramp to rest, from past commands alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.message import STAMP_ON_ARRIVAL, Command, End, Reference, Severity, State, Telemetry
from rti_mpc.mode import ModeMachine
from rti_mpc.observer import Observer
from rti_mpc.prediction import Prediction
from rti_mpc.robot_clock import RobotClock
from rti_mpc.rti import Rti
from rti_mpc.sent import Sent
from rti_mpc.status import Mode, QpStatus
from rti_mpc.track import TWO_PI, Track

FALLBACKS = 3  # samples in a row that the shifted previous plan may serve
ITERATIONS_COLD = 3  # iterations of a first sample, whose guess is one state and one input


@dataclass(frozen=True)
class Timing:
    """
    Delays and timeouts, in the robot's time.

    Attributes:
        delay_s: From a state to the act of its command, s.
        stale_s: Age from which a state is not used, s.
        valid_s: How long after its state, and the delay, a command may act, s.
    """

    delay_s: float = 0.0
    stale_s: float = 0.25
    valid_s: float = 0.25


class Controller:
    """
    The controller of one robot.

    The caller hands in each message as it comes, publishes what is returned,
    and calls `prepare` after each command, off the path from state to command.

    Attributes:
        notices: Mode changes and faults since the caller last emptied it.
        np_: Parameters a row of a reference may carry: the model's, without the disturbances an observer estimates.
        skipped: Samples skipped since start.
        fallbacks: Samples commanded without a usable QP since start.
    """

    def __init__(
        self, rti: Rti, timing: Timing, *, epoch: int = 1, config_hash: int = 0, observer: Observer | None = None, compile: bool = True
    ) -> None:
        ocp, model = rti.ocp, rti.ocp.model
        self._rti = rti
        self._epoch = epoch
        self._config_hash = config_hash
        self._seq = 0
        self._dt_ns = round(1e9 * ocp.dt)
        self._delay_ns = round(1e9 * timing.delay_s)
        self._stale_ns = round(1e9 * timing.stale_s)
        self._valid_ns = round(1e9 * timing.valid_s)
        self._angles = [j for j, signal in enumerate(model.states) if signal.angle]
        self._u_rest: Array = np.array(model.u_rest)
        self._held = np.minimum(np.arange(ocp.N), ocp.N_u - 1)  # plan row of each stage

        self._observer = observer
        self.np_ = model.np_ - (0 if observer is None else len(observer.d))
        self._modes = ModeMachine()
        self.notices = self._modes.notices
        self.skipped = 0
        self.fallbacks = 0
        self._track = Track(model, ocp.N, self._dt_ns)
        self._arriving: Reference | None = None  # waits for a state, to start at or to put its angles next to
        self._clock = RobotClock()
        self._sent = Sent(self._u_rest, ocp.lbdu, ocp.ubdu, self._dt_ns)
        self._state: State | None = None
        self._x: Array = np.zeros(model.nx)  # the last state, angles unwrapped
        self._act_ns = 0  # t_k
        self._warm = False  # whether the guess is one to shift and act on
        self._loaded = False  # whether the QP of t_k is prepared
        self._failed = 0  # samples in a row without a usable QP
        self._stopped = ""  # why an operator's stop is latched
        self._command: Command | None = None
        self._planned = (rti.x.copy(), rti.y_ref.copy(), 0.0)  # states, reference and cost of a command, for telemetry
        self._planned_seq = 0  # of that command
        self._valid_until_ns = 0

        self._prediction = Prediction(model, self._sent, compile=compile)
        self._x0 = self._prediction.x

    @property
    def mode(self) -> Mode:
        """What the controller is doing."""
        return self._modes.mode

    # What comes in.

    def receive_state(self, state: State, arrival_ns: int) -> Command | None:
        """
        Act on a state, if its sample is due.

        Args:
            state: Of the model's `nx`, finite.
            arrival_ns: Local monotonic time.

        Returns:
            The command to publish at once, or None: then the state is only kept as the freshest.
        """
        if self._state is not None and state.epoch != self._state.epoch:
            self._restart("robot_restarted", "the robot was restarted: starting anew")
        if self._state is not None and state.stamp_ns <= self._state.stamp_ns:
            if self._state.stamp_ns - state.stamp_ns <= self._stale_ns:
                return None
            self._restart("clock_jumped", f"the robot's clock went back {1e-9 * (self._state.stamp_ns - state.stamp_ns):.3f} s: starting anew")
        self._clock.observe(state.seq, state.stamp_ns, arrival_ns)
        self._unwrap(state)
        self._observe(state)
        self._state = state
        if self.mode is Mode.IDLE:
            self._modes.enter(Mode.WAITING, "first state")
        if self._arriving is not None:
            self._anchor(self._arriving)
        if not (self._track.loaded or self._stopped):
            return None
        early_ns = self._act_ns - self._delay_ns - state.stamp_ns
        if self._warm and early_ns > self._clock.period_ns / 2:
            return None
        if not self._warm or -early_ns > self._dt_ns / 2:
            self._rejoin(state.stamp_ns)
            if self._act_ns - self._delay_ns - state.stamp_ns > self._clock.period_ns / 2:
                return None
        return self._act(state)

    def receive_reference(self, reference: Reference) -> Reference | None:
        """
        Follow a reference from the next sample on.

        Returns:
            The reference with its real stamp, to be published, if it was to start on arrival and a state is there to start at.
        """
        model = self._rti.ocp.model
        rows, ny = reference.y.shape
        if rows < 1 or ny != model.ny or reference.p.shape[1] not in (0, self.np_) or reference.period_ns <= 0:
            self._modes.say(
                Severity.WARNING,
                "reference_refused",
                f"a reference must have rows of {model.ny} outputs and of 0 or {self.np_} parameters, and a positive period, "
                f"got {rows} rows of {ny} and {reference.p.shape[1]}, {reference.period_ns} ns",
            )
            return None
        if self._state is None:
            self._arriving = reference
            return None
        anchored = self._anchor(reference)
        return anchored if reference.stamp_ns == STAMP_ON_ARRIVAL else None

    def stop(self, reason: str) -> None:
        """Ramp to rest and stay there until `enable`."""
        if not self._stopped:
            self._stopped = reason
            self._modes.say(Severity.INFO, "stop", f"stop: {reason}")

    def enable(self) -> None:
        """Release a `stop`: start cold, from the input that acts."""
        if self._stopped:
            self._stopped = ""
            self._modes.say(Severity.INFO, "enable", "released by an operator")
            if self.mode is Mode.STOPPED:
                self._warm = False
                self._modes.enter(Mode.WAITING, "enabled")

    def tick(self, local_ns: int) -> Command | None:
        """
        Notice silence: return a ramp to rest, once, when the last state has become stale.

        Args:
            local_ns: Local monotonic time.
        """
        if self._state is None or self.mode in (Mode.IDLE, Mode.WAITING) or not self._warm:
            return None
        now_ns = self._clock.now_ns(local_ns)
        age_ns = now_ns - self._state.stamp_ns
        if age_ns <= self._stale_ns:
            return None
        self._warm = False
        self._modes.enter(Mode.STOPPED if self._stopped else Mode.BRAKING, f"no state for {1e-9 * age_ns:.3f} s", Severity.ERROR, "state_stale")
        return self._issue(self._state, now_ns, QpStatus.NONE, self._ramp(self._sent.at(now_ns)[0]))

    # The two phases.

    def prepare(self) -> None:
        """Prepare the next sample: fix `t_k`, look the reference up, shift, linearize and load the QP."""
        self._keep()
        if not self._warm or self._state is None:
            return
        offset_ns = self._state.stamp_ns + self._delay_ns - self._act_ns
        self._act_ns += self._dt_ns
        if abs(offset_ns) <= self._clock.period_ns / 2:
            self._act_ns += offset_ns  # the grid follows the robot's; what is late beyond jitter does not move it
        self._loaded = False
        if self.mode in (Mode.TRACKING, Mode.HOLDING, Mode.FALLBACK):
            self._load(shift=True)

    def _keep(self) -> None:
        """Keep the plan of the last command for telemetry, before the next one overwrites it."""
        if self._planned_seq != self._seq:
            self._planned = (self._rti.x.copy(), self._rti.y_ref.copy(), self._rti.cost)
            self._planned_seq = self._seq

    def _load(self, *, shift: bool) -> None:
        """Load the QP of `t_k`."""
        self._track.look_up(self._act_ns)
        self._track.p[:, self.np_ :] = self._prediction.p[self.np_ :]
        self._rti.prepare(self._track.y_ref, self._track.p, shift=shift, u_prev=self._sent.at(self._act_ns - 1)[0])
        self._loaded = True

    def _rejoin(self, stamp_ns: int) -> None:
        """Bring plan and grid to a state that the grid has not expected: the first one, or one that comes late."""
        behind = round((stamp_ns + self._delay_ns - self._act_ns) / self._dt_ns) if self._warm else 0
        if 0 < behind < self._rti.ocp.N:
            self.skipped += behind
            self._act_ns += behind * self._dt_ns
            if self._loaded:
                for _ in range(behind - 1):
                    self._rti.shift()
                self._load(shift=True)
            return
        self.skipped += behind
        self._act_ns = stamp_ns + self._delay_ns
        self._warm = True
        self._failed = 0
        self._loaded = False

    def _act(self, state: State) -> Command:
        """Feedback: from a due state to the command that acts at `t_k`."""
        ending = self._track.ended(self._act_ns)
        if self._stopped or ending is End.STOP:
            mode, reason = (Mode.STOPPED, self._stopped) if self._stopped else (Mode.BRAKING, "the reference ended with STOP")
            self._loaded = False
            self._modes.enter(mode, reason)
            self._valid_until_ns = state.stamp_ns + self._delay_ns + self._valid_ns
            return self._issue(state, self._act_ns, QpStatus.NONE, self._ramp(self._sent.at(self._act_ns - 1)[0]))
        self._prediction.predict(self._x, state.stamp_ns, self._act_ns)
        status = self._feedback_cold() if not self._loaded else self._rti.feedback(self._x0)
        if status.usable:
            self._failed = 0
            if ending is None:
                self._modes.enter(Mode.TRACKING, "following the reference")
            else:
                self._modes.enter(Mode.HOLDING, "the reference has ended")
            self._valid_until_ns = min(self._act_ns + self._rti.ocp.N * self._dt_ns, state.stamp_ns + self._delay_ns + self._valid_ns)
            return self._issue(state, self._act_ns, status, self._rti.u[self._held])
        self._failed += 1
        self.fallbacks += 1
        if self._failed <= FALLBACKS and self._loaded:
            self._modes.enter(Mode.FALLBACK, f"the QP is {status.name.lower()}: playing the previous plan", Severity.WARNING, "qp_failed")
            return self._issue(state, self._act_ns, status, self._rti.u[self._held])
        self._loaded = False
        self._modes.enter(Mode.BRAKING, f"the QP is {status.name.lower()} and no plan is left", Severity.ERROR, "no_plan")
        self._valid_until_ns = state.stamp_ns + self._delay_ns + self._valid_ns
        return self._issue(state, self._act_ns, status, self._ramp(self._sent.at(self._act_ns - 1)[0]))

    def _feedback_cold(self) -> QpStatus:
        """Solve a first sample: the guess stays where the robot is, and is iterated on."""
        self._rti.reset(self._x0, self._sent.at(self._act_ns - 1)[0])
        status = QpStatus.FAILED
        for _ in range(ITERATIONS_COLD):
            self._load(shift=False)
            status = self._rti.feedback(self._x0)
        self._loaded = status.usable  # a guess that was never a plan is none to fall back to
        return status

    # What goes out.

    def _issue(self, state: State, act_ns: int, status: QpStatus, u: Array) -> Command:
        """Make a command of a plan, shape ``(N, nu)``."""
        self._seq += 1
        self._command = Command(
            epoch=self._epoch,
            seq=self._seq,
            stamp_ns=act_ns,
            state_epoch=state.epoch,
            state_seq=state.seq,
            state_stamp_ns=state.stamp_ns,
            valid_until_ns=self._valid_until_ns,
            config_hash=self._config_hash,
            mode=self.mode,
            status=status,
            period_ns=self._dt_ns,
            u=u,
        )
        self._sent.append(self._command)
        return self._command

    def _ramp(self, u: Array) -> Array:
        """Return a plan from an input to rest inside the slew limits, shape ``(N, nu)``; from past commands, never from a measured speed."""
        ocp = self._rti.ocp
        plan = np.empty((ocp.N, len(u)))
        for k in range(ocp.N):
            u = u + np.clip(self._u_rest - u, ocp.lbdu, ocp.ubdu)
            plan[k] = u
        return plan

    def standstill(self) -> Command | None:
        """Return the last command of a life: rest, whatever came before; None if nothing was ever commanded."""
        if self._command is None or self._state is None:
            return None
        self._valid_until_ns = self._state.stamp_ns + self._delay_ns + self._valid_ns
        return self._issue(self._state, self._act_ns, QpStatus.NONE, np.tile(self._u_rest, (self._rti.ocp.N, 1)))

    @property
    def at_rest(self) -> bool:
        """Whether the last command is rest from its first row on, or there never was one."""
        return self._command is None or np.array_equal(self._command.u[0], self._u_rest)

    def slack_s(self, local_ns: int) -> float:
        """Return robot time, s, from a local monotonic time to the state of the next sample."""
        return 1e-9 * (self._act_ns - self._delay_ns - self._clock.now_ns(local_ns))

    def robot_now_ns(self, local_ns: int) -> int:
        """Return robot time at a local monotonic time."""
        return self._clock.now_ns(local_ns)

    def telemetry(self, *, prepare_us: float, feedback_us: float, latency_us: float, slack_s: float) -> Telemetry:
        """Describe the last sample; the times are the caller's, who has a clock."""
        command, solver = self._command, self._rti.solver
        assert command is not None
        self._keep()
        return Telemetry(
            epoch=command.epoch,
            seq=command.seq,
            stamp_ns=command.stamp_ns,
            state_seq=command.state_seq,
            state_stamp_ns=command.state_stamp_ns,
            mode=command.mode,
            status=command.status,
            iterations=solver.iterations,
            res_prim=solver.res_prim,
            res_dual=solver.res_dual,
            cost=self._planned[2],
            violation=self._rti.violation,
            prepare_us=prepare_us,
            feedback_us=feedback_us,
            latency_us=latency_us,
            state_age_s=1e-9 * (command.stamp_ns - command.state_stamp_ns),
            slack_s=slack_s,
            skipped=self.skipped,
            fallbacks=self.fallbacks,
            parameter_version=0,
            x0=self._x0.copy(),
            x=self._planned[0],
            u=command.u,
            y_ref=self._planned[1],
            d=self._prediction.p[self.np_ :].copy(),
        )

    # Small parts.

    def _anchor(self, reference: Reference) -> Reference:
        """Follow a checked reference, from the last state on if it is to start on arrival."""
        self._arriving = None
        stamp_ns = reference.stamp_ns if self._state is None else self._state.stamp_ns
        if reference.stamp_ns == STAMP_ON_ARRIVAL:
            reference = replace(reference, stamp_ns=stamp_ns)
        self._track.load(reference, self._x, stamp_ns)
        if self._loaded and self._warm:
            self._load(shift=False)
        return reference

    def _unwrap(self, state: State) -> None:
        """Take over a state, its angles nearest to those of the last one."""
        last = self._x.copy()
        self._x[:] = state.x
        if self._state is not None:
            for j in self._angles:
                self._x[j] += TWO_PI * round((last[j] - self._x[j]) / TWO_PI)

    def _observe(self, state: State) -> None:
        """Replace the state by its estimate, and let predictions know of the disturbances."""
        observer = self._observer
        if observer is None:
            return
        if self._state is None or state.stamp_ns - self._state.stamp_ns > self._stale_ns:
            observer.reset(self._x)
        else:
            observer.frozen = self.mode not in (Mode.TRACKING, Mode.HOLDING)  # which inputs act is then known less well
            for u, span_s in self._sent.spans(self._state.stamp_ns, state.stamp_ns):
                observer.predict(u, span_s)
            observer.correct(self._x)
        self._x[:] = observer.x
        self._prediction.p[self.np_ :] = observer.d

    def _restart(self, code: str, text: str) -> None:
        """Forget the robot's last life."""
        self._modes.enter(Mode.IDLE, text, Severity.WARNING, code)
        self._state = None
        self._clock.reset()
        self._sent.clear()
        self._track.clear()
        self._warm = self._loaded = False
