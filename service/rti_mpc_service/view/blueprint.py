# SPDX-License-Identifier: Apache-2.0
"""Blueprint of the viewer: its panels, and the look of each entity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rti_mpc.array import Array
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.signals import in_plane, plane
from rti_mpc.wire.info import Info
from rti_mpc_service.outline import outline
from rti_mpc_service.view.plan import ACTING, FREE, LATER

TIMELINE = "robot_time"
TRAIL_S = 90.0
WINDOW_S = (-60.0, 15.0)  # shown time, relative to now; the legend covers the empty part after now
HALF_FIELD_TANGENT = 0.52  # tangent of half the viewer's vertical field of view
GRID_M, WIDE_GRID_M, WIDE_M = 0.5, 5.0, 10.0  # distance of the lines, and where more than WIDE_M are shown
ROOM = 1.25  # shown of a path that is told part by part, relative to what is known of it
MARGIN_M = 0.35  # space around the reference, enough for a robot

COLORS = {
    "reference": (150, 156, 168),
    "measured": (86, 160, 255),
    "command": (255, 176, 59),
    "actuation": (38, 128, 118),
    "limit": (226, 86, 86),
    "error": (240, 110, 170),
    "prepare": (124, 200, 124),
    "feedback": (255, 176, 59),
    "latency": (170, 140, 245),
    "body": (70, 78, 96),
    "obstacle": (74, 40, 44),
    "wheel": (112, 120, 138),
    "edge": (200, 206, 218),
    "idle": (110, 116, 128),
    "good": (72, 160, 96),
    "warning": (222, 160, 40),
    "bad": (214, 70, 70),
}
PHASES = ("prepare", "feedback", "latency")
RUNG_COLORS = {
    "softened": "measured",
    "shifted": "warning",
    "braked": "bad",
    "rested": "latency",
}  # the fallbacks
DRIVEN_COLORS = ("measured", "error", "prepare", "latency", "limit", "actuation")  # of where robots have driven that share one view, in turn
TERM_COLORS = ("measured", "command", "error", "prepare", "latency", "limit", "actuation", "edge")
MODE_COLORS = dict(zip(Mode, ("idle", "idle", "good", "good", "warning", "warning", "bad"), strict=True))
STATUS_COLORS = dict(zip(QpStatus, ("good", "warning", "warning", "warning", "bad", "bad", "idle"), strict=True))
LANE_COLORS: dict[str, dict[Any, str]] = {"guard": MODE_COLORS, "mode": MODE_COLORS, "status": STATUS_COLORS}  # a leader is any epoch


@dataclass(frozen=True)
class Frame:
    """
    The visible part of the plane.

    Attributes:
        center: Center, in m.
        half: Half of each side, in m.
    """

    center: tuple[float, float] = (0.0, 0.0)
    half: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def around(cls, xy: Array) -> Frame:
        """Return the frame of points, shape ``(M, 2)``, rounded to 0.1 m so that small changes do not move it."""
        low, high = xy.min(axis=0), xy.max(axis=0)
        (x, y), (w, h) = (0.5 * (low + high)).round(1).tolist(), (0.5 * (high - low)).round(1).tolist()
        return cls((x, y), (w, h))

    @classmethod
    def with_room(cls, frame: Frame | None, xy: Array) -> Frame:
        """Return a frame if points, shape ``(M, 2)``, are inside, else one around both, with room for what follows."""
        corners = xy if frame is None else np.array([np.subtract(frame.center, frame.half), np.add(frame.center, frame.half)])
        if frame is not None and np.all(np.abs(xy - frame.center) <= frame.half):
            return frame
        around = cls.around(np.vstack([corners, xy]))
        return cls(around.center, (ROOM * around.half[0], ROOM * around.half[1]))

    @property
    def grid_m(self) -> float:
        """Distance of the lines of the grid, in m."""
        return WIDE_GRID_M if max(self.half) > 0.5 * WIDE_M else GRID_M

    @property
    def eye_height(self) -> float:
        """Height of the eye above the plane, in m, for a view that is wider than high."""
        return (max(self.half[1], self.half[0] / 1.3) + MARGIN_M) / HALF_FIELD_TANGENT


def below(root: str, path: str) -> str:
    """Return an entity of the robot that is drawn below a root; empty for the only one."""
    return f"{rr.escape_entity_path_part(root)}/{path}" if root else path


def blueprint(info: Info, frame: Frame | None = None) -> rrb.Blueprint:
    """
    Return the layout of all views of a robot.

    Args:
        info: Description of the robot: signals, which state a command drives, whether there is a position.
        frame: Visible part of the plane.
    """
    tabs = _tabs(info, "")
    left = rrb.Tabs(_world(frame or Frame(), [""]), *tabs) if info.planar else rrb.Vertical(*tabs)
    return _laid_out(left, _series_of(info, ""), [""])


def common_blueprint(robots: Mapping[str, tuple[Info, Frame | None]]) -> rrb.Blueprint:
    """Return the layout of several robots, by their roots: one plane, and a tab for each robot."""
    planar = {root: frame for root, (info, frame) in robots.items() if info.planar}
    frames = [frame for frame in planar.values() if frame is not None]
    corners = [np.add(frame.center, np.multiply(sign, frame.half)) for frame in frames for sign in (-1, 1)]
    world = [_world(Frame.around(np.array(corners)) if corners else Frame(), [*planar])] if planar else []
    left = rrb.Tabs(*world, *(rrb.Tabs(*_tabs(info, root), name=root) for root, (info, _) in robots.items()))
    return _laid_out(left, rrb.Tabs(*(_series_of(info, root) for root, (info, _) in robots.items())), [*robots])


def _laid_out(left: rrb.Container, right: rrb.Container, roots: Sequence[str]) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(left, right, column_shares=[1, 1]),
            rrb.Horizontal(_lanes(roots), _bounds(roots), _events(roots), column_shares=[3, 3, 5]),
            row_shares=[8, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _series_of(info: Info, root: str) -> rrb.Vertical:
    """Return the views of commands, errors and times of a robot."""
    series: list[rrb.View | rrb.Container] = [*(_commands(info, i, root) for i in range(len(info.inputs))), _errors(info, root), _times(info, root)]
    return rrb.Vertical(*series, row_shares=[4] * len(info.inputs) + [3, 3], name=root or None)


def _tabs(info: Info, root: str) -> list[rrb.View | rrb.Container]:
    """Return what is beside the plane, for a robot."""
    estimated = [_series("Disturbances", ["disturbance/**"], root)] if info.disturbances else []
    computed = [_series("Outputs", [f"output/{info.outputs[i].name}" for i in info.computed], root)] if info.computed else []
    cost = [_series("Cost by term", ["cost/**"], root)] if info.weights is not None else []
    return [*computed, _series("States", ["state/**"], root), *cost, *estimated, _troubles(root)]


def _world(frame: Frame, roots: Sequence[str]) -> rrb.Spatial3DView:
    """Return the view of the plane from above, y up; Rerun's 2D view draws y down."""
    x, y = frame.center
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S)
    trail = rrb.VisibleTimeRanges([rrb.VisibleTimeRange(TIMELINE, start=start, end=rrb.TimeRangeBoundary.cursor_relative())])
    return rrb.Spatial3DView(
        origin="/world" if list(roots) == [""] else "/",
        contents=[f"+ /{below(root, 'world')}/**" for root in roots],
        name=f"From above, y up, grid {frame.grid_m:g} m",
        background=(16, 18, 22),
        line_grid=rrb.LineGrid3D(visible=True, spacing=frame.grid_m, stroke_width=0.5, color=(255, 255, 255, 28)),
        eye_controls=rrb.EyeControls3D(position=(x, y - 0.01, frame.eye_height), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)),
        overrides={below(root, path): [trail] for root in roots for path in REMAINING},
    )


