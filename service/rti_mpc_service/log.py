# SPDX-License-Identifier: Apache-2.0
"""Log of a process on standard output: for people on a terminal, otherwise one JSON object per line."""

from __future__ import annotations

import json
import logging
import os
import sys
import warnings
from contextlib import suppress
from queue import Full, Queue
from threading import Thread

MAX_WAITING_LINES = 1000  # lines that wait to be written; further ones are dropped
CLOSE_TIMEOUT_S = 0.5  # for writing the waiting lines at the end


class JsonLines(logging.Formatter):
    """One JSON object a record, for journals."""

    def format(self, record: logging.LogRecord) -> str:
        """Write level, logger and text, and the traceback if there is one."""
        line = {"level": record.levelname, "logger": record.name, "text": record.getMessage()}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line)


class Aside(logging.Handler):
    """
    Writes in a thread of its own, and drops what waits in vain.

    A terminal that hangs, as with Ctrl-S or a lost connection, or a pipe that nobody
    reads, would otherwise hold up whoever has something to say: a controller, or
    its guard. (`logging.handlers.QueueListener` waits for it without limit at the end.)
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor
        self._lines: Queue[tuple[int, str] | None] = Queue(MAX_WAITING_LINES)  # each with how many before it were dropped
        self._dropped = 0  # since the last one that was not
        self._thread = Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Leave a record to be written."""
        try:
            self._lines.put_nowait((self._dropped, self.format(record)))
            self._dropped = 0
        except Full:
            self._dropped += 1
        except Exception:  # as every handler does: a record that cannot be formatted ends nobody's loop
            self.handleError(record)

    def close(self) -> None:
        """Wait until all is written, within a bounded time."""
        with suppress(Full):
            self._lines.put(None, timeout=CLOSE_TIMEOUT_S)
            self._thread.join(CLOSE_TIMEOUT_S)
        super().close()

    def _write(self) -> None:
        """Write what there is, past the buffers of `sys.stdout`, which a process cannot end without."""
        for dropped, line in iter(self._lines.get, None):
            if dropped:
                text = f"{dropped} lines are lost: standard output did not take them"
                line = self.format(logging.makeLogRecord({"name": "log", "levelname": "WARNING", "msg": text})) + "\n" + line
            with suppress(OSError):  # nobody reads it any more, or its disk is full
                os.write(self._descriptor, f"{line}\n".encode(errors="backslashreplace"))


def start() -> None:
    """Send all records from INFO on to standard output."""
    handler = Aside(sys.stdout.fileno())
    people = logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S")
    handler.setFormatter(people if sys.stdout.isatty() else JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    warnings.showwarning = lambda message, *_, **__: logging.getLogger("rti_mpc").warning(
        "%s", message
    )  # the library's: one line, not where it is from
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it tells of fonts it has found, in the middle of a first demo's sum
