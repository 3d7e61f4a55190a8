# SPDX-License-Identifier: Apache-2.0
"""
Recorder: a process that listens to all streams of one or more robots and writes them into an MCAP file.

A chunk is closed and written twice a second, so that the recorder may be killed at any
instant. What it writes is checked before: a message that cannot be decoded is counted, not
recorded, since readers would stop at it.
"""

from __future__ import annotations

import json
import logging
import re
import secrets
import time
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from threading import Event, Lock
from typing import Any

from rti_mpc.contract.epoch import MAX_SEQ_GAP, NUMBER_BITS
from rti_mpc.contract.message import Notice, Severity
from rti_mpc.errors import ConfigError, MessageError, reason
from rti_mpc.recording.host import HOST
from rti_mpc.recording.repair import repair
from rti_mpc.wire import document
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import MAX_NUMBER, Bus, BusSettings, new_epoch
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.received import Received
from rti_mpc.wire.streams import CONTROLLER_ROLES, JOURNAL, KNOWN_ROLES, STATE, admitted, role_of
from rti_mpc_service.host.pressure import waited_us
from rti_mpc_service.record.hearing import fetch_origin, hear
from rti_mpc_service.record.inbox import Arrived, Inbox
from rti_mpc_service.record.segments import Retention, Segments

ROLE = "recorder"
PERIOD_S = 0.5  # between two chunks
MAX_NUMBERED = 4096  # publishers whose sequence numbers are followed
MAX_ROBOTS = 100
STALE_S = 2.0
WILD = set("*?[")  # characters of a pattern
ANY_NAME = str.maketrans(dict.fromkeys("*?[!]", "x"))  # makes a name of a pattern
EVERYTHING = Retention()

MEDIA_TYPES = {".toml": "application/toml", ".py": "text/x-python", ".json": "application/json"}
MIN_LAST_S = 30.0  # that a ring of segments keeps: a controller takes a snapshot every 10 s, or later if it has no slack
UNITS_S = {"s": 1.0, "min": 60.0, "h": 3600.0}
UNITS_BYTES = {"KB": 10**3, "MB": 10**6, "GB": 10**9}

log = logging.getLogger(__name__)


def main(
    bus_settings: BusSettings,
    keys: Keys,
    *,
    out: Path | None = None,
    robots: Sequence[str] = (),
    retention: Retention = EVERYTHING,
    stop: Event | None = None,
) -> int:
    """
    Record until stopped.

    Args:
        bus_settings: How to join the bus.
        keys: Keys of a robot.
        out: File, or folder if there is a limit; None: in ``runs``, by robot and time.
        robots: Names of the robots to record instead, or patterns such as ``"*"`` for those that show presence below the same prefix.
        retention: Limits of time and size, beyond which the oldest segments are deleted.
        stop: Event that stops the process; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 1 if the disk did not take everything, else 0.

    Raises:
        ConfigError: The file is there already, or cannot be written, or a robot cannot have one of the names.
    """
    stop = stop or stop_on_signals()
    names = list(robots) or [keys.robot]
    for name in names:
        Keys(keys.prefix, name.translate(ANY_NAME) if WILD & set(name) else name)  # refuses what no robot can be called
    end = "" if retention else ".mcap"
    path = out or Path("runs") / f"{keys.robot if names == [keys.robot] else 'robots'}-{time.strftime('%Y%m%d-%H%M%S')}{end}"
    with Bus.join(bus_settings, keys, stop=stop, say=log.warning) as bus:
        now_ns = time.monotonic_ns()
        recorder = Recorder(bus, Segments(path, retention, now_ns, time.time_ns() - now_ns))
        log.info("recording %s to %s", ", ".join(f"{keys.prefix}/{name}" for name in names), path)
        fixed = [name for name in names if not WILD & set(name)]
        for name in fixed:
            recorder.follow(name)
        if fixed != names:

            def meet(robot: str, _: str, present: bool) -> None:
                if present and any(fnmatchcase(robot, name) for name in names):
                    recorder.follow(robot)

            bus.watch_robots(meet)
        bus.watch_connection(recorder.say)
        return recorder.run(stop)