def _time_axis() -> rrb.TimeAxis:
    boundaries = (rrb.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in WINDOW_S)
    return rrb.TimeAxis(view_range=rr.TimeRange(*boundaries))


def _series(
    name: str, contents: list[str], root: str, axis_y: rrb.ScalarAxis | None = None, overrides: Mapping[str, rr.SeriesLines] | None = None
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ /{below(root, path)}" for path in contents],
        name=name,
        axis_x=_time_axis(),
        axis_y=axis_y,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightBottom),
        overrides=None if overrides is None else {below(root, path): lines for path, lines in overrides.items()},
    )


def _commands(info: Info, i: int, root: str) -> rrb.TimeSeriesView:
    """Return the view of a command with its limits, the command that a guard let through, and the measured state that it drives."""
    name, k = info.inputs[i].name, info.measured(i)
    measured = {} if k is None else {f"state/{info.states[k].name}": _line("measured", "measured")}
    return _series(f"Command {info.inputs[i]}", [f"actuation/{name}", f"command/{name}/**", *measured], root, overrides=measured)


def _errors(info: Info, root: str) -> rrb.TimeSeriesView:
    """Return the view of the errors: of the distance in the plane, where outputs are nothing but a pose."""
    tracked, pair = [i for i, _ in info.tracked], plane(info.outputs)
    if pair is not None and in_plane(info.outputs) and (pair[0] in tracked) == (pair[1] in tracked):
        return _series("Tracking error [mm]", ["error/position"], root)
    return _series("Tracking error", [f"error/{label.name}" for label in info.outputs], root)


