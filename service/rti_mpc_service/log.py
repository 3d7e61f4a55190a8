# SPDX-License-Identifier: Apache-2.0
"""Log of a process on standard output: readable text on a terminal, otherwise one JSON object per line."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import sys
import warnings
from contextlib import suppress
from datetime import datetime
from queue import Full, Queue
from threading import Thread

MAX_WAITING_LINES = 1000  # lines that wait to be written; further ones are dropped
CLOSE_TIMEOUT_S = 0.5  # for writing the waiting lines at the end


class JsonLines(logging.Formatter):
    """Formatter that writes one JSON object per record, for journals."""

    def format(self, record: logging.LogRecord) -> str:
        """Return wall time, robot time where it is known, level, logger, text and the traceback, if there is one."""
        wall = datetime.fromtimestamp(record.created).astimezone().isoformat(timespec="milliseconds")
        line: dict[str, object] = {"time": wall, "level": record.levelname, "logger": record.name, "text": record.getMessage()}
        if (stamp_ns := robot_ns(record)) is not None:
            line["robot_s"] = round(1e-9 * stamp_ns, 3)
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line)


class People(logging.Formatter):
    """Formatter for a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Return wall time, level, logger and text, and robot time where it is known."""
        stamp_ns = robot_ns(record)
        return super().format(record) + ("" if stamp_ns is None else f"  (robot time {1e-9 * stamp_ns:.3f} s)")


def robot_ns(record: logging.LogRecord) -> int | None:
    """Return the robot time that a record was given as its extra ``robot_ns``, None if there is none."""
    return getattr(record, "robot_ns", None)


class Aside(logging.Handler):
    """
    Handler that writes in a thread of its own, and drops lines when too many wait.

    A terminal that hangs, as with Ctrl-S or a lost connection, or a pipe that nobody
    reads, would otherwise block the logging process: a controller or its guard.
    (`logging.handlers.QueueListener` waits without limit at the end.)

    Attributes:
        descriptor: Where lines are written.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self.descriptor = descriptor
        self._lines: Queue[tuple[int, str] | None] = Queue(MAX_WAITING_LINES)  # number of lines dropped before each line, and the line
        self._dropped = 0  # lines dropped since the last accepted one
        self._thread = Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a record for writing."""
        try:
            self._lines.put_nowait((self._dropped, self.format(record)))
            self._dropped = 0
        except Full:
            self._dropped += 1
        except Exception:  # as every handler does: a record that cannot be formatted must not end the caller
            self.handleError(record)

    def close(self) -> None:
        """Wait until all queued lines are written, for at most twice `CLOSE_TIMEOUT_S`."""
        with suppress(Full):
            self._lines.put(None, timeout=CLOSE_TIMEOUT_S)
            self._thread.join(CLOSE_TIMEOUT_S)
        super().close()

    def _write(self) -> None:
        """Write queued lines directly to the descriptor: a process could not end while the buffer of `sys.stdout` is not accepted."""
        for dropped, line in iter(self._lines.get, None):
            if dropped:
                text = f"{dropped} lines were lost: standard output did not accept them"
                line = self.format(logging.makeLogRecord({"name": "log", "levelname": "WARNING", "msg": text})) + "\n" + line
            with suppress(OSError):  # nobody reads it any more, or its disk is full
                os.write(self.descriptor, f"{line}\n".encode(errors="backslashreplace"))


def divert() -> int:
    """
    Keep what else this process writes to standard output, such as native code, out of the log; return a file in memory where it goes.

    Its writers never wait and never fail, as they would at a pipe. Whoever reads it cuts it off.
    """
    ours = os.dup(sys.stdout.fileno())
    others = os.memfd_create("standard output of native code")
    fcntl.fcntl(others, fcntl.F_SETFL, os.O_APPEND)
    os.dup2(others, sys.stdout.fileno())
    for handler in logging.getLogger().handlers:
        if isinstance(handler, Aside):
            handler.descriptor = ours
    return others


def start() -> None:
    """Send all records from INFO on to standard output."""
    handler = Aside(sys.stdout.fileno())
    people = People("%(asctime)s.%(msecs)03d %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S")
    handler.setFormatter(people if sys.stdout.isatty() else JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    warnings.showwarning = lambda message, *_, **__: logging.getLogger("rti_mpc").warning(
        "%s", message
    )  # the library's: one line, not where it is from
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it would log its search for fonts into the summary of a first demo
