# SPDX-License-Identifier: Apache-2.0
"""Messages as columns of a Rerun recording."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.message import Command, Event, Reference, Severity, State, Telemetry
from rti_mpc.status import Mode, QpStatus
from service.blueprint import COLORS, TIMELINE, Frame, blueprint
from service.info import Info, Label
from service.outline import outline

Message = Info | Reference | State | Command | Telemetry | Event
Columns = Iterable[rr.ComponentColumn]
Times = NDArray[np.int64]

VECTORS = {"x": "states", "u": "inputs", "y": "outputs", "y_ref": "outputs"}  # of messages, and whose labels they take
HELD = 10_000  # entries kept until an info tells their names
SCALARS = (
    *("prepare_us", "feedback_us", "latency_us"),
    *("iterations", "res_prim", "res_dual", "cost", "violation"),
    *("state_age_s", "slack_s", "skipped", "fallbacks", "parameter_version"),
)
LANES = {"mode": Mode, "status": QpStatus}
LANE_COLORS = {
    "mode": ("idle", "idle", "good", "good", "warning", "warning", "bad"),
    "status": ("good", "warning", "warning", "warning", "bad", "bad", "idle"),
}
LEVELS = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}
ROWS = 5000  # of a reference, drawn


class Strip(NamedTuple):
    """How a polyline in the plane looks; heights, in m, say what lies on top of what."""

    color: str
    width: float
    z: float


STRIPS = {
    "world/reference": Strip("reference", 5.0, 0.0),
    "world/trail": Strip("measured", 2.0, 0.004),
    "world/horizon": Strip("command", 4.0, 0.02),
}
ROBOT_Z = 0.008  # [m], between trail and horizon


@dataclass(slots=True, eq=False)
class Entry:
    """
    A message and where it lies on the robot's timeline.

    Attributes:
        time_ns: From `service.timeline.Timeline`.
        message: What was received.
    """

    time_ns: int
    message: Message


class Recording:
    """
    One Rerun stream being written: a file, or a viewer that is connected.

    Names and limits come from an `Info`. What arrives before any is held, and
    written once there is one, or under numbers when the recording ends without.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
        self.info: Info | None = None
        self._reference: Reference | None = None
        self._frame: Frame | None = None
        self._held: deque[Entry] = deque(maxlen=HELD)
        self._last: State | None = None
        self._lanes: dict[str, int] = {}
        self._writers: dict[type, Callable[[Times, list[Any]], None]] = {
            Reference: self._references,
            State: self._states,
            Command: self._commands,
            Telemetry: self._telemetry,
            Event: self._events,
        }

    def send(self, entries: Iterable[Entry]) -> None:
        """Write entries; one column an entity, whatever their number."""
        groups: defaultdict[type, list[Any]] = defaultdict(list)
        for entry in entries:
            groups[type(entry.message)].append(entry)
        for entry in groups.pop(Info, ()):
            self._info(entry.message)
        for cls, write in self._writers.items():
            if self.info is None and cls is not Event:
                self._held.extend(groups[cls])
                continue
            fitting = [entry for entry in groups[cls] if self._fits(entry.message)]
            if fitting:
                write(np.array([entry.time_ns for entry in fitting], np.int64), [entry.message for entry in fitting])

    def finish(self) -> None:
        """Write what was held for want of an info."""
        if self.info is None and self._held:
            widths = {name: getattr(e.message, name).shape[-1] for e in self._held for name in VECTORS if hasattr(e.message, name)}
            self._name(Info.unnamed(widths.get("x", 0), widths.get("u", 0), widths.get("y", widths.get("y_ref", 0))))

    def _info(self, info: Info) -> None:
        """Keep a description; take names from it, a controller's before a robot's."""
        self.stream.log(f"info/{info.role}", rr.TextDocument(info.document, media_type="text/plain"), static=True)
        if info.states and info != self.info and (self.info is None or info.role == "controller"):
            self._name(info)

    def _name(self, info: Info) -> None:
        """Take names from a description, and write what was held for want of them."""
        if self.info is not None and (info.states, info.outputs) != (self.info.states, self.info.outputs):
            self._reference, self._last = None, None
        self.info = info
        self._describe(info)
        held, self._held = list(self._held), deque(maxlen=HELD)
        self.send(held)

    def _fits(self, message: Message) -> bool:
        """Whether the vectors of a message are as long as the info says: it may be about another model."""
        return self.info is None or all(
            getattr(message, name).shape[-1] == len(getattr(self.info, labels)) for name, labels in VECTORS.items() if hasattr(message, name)
        )

    def _describe(self, info: Info) -> None:
        """Write what does not change: names, colours, the robot's shape, the blueprint."""
        static: dict[str, rr.AsComponents] = {f"state/{label.name}": _line(str(label), "measured", 1.5) for label in info.states}
        for label in info.inputs:
            static[f"command/{label.name}"] = _line("command", "command", 1.5, rr.components.InterpolationMode.StepAfter)
            static |= {f"command/{label.name}/{side}": _line(side, "limit", 1.0) for side in ("min", "max")}
        for label, color in ((Label("position", "mm"), "error"), *((info.outputs[i], "measured") for i, _ in info.tracked)):
            static[f"error/{label.name}"] = _line(str(label), color, 1.5)
        for name, color in (("prepare_us", "prepare"), ("feedback_us", "feedback"), ("latency_us", "latency")):
            static[f"telemetry/{name}"] = _line(name[:-3], color, 1.5)
        static["slack"] = _line("left", "feedback", 1.5)
        static["slack/period"] = _line("period", "limit", 1.0)
        for lane, values in LANES.items():
            names = [value.name for value in values]
            static[f"lane/{lane}"] = rr.StateConfiguration(values=names, labels=names, colors=[COLORS[c] for c in LANE_COLORS[lane]])
        for path, archetype in static.items():
            self.stream.log(path, archetype, static=True)
        if info.position is not None:
            self._describe_world(info)
        self.stream.send_blueprint(blueprint(info, self._frame))

    def _describe_world(self, info: Info) -> None:
        self.stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for path, strip in STRIPS.items():
            look = rr.LineStrips3D.from_fields(colors=COLORS[strip.color], radii=rr.Radius.ui_points(strip.width / 2))
            self.stream.log(path, look, static=True)
        if info.heading is not None:
            for k, polygon in enumerate(outline(info.model)):
                part = f"world/robot/part_{k}"
                self.stream.log(part, _filled(polygon, ROBOT_Z - 0.001 * (k > 0), COLORS["wheel" if k else "body"]), static=True)
                edge = _lifted(np.vstack([polygon, polygon[:1]]), ROBOT_Z + 0.002)
                self.stream.log(f"{part}/edge", rr.LineStrips3D([edge], colors=COLORS["edge"], radii=rr.Radius.ui_points(0.75)), static=True)
        self.stream.log("world/robot/point", rr.Points3D([[0.0, 0.0, 0.02]], colors=COLORS["measured"], radii=rr.Radius.ui_points(3.0)), static=True)

    def _columns(self, path: str, times: Times, *columns: Columns) -> None:
        index = rr.TimeColumn(TIMELINE, duration=times.astype("timedelta64[ns]"))
        self.stream.send_columns(path, [index], [column for group in columns for column in group])

    def _strips(self, path: str, times: Times, lines: Iterable[Array]) -> None:
        """Write one polyline a row, each of shape ``(M, 2)``, at the height of what it is."""
        strips = [_lifted(line, STRIPS[path].z) for line in lines]
        self._columns(path, times, rr.LineStrips3D.columns(strips=strips))

    def _scalars(self, path: str, times: Times, values: Array) -> None:
        """Write values, shape ``(n,)``; infinities and NaN are left out."""
        said = np.isfinite(values)
        if said.any():
            self._columns(path, times[said], rr.Scalars.columns(scalars=values[said]))

    def _references(self, times: Times, references: list[Reference]) -> None:
        assert self.info is not None
        self._reference = references[-1]
        pair = _positions(self.info.outputs)
        if pair is not None and self.info.position is not None:
            frame = Frame.around(references[-1].y[:, pair])
            if frame != self._frame:
                self._frame = frame
                self.stream.send_blueprint(blueprint(self.info, frame))
            self._strips("world/reference", times, [r.y[:: 1 + len(r.y) // ROWS, pair] for r in references])

    def _states(self, times: Times, states: list[State]) -> None:
        assert self.info is not None
        x = np.array([state.x for state in states])
        for i, label in enumerate(self.info.states):
            self._scalars(f"state/{label.name}", times, x[:, i])
        if self.info.position is not None:
            self._motion(times, states, x)
        if self._reference is not None:
            self._errors(times, np.array([state.stamp_ns for state in states], np.int64), x)
        self._last = states[-1]

    def _motion(self, times: Times, states: list[State], x: Array) -> None:
        """Write pose and trail: a segment a state, none across two lives of the robot."""
        assert self.info is not None
        assert self.info.position is not None
        xy = x[:, self.info.position]
        psi = np.zeros(len(x)) if self.info.heading is None else x[:, self.info.heading]
        rotation = np.column_stack([0 * psi, 0 * psi, np.sin(psi / 2), np.cos(psi / 2)])
        self._columns("world/robot", times, rr.Transform3D.columns(translation=_lifted(xy, 0.0), quaternion=rotation))
        before = [self._last if self._last is not None else states[0], *states[:-1]]
        joined = np.array([a.epoch == b.epoch for a, b in zip(before, states, strict=True)])
        start = np.where(joined[:, None], [state.x[list(self.info.position)] for state in before], xy)
        self._strips("world/trail", times, np.stack([start, xy], axis=1))

    def _errors(self, times: Times, stamps: Times, x: Array) -> None:
        """Write state minus reference, where the reference has begun; after its last row, against that."""
        assert self.info is not None
        assert self._reference is not None
        row = (stamps - self._reference.stamp_ns) / self._reference.period_ns
        begun = row >= 0.0
        error = {}
        for i, k in self.info.tracked:
            label = self.info.outputs[i]
            y = np.unwrap(self._reference.y[:, i]) if label.angle else self._reference.y[:, i]
            error[label.name] = x[:, k] - np.interp(row, np.arange(len(y)), y)
            if label.angle:
                error[label.name] = np.remainder(error[label.name] + np.pi, 2 * np.pi) - np.pi
        if {"x", "y"} <= error.keys():
            error["position"] = 1e3 * np.hypot(error["x"], error["y"])
        for name, values in error.items():
            self._scalars(f"error/{name}", times[begun], values[begun])

    def _commands(self, times: Times, commands: list[Command]) -> None:
        assert self.info is not None
        u = np.array([command.u[0] for command in commands])
        for i, label in enumerate(self.info.inputs):
            self._scalars(f"command/{label.name}", times, u[:, i])
            for side, bounds in (("min", self.info.lbu), ("max", self.info.ubu)):
                self._scalars(f"command/{label.name}/{side}", times, np.full(len(u), bounds[i]))

    def _telemetry(self, times: Times, samples: list[Telemetry]) -> None:
        assert self.info is not None
        for name in SCALARS:
            self._scalars(f"telemetry/{name}", times, np.array([getattr(sample, name) for sample in samples], float))
        self._scalars("slack", times, np.array([1e3 * sample.slack_s for sample in samples]))
        self._scalars("slack/period", times, np.full(len(times), 1e3 * self.info.dt_s))
        for lane in LANES:
            self._lane(lane, times, [int(getattr(sample, lane)) for sample in samples])
        if self.info.position is not None:
            self._strips("world/horizon", times, [sample.x[:, self.info.position] for sample in samples])

    def _lane(self, lane: str, times: Times, values: Sequence[int]) -> None:
        before = [self._lanes.get(lane), *values[:-1]]
        changed = [k for k, value in enumerate(values) if value != before[k]]
        self._lanes[lane] = values[-1]
        if changed:
            self._columns(f"lane/{lane}", times[changed], rr.StateChange.columns(state=[LANES[lane](values[k]).name for k in changed]))

    def _events(self, times: Times, events: list[Event]) -> None:
        for source in sorted({event.source for event in events}):
            mine = [k for k, event in enumerate(events) if event.source == source]
            text = [f"{source}: {events[k].text} ({events[k].code})" for k in mine]
            columns = rr.TextLog.columns(text=text, level=[LEVELS[events[k].severity] for k in mine])
            self._columns(f"event/{rr.escape_entity_path_part(source)}", times[mine], columns)


def _line(name: str, color: str, width: float, interpolation: rr.components.InterpolationMode | None = None) -> rr.SeriesLines:
    return rr.SeriesLines(names=name, colors=COLORS[color], widths=width, interpolation_mode=interpolation)


def _positions(outputs: Sequence[Label]) -> tuple[int, int] | None:
    names = [label.name for label in outputs]
    return (names.index("x"), names.index("y")) if {"x", "y"} <= set(names) else None


def _lifted(xy: Array, z: float) -> Array:
    """Return points in the plane, shape ``(..., 2)``, at a height, shape ``(..., 3)``."""
    return np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1)


def _filled(polygon: Array, z: float, color: tuple[int, int, int]) -> rr.Mesh3D:
    """Return a convex polygon, or one that its first corner sees whole, as a fan of triangles."""
    fan = [(0, k, k + 1) for k in range(1, len(polygon) - 1)]
    return rr.Mesh3D(vertex_positions=_lifted(polygon, z), triangle_indices=fan, vertex_colors=[color] * len(polygon))
