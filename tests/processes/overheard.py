# SPDX-License-Identifier: Apache-2.0
"""
Recorder of all messages on the bus: ``python -m tests.processes.overheard ENDPOINT FILE``, one line of JSON per message.

On a bus with TLS the first argument is the folder of the host's certificates. Read by tests whose processes run on other hosts.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from rti_mpc.contract.message import Command, State, Telemetry
from rti_mpc.wire.bus import Bus, BusSettings, Subscriber
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc_service.certs.folder import secured
from rti_mpc_service.entry import enter
from tests.processes.system import KEYS

STREAMS: dict[str, tuple[str, type[Any], tuple[str, ...]]] = {
    "state": (KEYS.state, State, ("epoch", "seq", "stamp_ns")),
    "command": (KEYS.command, Command, ("epoch", "seq", "state_seq", "state_stamp_ns", "mode")),
    "actuation": (KEYS.actuation, Command, ("epoch", "seq", "state_seq", "state_stamp_ns", "mode")),
    "standby": (KEYS.standby_telemetry, Telemetry, ("epoch", "seq", "state_seq", "mode")),
}


@dataclass
class Overheard:
    """Messages recorded so far, by stream: each message's fields, when it was heard (`at_ns`, monotonic), and `u`, the first row of inputs."""

    path: Path
    streams: dict[str, list[dict[str, Any]]] = field(default_factory=lambda: {name: [] for name in STREAMS})
    _offset: int = 0

    def listen(self) -> Overheard:
        """Read the messages recorded since the last call."""
        with self.path.open("rb") as file:
            file.seek(self._offset)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._offset += len(line)
                message = json.loads(line)
                self.streams[message["stream"]].append(message)
        return self


def write(name: str, cls: type[Any], fields: tuple[str, ...], subscriber: Subscriber, file: TextIO) -> None:
    """Write a stream down; a thread of its own."""
    for received in iter(subscriber.recv, None):
        at_ns, message = time.monotonic_ns(), decode(cls, received.payload)
        values = {field: int(getattr(message, field)) for field in fields}
        if cls is Command:
            values["u"] = message.u[0].tolist()
        if cls is State:
            values["x"] = message.x.tolist()
        file.write(json.dumps({"stream": name, "at_ns": at_ns, **values}) + "\n")


def main(where: str, path: Path) -> None:
    """Record messages until stopped."""
    stop = stop_on_signals()
    settings = secured(BusSettings(), Path(where), "view") if Path(where).is_dir() else BusSettings(mode="client", connect=(where,))
    with Bus.join(settings, KEYS, timeout_s=60.0, stop=stop) as bus, path.open("w", buffering=1) as file:
        for name, (key, cls, fields) in STREAMS.items():
            threading.Thread(target=write, args=(name, cls, fields, bus.subscriber(key, capacity=1024), file), daemon=True).start()
        stop.wait()


if __name__ == "__main__":
    enter(lambda: main(sys.argv[1], Path(sys.argv[2])))
