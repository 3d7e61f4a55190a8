# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from rti_mpc.wire.info import Info, Label
from rti_mpc_service.rig.run_data import Run

SECOND = 1_000_000_000
PIONEER = Info(
    role="controller",
    model="pioneer_3dx",
    states=(Label("x", "m", role="x"), Label("y", "m", role="y"), Label("psi", "rad", True, "heading"), Label("u", "m/s"), Label("omega", "rad/s")),
    inputs=(Label("u_c", "m/s", state="u"), Label("omega_c", "rad/s", state="omega")),
    outputs=(Label("x", "m", role="x"), Label("y", "m", role="y")),
    dt_s=0.1,
    lbu=(-0.2, -np.inf),
    ubu=(0.5, np.inf),
)


@pytest.fixture
def run() -> Run:
    """One minute of a circle: 100 mm beside it at first, 1 mm after 20 s."""
    t = np.arange(0.0, 60.0, 0.1)
    reference = np.column_stack([np.sin(t / 10), np.cos(t / 10)])
    position = reference * (1.0 + np.where(t < 20.0, 0.1, 0.001))[:, None]
    stamp_ns = 5 * SECOND + np.round(t * SECOND).astype(np.int64)
    return Run(
        info=PIONEER,
        scenario="circle",
        stamp_ns=stamp_ns,
        x=np.column_stack([position, -t / 10, np.full_like(t, 0.1), np.full_like(t, -0.1)]),
        u_applied=np.column_stack([np.full_like(t, 0.1), np.full_like(t, -0.11)]),
        y=position,
        reference=reference,
        sample_stamp_ns=stamp_ns[1:],
        prepare_us=np.linspace(100.0, 200.0, len(t) - 1),
        feedback_us=np.full(len(t) - 1, 150.0),
        latency_us=np.full(len(t) - 1, 250.0),
        speed=4.0,
    )


def figure(run: Run, path: Path) -> None:
    from rti_mpc_service.rig import figure  # with matplotlib

    figure.figure(run, path)


def words(path: Path) -> str:
    return " ".join(text for element in ElementTree.parse(path).iter() for text in element.itertext())


def test_error_is_the_distance_at_the_same_stamp_in_mm(run: Run) -> None:
    assert run.error_mm[run.settled] == pytest.approx(1.0)
    assert run.error_mm[~run.settled] == pytest.approx(100.0)
    assert run.time_s[run.settled][0] == pytest.approx(20.0)


def test_there_is_less_wall_time_for_a_sample_at_a_higher_speed(run: Run) -> None:
    assert run.period_us == pytest.approx(25_000.0)


def test_the_figure_names_what_it_shows_with_units(run: Run, tmp_path: Path) -> None:
    import matplotlib as mpl

    with mpl.rc_context({"svg.fonttype": "none"}):
        figure(run, tmp_path / "run.svg")
    shown = words(tmp_path / "run.svg")
    for expected in (
        "Path: circle",
        "x [m]",
        "y [m]",
        "distance [mm]",
        "after the transient: max 1 mm, rms 1 mm",
        "Command u_c",
        "[m/s]",
        "[rad/s]",
        "prepare: median 150, p99 199 us",
        "period at speed 4: 25000 us",
        "robot time [s]",
    ):
        assert expected in shown