def _times(info: Info, root: str) -> rrb.Container:
    """Return the views of the phase times and of the rest of the period."""
    period_ms = 1e3 * info.dt_s
    axis = rrb.ScalarAxis(range=(-0.1 * period_ms, 1.2 * period_ms)) if period_ms > 0 else None
    return rrb.Horizontal(
        _series("Phase times [us]", [f"telemetry/{name}_us" for name in PHASES], root),
        _series(f"Left of the {period_ms:g} ms period [ms]" if axis else "Left of the period [ms]", ["slack/**"], root, axis),
    )


def _troubles(root: str) -> rrb.Container:
    """Return the views of the fallbacks, of the delay from a state to its command, and of the second opinions."""
    return rrb.Vertical(
        _series("Samples since start, softened or without a plan of their own", [f"telemetry/{rung}" for rung in RUNG_COLORS], root),
        _series("From a state to the act of its command [s]", ["telemetry/delay_s", "telemetry/state_age_s"], root),
        _series("OSQP's plan from the commanded one [half an input's range]", ["telemetry/second_difference"], root),
        name="Fallbacks, delay, second opinion",
    )


def _lanes(roots: Sequence[str]) -> rrb.StateTimelineView:
    alone = list(roots) == [""]
    contents = [f"+ /{below(root, 'lane')}/**" for root in roots]
    return rrb.StateTimelineView(origin="/lane" if alone else "/", contents=contents, name="Modes, QP status and who leads", time_view=_time_axis())


def _bounds(roots: Sequence[str]) -> rrb.StateTimelineView:
    alone = list(roots) == [""]
    contents = [f"+ /{below(root, 'bound')}/**" for root in roots]
    return rrb.StateTimelineView(origin="/bound" if alone else "/", contents=contents, name="Bounds that act in the plan", time_view=_time_axis())


def _events(roots: Sequence[str]) -> rrb.TextLogView:
    kinds, alone = rrb.encodings.TextLogColumnKind, list(roots) == [""]
    columns = [rrb.encodings.TextLogColumn(kind, visible=kind is not kinds.EntityPath or not alone) for kind in kinds]
    contents = [f"+ /{below(root, 'event')}/**" for root in roots]
    return rrb.TextLogView(origin="/event" if alone else "/", contents=contents, name="Events", columns=rrb.TextLogColumns(text_log_columns=columns))


class Strip(NamedTuple):
    """Style of a polyline in the plane; the height `z`, in m, decides what lies on top."""

    color: str
    width: float
    z: float


