# SPDX-License-Identifier: Apache-2.0
"""
Conformance test of a robot or a guard that runs elsewhere, in the place of its controller.

A test leads: it is present as the controller, so none starts beside it, and it does not
begin beside one. A guard is tested with a robot that this process plays, so no other may
use the name meanwhile.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Event
from typing import TypeVar

from rti_mpc.array import Array
from rti_mpc.contract.epoch import NUMBER_BITS, epoch_above
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import RING_MESSAGES, Bus, BusSettings, new_epoch, unix_s
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Key
from rti_mpc_service.config.build import build_observer, build_rti, build_signals, guard_limits
from rti_mpc_service.config.fit import check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.conformance import guard, moving, robot
from rti_mpc_service.conformance.finding import Case, Judgement, judgements
from rti_mpc_service.conformance.report import conclude, progress
from rti_mpc_service.conformance.stand import Stand
from rti_mpc_service.console import plain_console
from rti_mpc_service.entry import EXIT_FAILED, say
from rti_mpc_service.host.hold_up import Host, Unwitnessed
from rti_mpc_service.json_text import json_text

WHAT = ("robot", "guard")
LISTEN_BEFORE_START_S = 1.0  # how long a test listens for others before it moves anything
SILENCE_S = 10.0  # wall time after which a robot that sends no state is gone
POLL_S = 1e-3
STALE_S = 0.25
STOPPED = "stopped before everything was judged"
LEADING = {"robot": ("controller", "standby"), "guard": ("controller", "standby", "robot")}  # roles beside which no test begins

T = TypeVar("T", robot.Trial, moving.MovingTrial)


class Ended(Exception):
    """The test was stopped, or the robot sends no states."""


def main(config: Config, bus_settings: BusSettings, words: Sequence[str], path: Path | None = None, *, moves: bool = False) -> int:
    """
    Judge a robot or a guard, print the table, and write it to a file if asked to.

    Args:
        config: The robot's configuration.
        bus_settings: How to join the bus.
        words: ``robot`` or ``guard``.
        path: JSON file to write.
        moves: Whether the robot may be moved.

    Returns:
        Exit status: 0 if every promise is visible and kept; else 1, also beside a controller.

    Raises:
        ConfigError: The words are not valid, the robot may not be moved, or it cannot be judged by commands without its controller.
    """
    if len(words) != 1 or words[0] not in WHAT:
        raise ConfigError(f"conformance must be followed by robot or guard, got {' '.join(words) or 'neither'}")
    (what,) = words
    if what == "guard" and not config.guard.enabled:
        raise ConfigError("guard.enabled must be true for a robot to have a guard, got false")
    if what == "robot" and config.model.stop == "coasts":
        raise ConfigError(f"model.name: {config.model.name} coasts, and a test cannot bring it to rest")
    if not moves:
        raise ConfigError("conformance moves the robot, by metres and without a view of it: clear its way, and give --moves-the-robot")
    holder = hold(config) if what == "robot" else None
    limits, console, stop = guard_limits(config, build_signals(config)), plain_console(), stop_on_signals()
    found: list[Judgement] = []
    count = len(robot.CASES if what == "robot" else guard.CASES)
    with ExitStack() as stack:
        bus = stack.enter_context(Bus.join(bus_settings, config.keys(), stop=stop, say=say))
        others, heard = company(bus, what, guarded=config.guard.enabled)
        if others:
            say(f"{config.robot} has {others}: a {what} is judged without, stop it first")
            return EXIT_FAILED
        epoch = epoch_above(max(heard, unix_s() << NUMBER_BITS), secrets.randbits(NUMBER_BITS))
        try:
            host = stack.enter_context(Host())
            for judgement in judge(what, bus, config, limits, epoch, stop, host, holder):
                found.append(judgement)
                progress(console, judgement, len(found), count)
                if stop.is_set() and len(found) < count:
                    raise Ended(STOPPED)
        except (Ended, Unwitnessed) as error:
            say(str(error))
            if not found:
                return EXIT_FAILED
    conclude(console, f"{what} of {config.robot}", found)
    if path is not None:
        path.write_text(json_text([judgement.to_json() for judgement in found]) + "\n", encoding="utf-8")
    return 0 if len(found) == count and all(judgement.verdict in ("yes", "host") for judgement in found) else EXIT_FAILED


def hold(config: Config) -> tuple[Controller, Array] | None:
    """Return a controller that stops and holds a robot, and how fast its states change in operation; None for one that inputs at rest stop."""
    if (law := check_stop(config)) is None:
        return None
    timing = Timing(config.delay_s, config.stale_s, config.timing.valid_s)
    return Controller(build_rti(config, say), timing, observer=build_observer(config), stop_law=law), law.rates


def judge(
    what: str, bus: Bus, config: Config, limits: Limits, epoch: int, stop: Event, host: Host, holder: tuple[Controller, Array] | None = None
) -> Iterator[Judgement]:
    """
    Yield the judgements of a robot or a guard, which is left at rest.

    Raises:
        Ended: No state comes, or this process was stopped.
    """
    bus.alive("controller")
    if what == "guard":
        bus.alive("robot")
        yield from judgements(guard.CASES, Stand(bus, limits, epoch=new_epoch(), leader=epoch), host)
        return
    if config.guard.enabled:
        bus.alive("guard")
    link = BusLink(bus, bus.keys.actuation if config.guard.enabled else bus.keys.command, stop)
    if holder is None:
        yield from left_at_rest(robot.CASES, robot.Trial(link, limits, config.timing.valid_s, epoch), host)
    else:
        yield from left_at_rest(moving.CASES, moving.MovingTrial(link, limits, *holder, epoch), host)


def left_at_rest(cases: Sequence[Case[T]], trial: T, host: Host) -> Iterator[Judgement]:
    """Yield the judgements of a robot, and leave it at rest."""
    try:
        yield from judgements(cases, trial, host)
    finally:
        trial.leave()


def company(bus: Bus, what: str, *, guarded: bool) -> tuple[str, int]:
    """Listen for others; return who leads, in words, empty if nobody does, and the highest epoch of a controller that was heard."""
    roles: set[str] = set()
    bus.watch_alive(lambda role, present: (roles.add if present else roles.discard)(role))
    keys, leading = bus.keys, {*LEADING[what], *(("guard",) if what == "robot" and guarded else ())}
    commanding = {"controller": keys.command, **({"guard": keys.actuation} if what == "robot" else {})}
    ears = {role: (bus.subscriber(key, capacity=RING_MESSAGES), bus.intake(Command, STALE_S, choosing=True)) for role, key in commanding.items()}
    states, reading = bus.subscriber(keys.state, capacity=RING_MESSAGES), bus.intake(State, STALE_S)
    time.sleep(LISTEN_BEFORE_START_S)
    epochs = {role: intake.highest_epoch(heard.drain()) for role, (heard, intake) in ears.items()}
    if what == "guard" and reading.highest_epoch(states.drain()):
        roles.add("robot")
    live = {role.partition(".")[0] for role in set(roles)} | {role for role, epoch in epochs.items() if epoch}  # without the number of some
    return " and ".join(f"a live {role}" for role in sorted(live & leading)), max(epochs.values())


class BusLink:
    """
    Connection to a robot on the bus.

    Raises:
        Ended: It sends no states, or this process was stopped.
    """

    def __init__(self, bus: Bus, key: Key[Command], stop: Event) -> None:
        self._heard, self._intake = bus.subscriber(bus.keys.state, capacity=RING_MESSAGES), bus.intake(State, STALE_S)
        self._commands, self._stop, self._robot = bus.publisher(key), stop, bus.keys.robot

    def states(self) -> list[State]:
        """Wait for the next states, oldest first."""
        deadline_s = time.monotonic() + SILENCE_S
        while time.monotonic() < deadline_s:
            if self._stop.is_set():
                self._stop = Event()  # what follows brings the robot to rest, and is not stopped
                raise Ended(STOPPED)
            if states := [state for received in self._heard.drain() if (state := self._intake.read(received)) is not None]:
                return states
            time.sleep(POLL_S)
        raise Ended(f"no state of {self._robot} has come for {SILENCE_S:g} s: is it running, under this name?")

    def put(self, command: Command | bytes) -> None:
        """Send a command, or bytes that are none."""
        if isinstance(command, bytes):
            self._commands.put_bytes(command)
        else:
            self._commands.put(command)
