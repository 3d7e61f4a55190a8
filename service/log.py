# SPDX-License-Identifier: Apache-2.0
"""What a process says on standard output: for people on a terminal, one JSON object a line otherwise."""

from __future__ import annotations

import json
import logging
import sys


class JsonLines(logging.Formatter):
    """One JSON object a record, for journals."""

    def format(self, record: logging.LogRecord) -> str:
        """Write level, logger and text, and the traceback if there is one."""
        line = {"level": record.levelname, "logger": record.name, "text": record.getMessage()}
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line)


def start() -> None:
    """Send all records from INFO on to standard output."""
    handler = logging.StreamHandler(sys.stdout)
    people = logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s", "%H:%M:%S")
    handler.setFormatter(people if sys.stdout.isatty() else JsonLines())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logging.getLogger("matplotlib").setLevel(logging.WARNING)  # it tells of fonts it has found, in the middle of a first demo's sum