STRIPS = {
    "world/reference": Strip("reference", 5.0, 0.0),
    "world/path": Strip("reference", 3.0, 0.0),
    "world/path/right": Strip("limit", 2.0, 0.0),
    "world/path/left": Strip("limit", 2.0, 0.0),
    "world/trail": Strip("measured", 2.0, 0.004),
    "world/output": Strip("measured", 2.0, 0.004),
    "world/horizon": Strip("command", 4.0, 0.02),
}
REMAINING = ("world/trail", "world/output", "world/path", "world/path/right", "world/path/left")  # strips that stay for TRAIL_S
LEGEND_COLORS = {"reference": "reference", "driven": "measured", "planned": "command"}
OBSTACLE_Z_M = -0.004  # [m], below everything
MAX_COORDINATE_M = 1e38  # m, within single precision, in which Rerun draws
UNIT_CIRCLE: Array = np.column_stack([np.cos(angles := np.linspace(0, 2 * np.pi, 48, endpoint=False)), np.sin(angles)])
ROBOT_Z_M = 0.008  # [m], between trail and horizon


def looks(info: Info, name: str, driven: str) -> dict[str, rr.AsComponents]:
    """Return the constant components of a recording, by entity; of several robots each has its name, and a color of where it has driven."""
    return _series_looks(info) | _cost_looks(info) | _lane_looks(info) | (_world_looks(info, name, driven) if info.planar else {})


def legend(frame: Frame) -> rr.Points3D:
    """Return the legend of the lines in the plane, at the bottom of the frame."""
    (x, y), reach = frame.center, HALF_FIELD_TANGENT * frame.eye_height
    xy = np.array([(x + shift * reach, y - 0.88 * reach) for shift in (-0.6, 0.0, 0.6)])
    return rr.Points3D(
        lifted(xy, 0.0),
        labels=list(LEGEND_COLORS),
        show_labels=True,
        colors=[COLORS[color] for color in LEGEND_COLORS.values()],
        radii=rr.Radius.ui_points(4.0),
    )


def lifted(xy: Array, z: float) -> Array:
    """Return points of the plane, shape ``(..., 2)``, at height `z`, shape ``(..., 3)``, clipped to `MAX_COORDINATE_M`."""
    return np.concatenate([np.clip(xy, -MAX_COORDINATE_M, MAX_COORDINATE_M), np.full((*xy.shape[:-1], 1), z)], axis=-1)


def _series_looks(info: Info) -> dict[str, rr.AsComponents]:
    looks: dict[str, rr.AsComponents] = {f"state/{label.name}": _line(str(label), "measured") for label in info.states}
    looks |= {f"disturbance/{label.name}": _line(str(label), "error") for label in info.disturbances}
    for label, low, high in zip(info.inputs, info.lbu, info.ubu, strict=True):
        looks[f"actuation/{label.name}"] = _line("let through", "actuation", 6.0, rr.components.InterpolationMode.StepAfter)
        looks[f"command/{label.name}"] = _line("command", "command", interpolation=rr.components.InterpolationMode.StepAfter)
        said = f"±{high:g}" if low == -high else f"{low:g} to {high:g}"
        limits = _line(f"limits {said}", "limit", 1.0)  # of one name: one entry of the legend, and the scale of a plot too low for ticks
        looks |= {f"command/{label.name}/{side}": limits for side in ("min", "max")}
    looks |= {f"error/{label.name}": _line(str(label), "error") for label in info.outputs}
    looks |= {f"output/{info.outputs[i].name}": _line(str(info.outputs[i]), "measured") for i in info.computed}
    looks |= {f"telemetry/{phase}_us": _line(phase, phase) for phase in PHASES}
    looks |= {f"telemetry/{rung}": _line(rung, color) for rung, color in RUNG_COLORS.items()}
    looks["telemetry/second_difference"] = _line("difference", "error")
    looks |= {"telemetry/delay_s": _line("delay", "measured"), "telemetry/state_age_s": _line("age of the state", "idle")}
    looks |= {"error/position": _line("position [mm]", "error"), "slack": _line("left", "feedback"), "slack/period": _line("period", "limit", 1.0)}
    return looks