class Recorder:
    """
    One recording.

    Attributes:
        counts: Numbers of messages: recorded; missing, by their sequence numbers; refused, since they cannot be decoded or their
            publisher's role is beyond `MAX_UNKNOWN_ROLES`.
    """

    def __init__(self, bus: Bus, segments: Segments) -> None:
        self.counts: Counter[str] = Counter(recorded=0, missing=0, refused=0)
        self._bus = bus
        self._segments = segments
        self._inbox = Inbox()
        self._buses: dict[str, Bus] = {}
        self._announcers: dict[str, Announcer] = {}  # by robot
        self._stamps_ns: dict[str, int] = {}  # of each robot's last state
        self._files: list[tuple[str, Mapping[str, str]]] = []  # of controllers, to be attached, with the beginning of their names
        self._lock = Lock()
        self._doors: dict[type[Any], Intake[Any]] = {}
        self._keys: dict[str, Key[Any]] = {}
        self._others: defaultdict[tuple[str, str], list[str]] = defaultdict(list)  # those of other roles than `KNOWN_ROLES`, by robot and stream
        self._last: dict[tuple[str, int], int] = {}  # sequence numbers by key and epoch
        self._owners: set[tuple[str, int]] = set()  # controllers whose files were asked for
        self._own = f"{ROLE}.{secrets.randbelow(MAX_NUMBER)}"  # a token that nobody else has: one that is there already tells no controller
        self._waited: tuple[int, int] | None = None  # monotonic time, ns, and what the host had waited then, us

    def follow(self, robot: str) -> None:
        """Record a robot from now on, too; in any thread."""
        with self._lock:
            if robot in self._buses or len(self._buses) >= MAX_ROBOTS:
                return
            try:
                bus = self._bus if robot == self._bus.keys.robot else self._bus.beside(Keys(self._bus.keys.prefix, robot))
            except ConfigError:
                return
            self._buses[robot] = bus
            self._announcers[robot] = Announcer(bus, ROLE, new_epoch())
        hear(bus, self._inbox, self._described)
        bus.alive(ROLE)
        bus.alive(self._own)
        bus.expect("message", lambda: any(entry[0].startswith(f"{bus.keys.prefix}/{robot}/") for entry in list(self._last)))

    def run(self, stop: Event) -> int:
        """Record until stopped, and return the exit status."""
        told = 0
        try:
            stopped = False
            while not stopped:
                stopped = stop.wait(PERIOD_S)
                self._write(time.monotonic_ns())
                if (lost := self.counts["missing"]) > told:
                    text = f"{lost} messages are missing in the recording so far, {self._inbox.dropped} of them because the disk was too slow"
                    self.say(Notice(Severity.WARNING, "recording_incomplete", text))
                    told = lost
            self._segments.writer.finish(self._outcome())
        except OSError as error:
            self._segments.writer.abandon()
            text = f"the recording ends here: {error.strerror}; its {1e-6 * self._segments.size:.1f} MB before are whole, see rti-mpc record --repair"
            self.say(Notice(Severity.ERROR, "recording_ended", text))
            return 1
        log.info("%s, %.1f MB", ", ".join(f"{count} {name}" for name, count in self.counts.items()), 1e-6 * self._segments.size)
        return 0

    def say(self, notice: Notice) -> None:
        """Announce to every robot, with the stamp of its last state, and log it once. In any thread."""
        with self._lock:
            announcers = dict(self._announcers)
        stamps_ns = {robot: self._stamps_ns.get(robot, 0) for robot in announcers}
        said = [announcer.say(notice, stamps_ns[robot]) for robot, announcer in announcers.items()]
        if any(said) or not said:
            alone_ns = next(iter(stamps_ns.values())) if len(said) == 1 else 0  # several robots have a time each
            log.log(notice.severity.level, "%s", notice.text, extra={"robot_ns": alone_ns or None})

    def _write(self, now_ns: int) -> None:
        """
        Write what has arrived as a chunk.

        Raises:
            OSError: The disk did not take it.
        """
        with self._lock:
            files, self._files = self._files, []
        for beginning, contents in files:
            for name, text in contents.items():
                media_type = MEDIA_TYPES.get(Path(name).suffix, "text/plain")
                self._segments.attach(f"{beginning}/{name}", media_type, text.encode(errors="replace"), now_ns)
        for entry in self._inbox.take():
            self._record(entry)
        self._watch_host(now_ns)
        self._segments.writer.flush()
        for entry in self._segments.roll(now_ns, self._outcome()):
            self._add(entry, self._keys[entry.received.key])

    def _watch_host(self, now_ns: int) -> None:
        """Add to each robot's streams for how long this host's processes waited for a core since the last chunk, where the kernel counts it."""
        before, total_us = self._waited, waited_us()
        self._waited = None if total_us is None else (now_ns, total_us)
        if before is None or total_us is None:
            return
        payload = json.dumps({"from_ns": before[0], "waited_s": 1e-6 * (total_us - before[1])}).encode()
        with self._lock:
            buses = dict(self._buses)
        for robot, bus in buses.items():
            self._segments.writer.add(robot, bus.keys.of(HOST), now_ns, payload)

    def _record(self, entry: Arrived) -> None:
        """Check a message and add it to the chunk."""
        received, stream = entry.received, entry.stream
        if received.key not in self._keys:
            if not self._admit(entry):
                self.counts["refused"] += 1
                return
            self._keys[received.key] = Key(received.key, stream)
        key = self._keys[received.key]
        seq = 0
        if stream.message is None:
            try:
                document.read(received.payload, received.size)
            except MessageError:
                self.counts["refused"] += 1
                return
        else:
            door = self._doors.setdefault(stream.message, self._bus.intake(stream.message, STALE_S))
            if (message := door.read(received)) is None:
                self.counts["refused"] += 1
                return
            seq = message.seq
            if stream is STATE:
                self._stamps_ns[entry.robot] = message.stamp_ns
            if stream is not JOURNAL:  # whose numbers count entries
                self._follow_numbers(received.key, message.epoch, seq)
        self._add(entry, key, seq)
        self._segments.keep(entry)
        self.counts["recorded"] += 1

    def _admit(self, entry: Arrived) -> bool:
        """Whether to record the key of a message from now on; one that is refused is not remembered, as any peer can invent roles."""
        key = entry.received.key
        if not entry.stream.by_role or role_of(key) in KNOWN_ROLES:
            return True
        others = self._others[entry.robot, entry.stream.name]
        if heard := admitted(key, others):
            others.append(key)
        return heard

    def _add(self, entry: Arrived, key: Key[Any], seq: int = 0) -> None:
        self._segments.writer.add(entry.robot, key, entry.local_ns, entry.received.payload, seq)

    def _follow_numbers(self, key: str, epoch: int, seq: int) -> None:
        """Count the sequence numbers that were left out."""
        last = self._last.get((key, epoch))
        if last is None and len(self._last) >= MAX_NUMBERED:
            self._last.clear()
        if last is not None and 1 < seq - last <= MAX_SEQ_GAP:
            self.counts["missing"] += seq - last - 1
        self._last[key, epoch] = max(seq, last or 0)

    def _described(self, robot: str, received: Received) -> None:
        """Ask a controller that has described itself for the first time for its files; in the thread that hears descriptions of this robot."""
        try:
            epoch = document.read(received.payload, received.size).get("epoch")
        except MessageError:
            return
        if role_of(received.key).partition(".")[0] not in CONTROLLER_ROLES or type(epoch) is not int:
            return
        owner = epoch % (1 << NUMBER_BITS)
        if (robot, owner) in self._owners or len(self._owners) >= MAX_NUMBERED:
            return
        self._owners.add((robot, owner))
        fetch_origin(self._buses[robot], owner, partial(self._give, f"{robot}/{owner}"))

    def _give(self, beginning: str, files: Mapping[str, str]) -> None:
        with self._lock:
            self._files.append((beginning, files))

    def _outcome(self) -> dict[str, str]:
        return {**{name: str(count) for name, count in self.counts.items()}, "dropped": str(self._inbox.dropped)}


