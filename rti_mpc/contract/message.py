# SPDX-License-Identifier: Apache-2.0
"""
The messages between robot, planner, controller and viewer, as values.

Every message starts with ``epoch, seq, stamp_ns``: `seq` increases within an
epoch, an epoch is one life of its publisher, and `stamp_ns` is integer
nanoseconds of the robot's clock. SI units unless a name says otherwise.
`rti_mpc.wire.cdr` turns them into bytes.
"""

from __future__ import annotations

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
    """Severity of an event: WARNING if the process coped, ERROR if something was lost or stopped."""

    INFO = 0
    WARNING = 1
    ERROR = 2


@dataclass(slots=True)
class State:
    """
    The robot's state.

    Attributes:
        x: State estimate, shape ``(nx,)``. Angles may wrap.
        u: Inputs that act at `stamp_ns`, shape ``(nu,)``; empty if the robot does not report them.
        command_epoch: Epoch of the command that `u` comes from; 0: the robot's own ramp, or not reported.
        command_seq: Its sequence number.
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
    A plan of inputs: row ``i`` acts from ``stamp_ns + i * period_ns``, nothing acts from `valid_until_ns` on.

    Attributes:
        stamp_ns: When row 0 acts.
        state_epoch: Epoch of the state this command answers.
        state_seq: Its sequence number.
        state_stamp_ns: Its stamp, from which age and delay are computed.
        valid_until_ns: The command is dropped from this stamp on.
        config_hash: Configuration of the controller, as in `info`.
        mode: What the controller was doing.
        status: Outcome of the QP behind this command.
        period_ns: Time between rows.
        u: Inputs, shape ``(N, nu)``, held inputs expanded.
        rest_period_ns: Time between rows of the way to rest; 0 where there are none.
        u_rest: Way to rest from `valid_until_ns` on, shape ``(M, nu)``; no rows: inside the slew limits to rest.
        x_rest: States along it, shape ``(M, nx)``; no rows where no feedback is needed.
        K: Gain on the way to rest, shape ``(nu, nx)``: :math:`u = u_{rest} - K (x - x_{rest})`; no rows where no feedback is needed.
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
    Everything an engineer plots of one sample.

    Attributes:
        stamp_ns: When the command of this sample acts.
        state_seq: Sequence number of the state it answers.
        state_stamp_ns: Stamp of that state.
        iterations: Iterations of the QP solver.
        res_prim: Violation of dynamics, bounds and increments by the plan, relative to range; of another solver its primal residual.
        res_dual: Bound on what the plan costs above the optimum, relative to 1 plus its cost, normalised; of another solver its dual residual.
        cost: The cost (4) of the plan.
        violation: Largest slack of a softened bound in the plan, in that state's unit.
        prepare_us: Time of the preparation phase before this sample.
        feedback_us: Time of the feedback phase.
        latency_us: From the state's arrival to the command's hand-over to the bus.
        state_age_s: Stamp of the command minus stamp of the state, robot time.
        slack_s: Time left to the next state when its sample was prepared, robot time; negative: the sample overran its period.
        skipped: Samples skipped since start.
        fallbacks: Samples without a plan of their own since start.
        parameter_version: Version of the controller's parameters.
        x0: State embedded at stage 0, shape ``(nx,)``.
        x: Predicted states, shape ``(N + 1, nx)``.
        u: Planned inputs, shape ``(N, nu)``; row 0 is what was commanded.
        y_ref: Reference rows used, shape ``(N, ny)``.
        d: Estimated disturbances, shape ``(nd,)``, those of ``info``; none without an observer.
        delay_s: Delay from a state to the time at which its command acts, configured or measured, robot time.
        softened: Samples since start whose plan came from another solver than the first.
        shifted: Samples since start, of the fallbacks, on which the previous plan was continued.
        braked: Samples since start, of the fallbacks, that were answered by the ramp to rest.
        rested: Samples since start, of the fallbacks, that were answered by a standstill.
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


@dataclass(slots=True)
class Event:
    """
    A mode change or a fault.

    Attributes:
        source: Role of the publisher: controller, robot, reference, guard.
        code: Stable word for machines, such as ``state_stale``.
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
        code: Stable word for machines, such as ``state_stale``.
        text: One sentence for people.
        change: Whether it is a change of mode: each change is published, faults of one code at a limited rate.
    """

    severity: Severity
    code: str
    text: str
    change: bool = False
