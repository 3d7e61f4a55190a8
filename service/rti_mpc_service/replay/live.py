# SPDX-License-Identifier: Apache-2.0
"""Explanation of what a running controller has just done, from a recording of a few seconds: nothing is asked of it but a snapshot."""

from __future__ import annotations

import logging
import sys
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
from rti_mpc_service.replay.place import Unreached

LISTENED_S = 4.0  # for the bus to be joined, a snapshot, and two commands after it
PATIENCE_S = 15.0  # for the same where that was too short: a busy controller leaves a snapshot to the slack of a later sample


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
        ConfigError: No controller was heard, it took no snapshot, it sent no commands, or its model is not here.
    """
    logging.getLogger(record.__name__).setLevel(logging.ERROR)  # what is missing is said where it matters
    try:
        return explained(bus_settings, keys, LISTENED_S, choice)
    except Unreached:
        print(
            f"rti-mpc: no snapshot of the controller and two commands after it in {LISTENED_S:g} s, listening for {PATIENCE_S:g} s", file=sys.stderr
        )
    try:
        return explained(bus_settings, keys, PATIENCE_S, choice)
    except Unreached as error:
        needed = f"why needs a snapshot of the running controller and two commands after it, and heard none in {PATIENCE_S:g} s"
        causes = "without a reference it sends no commands, and with little slack it takes no snapshot, see its event snapshot_waits"
        raise ConfigError(f"{needed}: {causes}") from error


def explained(bus_settings: BusSettings, keys: Keys, listened_s: float, choice: dict[str, Any]) -> int:
    """
    Explain the last command that is heard in a time.

    Raises:
        ConfigError: No controller was heard, or its model is not here.
        Unreached: No snapshot was heard, or not two commands after it.
    """
    over = Event()
    with tempfile.TemporaryDirectory(prefix="rti-mpc-why-") as folder:
        path = Path(folder) / "heard.mcap"
        timer = Timer(listened_s, over.set)
        timer.daemon = True
        timer.start()
        record.main(bus_settings, keys, out=path, stop=over)
        if not any(Recording(path).messages(keys.robot, ("journal",))):
            where = " or ".join(bus_settings.connect) or "any endpoint that it listens at"
            none = f"in {listened_s:g} s none of {keys.prefix}/{keys.robot} was heard at {where}"
            raise ConfigError(f"why needs a running controller, or a recording, RUN.mcap: {none}")
        return why.main(path, **choice, name=f"the last {listened_s:g} s of {keys.robot}")