def repaired(path: Path, to: Path) -> int:
    """
    Repair a file, say what it holds, and return the exit status.

    Raises:
        ConfigError: It is no recording, or cannot be read or written.
    """
    try:
        count = repair(path, to)
    except (OSError, MessageError) as error:
        raise ConfigError(f"--repair must be a recording that can be read and written, got {path}: {reason(error)}") from error
    print(f"{to}: {count} messages")
    return 0


def parse_retention(last: str | None, max_size: str | None) -> Retention:
    """
    Return limits as they are written on the command line.

    Raises:
        ConfigError: They are no time such as ``10min``, or one in which no snapshot may lie, or no size such as ``2GB``.
    """
    last_s, size = _quantity("last", last, UNITS_S, "10min"), _quantity("max-size", max_size, UNITS_BYTES, "2GB")
    if last_s is not None and last_s < MIN_LAST_S:
        raise ConfigError(f"--last must be at least {MIN_LAST_S:g}s, for a replay to begin at a snapshot of the controller, got {last!r}")
    return Retention(last_s, None if size is None else round(size))


def _quantity(option: str, text: str | None, units: Mapping[str, float], example: str) -> float | None:
    if text is None:
        return None
    match = re.fullmatch(rf"(\d+(?:\.\d+)?) ?({'|'.join(units)})", text)
    if match is None or not float(match[1]):
        raise ConfigError(f"--{option} must be a number above 0 and one of {', '.join(units)}, such as {example}, got {text!r}")
    return float(match[1]) * units[match[2]]
