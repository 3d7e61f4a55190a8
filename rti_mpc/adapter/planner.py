# SPDX-License-Identifier: Apache-2.0
"""Adapter of a planner: references of one's own, sent to the controller of a robot."""

from __future__ import annotations

import sys
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rti_mpc import given
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, End, Reference, Severity
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.wire.bus import Bus, BusSettings, new_epoch
from rti_mpc.wire.intake import taken
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.layout import most_rows
from rti_mpc.wire.rival import Rival

ROLE = "reference"
MAX_PERIOD_S = 1e9  # whose nanoseconds fit a stamp


class PlannerAdapter:
    """
    One life of a planner on the bus; leaves it at the end of a ``with`` block.

    Controllers that join while it lives get the last reference, too.
    """

    def __init__(self, robot: str, *, prefix: str = "rti_mpc", bus: BusSettings | None = None) -> None:
        """
        Join the bus.

        Args:
            robot: Name of the robot, as in its TOML file.
            prefix: What all keys begin with.
            bus: How to join; None: a peer that connects to the usual endpoint.

        Raises:
            ConfigError: The name is none for a key, or Zenoh refuses a setting.
        """
        self._robot = robot
        self._bus = Bus.join(bus or BusSettings(), Keys(prefix, robot), say=self._say)
        self._publisher = self._bus.publisher(self._bus.keys.reference)
        self._epoch, self._seq = new_epoch(), 0
        self._rival = Rival(self._bus, self._epoch)
        self._bus.watch_connection(lambda notice: self._say(notice.text, notice.severity))
        self._bus.alive(ROLE)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus; the robot follows the last reference to its end. From then on `send` does nothing."""
        self._bus.close()

    def send(self, y: ArrayLike, period_s: float, *, stamp_ns: int = STAMP_ON_ARRIVAL, end: End = End.HOLD, p: ArrayLike | None = None) -> None:
        """
        Send a reference, which takes the place of the last one. A line tells of another source for the same robot, once.

        Args:
            y: Rows of outputs in the order of the model, shape ``(M, ny)``; angles may wrap.
            period_s: Time between rows.
            stamp_ns: Time of row 0 on the robot's clock; by default that of the state which is current on arrival.
            end: What happens after the last row: it is held, or the robot stops.
            p: Stage parameters in the order of the model, shape ``(M, np)``; None: the model's nominal ones.

        Raises:
            ConfigError: The rows are no table of finite numbers, or too many for a message; or the period, the time or the end is none.
            OcpError: What must be numbers is none.
        """
        rows = given.numbers("y", y).copy()
        parameters = np.zeros((rows.shape[0] if rows.ndim else 0, 0)) if p is None else given.numbers("p", p).copy()
        for name, table in (("y", rows), ("p", parameters)):
            if table.ndim != 2 or not rows.size or len(table) != len(rows) or not np.isfinite(table).all():
                raise ConfigError(f"{name} must be a table of finite numbers, as many rows as y has, got shape {table.shape}")
        if len(rows) > (most := most_rows(rows.shape[1], parameters.shape[1])):
            raise ConfigError(f"y must have at most {most} rows of this length, for a reference to arrive, got {len(rows)}: send the others later")
        if not 0.0 < given.number("period_s", period_s) <= MAX_PERIOD_S:
            raise ConfigError(f"period_s must be above 0 and at most {MAX_PERIOD_S:g} s, got {period_s}")
        reference = Reference(self._epoch, self._seq + 1, stamp_ns, round(1e9 * period_s), end, rows, parameters)
        try:
            payload = taken(reference)
        except MessageError as error:
            raise ConfigError(f"a reference must be one that receivers take: {error}") from error
        self._seq += 1
        self._publisher.put_bytes(payload)
        if (notice := self._rival.notice()) is not None:
            self._say(notice.text, notice.severity)

    def _say(self, line: str, severity: Severity = Severity.WARNING) -> None:
        """Print a line with its level, as the logs of the other processes have it; what the bus waits for is a warning there, too."""
        print(f"{severity.name:<7} {self._robot}: {line}", file=sys.stderr)
