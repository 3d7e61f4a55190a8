# SPDX-License-Identifier: Apache-2.0
"""Recording: messages as columns of a Rerun stream."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Event, Reference, Severity, State, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.signals import plane
from rti_mpc.wire.info import Info, Label
from rti_mpc_service.rig.run_data import located
from rti_mpc_service.view.blueprint import DRIVEN_COLORS, RUNG_COLORS, STRIPS, TIMELINE, Frame, below, blueprint, legend, lifted, looks
from rti_mpc_service.view.path_window import KNOT_PARTS, MIN_KNOTS, path_window
from rti_mpc_service.view.plan import FREE, acting_bounds, cost_terms, is_plan
from rti_mpc_service.view.playback import Actuation, Playback, PlayedRow
from rti_mpc_service.view.tracking_error import tracked, tracking_error

Message = Info | Reference | State | Command | Actuation | Telemetry | Event
Columns = Iterable[rr.ComponentColumn]
Times = NDArray[np.int64]

LABELS_OF_VECTOR = {"x": "states", "u": "inputs", "y": "outputs", "y_ref": "outputs"}  # field of a message: field of `Info` with its labels
MAX_HELD_ENTRIES = 10_000  # kept until an info tells the names of their signals
TELEMETRY_SCALARS = (
    *("prepare_us", "feedback_us", "latency_us"),
    *("iterations", "res_prim", "res_dual", "cost", "violation"),
    *("state_age_s", "slack_s", "delay_s", "skipped", "fallbacks", *RUNG_COLORS, "parameter_version"),
    *("second_difference", "second_iterations", "second_us"),
)
RERUN_LEVELS = {Severity.INFO: "INFO", Severity.WARNING: "WARN", Severity.ERROR: "ERROR"}
EVENT_GRID_NS = 1_000_000  # times of events are rounded down to 1 ms, which keeps the time column narrow
MAX_DRAWN_ROWS = 5000  # per reference


@dataclass(slots=True, eq=False)
class Entry:
    """
    A message with its time on the robot's timeline.

    Attributes:
        time_ns: Time from `rti_mpc_service.view.timeline.Timeline`.
        message: The received message.
        root: Entity below which its robot is drawn; empty for the only one.
    """

    time_ns: int
    message: Message
    root: str = ""


class RerunRecording:
    """
    Writer of one Rerun stream: a file, or a connected viewer.

    Names and limits come from an `Info`. Messages that arrive before the first one are
    held, and written when it comes, or with numbers for names if the recording ends without.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        root: str = "",
        lay_out: Callable[[Info, Frame | None], object] | None = None,
        driven: str = DRIVEN_COLORS[0],
    ) -> None:
        """
        Write to a stream.

        Args:
            stream: Stream of Rerun.
            root: Entity below which everything is written; empty for the only robot.
            lay_out: Takes what a layout depends on, whenever it changes; None: the layout of the only robot is sent.
            driven: Name of the color of where the robot has driven.
        """
        self.stream = stream
        self._driven = driven
        self._root = root
        self._lay_out = lay_out or (lambda info, frame: stream.send_blueprint(blueprint(info, frame)))
        self.info: Info | None = None
        self._reference: Reference | None = None
        self._references_now: list[Reference] = []  # those of the present entries, after the one before
        self._told_modes: list[tuple[int, Mode]] = []  # times and modes of the samples of the present entries, after the one before
        self._frame: Frame | None = None
        self._held: deque[Entry] = deque(maxlen=MAX_HELD_ENTRIES)
        self._last: State | None = None
        self._last_output: Array | None = None  # position of the outputs, shape ``(1, 2)``
        self._planned: Telemetry | None = None  # the last sample
        self._playback = Playback()
        self._going: set[str] = set()  # lines that may be broken, and are not
        self._lanes: dict[str, tuple[str, int]] = {}  # value and time of the last change of each lane
        self._writers: dict[type, Callable[[Times, list[Any]], None]] = {
            Reference: self._references,
            State: self._states,
            Command: self._commands,
            Actuation: self._actuations,
            Telemetry: self._telemetry,
            Event: self._events,
        }

    def send(self, entries: Iterable[Entry]) -> None:
        """Write entries, as one column per entity for any number of entries."""
        groups: defaultdict[type, list[Any]] = defaultdict(list)
        for entry in entries:
            groups[type(entry.message)].append(entry)
        for entry in groups.pop(Info, ()):
            self._info(entry.message)
        if self.info is not None:  # else they are held
            self._told_modes = [*self._told_modes[-1:], *((entry.time_ns, entry.message.mode) for entry in groups[Telemetry])]
            self._references_now = self._references_now[-1:]
        for cls, write in self._writers.items():
            if self.info is None and cls is not Event:
                self._held.extend(groups[cls])
                continue
            fitting = [entry for entry in groups[cls] if self._fits(entry.message)]
            if fitting:
                write(np.array([entry.time_ns for entry in fitting], np.int64), [entry.message for entry in fitting])

    def finish(self) -> None:
        """Write the entries that were held for an info, and the rows of the last plan."""
        if self.info is None and self._held:
            widths = {name: width for entry in self._held for name, width in _widths(entry.message).items()}
            self._name(Info.unnamed(widths.get("x", 0), widths.get("u", 0), widths.get("y", widths.get("y_ref", 0))))
        self._told(self._playback.end())

    def _info(self, info: Info) -> None:
        """Write a description, and take names from it; a controller's description overrides a robot's."""
        self._log(f"info/{info.role}", rr.TextDocument(info.document, media_type="text/plain"))
        if info.states and info != self.info and (self.info is None or info.role == "controller"):
            self._name(info)

    def _name(self, info: Info) -> None:
        """Take names from a description, and write the entries that were held for them."""
        if self.info is not None and _vectors(info) != _vectors(self.info):
            self._reference, self._last, self._last_output, self._planned, self._playback = None, None, None, None, Playback()
            self._references_now = []
        self.info = info
        for path, archetype in looks(info, self._root, self._driven).items():
            self._log(path, archetype)
        self._lay_out(info, self._frame)
        held, self._held = list(self._held), deque(maxlen=MAX_HELD_ENTRIES)
        self.send(held)

    def _fits(self, message: Message) -> bool:
        """Whether the vectors of a message have the lengths of the info; it may come from another model."""
        return self.info is None or all(width == len(getattr(self.info, LABELS_OF_VECTOR[name])) for name, width in _widths(message).items())

    def _log(self, path: str, archetype: rr.AsComponents) -> None:
        self.stream.log(below(self._root, path), archetype, static=True)

    def _columns(self, path: str, times: Times, *columns: Columns) -> None:
        index = rr.TimeColumn(TIMELINE, duration=times.astype("timedelta64[ns]"))
        self.stream.send_columns(below(self._root, path), [index], [column for group in columns for column in group])

    def _strips(self, path: str, times: Times, lines: Iterable[Array]) -> None:
        """Write one polyline per row, each of shape ``(M, 2)``, at the height of its entity."""
        strips = [lifted(line, STRIPS[path].z) for line in lines]
        self._columns(path, times, rr.LineStrips3D.columns(strips=strips))

    def _scalars(self, path: str, times: Times, values: Array, *, broken: bool = False) -> None:
        """Write values, shape ``(n,)``; infinities and NaN are left out, or are where the line is broken."""
        said = np.isfinite(values)
        ends = ~said & np.concatenate([[path in self._going], said[:-1]]) & broken
        if (shown := said | ends).any():
            self._columns(path, times[shown], rr.Scalars.columns(scalars=values[said]).partition(said[shown].astype(int)))
        if broken:
            (self._going.add if said[-1] else self._going.discard)(path)

    def _references(self, times: Times, references: list[Reference]) -> None:
        assert self.info is not None
        self._reference = references[-1]
        self._references_now += references
        pair = plane(self.info.outputs)
        if pair is not None and self.info.planar:
            self._look_at(Frame.around(references[-1].y[:, pair]))
            self._strips("world/reference", times, [r.y[:: 1 + len(r.y) // MAX_DRAWN_ROWS, pair] for r in references])
        elif (path := self.info.path) is not None and self.info.planar:
            self._paths(times, references, *path)

    def _paths(self, times: Times, references: list[Reference], first: int, knots: int) -> None:
        """Write the part of a followed path around the robot, and its edges; what was written before stays visible for a while."""
        carried = [k for k, r in enumerate(references) if r.p.shape[1] >= first + 2 + KNOT_PARTS * knots]
        if not carried or knots < MIN_KNOTS:
            return
        windows = [path_window(references[k].p[0], first, knots) for k in carried]
        for path, lines in zip(("world/path", "world/path/right", "world/path/left"), zip(*windows, strict=True), strict=True):
            self._strips(path, times[carried], lines)
        self._look_at(Frame.with_room(self._frame, np.concatenate([edge for _, *edges in windows for edge in edges])))

    def _look_at(self, frame: Frame) -> None:
        """Show another part of the plane, if it is another."""
        assert self.info is not None
        if frame != self._frame:
            self._frame = frame
            if not self._root:  # several would lie on top of each other
                self._log("world/legend", legend(frame))
            self._lay_out(self.info, frame)

    def _states(self, times: Times, states: list[State]) -> None:
        assert self.info is not None
        x = np.array([state.x for state in states])
        for i, label in enumerate(self.info.states):
            self._scalars(f"state/{label.name}", times, x[:, i])
        if self.info.position is not None:
            self._motion(times, states, x)
        if self._reference is not None:
            stamps = np.array([state.stamp_ns for state in states], np.int64)
            self._errors(times, stamps, {i: x[:, k] for i, k in self.info.tracked})
        self._last = states[-1]

    def _errors(self, times: Times, stamps: NDArray[np.int64], y: dict[int, Array]) -> None:
        """Write how far outputs, by their indices, are from the reference, as long as it is tracked."""
        assert self.info is not None
        follows = tracked(times, self._told_modes, self.info.dt_s)
        for name, values in tracking_error(self.info, self._references_now, stamps, y).items():
            self._scalars(f"error/{name}", times, np.where(follows, values, np.nan), broken=True)

    def _motion(self, times: Times, states: list[State], x: Array) -> None:
        """Write pose and trail: one segment per state, none between two lives of the robot."""
        assert self.info is not None
        assert self.info.position is not None
        xy = x[:, self.info.position]
        psi = np.zeros(len(x)) if self.info.heading is None else x[:, self.info.heading]
        rotation = np.column_stack([0 * psi, 0 * psi, np.sin(psi / 2), np.cos(psi / 2)])
        self._columns("world/robot", times, rr.Transform3D.columns(translation=lifted(xy, 0.0), quaternion=rotation))
        before = [self._last if self._last is not None else states[0], *states[:-1]]
        joined = np.array([a.epoch == b.epoch for a, b in zip(before, states, strict=True)])
        start = np.where(joined[:, None], [state.x[list(self.info.position)] for state in before], xy)
        self._strips("world/trail", times, np.stack([start, xy], axis=1))

    def _commands(self, times: Times, commands: list[Command]) -> None:
        assert self.info is not None
        u = np.array([command.u[0] for command in commands])
        self._inputs("command", times, u)
        for i, label in enumerate(self.info.inputs):
            for side, bounds in (("min", self.info.lbu), ("max", self.info.ubu)):
                self._scalars(f"command/{label.name}/{side}", times, np.full(len(u), bounds[i]))

    def _actuations(self, times: Times, actuations: list[Actuation]) -> None:
        self._told(self._playback.add(times.tolist(), actuations))

    def _told(self, rows: list[PlayedRow]) -> None:
        """Write the inputs that a guard sent to the robot."""
        if rows:
            times = np.array([row.time_ns for row in rows], np.int64)
            self._inputs("actuation", times, np.array([row.u for row in rows]))
            self._lane("guard", times, [row.mode.name for row in rows])

    def _inputs(self, stream: str, times: Times, u: Array) -> None:
        """Write inputs, shape ``(n, nu)``."""
        assert self.info is not None
        for i, label in enumerate(self.info.inputs):
            self._scalars(f"{stream}/{label.name}", times, u[:, i])

    def _telemetry(self, times: Times, samples: list[Telemetry]) -> None:
        assert self.info is not None
        for name in TELEMETRY_SCALARS:
            self._scalars(f"telemetry/{name}", times, np.array([getattr(sample, name) for sample in samples], float))
        for i, label in enumerate(self.info.disturbances):
            self._scalars(f"disturbance/{label.name}", times, np.array([sample.d[i] if i < len(sample.d) else np.nan for sample in samples]))
        self._scalars("slack", times, np.array([1e3 * sample.slack_s for sample in samples]))
        self._scalars("slack/period", times, np.full(len(times), 1e3 * self.info.dt_s))
        self._plans(times, samples)
        versions = [f"version {sample.parameter_version}" for sample in samples]
        if "lane/parameters" in self._lanes or any(sample.parameter_version for sample in samples):  # what never changes needs no lane
            self._lane("parameters", times, versions)
        self._lane("mode", times, [sample.mode.name for sample in samples])
        self._lane("status", times, [sample.status.name for sample in samples])
        self._lane("leader", times, [f"epoch {sample.epoch}" for sample in samples])
        stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
        if self.info.planar:
            self._obstacles(times, stamps)
        if self.info.position is not None:
            self._strips("world/horizon", times, [sample.x[:, self.info.position] for sample in samples])
        computed = np.array([sample.y.size > 0 for sample in samples])
        if self.info.computed and computed.any():
            self._outputs(times[computed], stamps[computed], np.array([sample.y for sample in samples if sample.y.size]))

    def _plans(self, times: Times, samples: list[Telemetry]) -> None:
        """Write what the cost of each plan is made of, and which bounds act in it."""
        assert self.info is not None
        terms: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
        sides: defaultdict[str, list[tuple[int, str]]] = defaultdict(list)
        for time_ns, sample in zip(times.tolist(), samples, strict=True):
            before, self._planned = self._planned, sample
            if is_plan(sample):
                u_before = before.u[0] if before is not None and before.epoch == sample.epoch and len(before.u) else None
                with np.errstate(all="ignore"):
                    for name, value in cost_terms(self.info, sample, u_before).items():
                        terms[name].append((time_ns, value))
                    for name, side in acting_bounds(self.info, sample, u_before, self._distances(sample)).items():
                        sides[name].append((time_ns, side))
        for name, points in terms.items():
            self._scalars(f"cost/{name}", np.array([t for t, _ in points], np.int64), np.array([value for _, value in points]))
        inputs = [label.name for label in self.info.inputs]
        for name, said in sides.items():
            if name in inputs or f"bound/{name}" in self._lanes or any(side != FREE for _, side in said):  # else what never acts needs no lane
                self._lane(name, np.array([t for t, _ in said], np.int64), [side for _, side in said], "bound")

    def _distances(self, sample: Telemetry) -> tuple[Array, ...]:
        """Return how far a plan is from the edge of each obstacle at nodes 1 to N, each of shape ``(N,)``, in m."""
        assert self.info is not None
        if self.info.position is None or not np.isfinite(self.info.dt_s):
            return ()
        xy = sample.x[1:, self.info.position]
        stamps = sample.stamp_ns + (1e9 * self.info.dt_s * np.arange(1, len(sample.x))).astype(np.int64)
        discs = (located(obstacle, self._reference, stamps) for obstacle in self.info.obstacles)
        return tuple(np.hypot(xy[:, 0] - x, xy[:, 1] - y) - r for x, y, r in discs)

    def _outputs(self, times: Times, stamps: NDArray[np.int64], y: Array) -> None:
        """Write the outputs that are no state, and where those that are a position have been; shape ``(n, ny)``."""
        assert self.info is not None
        for i in self.info.computed:
            self._scalars(f"output/{self.info.outputs[i].name}", times, y[:, i])
        if self._reference is not None:
            self._errors(times, stamps, {i: y[:, i] for i in self.info.computed})
        if (pair := self.info.computed_position) is not None:
            xy = y[:, pair]
            before = xy[:1] if self._last_output is None else self._last_output
            self._strips("world/output", times, np.stack([np.concatenate([before, xy[:-1]]), xy], axis=1))
            self._last_output = xy[-1:]

    def _obstacles(self, times: Times, stamps: NDArray[np.int64]) -> None:
        """Write the positions of obstacles: those of the reference, or the configured ones if it has none."""
        assert self.info is not None
        for i, obstacle in enumerate(self.info.obstacles):
            x, y, r = located(obstacle, self._reference, stamps)
            scale = np.column_stack([r, r, np.ones_like(r)])
            self._columns(f"world/obstacle_{i}", times, rr.Transform3D.columns(translation=np.column_stack([x, y, 0 * x]), scale=scale))

    def _lane(self, name: str, times: Times, values: Sequence[str], kind: str = "lane") -> None:
        """Write the changes of a lane in the order received; times increase, even if a braking sample has a later stamp than the next one."""
        lane = f"{kind}/{name}"
        value, since_ns = self._lanes.get(lane, ("", -1))
        changes = []
        for time_ns, new in zip(times.tolist(), values, strict=True):
            if new != value:
                value, since_ns = new, max(time_ns, since_ns + 1)
                changes.append((since_ns, value))
        self._lanes[lane] = value, since_ns
        if changes:
            begins, states = zip(*changes, strict=True)
            self._columns(lane, np.array(begins, np.int64), rr.StateChange.columns(state=states))

    def _events(self, times: Times, events: list[Event]) -> None:
        for source in sorted({event.source for event in events}):
            mine = [k for k, event in enumerate(events) if event.source == source]
            text = [f"{source}: {events[k].text} ({events[k].code})" for k in mine]
            columns = rr.TextLog.columns(text=text, level=[RERUN_LEVELS[events[k].severity] for k in mine])
            self._columns(f"event/{rr.escape_entity_path_part(source)}", times[mine] // EVENT_GRID_NS * EVENT_GRID_NS, columns)


def _widths(message: Message) -> dict[str, int]:
    """Return the lengths of the vectors of a message, or of the rows of its matrices, by name; unreported inputs of a state are left out."""
    arrays = {name: getattr(message, name) for name in LABELS_OF_VECTOR if hasattr(message, name)}
    return {name: array.shape[-1] for name, array in arrays.items() if array.ndim > 1 or array.size}


def _vectors(info: Info) -> tuple[tuple[Label, ...], ...]:
    return info.states, info.inputs, info.outputs
