# SPDX-License-Identifier: Apache-2.0
"""Test stand of a guard with the guard's own process, which tests start, stop and kill."""

from __future__ import annotations

import os
import subprocess
import time
from pathlib import Path

import numpy as np

from rti_mpc.array import Array
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.session import BusSettings
from rti_mpc_service.config.build import build_signals, guard_limits
from rti_mpc_service.config.config import load
from rti_mpc_service.conformance.stand import BIRTH_NS, MS, Stand, Steering
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.guarded import write_robot
from tests.in_time import in_time, on_time

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0  # to start a guard and hear of it


class Rig(Stand):
    """
    Drives one guard.

    Attributes:
        config: Configuration file given to the guard.
        process: The guard.
    """

    def __init__(self, guard: list[str], folder: Path, host: Host) -> None:
        self._host = host
        self.config = write_robot(folder / "robot.toml")
        loaded = load(self.config)
        self._guard, self._folder = guard, folder
        self._endpoint = free_endpoint()
        bus = Bus.join(BusSettings(listen=(self._endpoint,), connect=()), loaded.keys())
        super().__init__(bus, guard_limits(loaded, build_signals(loaded)))
        self.start()

    def start(self) -> None:
        """Start a guard."""
        with (self._folder / "guard.log").open("ab") as log:
            command = [*self._guard, str(self.config), "-e", self._endpoint]
            environment = {**os.environ, "PYTHONPATH": str(ROOT), "STATE_DIRECTORY": str(self._folder / "state")}
            self.process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def close(self) -> None:
        self.kill()
        self.bus.close()

    def ready(self) -> None:
        """Begin a life of the robot, and wait until the guard lets its commands pass."""
        self.new_robot()
        deadline_s = time.monotonic() + PATIENCE_S
        while not any(told.state_epoch == self.epoch for _, told in self.heard):
            assert self.process.poll() is None, (self._folder / "guard.log").read_text()
            assert time.monotonic() < deadline_s, "a guard must let healthy commands pass"
            self.run(100, lambda state: self.command(np.zeros(2)))
        self.run(300, lambda state: self.command(np.zeros(2)))

    def drive(self) -> None:
        """Bring the robot to full inputs."""
        self.reach(self.ubu, self.towards(self.ubu))

    def reach(self, u: Array, pilot: Steering) -> None:
        """Let a controller command until an input acts."""
        deadline_s = time.monotonic() + PATIENCE_S
        self.run(300, pilot)
        while not np.allclose(self.actuator.u, u):
            assert time.monotonic() < deadline_s, "a guard must let a healthy controller drive"
            self.run(100, pilot)

    def in_time(self, what: str, took_ms: float, limit_ms: float, since_ns: int) -> None:
        """Hold something that began at a time of the robot to its limit, as `tests.in_time` does."""
        in_time(self._host, what, took_ms, limit_ms, since_ns + self._zero_ns)

    def on_time(self, what: str, since_ns: int = BIRTH_NS) -> bool:
        """Whether the host has let everybody be on time since a time of the robot, as `tests.in_time` says."""
        return on_time(self._host, what, self.period_ns / MS, since_ns + self._zero_ns)
