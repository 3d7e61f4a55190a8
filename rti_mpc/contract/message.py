# SPDX-License-Identifier: Apache-2.0
"""
The messages between robot, planner, controller and viewer, as values.

Every message starts with ``epoch, seq, stamp_ns``: `seq` increases within an
epoch, the epoch is higher after every restart of the publisher, and `stamp_ns` is
integer nanoseconds of the robot's clock. SI units unless a name says otherwise.
`rti_mpc.wire.cdr` turns them into bytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.status import Mode, QpStatus

STAMP_ON_ARRIVAL = -(2**63)  # stamp of a Reference that starts at the newest state when it arrives


class End(IntEnum):
    """What to do after the last row of a reference."""

    HOLD = 0
    STOP = 1


class Severity(IntEnum):
    """Severity of an event: WARNING for a fault that the system handled, ERROR if something was lost or stopped."""

    INFO = 0
    WARNING = 1
    ERROR = 2

    @property
    def level(self) -> int:
        """Level in a log, as the standard library counts: 20, 30 or 40."""
        return 10 * (self + 2)


@dataclass(slots=True)
class State:
    """
    The robot's state.

    Attributes:
        x: State estimate, shape ``(nx,)``. Angles may wrap.
        u: Inputs that act at `stamp_ns`, shape ``(nu,)``; empty if the robot does not report them.
        command_epoch: Epoch of the command that `u` comes from; 0: the robot's own ramp to rest, from which plans begin, or no `u` is reported.
        command_seq: Sequence number of that command.
    """

    epoch: int
    seq: int
    stamp_ns: int
    x: Array
    u: Array = field(default_factory=lambda: np.zeros(0))
    command_epoch: int = 0
    command_seq: int = 0


@dataclass(slots=True)
class Reference:
    """
    Output reference on a regular time grid; it ends with its last row.

    Attributes:
        stamp_ns: Time of row 0, or `STAMP_ON_ARRIVAL`.
        period_ns: Time between rows.
        end: What to do after the last row.
        y: Output rows, shape ``(M, ny)``. Angles may wrap.
        p: Stage parameters, shape ``(M, np)``; ``(M, 0)`` for the model's nominal ones.
    """

    epoch: int
    seq: int
    stamp_ns: int
    period_ns: int
    end: End
    y: Array
    p: Array


@dataclass(slots=True)
class Command:
    """
    A plan of inputs: row ``i`` acts from ``stamp_ns + i * period_ns`` on. From `valid_until_ns` on, only the way to rest acts.

    Attributes:
        stamp_ns: Time from which row 0 acts.
        state_epoch: Epoch of the state that this command answers.
        state_seq: Sequence number of that state.
        state_stamp_ns: Stamp of that state, from which age and delay are computed.
        valid_until_ns: Time from which no row of `u` may act.
        config_hash: Hash of the controller's configuration, as in `info`.
        mode: Mode of the controller.
        status: Outcome of the QP behind this command.
        period_ns: Time between rows.
        u: Inputs, shape ``(N, nu)``, held inputs expanded.
        rest_period_ns: Time between rows of the way to rest; 0: it has no rows.
        u_rest: Inputs of the way to rest from `valid_until_ns` on, shape ``(M, nu)``; no rows: the robot ramps its inputs to rest.
        x_rest: States along the way to rest, shape ``(M, nx)``; no rows where no feedback is needed.
        K: Feedback gain along the way to rest, shape ``(nu, nx)``: :math:`u = u_{rest} - K (x - x_{rest})`; no rows where no feedback is needed.
    """

    epoch: int
    seq: int
    stamp_ns: int
    state_epoch: int
    state_seq: int
    state_stamp_ns: int
    valid_until_ns: int
    config_hash: int
    mode: Mode
    status: QpStatus
    period_ns: int
    u: Array
    rest_period_ns: int = 0
    u_rest: Array = field(default_factory=lambda: np.zeros((0, 0)))
    x_rest: Array = field(default_factory=lambda: np.zeros((0, 0)))
    K: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(slots=True)
class Telemetry:
    """
    Measurements and results of one sample.

    Attributes:
        stamp_ns: Time from which the command of this sample acts.
        state_seq: Sequence number of the state that the command answers.
        state_stamp_ns: Stamp of that state.
        iterations: Iterations of the QP solver.
        res_prim: Violation of dynamics, bounds and increments by the plan, relative to range; from other QP solvers their primal residual.
        res_dual: Bound on the plan's cost above the optimum, relative to 0.01 plus the cost, normalised; from other QP solvers their dual residual.
        cost: The cost (4) of the plan.
        violation: Largest slack of a softened bound in the plan, in the unit of the bounded state or constraint.
        prepare_us: Time of the preparation phase before this sample.
        feedback_us: Time of the feedback phase.
        latency_us: Time from the state's arrival until the command was given to the bus.
        state_age_s: Stamp of the command minus stamp of the state, robot time.
        slack_s: Time left until the next state when the next sample was prepared, robot time; negative: this sample overran its period.
        skipped: Samples skipped since the start.
        fallbacks: Samples without a new plan since the start: the sum of shifted, braked and rested.
        parameter_version: Version of the controller's parameters.
        x0: State embedded at stage 0, shape ``(nx,)``.
        x: Predicted states, shape ``(N + 1, nx)``.
        u: Planned inputs, shape ``(N, nu)``; row 0 is what was commanded.
        y_ref: Reference rows used, shape ``(N, ny)``.
        d: Estimated disturbances, shape ``(nd,)``, those of ``info``; none without an observer.
        delay_s: Delay from a state to the time at which its command acts, configured or measured, robot time.
        softened: Samples since the start that a backup solver solved, because the first one did not.
        shifted: Those of `fallbacks` on which the previous plan was continued.
        braked: Those of `fallbacks` that were answered by the ramp to rest.
        rested: Those of `fallbacks` that were answered by a standstill.
        y: Outputs at `x0`, shape ``(ny,)``; none where they were not computed.
        second_seq: Sequence number of the command whose plan OSQP has judged since the sample before; 0: none.
        second_status: SOLVED if OSQP has come to an opinion; NONE if there was none to come to, or this sample has cut it short.
        second_difference: Largest difference of an input in OSQP's plan from the commanded one, relative to half its range; NaN without a plan.
        second_iterations: Iterations of OSQP.
        second_us: Time that OSQP took, in the slack.
    """

    epoch: int
    seq: int
    stamp_ns: int
    state_seq: int
    state_stamp_ns: int
    mode: Mode
    status: QpStatus
    iterations: int
    res_prim: float
    res_dual: float
    cost: float
    violation: float
    prepare_us: float
    feedback_us: float
    latency_us: float
    state_age_s: float
    slack_s: float
    skipped: int
    fallbacks: int
    parameter_version: int
    x0: Array
    x: Array
    u: Array
    y_ref: Array
    d: Array = field(default_factory=lambda: np.zeros(0))
    delay_s: float = 0.0
    softened: int = 0
    shifted: int = 0
    braked: int = 0
    rested: int = 0
    y: Array = field(default_factory=lambda: np.zeros(0))
    second_seq: int = 0
    second_status: QpStatus = QpStatus.NONE
    second_difference: float = math.nan
    second_iterations: int = 0
    second_us: float = 0.0


class JournalKind(IntEnum):
    """Content of a `Journal` message."""

    CALLS = 0
    SNAPSHOT = 1
    CASE = 2


@dataclass(slots=True)
class Journal:
    """
    Part of a controller's journal: a batch of consecutive entries, or one that is a snapshot of its state or the QP of a failed or late sample.

    Attributes:
        epoch: Number of the controller's process; it does not change when a standby takes over.
        seq: Number of the first entry; a number that no message has is an entry that was dropped.
        stamp_ns: Stamp of the robot's last state when this was published; 0: none had come.
        local_ns: Local monotonic time at which this was published.
        dropped: Entries dropped since the start.
        data: Entries or snapshot, in an encoding of their own; a case as NumPy's npz, empty if it was too long.
    """

    epoch: int
    seq: int
    stamp_ns: int
    local_ns: int
    dropped: int
    kind: JournalKind
    data: bytes


@dataclass(slots=True)
class Event:
    """
    A mode change or a fault.

    Attributes:
        source: Role of the publisher: controller, robot, reference, guard.
        code: Name of the event for programs, such as ``state_stale``.
        text: One sentence for people.
    """

    epoch: int
    seq: int
    stamp_ns: int
    source: str
    severity: Severity
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Notice:
    """
    Content of an event; its publisher adds source, stamp and sequence number.

    Attributes:
        code: Name of the event for programs, such as ``state_stale``.
        text: One sentence for people.
        change: Whether it is a change of mode: each change is published, faults of one code at a limited rate.
    """

    severity: Severity
    code: str
    text: str
    change: bool = False
