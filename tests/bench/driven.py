# SPDX-License-Identifier: Apache-2.0
"""The shipped robot, sampled faster, driven along the eight in real time by the processes that a user runs, and the messages received from them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rti_mpc.contract.message import Telemetry
from rti_mpc.wire.bus import Bus, BusSettings, Subscriber
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.info import Info, Label
from rti_mpc_service.config.config import load
from rti_mpc_service.rig import robot_log
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.rig.robot_log import RobotLog
from rti_mpc_service.shipped import SHIPPED
from tests.processes.system import PATIENCE_S, until

INFO = Info("controller", states=tuple(map(Label, ("x", "y", "psi", "u", "omega"))), inputs=tuple(map(Label, ("u_c", "omega_c"))))


@dataclass
class Driven:
    """A robot being driven."""

    folder: Path
    endpoint: str
    bus: Bus
    children: Children
    lives: set[str]
    subscriber: Subscriber
    pids: dict[str, int]
    telemetry: list[Telemetry] = field(default_factory=list)

    @property
    def toml(self) -> Path:
        return self.folder / "robot.toml"

    def listen(self) -> int:
        """Store the samples since the last call; return the number of all samples so far."""
        self.telemetry += [decode(Telemetry, received.payload) for received in self.subscriber.drain()]
        return len(self.telemetry)

    def samples(self, number: int) -> list[Telemetry]:
        """Wait for this number of new samples."""
        first = self.listen()
        period_s = 1e-9 * (self.telemetry[-1].state_stamp_ns - self.telemetry[-2].state_stamp_ns)
        until(lambda: self.listen() >= first + number, f"{number} samples", pause_s=0.2, patience_s=2 * number * period_s + PATIENCE_S)
        return self.telemetry[first : first + number]

    def log(self) -> RobotLog:
        """Log written by the robot; complete only after the robot has ended."""
        return robot_log.read(self.folder / "robot.csv", INFO)


def sampled(folder: Path, dt_s: float, realtime: str = "") -> Path:
    """Write the shipped robot's configuration with another period, and what its controller asks of the system."""
    path = folder / "robot.toml"
    path.write_text(
        SHIPPED.read_text().replace("dt_s = 0.1 ", f"dt_s = {dt_s} ").replace("live = false ", "live = true ")
        + f"[sim]\nx0 = {{ x = 0.5 }}\n[realtime]\n{realtime}\n"
    )
    assert load(path).ocp.dt_s == dt_s
    return path


@contextmanager
def driven(folder: Path, dt_s: float, duration_s: float, realtime: str = "") -> Iterator[Driven]:
    """Drive until the block ends, at most for this duration."""
    endpoint, toml = free_endpoint(), sampled(folder, dt_s, realtime)
    keys = load(toml).keys()
    with Bus.join(BusSettings(listen=(endpoint,), connect=()), keys) as bus, Children(folder) as children:
        lives: set[str] = set()
        bus.watch_alive(lambda role, present: (lives.add if present else lives.discard)(role))
        meeting = ("-l", "tcp/127.0.0.1:0", "-e", endpoint)
        pids = {
            "controller": children.start("controller", "rti_mpc_service.cli", "run", toml, "-e", endpoint),
            "reference": children.start("reference", "rti_mpc_service.cli", "reference", toml, "-e", endpoint, "--duration", duration_s),
        }
        until(lambda: pids.keys() <= lives, "controller and reference")
        robot = Driven(folder, endpoint, bus, children, lives, bus.subscriber(keys.telemetry, capacity=8192), pids)
        pids["robot"] = children.start("robot", "rti_mpc_service.cli", "sim", toml, *meeting, "--log", folder / "robot.csv")
        until(lambda: robot.listen() > 1, "the first samples")
        yield robot


def quantiles(values: np.ndarray) -> str:
    if not np.isfinite(values).any():  # of a short form on a busy host
        return "none in time"
    return "p50 {:6.0f}  p99 {:6.0f}  max {:6.0f} us".format(*np.nanpercentile(values, [50, 99, 100]))
