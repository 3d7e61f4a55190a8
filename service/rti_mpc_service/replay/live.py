# SPDX-License-Identifier: Apache-2.0
"""Explanation of what a running controller has just done, from a recording of a few seconds: nothing is asked of it but a snapshot."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from threading import Event, Timer
from typing import Any

from rti_mpc.errors import ConfigError
from rti_mpc.recording import Recording
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.record import record
from rti_mpc_service.replay import why

LISTENED_S = 4.0  # for the bus to be joined, a snapshot, and a command after it


def main(bus_settings: BusSettings, keys: Keys, **choice: Any) -> int:
    """
    Explain the last command of a running controller.

    Args:
        bus_settings: How to join the bus.
        keys: Keys of the robot.
        choice: What `rti_mpc_service.replay.why.main` takes besides the recording.

    Returns:
        Exit status 0.

    Raises:
        ConfigError: No controller was heard, or its model is not here.
    """
    heard = f"the last {LISTENED_S:g} s of {keys.robot}"  # as messages name it, without its temporary folder
    logging.getLogger(record.__name__).setLevel(logging.ERROR)  # what is missing is said where it matters
    over = Event()
    with tempfile.TemporaryDirectory(prefix="rti-mpc-why-") as folder:
        path = Path(folder) / heard
        timer = Timer(LISTENED_S, over.set)
        timer.daemon = True
        timer.start()
        record.main(bus_settings, keys, out=path, stop=over)
        if not any(Recording(path).messages(keys.robot, ("journal",))):
            where = " or ".join(bus_settings.connect) or "any endpoint that it listens at"
            none = f"in {LISTENED_S:g} s none of {keys.prefix}/{keys.robot} was heard at {where}"
            raise ConfigError(f"why needs a running controller, or a recording, RUN.mcap: {none}")
        try:
            return why.main(path, **choice)
        except ConfigError as error:
            raise ConfigError(str(error).replace(f"{path}", heard)) from error
