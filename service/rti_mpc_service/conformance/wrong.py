# SPDX-License-Identifier: Apache-2.0
"""Wrong commands: each differs in one thing from a healthy one, and has to be refused as a whole."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command
from rti_mpc.wire.cdr import encode

MS = 1_000_000


@dataclass(frozen=True)
class Wrong:
    """
    A way to be wrong.

    Attributes:
        what: The command, in words that follow "a command".
        case: Name of the case that it belongs to.
        make: Makes it from the next healthy command of the leader, which was not sent.
        by_guard: Whether only a guard has to refuse it.
    """

    what: str
    case: str
    make: Callable[[Command, Limits], Command | bytes]
    by_guard: bool = False


def moved(command: Command, by_ns: int) -> Command:
    """Return a command with all of its times moved."""
    return replace(command, **{name: getattr(command, name) + by_ns for name in ("state_stamp_ns", "stamp_ns", "valid_until_ns")})


def rows(command: Command, *u: Any) -> Command:
    """Return a command with other rows."""
    return replace(command, u=np.vstack(u))


WRONG = (
    Wrong("of a lower epoch", "epochs", lambda command, _: replace(command, epoch=command.epoch - 1)),
    Wrong("that has expired", "late", lambda command, _: replace(command, valid_until_ns=command.stamp_ns - 1)),
    Wrong("whose rows are over", "late", lambda command, _: moved(command, -(len(command.u) + 1) * command.period_ns)),
    Wrong(
        "that answers a state of half a second ago",
        "late",
        lambda command, _: replace(command, state_stamp_ns=command.state_stamp_ns - 500 * MS),
        by_guard=True,
    ),
    Wrong("that answers a state of the future", "late", lambda command, _: moved(command, 400 * MS), by_guard=True),
    Wrong("of a robot's earlier life", "foreign", lambda command, _: replace(command, state_epoch=command.state_epoch - 1)),
    Wrong("whose number has passed", "repeated", lambda command, _: replace(command, seq=0)),
    Wrong("whose number was taken by another", "repeated", lambda command, _: replace(command, seq=command.seq - 1)),
    Wrong("of rows that are too wide", "malformed", lambda command, _: rows(command, np.tile(command.u[:, :1], (1, command.u.shape[1] + 1)))),
    Wrong("of rows that are not finite", "malformed", lambda command, _: rows(command, np.full_like(command.u, np.nan))),
    Wrong("that ends in the middle", "malformed", lambda command, _: encode(command)[:40]),
    Wrong("without its last byte", "malformed", lambda command, _: encode(command)[:-1]),
    Wrong("with a byte after its end", "malformed", lambda command, _: encode(command) + b"\x00"),
    Wrong("in big-endian order", "malformed", lambda command, _: b"\x00\x00" + encode(command)[2:]),
    Wrong("without content", "malformed", lambda _command, _: b""),
    Wrong("of nothing but ones", "malformed", lambda _command, _: b"\x00\x01\x00\x00" + b"\xff" * 400),
    Wrong("beyond the bounds at once", "limits", lambda command, limits: rows(command, np.tile(1.2 * limits.ubu, (20, 1))), by_guard=True),
    Wrong("beyond the bounds later", "limits", lambda command, limits: rows(command, np.tile(limits.ubu, (10, 1)), 1.01 * limits.ubu), by_guard=True),
    Wrong(
        "beyond the slew limits from row to row",
        "limits",
        lambda command, limits: rows(command, limits.ubu, limits.ubu - 1.2 * limits.step),
        by_guard=True,
    ),
)


def wrong(case: str, *, robot: bool = False) -> list[Wrong]:
    """Return those of a case; for a robot without those that only a guard has to refuse."""
    return [way for way in WRONG if way.case == case and not (robot and way.by_guard)]


def refused(ways: Sequence[Wrong]) -> str:
    """Return in words that all were refused."""
    return f"refused: a command {', one '.join(way.what for way in ways)}"
