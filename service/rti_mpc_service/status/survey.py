# SPDX-License-Identifier: Apache-2.0
"""Survey of one robot: what its processes have said last, and how long ago."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.latch import read_latch
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Event, Reference, State, Telemetry
from rti_mpc.errors import MessageError
from rti_mpc.signals import plane
from rti_mpc.wire import document
from rti_mpc.wire.bus import RING_MESSAGES, Bus
from rti_mpc.wire.info import Info
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.streams import admitted, role_of

RECENT_SAMPLES = 200  # that times and differences are taken over
STALE_S = 2.0
PHASES = ("prepare_us", "feedback_us", "latency_us")
LEADER = "controller"


class Survey:
    """
    Subscriptions to one robot, and what came last.

    Attributes:
        present: Roles that show presence.
    """

    def __init__(self, bus: Bus) -> None:
        keys = bus.keys
        self.present: set[str] = set()
        self._bus = bus
        self._infos: dict[str, tuple[Info, Mapping[str, Any]]] = {}  # by key
        self._samples: deque[Telemetry] = deque(maxlen=RECENT_SAMPLES)
        self._error: dict[str, tuple[float, str]] = {}  # by output, with its unit
        self._state: State | None = None
        self._reference: Reference | None = None
        self._events: dict[str, Event] = {}  # the last one by source
        self._heard_ns: dict[str, int] = {}  # local time at which each kind of message came last
        self._doors: dict[str, Intake[Any]] = {}
        self._info_ring = bus.subscriber(keys.infos, capacity=RING_MESSAGES)
        streams = (keys.state, keys.telemetry, keys.reference, keys.anchored, keys.events)
        self._rings = [(key.stream, bus.subscriber(key, capacity=RING_MESSAGES)) for key in streams]

    def listen(self, now_ns: int) -> None:
        """Take what has arrived."""
        for received in self._info_ring.drain():
            try:
                if admitted(received.key, self._infos):
                    self._infos[received.key] = Info.from_received(received), document.read(received.payload, received.size)
            except MessageError:
                continue
        for stream, ring in self._rings:
            for received in ring.drain():
                key = received.key
                if stream.message is None or not (key in self._doors or not stream.by_role or admitted(key, self._doors)):
                    continue
                door = self._doors.setdefault(key, self._bus.intake(stream.message, STALE_S))
                if (message := door.accept(received, now_ns)) is not None:
                    self._take(message, now_ns)

    def _take(self, message: Any, now_ns: int) -> None:
        self._heard_ns[type(message).__name__] = now_ns
        if isinstance(message, State):
            self._state = message
        elif isinstance(message, Telemetry):
            self._compare(message)
            self._samples.append(message)
        elif isinstance(message, Event):
            self._events[message.source] = message
        elif message.stamp_ns != STAMP_ON_ARRIVAL:  # such a reference follows with its real stamp
            self._reference = message

    def _compare(self, sample: Telemetry) -> None:
        """Compare the outputs at a sample with the first row of the reference that the sample before has used, which is for this time."""
        info, before = self._info(LEADER), self._samples[-1] if self._samples else None
        if info is None or before is None or (sample.epoch, sample.seq) != (before.epoch, before.seq + 1):
            return
        if (1, *sample.y.shape) != before.y_ref[:1].shape or len(sample.y) != len(info.outputs):  # messages of others may be of any width
            return
        error = info.rotations("outputs").difference(sample.y, before.y_ref[0])
        values = {label.name: (value, label.unit) for label, value in zip(info.outputs, error.tolist(), strict=True)}
        if (position := plane(info.outputs)) is not None:
            values = {"position": (1e3 * math.hypot(*error[list(position)]), "mm"), **values}
        self._error = values

    def _info(self, role: str) -> Info | None:
        return next((info for key, (info, _) in self._infos.items() if role_of(key) == role), None)

    def _said(self, role: str) -> Mapping[str, Any]:
        return next((said for key, (_, said) in self._infos.items() if role_of(key) == role), {})

    @property
    def complete(self) -> bool:
        """Whether the processes that are present have said what a report holds."""
        return (LEADER not in self.present or bool(self._samples)) and ("robot" not in self.present or self._state is not None)

    def report(self, now_ns: int) -> dict[str, Any]:
        """Return what is known now, as JSON: numbers in the unit that their names end with, null where nothing was heard."""
        last = self._samples[-1] if self._samples else None
        leads = LEADER in self.present
        times = {name: np.array([getattr(sample, name) for sample in self._samples]) for name in PHASES}
        differences = [sample.second_difference for sample in self._samples if not math.isnan(sample.second_difference)]
        epoch = self._said(LEADER).get("epoch")
        return {
            "present": sorted(self.present),
            "mode": last.mode.name if last is not None and leads else None,
            "qp": last.status.name if last is not None and leads else None,
            "error": {name: {"value": value, "unit": unit} for name, (value, unit) in self._error.items()} if leads else {},
            "state_age_s": self._age_s("State", now_ns),
            "sample_age_s": self._age_s("Telemetry", now_ns),
            "reference_age_s": self._age_s("Reference", now_ns),
            "reference_left_s": self._reference_left_s(),
            "times_us": {name.removesuffix("_us"): {"p50": float(np.median(of)), "max": float(of.max())} for name, of in times.items() if of.size},
            "leader": {"epoch": epoch, "owner": epoch % (1 << NUMBER_BITS)} if leads and type(epoch) is int else None,
            "standby": sum(role.startswith("standby.") for role in self.present),
            "fallbacks": None if last is None else last.fallbacks,
            "skipped": None if last is None else last.skipped,
            "agreement": {"max_difference": max(differences) if differences else None, "judged": len(differences), "samples": len(self._samples)},
            "versions": {role_of(key): said["version"] for key, (_, said) in self._infos.items() if isinstance(said.get("version"), str)},
            "stopped": self._stopped(),
            "event": self._last_event(now_ns),
        }

    def _stopped(self) -> bool | None:
        """Whether the leader says that an operator's stop is latched, or the guard if there is none; None: not said, or not to be understood."""
        with suppress(MessageError):
            return read_latch((self._said(LEADER) or self._said("guard")).get("latch")).stopped
        return None

    def _age_s(self, kind: str, now_ns: int) -> float | None:
        return 1e-9 * (now_ns - self._heard_ns[kind]) if kind in self._heard_ns else None

    def _reference_left_s(self) -> float | None:
        """Time from the last state to the last row of the reference, s of the robot."""
        if self._reference is None or self._state is None:
            return None
        reference = self._reference
        return 1e-9 * (reference.stamp_ns + (len(reference.y) - 1) * reference.period_ns - self._state.stamp_ns)

    def _last_event(self, now_ns: int) -> dict[str, Any] | None:
        """Return the newest event by the robot's clock: who joins late hears the last one of each source at once. An earlier life's has no age."""
        age_s = self._age_s("State", now_ns)
        robot_ns = None if self._state is None or age_s is None else self._state.stamp_ns + round(1e9 * age_s)
        ages_s = {source: None if robot_ns is None else 1e-9 * (robot_ns - event.stamp_ns) for source, event in self._events.items()}
        if not ages_s:
            return None
        source = min(ages_s, key=lambda each: math.inf if (age := ages_s[each]) is None or age < -STALE_S else age)
        event, age = self._events[source], ages_s[source]
        said = {"source": event.source, "severity": event.severity.name, "code": event.code, "text": event.text}
        return {**said, "age_s": None if age is None or age < -STALE_S else max(age, 0.0)}
