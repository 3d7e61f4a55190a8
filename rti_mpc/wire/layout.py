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

from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Event, Reference, Severity, State, Telemetry
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
        name: Name in the dataclass and in the ``.msg`` file.
        kind: Type in the ``.msg`` file: an integer, ``float64``, ``string`` or ``float64[]``.
        about: Meaning and unit, the comment in the ``.msg`` file.
        member_of: Enumeration of which the number is a member.
        low: Least value of an integer, None without a limit.
        high: Largest value of an integer, or most bytes of a string with its final zero, None without a limit.
        also: A value outside these limits that is allowed all the same.
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
        Field("epoch", "uint64", "one life of the publisher; higher after every restart"),
        Field("seq", "uint64", "increases within an epoch"),
        _stamp("stamp_ns", stamp, also),
    )


LAYOUTS: dict[type[Any], tuple[Field, ...]] = {
    State: (
        *_head("when the state held, ns of the robot's clock"),
        Field("x", "float64[]", "state, SI units in the order of the model; angles in rad, may wrap", finite=True, filled=True),
        Field("u", "float64[]", "inputs that act at the stamp, in the order of the model; empty: not reported", finite=True),
        Field("command_epoch", "uint64", "epoch of the command they come from; 0: the robot's own ramp, or not reported"),
        Field("command_seq", "uint64", "its sequence number"),
    ),
    Reference: (
        *_head("time of row 0, ns of the robot's clock; STAMP_ON_ARRIVAL: the state current on arrival", STAMP_ON_ARRIVAL),
        Field("period_ns", "int64", "ns between rows", low=1, high=MAX_PERIOD_NS),
        Field("end", "uint8", "after the last row: HOLD it, or STOP", member_of=End),
        Field(
            "y",
            "float64[]",
            "rows of ny, SI units in the order of the model's outputs; angles in rad, may wrap",
            width="ny",
            finite=True,
            filled=True,
        ),
        Field(
            "p",
            "float64[]",
            "rows of np, as many as y has: the model's parameters, then x, y and radius of each obstacle, m; np = 0: the model's nominal ones",
            width="np",
            finite=True,
        ),
    ),
    Command: (
        *_head("when row 0 acts, ns of the robot's clock"),
        Field("state_epoch", "uint64", "epoch of the state this command answers"),
        Field("state_seq", "uint64", "its sequence number"),
        _stamp("state_stamp_ns", "its stamp, ns of the robot's clock"),
        _stamp("valid_until_ns", "dropped from this stamp on, ns of the robot's clock"),
        Field("config_hash", "uint64", "configuration of the controller, as in info"),
        Field("mode", "uint8", "what the controller was doing: IDLE ... STOPPED", member_of=Mode),
        Field("status", "uint8", "outcome of the QP behind this command: SOLVED ... NONE", member_of=QpStatus),
        Field("period_ns", "int64", "ns between rows", low=MIN_PERIOD_NS, high=MAX_PERIOD_NS),
        Field("u", "float64[]", "rows of nu, SI units in the order of the model's inputs", width="nu", finite=True, filled=True),
        Field("rest_period_ns", "int64", "ns between rows of the way to rest; 0 where there are none", low=0, high=MAX_PERIOD_NS),
        Field(
            "u_rest", "float64[]", "way to rest from valid_until_ns on, rows of nu; empty: inside the slew limits to rest", width="nu", finite=True
        ),
        Field("x_rest", "float64[]", "states along the way to rest, rows of nx; empty where no feedback is needed", width="nx", finite=True),
        Field("K", "float64[]", "gain, nu rows of nx: u = u_rest - K (x - x_rest); empty where no feedback is needed", width="nx", finite=True),
    ),
    Telemetry: (
        *_head("when the command of this sample acts, ns of the robot's clock"),
        Field("state_seq", "uint64", "sequence number of the state it answers"),
        _stamp("state_stamp_ns", "stamp of that state, ns of the robot's clock"),
        Field("mode", "uint8", "as in Command", member_of=Mode),
        Field("status", "uint8", "as in Command", member_of=QpStatus),
        Field("iterations", "uint32", "of the QP solver"),
        Field("res_prim", "float64", "primal residual of the QP, infinity norm"),
        Field("res_dual", "float64", "dual residual of the QP, infinity norm"),
        Field("cost", "float64", "cost of the plan"),
        Field("violation", "float64", "largest slack of a softened bound in the plan, unit of that state"),
        Field("prepare_us", "float64", "preparation phase before this sample, us"),
        Field("feedback_us", "float64", "feedback phase, us"),
        Field("latency_us", "float64", "from the state's arrival to the command's hand-over to the bus, us"),
        Field("state_age_s", "float64", "command's stamp minus state's stamp, s of the robot's clock"),
        Field("slack_s", "float64", "left to the next state when its sample was prepared, s of the robot's clock; negative: the sample overran"),
        Field("skipped", "uint64", "samples skipped since start"),
        Field("fallbacks", "uint64", "samples without a plan of their own since start: shifted, braked and rested"),
        Field("parameter_version", "uint32", "of the controller's parameters"),
        Field("x0", "float64[]", "state embedded at stage 0, nx numbers, SI units"),
        Field("x", "float64[]", "predicted states, N + 1 rows of nx, SI units", width="nx"),
        Field("u", "float64[]", "planned inputs, N rows of nu, SI units; row 0 is what was commanded", width="nu"),
        Field("y_ref", "float64[]", "reference rows used, N rows of ny, SI units", width="ny"),
        Field("d", "float64[]", "estimated disturbances, as info/controller names them; none without an observer"),
        Field("delay_s", "float64", "from a state to the act of its command, configured or measured, s of the robot's clock"),
        Field("softened", "uint64", "samples since start whose plan another solver had to find than the first"),
        Field("shifted", "uint64", "samples since start on which the previous plan played on"),
        Field("braked", "uint64", "samples since start that were answered by the ramp to rest"),
        Field("rested", "uint64", "samples since start that were answered by a standstill"),
    ),
    Event: (
        *_head("ns of the robot's clock"),
        Field("source", "string", "role of the publisher: controller, robot, reference, guard", high=64),
        Field("severity", "uint8", "INFO, WARNING: we coped, ERROR: something was lost or stopped", member_of=Severity),
        Field("code", "string", "stable word for machines, such as state_stale", high=64),
        Field("text", "string", "one sentence for people", high=4096),
    ),
}
MAX_PAYLOAD_BYTES: dict[type[Any], int] = {
    State: 1 << 16,
    Reference: 1 << 23,  # 349,000 rows of three outputs; a session reassembles no longer message on any key
    Command: 1 << 20,
    Telemetry: 1 << 21,
    Event: 1 << 13,
}
MESSAGE_DESCRIPTIONS: dict[type[Any], str] = {
    State: "The robot's state, published by the robot.",
    Reference: "Output reference on a regular time grid. It ends with its last row: no heartbeat.",
    Command: "A plan of inputs: row i acts from stamp_ns + i * period_ns on, nothing acts from valid_until_ns on but the way to rest.",
    Telemetry: "Everything an engineer plots of one sample of the controller. Numbers may be NaN where nothing was computed.",
    Event: "A mode change or a fault.",
}
WIDTH_DESCRIPTIONS: dict[str, str] = {"nx": "states per row", "nu": "inputs per row", "ny": "outputs per row", "np": "stage parameters per row"}


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
        lines.append((f"{field.kind} {field.name}", field.about))
    column = max(len(declaration) for declaration, _ in lines)
    body = [f"{declaration:<{column}}  # {about}" for declaration, about in lines]
    return "\n".join([f"# {MESSAGE_DESCRIPTIONS[cls]}", *constants, "", *body]) + "\n"
