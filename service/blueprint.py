# SPDX-License-Identifier: Apache-2.0
"""What the viewer shows where."""

from __future__ import annotations

from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from rti_mpc.array import Array
from service.info import Info

TIMELINE = "robot_time"
TRAIL_S = 90.0
WINDOW_S = (-60.0, 15.0)  # around now; the legend lies on what is yet to come
HALF_FIELD = 0.52  # tangent of half the viewer's vertical field of view
MARGIN_M = 0.35  # a robot around a reference

COLORS = {
    "reference": (150, 156, 168),
    "measured": (86, 160, 255),
    "command": (255, 176, 59),
    "limit": (226, 86, 86),
    "error": (240, 110, 170),
    "prepare": (124, 200, 124),
    "feedback": (255, 176, 59),
    "latency": (170, 140, 245),
    "body": (70, 78, 96),
    "wheel": (112, 120, 138),
    "edge": (200, 206, 218),
    "idle": (110, 116, 128),
    "good": (72, 160, 96),
    "warning": (222, 160, 40),
    "bad": (214, 70, 70),
}


@dataclass(frozen=True)
class Frame:
    """
    What is seen of the plane.

    Attributes:
        center: In m.
        half: Half of its sides, in m.
    """

    center: tuple[float, float] = (0.0, 0.0)
    half: tuple[float, float] = (1.0, 1.0)

    @classmethod
    def around(cls, xy: Array) -> Frame:
        """Frame points, shape ``(M, 2)``, to a tenth of a metre, so that it does not follow every change of them."""
        low, high = xy.min(axis=0), xy.max(axis=0)
        (x, y), (w, h) = (0.5 * (low + high)).round(1).tolist(), (0.5 * (high - low)).round(1).tolist()
        return cls((x, y), (w, h))

    @property
    def eye_height(self) -> float:
        """How far above the plane to look from, in m, for a view wider than high."""
        return (max(self.half[1], self.half[0] / 1.3) + MARGIN_M) / HALF_FIELD


def blueprint(info: Info, frame: Frame | None = None) -> rrb.Blueprint:
    """
    Lay the views out.

    Args:
        info: Names: which state belongs beside which command, whether there is a plane to look at.
        frame: What to see of the plane.
    """
    series: list[rrb.View | rrb.Container] = [
        *(_commands(info, i) for i in range(len(info.inputs))),
        _errors(info),
        _times(info),
    ]
    states = _series("States", ["state/**"])
    left: rrb.Container = rrb.Vertical(states) if info.position is None else rrb.Tabs(_world(frame or Frame()), states)
    lanes = rrb.StateTimelineView(origin="/lane", name="Mode and QP status", time_view=_time_axis())
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(left, rrb.Vertical(*series), column_shares=[1, 1]),
            rrb.Horizontal(lanes, _events(), column_shares=[1, 1]),
            row_shares=[5, 1],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _world(frame: Frame) -> rrb.Spatial3DView:
    """Look from above, y up: a plain 2D view would draw y down."""
    x, y = frame.center
    start = rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S)
    trail = rrb.VisibleTimeRanges([rrb.VisibleTimeRange(TIMELINE, start=start, end=rrb.TimeRangeBoundary.cursor_relative())])
    return rrb.Spatial3DView(
        origin="/world",
        name="From above, y up",
        background=(16, 18, 22),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.5, stroke_width=0.5, color=(255, 255, 255, 28)),
        eye_controls=rrb.EyeControls3D(position=(x, y - 0.01, frame.eye_height), look_target=(x, y, 0.0), eye_up=(0.0, 1.0, 0.0)),
        overrides={"world/trail": [trail]},
    )


def _time_axis() -> rrb.TimeAxis:
    boundaries = (rrb.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in WINDOW_S)
    return rrb.TimeAxis(view_range=rr.TimeRange(*boundaries))


def _series(name: str, contents: list[str], axis_y: rrb.ScalarAxis | None = None) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ /{path}" for path in contents],
        name=name,
        axis_x=_time_axis(),
        axis_y=axis_y,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightBottom),
    )


def _commands(info: Info, i: int) -> rrb.TimeSeriesView:
    """Show a command between its limits, and the measured state it is about."""
    measured = info.measured(i)
    contents = [f"command/{info.inputs[i].name}/**"] + ([] if measured is None else [f"state/{info.states[measured].name}"])
    return _series(f"Command {info.inputs[i]}", contents)


def _errors(info: Info) -> rrb.TimeSeriesView:
    if info.position is not None:
        return _series("Tracking error [mm]", ["error/position"])
    return _series("Tracking error", [f"error/{info.outputs[i].name}" for i, _ in info.tracked])


def _times(info: Info) -> rrb.Container:
    """Show what a sample costs, and what it leaves of the period."""
    period_ms = 1e3 * info.dt_s
    axis = rrb.ScalarAxis(range=(-0.1 * period_ms, 1.2 * period_ms)) if period_ms > 0 else None
    return rrb.Horizontal(
        _series("Phase times [us]", [f"telemetry/{name}_us" for name in ("prepare", "feedback", "latency")]),
        _series(f"Left of the {period_ms:g} ms period [ms]" if axis else "Left of the period [ms]", ["slack/**"], axis),
    )


def _events() -> rrb.TextLogView:
    kinds = rrb.encodings.TextLogColumnKind
    columns = [rrb.encodings.TextLogColumn(kind, visible=kind is not kinds.EntityPath) for kind in kinds]
    return rrb.TextLogView(origin="/event", name="Events", columns=rrb.TextLogColumns(text_log_columns=columns))
