# SPDX-License-Identifier: Apache-2.0
"""
Source of a path as a process: the part of it that lies around the robot, again and again.

Each reference holds the path in its stage parameters, from the robot's position on for
longer than its horizon. It lasts a second and ends with a stop, so that a robot whose
path is sent no more comes to rest. A robot that is restarted begins the path anew, where
it is nearest.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path as File
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.lives import Heard, Lives
from rti_mpc.contract.message import End, Notice, Reference, Severity, State
from rti_mpc.errors import ConfigError
from rti_mpc.reference.path import Path, read_path
from rti_mpc.reference.path_source import PathSource
from rti_mpc.reference.speed_profile import SpeedLimits
from rti_mpc.reference.tracks import TRACKS, track
from rti_mpc.signals import place, plane
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import RING_MESSAGES, Bus, BusSettings, new_epoch
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.rival import Rival
from rti_mpc_service.announce import announce
from rti_mpc_service.reference import ROLE, STALE_S, has_source
from rti_mpc_service.scenario import Scenario

if TYPE_CHECKING:
    from rti_mpc.model.model import Model

LOOK_PERIOD_S = 0.02  # period of reading states
PERIOD_NS = 100_000_000  # of the robot's time between two references
LASTS_NS = 1_000_000_000  # of the robot's time, after which a robot without another reference stops
START_S = 5.0  # of a scenario, for a start from rest
SLOWER, LAPS = 1.1, 2  # times of the speed profile that a robot may take for a lap, and laps of a closed path

logger = logging.getLogger(ROLE)


def find_path(name: str, speed_m_s: float, limits: SpeedLimits | None, smooth_m: float | None = None) -> tuple[Path, ...]:
    """
    Find the path that a robot follows.

    Args:
        name: One of the tracks that ship, or a CSV file; see `rti_mpc.reference.path.read_path`.
        speed_m_s: Speed where the file names none, in m/s.
        limits: Limits of its speed profile, which also stays below the speeds of the file; None: those speeds as they are.
        smooth_m: Arc length that waypoints are averaged over, in m.

    Raises:
        ConfigError: There is no such track, or the file is wrong.
    """
    if name not in TRACKS and File(name).suffix.lower() != ".csv":
        raise ConfigError(f"--path must be one of {', '.join(TRACKS)} or a FILE.csv of a path, got {name!r}")
    pieces = (track(name, speed_m_s),) if name in TRACKS else read_path(File(name), speed_m_s=speed_m_s, smooth_m=smooth_m)
    return pieces if limits is None else tuple(piece.limited(limits, inside=True) for piece in pieces)


def path_of_options(
    name: str, path_limits: tuple[float, float, float, float] | None, waypoint_speed_m_s: float, smooth_m: float | None, **others: object
) -> tuple[Path, ...]:
    """
    Find the path that the options of a command ask for.

    Args:
        name: As of `find_path`.
        path_limits: Speed in m/s, lateral acceleration, acceleration and braking in m/s^2; None: the speeds of the file.
        waypoint_speed_m_s: Speed in m/s where neither says one.
        smooth_m: As of `find_path`.
        others: Values of options that say what is followed in time.

    Raises:
        ConfigError: One of the others was given, there is no such track, or the file is wrong.
    """
    if given := [f"--{option}" for option, value in others.items() if value is not None]:
        raise ConfigError(f"--path is followed in place of a scenario and says nothing of time: {', '.join(given)} must be left out")
    limits = None if path_limits is None else SpeedLimits(*path_limits)
    return find_path(name, waypoint_speed_m_s if limits is None else limits.speed, limits, smooth_m)


def path_scenario(model: Model, name: str, pieces: Sequence[Path]) -> Scenario:
    """
    Return a path as a scenario of a robot that follows it: its outputs are to be zero, for two laps or once to the end.

    Raises:
        ConfigError: The model follows no path.
    """
    path_source(model, pieces)
    rows = np.zeros((2, model.ny))
    time_s = START_S + SLOWER * sum(piece.time_s for piece in pieces) * (LAPS if pieces[-1].closed else 1)
    return Scenario(File(name).stem, model.nx, lambda x: rows, 1e-9 * LASTS_NS, time_s, End.STOP, pieces=tuple(pieces))


def path_source(model: Model, pieces: Sequence[Path]) -> tuple[PathSource, list[int], int]:
    """
    Return the source of a path for a robot, and which of its states are position and progress.

    Raises:
        ConfigError: The model follows no path.
    """
    from rti_mpc.model.path_following import window_place

    window, position, progress = window_place(model), plane(model.states), place(model.states, "progress")
    if window is None or position is None or progress is None:
        raise ConfigError(
            f"model {model.name} must be made by path_following for --path, see docs/paths.md: it has no parameter whose role is path_start"
        )
    return PathSource(pieces, model.p_nominal, *window), list(position), progress


class PathReferences:
    """
    References of a robot that follows a path, as its states come.

    Args:
        model: Model of the robot, which follows a path.
        pieces: Pieces of the path.
        epoch: Epoch of the references.

    Raises:
        ConfigError: The model follows no path.
    """

    def __init__(self, model: Model, pieces: Sequence[Path], epoch: int) -> None:
        self._source, self._position, self._progress = path_source(model, pieces)
        self._epoch, self._seq = epoch, 0
        self._y: Array = np.zeros((2, model.ny))
        self._sent_ns: int | None = None

    def begin(self, x: Array) -> None:
        """Begin the path where it is nearest to a robot, with its first state."""
        self._source.begin(x[self._position], float(x[self._progress]))
        self._sent_ns = None

    def answer(self, stamp_ns: int, x: Array) -> Reference | None:
        """Return the next reference to be published, None if it is not due yet; of the stamp and the state, shape ``(nx,)``, of a robot."""
        if self._sent_ns is not None and 0 <= stamp_ns - self._sent_ns < PERIOD_NS:
            return None
        self._sent_ns = stamp_ns
        self._seq += 1
        p = self._source.parameters(float(x[self._progress]), float(x[self._progress + 1]))
        return Reference(self._epoch, self._seq, stamp_ns, LASTS_NS, End.STOP, self._y, np.tile(p, (2, 1)))


def main(name: str, model: Model, pieces: Sequence[Path], bus_settings: BusSettings, keys: Keys, *, stop: Event | None = None) -> int:
    """
    Publish the path around the robot until stopped.

    Args:
        name: Name of the path.
        model: Model of the robot, which follows a path.
        pieces: Pieces of the path.
        bus_settings: How to join the bus.
        keys: Where the robot's streams are.
        stop: Event that stops the source; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 0 when stopped, 1 when another source is present.

    Raises:
        ConfigError: The model follows no path.
    """
    epoch = new_epoch()
    references = PathReferences(model, pieces, epoch)
    stop = stop or stop_on_signals()
    with Bus.join(bus_settings, keys, stop=stop, say=logger.warning) as bus:
        if has_source(bus):
            return 1
        publisher, states = bus.publisher(keys.reference), bus.subscriber(keys.state, capacity=RING_MESSAGES)
        announcer, intake = Announcer(bus, ROLE, epoch), bus.intake(State, STALE_S, {"x": model.nx})
        lives, rival = Lives(STALE_S, STALE_S), Rival(bus, epoch)
        begun, stamp_ns = 0, 0  # how often, and the last state's
        bus.expect("state", lambda: begun)
        bus.watch_connection(lambda notice: announce(logger, announcer, notice, stamp_ns))
        bus.alive(ROLE)
        text = f"path {name} of {sum(piece.length for piece in pieces):.1f} m, {sum(piece.time_s for piece in pieces):.1f} s"
        logger.info("%s for %s", text, keys.robot)
        while not stop.wait(LOOK_PERIOD_S):
            now_ns = time.monotonic_ns()
            if (notice := rival.notice()) is not None:
                announce(logger, announcer, notice, stamp_ns)
            for state in intake.newest_of_each(states.drain()):
                heard, stamp_ns = lives.judge(state.epoch, now_ns), state.stamp_ns
                if heard is Heard.BEGINS:
                    begun += 1
                    references.begin(state.x)
                    announcer.say(Notice(Severity.INFO, "reference_published", text), stamp_ns)
                if heard is not Heard.OTHER and (reference := references.answer(state.stamp_ns, state.x)) is not None:
                    publisher.put(reference)
            for notice in intake.notices(now_ns):
                announcer.say(notice, stamp_ns)
    return 0
