# SPDX-License-Identifier: Apache-2.0
"""
Guard process: loads no model and no solver, neither CasADi, OSQP nor SciPy.

One thread receives commands and passes them on, one receives states, and the main
thread ticks. Each holds the lock for microseconds. The decisions are made by
`rti_mpc.contract.guard`.
"""

from __future__ import annotations

import gc
import logging
import secrets
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any

import rti_mpc
from rti_mpc.contract.epoch import NUMBER_BITS, epoch_above
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.latch import Latch
from rti_mpc.contract.message import Command, Notice, Severity, State
from rti_mpc.errors import ConfigError
from rti_mpc.wire import info
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Received, Subscriber, unix_s
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.session import BusSettings
from rti_mpc_service.announce import announce
from rti_mpc_service.config import signals_file
from rti_mpc_service.config.build import guard_limits
from rti_mpc_service.config.schema import Config
from rti_mpc_service.config.signals_file import Signals
from rti_mpc_service.latch_file import LatchFile
from rti_mpc_service.operator_stop import OperatorStop

ROLE = "guard"
LISTEN_BEFORE_START_S = 0.5  # how long a starting guard listens for another one
MAX_RAMP_S = 3.0  # how long a guard that is being stopped may take to bring the robot to rest

log = logging.getLogger(ROLE)


def main(config: Config, bus_settings: BusSettings, path: Path, *, state: Path | None = None, stop: Event | None = None) -> int:
    """
    Guard one robot until stopped.

    Args:
        config: The robot's configuration.
        bus_settings: How to join the bus.
        path: Its file, beside which `check` has written the signals of the model.
        state: Folder in which an operator's stop is stored; None: the folder of the user or of the service.
        stop: Event that stops the guard; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 0 when stopped, 1 when another guard is present or an unforeseen error ended this one.

    Raises:
        ConfigError: The configuration has no guard, the signals do not fit it, or an endpoint is not available.
    """
    if not config.guard.enabled:
        raise ConfigError("guard.enabled must be true for the robot to take what a guard passes on, got false")
    signals = signals_file.read(path, config)
    stop = stop or stop_on_signals()
    with Bus.join(bus_settings, config.keys(), stop=stop, say=log.warning) as bus:
        heard, intake = bus.subscriber(bus.keys.actuation, capacity=RING_MESSAGES), bus.intake(Command, LISTEN_BEFORE_START_S, choosing=True)
        if bus.is_alive(ROLE, LISTEN_BEFORE_START_S):
            print(f"rti-mpc: {config.robot} already has a guard: stop it first, or give this robot another name", file=sys.stderr)
            return 1
        known = max(unix_s() << NUMBER_BITS, intake.highest_epoch(heard.drain()))
        epoch = epoch_above(known, secrets.randbits(NUMBER_BITS))
        process = Process(config, signals, bus, epoch, LatchFile(bus.keys, state))
        bus.alive(ROLE)
        log.info("epoch %d guards %s", epoch, config.robot)
        return process.run(stop)


def guard_info(config: Config, signals: Signals) -> dict[str, object]:
    """Return the guard's message for ``info``: its limits per input, null where there is none."""
    limits = guard_limits(config, signals)
    return {
        "role": ROLE,
        "version": rti_mpc.__version__,
        "model": signals.model,
        **info.labels(inputs=signals.inputs),
        **info.bounds(**{name: getattr(limits, name).tolist() for name in ("u_rest", "lbu", "ubu", "lbdu", "ubdu")}),
        "dt_s": limits.dt_s,
        "tick_s": config.guard.tick_s,
        "config_hash": config.config_hash,
    }


