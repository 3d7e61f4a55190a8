# SPDX-License-Identifier: Apache-2.0
"""Explanation of what a running controller has just done, from a recording of a few seconds: nothing is asked of it but a snapshot."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from threading import Event, Timer
from typing import Any

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
    logging.getLogger(record.__name__).setLevel(logging.ERROR)  # what is missing is said where it matters
    over = Event()
    with tempfile.TemporaryDirectory(prefix="rti-mpc-why-") as folder:
        path = Path(folder) / f"the last {LISTENED_S:g} s of {keys.robot}"
        timer = Timer(LISTENED_S, over.set)
        timer.daemon = True
        timer.start()
        record.main(bus_settings, keys, out=path, stop=over)
        return why.main(path, **choice)
