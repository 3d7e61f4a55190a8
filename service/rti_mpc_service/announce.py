# SPDX-License-Identifier: Apache-2.0
"""Announcements of a process: each an event on the bus and a line of its log."""

from __future__ import annotations

import logging

from rti_mpc.contract.message import Notice
from rti_mpc.wire.announcer import Announcer


def announce(log: logging.Logger, announcer: Announcer, notice: Notice, stamp_ns: int) -> None:
    """Publish and log a notice with a stamp in robot time, 0 where none is known yet; a fault that was announced just before is not repeated."""
    if announcer.say(notice, stamp_ns):
        log.log(notice.severity.level, "%s", notice.text, extra={"robot_ns": stamp_ns or None})