class Process:
    """One life of the guard on the bus."""

    def __init__(self, config: Config, signals: Signals, bus: Bus, epoch: int, file: LatchFile) -> None:
        limits, keys = guard_limits(config, signals), bus.keys
        self._bus = bus
        self._telling = Lock()
        self._about = {**guard_info(config, signals), "epoch": epoch}
        self._guard = Guard(limits, epoch=epoch, config_hash=config.config_hash)
        self._tick_s = config.guard.tick_s
        self._lock = Lock()
        self._crashed = Event()
        self._announcer = Announcer(bus, ROLE, epoch)
        self._actuation = bus.publisher(keys.actuation)
        self._states = bus.intake(State, config.stale_s, {"x": limits.rotations.size, "u": len(limits.u_rest)})
        bus.expect("state", lambda: self._guard.heard)
        bus.watch_connection(self._guard.notices.append)
        self._commands = bus.intake(Command, config.stale_s, {"u": len(limits.u_rest)})
        self._operator_stop = OperatorStop(file, self._obey, self._guard.notices.append)
        self._operator_stop.listen(bus)
        self._operator_stop.serve(bus, lambda: ROLE, self._publish_info)
        self._publish_info()
        self._threads = [
            Thread(target=self._guarded, args=(self._follow, act, bus.subscriber(key, capacity=RING_MESSAGES)), name=act.__name__, daemon=True)
            for act, key in ((self._state, keys.state), (self._command, keys.command))
        ]

    def run(self, stop: Event) -> int:
        """Guard until stopped; then tell the robot to ramp to rest, and to stand."""
        gc.collect()
        gc.freeze()
        for thread in self._threads:
            thread.start()
        self._guarded(self._watch, stop)
        with self._lock:
            self._guarded(self._guard.stop, time.monotonic_ns())
        deadline_s = time.monotonic() + MAX_RAMP_S
        while not self._guard.at_rest(time.monotonic_ns()) and time.monotonic() < deadline_s:
            self._guarded(self._tick)
            time.sleep(self._tick_s)
        for end in (self._tick, self._operator_stop.close):
            self._guarded(end)
        log.info("stopped")
        return int(self._crashed.is_set())

    def _watch(self, stop: Event) -> None:
        """Tick until stopped, or until another loop has ended by an error."""
        while not stop.wait(self._tick_s) and not self._crashed.is_set():
            self._tick()

    def _obey(self, latch: Latch) -> None:
        """Stop or release the robot, as the latch says."""
        with self._lock:
            if latch.stopped:
                self._guard.latch(latch.reason, time.monotonic_ns())
            else:
                self._guard.enable()

    def _publish_info(self) -> None:
        """Publish the description of this guard on ``info``."""
        with self._telling:
            self._bus.publish_json(self._bus.keys.info(ROLE), {**self._about, **self._operator_stop.latch_info()})

    def _state(self, received: Received) -> None:
        """Process a received state."""
        with self._lock:
            local_ns = time.monotonic_ns()
            if (state := self._states.read(received)) is not None:
                self._guard.receive_state(state, local_ns)

    def _command(self, received: Received) -> None:
        """Check a received command, and pass it on at once if it is accepted."""
        command = self._commands.read(received, known=self._guard.epoch)
        if command is None:
            return
        with self._lock:
            passed = self._guard.receive_command(command, time.monotonic_ns())
            if passed is not None:
                self._actuation.put(passed)

    def _tick(self) -> None:
        """Brake if nothing fresh has come, and announce what has happened."""
        with self._lock:
            local_ns = time.monotonic_ns()
            told = self._guard.tick(local_ns)
            if told is not None:
                self._actuation.put(told)
        stamp_ns = self._guard.robot_now_ns(local_ns)
        while self._guard.notices:
            notice = self._guard.notices.popleft()
            announce(log, self._announcer, notice, stamp_ns)
        for intake in (self._states, self._commands):
            for refusal in intake.notices(local_ns):
                announce(log, self._announcer, refusal, stamp_ns)

    def _follow(self, act: Callable[[Received], None], subscriber: Subscriber) -> None:
        """Act on what is received."""
        for received in iter(subscriber.recv, None):
            act(received)

    def _guarded(self, act: Callable[..., object], *given: Any) -> None:
        """Run a loop or a step of the end; an error leads to a ramp to rest and exit status 1, so that a supervisor restarts the guard."""
        try:
            act(*given)
        except Exception as error:
            if self._bus.closed or self._crashed.is_set():
                return  # closed by another thread, at the end of the process; or a further error on the way to rest, which goes on
            log.exception("stopping after an unexpected error")
            self._crashed.set()
            self._guard.notices.append(Notice(Severity.ERROR, "crashed", f"stopping after an unexpected error: {type(error).__name__}: {error}"))
