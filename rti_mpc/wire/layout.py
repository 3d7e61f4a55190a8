# SPDX-License-Identifier: Apache-2.0
"""
Field table of every message: the one source of the CDR codec and of the ``.msg`` files in `deploy/msg`.

Fields stand in the order of the wire, which is that of the dataclasses in
`rti_mpc.contract.message`. A matrix is flat on the wire; its row width is a ``uint32``
in front of the first matrix that has this width.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Event, Journal, JournalKind, Reference, Severity, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus

STAMP_LIMIT_NS = 2**62  # every time is smaller in magnitude: sums of two stamps, or of a stamp and a duration, fit an int64
MAX_PERIOD_NS = 3_600_000_000_000  # longest time between rows: one hour
MIN_PERIOD_NS = 100_000  # shortest time between rows of a command, and shortest period of a controller: each row costs the robot time
NUMBER_LIMIT = 1e18  # largest magnitude of a state, an input or a reference, in any unit: sums and products of them are finite


@dataclass(frozen=True)
class Field:
    """
    One field of a message.

    Attributes:
        name: Name in the dataclass, and in small letters in the ``.msg`` file.
        kind: Type in the ``.msg`` file: an integer, ``float64``, ``string``, ``float64[]`` or ``uint8[]``.
        about: Meaning and unit, the comment in the ``.msg`` file.
        member_of: Enumeration of which the number is a member.
        low: Least value of an integer, None without a limit.
        high: Largest value of an integer, or most bytes of a string with its final zero, None without a limit.
        also: A value outside these limits that is allowed as well.
        width: Name of the row width of a matrix; a vector has none.
        finite: Whether all numbers of an array must be finite, and at most `NUMBER_LIMIT`.
        filled: Whether an array must have numbers at all.
    """

    name: str
    kind: str
    about: str
    member_of: type[IntEnum] | None = None
    low: int | None = None
    high: int | None = None
    also: int | None = None
    width: str = ""
    finite: bool = False
    filled: bool = False


def _stamp(name: str, about: str, also: int | None = None) -> Field:
    return Field(name, "int64", about, low=1 - STAMP_LIMIT_NS, high=STAMP_LIMIT_NS - 1, also=also)


def _head(stamp: str, also: int | None = None) -> tuple[Field, ...]:
    return (
        Field("epoch", "uint64", "number of the publisher's current run; higher after every restart"),
        Field("seq", "uint64", "sequence number; increases within an epoch"),
        _stamp("stamp_ns", stamp, also),
    )


LAYOUTS: dict[type[Any], tuple[Field, ...]] = {
    State: (
        *_head("time at which the state was measured, ns of the robot's clock"),
        Field(
            "x",
            "float64[]",
            "state, SI units in the order of the model; angles in rad, may wrap; quaternions of either sign",
            finite=True,
            filled=True,
        ),
        Field("u", "float64[]", "inputs that act at that time, SI units in the order of the model; empty: not reported", finite=True),
        Field("command_epoch", "uint64", "epoch of the command that set these inputs; 0: the robot's own ramp, or not reported"),
        Field("command_seq", "uint64", "sequence number of that command"),
    ),
    Reference: (
        *_head("time of row 0, ns of the robot's clock; STAMP_ON_ARRIVAL: time of the latest state when this message arrives", STAMP_ON_ARRIVAL),
        Field("period_ns", "int64", "time between rows, ns", low=1, high=MAX_PERIOD_NS),
        Field("end", "uint8", "what to do after the last row: HOLD it, or STOP", member_of=End),
        Field(
            "y",
            "float64[]",
            "reference outputs, rows of ny, SI units in the order of the model's outputs; angles in rad, may wrap; quaternions of either sign",
            width="ny",
            finite=True,
            filled=True,
        ),
        Field(
            "p",
            "float64[]",
            "stage parameters, rows of np, one for each row of y: the model's, then x, y and radius of each obstacle, m; np = 0: the nominal ones",
            width="np",
            finite=True,
        ),
    ),
    Command: (
        *_head("time from which row 0 acts, ns of the robot's clock"),
        Field("state_epoch", "uint64", "epoch of the state that this command answers"),
        Field("state_seq", "uint64", "sequence number of that state"),
        _stamp("state_stamp_ns", "stamp of that state, ns of the robot's clock"),
        _stamp("valid_until_ns", "time from which no row of u may act, ns of the robot's clock"),
        Field("config_hash", "uint64", "hash of the controller's configuration, as in its info"),
        Field("mode", "uint8", "mode of the controller, IDLE to STOPPED", member_of=Mode),
        Field("status", "uint8", "outcome of the QP behind this command, SOLVED to NONE", member_of=QpStatus),
        Field("period_ns", "int64", "time between rows of u, ns", low=MIN_PERIOD_NS, high=MAX_PERIOD_NS),
        Field("u", "float64[]", "planned inputs, rows of nu, SI units in the order of the model's inputs", width="nu", finite=True, filled=True),
        Field("rest_period_ns", "int64", "time between rows of the way to rest, ns; 0: it has no rows", low=0, high=MAX_PERIOD_NS),
        Field(
            "u_rest",
            "float64[]",
            "inputs of the way to rest from valid_until_ns on, rows of nu; empty: the robot ramps its inputs to rest inside the slew limits",
            width="nu",
            finite=True,
        ),
        Field("x_rest", "float64[]", "states along the way to rest, rows of nx, SI units; empty: no feedback needed", width="nx", finite=True),
        Field(
            "K",
            "float64[]",
            "feedback gain along the way to rest, nu rows of nx: u = u_rest - K (x - x_rest); empty: no feedback needed",
            width="nx",
            finite=True,
        ),
    ),
    Telemetry: (
        *_head("time from which the command of this sample acts, ns of the robot's clock"),
        Field("state_seq", "uint64", "sequence number of the state that the command answers"),
        _stamp("state_stamp_ns", "stamp of that state, ns of the robot's clock"),
        Field("mode", "uint8", "as in Command", member_of=Mode),
        Field("status", "uint8", "as in Command", member_of=QpStatus),
        Field("iterations", "uint32", "iterations of the QP solver"),
        Field(
            "res_prim",
            "float64",
            "violation of dynamics, bounds and increments by the plan, relative to range; from other QP solvers than riccati their primal residual",
        ),
        Field(
            "res_dual",
            "float64",
            "bound on the plan's cost above the optimum, relative to 0.01 plus the cost, normalised; from others than riccati their dual residual",
        ),
        Field("cost", "float64", "cost of the plan"),
        Field("violation", "float64", "largest slack of a softened bound in the plan, unit of the bounded state or constraint"),
        Field("prepare_us", "float64", "duration of the preparation phase, before the state, us"),
        Field("feedback_us", "float64", "duration of the feedback phase, after the state, us"),
        Field("latency_us", "float64", "time from the state's arrival until the command was given to the bus, us"),
        Field("state_age_s", "float64", "stamp of the command minus stamp of the state, s of the robot's clock"),
        Field(
            "slack_s",
            "float64",
            "time left until the next state when the next sample was prepared, s of the robot's clock; negative: this sample overran",
        ),
        Field("skipped", "uint64", "number of samples skipped since the start"),
        Field("fallbacks", "uint64", "number of samples without a new plan since the start: the sum of shifted, braked and rested"),
        Field("parameter_version", "uint32", "version of the controller's live parameters"),
        Field("x0", "float64[]", "initial state, embedded at stage 0, nx numbers, SI units"),
        Field("x", "float64[]", "predicted states, N + 1 rows of nx, SI units", width="nx"),
        Field("u", "float64[]", "planned inputs, N rows of nu, SI units; row 0 is what was commanded", width="nu"),
        Field("y_ref", "float64[]", "reference outputs used, N rows of ny, SI units", width="ny"),
        Field("d", "float64[]", "estimated disturbances, in the order and units of info/controller; empty without an observer"),
        Field("delay_s", "float64", "delay from a state to the time at which its command acts, configured or measured, s of the robot's clock"),
        Field("softened", "uint64", "number of samples since the start that a backup solver solved, because the first one did not"),
        Field("shifted", "uint64", "number of samples since the start on which the previous plan was continued"),
        Field("braked", "uint64", "number of samples since the start that were answered by the ramp to rest"),
        Field("rested", "uint64", "number of samples since the start that were answered by a standstill"),
        Field("y", "float64[]", "outputs at x0, ny numbers, SI units in the order of the model's outputs; empty: not computed"),
        Field("second_seq", "uint64", "sequence number of the command whose plan OSQP has judged since the sample before; 0: none"),
        Field("second_status", "uint8", "as in Command; SOLVED: OSQP has solved the QP; NONE: nothing to judge, or no time", member_of=QpStatus),
        Field("second_difference", "float64", "largest difference of an input in OSQP's plan from the commanded one, relative to half its range"),
        Field("second_iterations", "uint32", "iterations of OSQP for this second opinion"),
        Field("second_us", "float64", "time that OSQP took for it, in the slack of the sample before, us"),
    ),
    Journal: (
        *_head("stamp of the robot's last state when this was published, ns of the robot's clock; 0: none had come"),
        Field("local_ns", "int64", "local monotonic time at which this was published, ns"),
        Field("dropped", "uint64", "number of entries dropped since the start"),
        Field("kind", "uint8", "content of data: CALLS, entries from seq on; SNAPSHOT and CASE, one entry", member_of=JournalKind),
        Field("data", "uint8[]", "entries or snapshot, in a versioned encoding of their own; a case as NumPy's npz"),
    ),
    Event: (
        *_head("time of the event, ns of the robot's clock"),
        Field("source", "string", "role of the publisher: controller, robot, reference, guard", high=64),
        Field("severity", "uint8", "INFO; WARNING: a fault that the system handled; ERROR: something was lost or stopped", member_of=Severity),
        Field("code", "string", "name of the event for programs, never changed, such as state_stale", high=64),
        Field("text", "string", "one sentence for people, with the numbers of this event", high=4096),
    ),
}
MAX_PAYLOAD_BYTES: dict[type[Any], int] = {
    State: 1 << 16,
    Reference: 1 << 23,  # 349,000 rows of three outputs; also the longest message that a session reassembles on any key
    Command: 1 << 20,
    Telemetry: 1 << 21,
    Journal: (1 << 23) + (1 << 11),  # a reference of the longest, with its entry
    Event: 1 << 13,
}
REFERENCE_HEAD_BYTES = 64  # of a reference, at most: all but its numbers
MESSAGE_DESCRIPTIONS: dict[type[Any], str] = {
    State: "The robot's state, published by the robot.",
    Reference: "Output reference on a regular time grid. It ends with its last row; it need not be repeated before.",
    Command: "A plan of inputs: row i acts from stamp_ns + i * period_ns on. From valid_until_ns on, only the way to rest acts.",
    Telemetry: "What the controller measured and computed at one sample. Numbers may be NaN where nothing was computed.",
    Journal: "Part of a controller's journal: calls that its commands depend on, a snapshot of its state, or the QP of a failed or late sample.",
    Event: "A mode change or a fault.",
}
WIDTH_DESCRIPTIONS: dict[str, str] = {"nx": "states per row", "nu": "inputs per row", "ny": "outputs per row", "np": "stage parameters per row"}


def most_rows(ny: int, np_: int) -> int:
    """Return how many rows a reference may have; a longer one arrives nowhere, for sessions drop it before it is reassembled."""
    return (MAX_PAYLOAD_BYTES[Reference] - REFERENCE_HEAD_BYTES) // (8 * (ny + np_))


def msg_text(cls: type[Any]) -> str:
    """Text of the ``.msg`` file of a message class."""
    constants, lines, widths = [], [], set()
    for field in LAYOUTS[cls]:
        if field.member_of is not None and MESSAGE_DESCRIPTIONS[cls] != MESSAGE_DESCRIPTIONS[Telemetry]:  # whose modes are those of Command
            constants += ["", *(f"uint8 {member.name}={int(member)}" for member in field.member_of)]
        if field.also is not None:
            constants += ["", f"{field.kind} STAMP_ON_ARRIVAL={field.also}"]
        if field.width and field.width not in widths:
            widths.add(field.width)
            lines.append(("uint32 " + field.width, WIDTH_DESCRIPTIONS[field.width]))
        lines.append((f"{field.kind} {field.name.lower()}", field.about))  # ROS 2 refuses a message with capitals in its fields
    column = max(len(declaration) for declaration, _ in lines)
    body = [f"{declaration:<{column}}  # {about}" for declaration, about in lines]
    return "\n".join([f"# {MESSAGE_DESCRIPTIONS[cls]}", *constants, "", *body]) + "\n"