def _cost_looks(info: Info) -> dict[str, rr.AsComponents]:
    names = {f"error/{label.name}": f"error of {label.name}" for label in info.outputs}
    names |= {f"changes/{label.name}": f"changes of {label.name}" for label in info.inputs}
    colors = dict(zip(names, cycle(TERM_COLORS), strict=False))
    looks: dict[str, rr.AsComponents] = {f"cost/{path}": _line(name, colors[path]) for path, name in names.items()}
    return looks | {"cost/rest": _line("rest", "reference")}


def _lane_looks(info: Info) -> dict[str, rr.AsComponents]:
    looks: dict[str, rr.AsComponents] = {}
    for lane, values in LANE_COLORS.items():
        names, colors = [value.name for value in values], [COLORS[color] for color in values.values()]
        looks[f"lane/{lane}"] = rr.StateConfiguration(values=names, labels=names, colors=colors)
    said = [FREE, *ACTING]
    colors = [COLORS["body" if words == FREE else "warning" if words.endswith(LATER) else "bad"] for words in said]
    obstacles = [f"obstacle_{i}" for i in range(len(info.obstacles))]
    for name in (*(label.name for label in (*info.states, *info.inputs)), *obstacles):
        looks[f"bound/{name}"] = rr.StateConfiguration(values=said, labels=said, colors=colors)
    return looks


def _world_looks(info: Info, name: str, driven: str) -> dict[str, rr.AsComponents]:
    looks: dict[str, rr.AsComponents] = {"world": rr.ViewCoordinates.RIGHT_HAND_Z_UP}
    for path, strip in STRIPS.items():
        color = COLORS[driven if strip.color == DRIVEN_COLORS[0] else strip.color]
        looks[path] = rr.LineStrips3D.from_fields(colors=color, radii=rr.Radius.ui_points(strip.width / 2))
    for k, polygon in enumerate(outline(info.model) if info.heading is not None else []):
        edge = lifted(np.vstack([polygon, polygon[:1]]), ROBOT_Z_M + 0.002)
        looks[f"world/robot/part_{k}"] = _filled(polygon, ROBOT_Z_M - 0.001 * (k > 0), COLORS["wheel" if k else "body"])
        looks[f"world/robot/part_{k}/edge"] = rr.LineStrips3D([edge], colors=COLORS["edge"], radii=rr.Radius.ui_points(0.75))
    for i in range(len(info.obstacles)):  # of radius 1 m: where each is, and its radius, come with the samples
        looks[f"world/obstacle_{i}/disc"] = _filled(UNIT_CIRCLE, OBSTACLE_Z_M, COLORS["obstacle"])
        looks[f"world/obstacle_{i}/edge"] = rr.LineStrips3D(
            [lifted(np.vstack([UNIT_CIRCLE, UNIT_CIRCLE[:1]]), OBSTACLE_Z_M)], colors=COLORS["limit"], radii=rr.Radius.ui_points(0.75)
        )
    if info.position is not None:
        looks["world/robot/point"] = rr.Points3D(
            [[0.0, 0.0, 0.02]], labels=[name] if name else None, show_labels=True, colors=COLORS[driven], radii=rr.Radius.ui_points(3.0)
        )
    return looks


def _line(name: str, color: str, width: float = 1.5, interpolation: rr.components.InterpolationMode | None = None) -> rr.SeriesLines:
    return rr.SeriesLines(names=name, colors=COLORS[color], widths=width, interpolation_mode=interpolation)


def _filled(polygon: Array, z: float, color: tuple[int, int, int]) -> rr.Mesh3D:
    """Return a filled polygon as a fan of triangles around its first corner, which must see all of it."""
    fan = [(0, k, k + 1) for k in range(1, len(polygon) - 1)]
    return rr.Mesh3D(vertex_positions=lifted(polygon, z), triangle_indices=fan, vertex_colors=[color] * len(polygon))