def test_an_obstacle_is_drawn_where_the_robot_came_nearest_to_it(run: Run) -> None:
    """It moves past the robot from the right; without it, nobody sees why the robot leaves the path."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    from rti_mpc_service.rig.figure import _path

    disc = np.column_stack([np.linspace(4.0, -4.0, len(run.y)), np.full(len(run.y), 1.2), np.full(len(run.y), 0.3)])
    axes = Figure().add_subplot()
    _path(axes, replace(run, discs=(disc,)))
    (circle,) = (patch for patch in axes.patches if isinstance(patch, Circle))
    nearest = disc[np.hypot(*(run.y - disc[:, :2]).T).argmin()]
    assert (*circle.center, circle.radius) == pytest.approx(tuple(nearest))
    legend = axes.get_legend()
    assert legend is not None
    assert "obstacle, when nearest" in [text.get_text() for text in legend.get_texts()]


def test_the_figure_is_an_image_of_a_legible_size_and_leaves_the_callers_settings_alone(run: Run, tmp_path: Path) -> None:
    import matplotlib as mpl
    from matplotlib.image import imread

    before = dict(mpl.rcParams)
    figure(run, tmp_path / "run.png")
    assert dict(mpl.rcParams) == before
    height, width, _ = imread(tmp_path / "run.png").shape
    assert width > 1500
    assert height > 900


def test_a_run_shorter_than_its_transient_and_without_error_is_drawn(run: Run, tmp_path: Path) -> None:
    short = replace(run, stamp_ns=run.stamp_ns[:2], x=run.x[:2], u_applied=run.u_applied[:2], y=run.y[:2], reference=run.y[:2])
    figure(short, tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 0


@pytest.mark.slow
def test_a_model_with_one_input_and_no_heading_is_drawn(run: Run, tmp_path: Path) -> None:
    info = Info(
        role="controller",
        states=(Label("x", "m", role="x"), Label("y", "m", role="y")),
        inputs=(Label("f", "N"),),
        outputs=(Label("x", "m", role="x"), Label("y", "m", role="y")),
        dt_s=0.1,
        lbu=(-np.inf,),
        ubu=(np.inf,),
    )
    figure(replace(run, info=info, x=run.position, u_applied=run.u_applied[:, :1]), tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 0


def test_a_model_without_position_is_drawn_by_its_outputs_against_their_references(run: Run, tmp_path: Path) -> None:
    import matplotlib as mpl

    joints = (Label("q1", "rad", True), Label("z", "m"))
    arm = replace(run.info, states=tuple(replace(label, role="") for label in run.info.states), outputs=joints)
    turned = run.reference + np.array([2 * np.pi, 0.25])
    with mpl.rc_context({"svg.fonttype": "none"}):
        figure(replace(run, info=arm, scenario="sines", y=turned), tmp_path / "run.svg")
    shown = words(tmp_path / "run.svg")
    assert "Command omega_c" in shown
    for expected in ("Output q1: sines", "Output z", "[rad]", "[m]", "true, then within 0.25"):
        assert expected in shown
    assert "Path:" not in shown
    assert "Tracking error" not in shown


def test_an_angle_that_is_whole_turns_off_has_no_error(run: Run) -> None:
    arm = replace(run.info, outputs=(Label("q1", "rad", True), Label("z", "m")))
    error = replace(run, info=arm, y=run.reference + 2 * np.pi).output_error
    assert np.abs(error[:, 0]).max() < 1e-9
    assert error[:, 1] == pytest.approx(2 * np.pi)


@pytest.mark.parametrize("planar", [True, False])
def test_dollar_signs_begin_no_formula_in_any_figure_of_a_run(planar: bool, run: Run, tmp_path: Path) -> None:
    import matplotlib as mpl

    from rti_mpc_service.replay import figure as replayed  # with matplotlib

    roles = ("x", "y") if planar else ("", "")
    named = replace(
        PIONEER,
        inputs=tuple(Label(rf"$\price{i}$", "$/s", state=one.state) for i, one in enumerate(PIONEER.inputs)),
        outputs=tuple(Label(rf"$\value{role}$", "m", role=role) for role in roles),
    )
    dollars = replace(run, info=named, scenario=r"of $\cost$")
    with mpl.rc_context({"svg.fonttype": "none"}):
        figure(dollars, tmp_path / "run.svg")
        replayed.figure([dollars, dollars], tmp_path / "both.svg", r"two $\drives$")
    for name in ("run.svg", "both.svg"):
        assert r"of $\cost$" in (drawn := words(tmp_path / name))
        assert r"Command $\price0$" in drawn
