# SPDX-License-Identifier: Apache-2.0
"""Cost by term and acting bounds, told from messages, against what the controller itself holds."""

from __future__ import annotations

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.contract.message import Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.info import Info
from rti_mpc_service.acting import DISTANCE
from rti_mpc_service.config.build import build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.description import controller_info
from rti_mpc_service.replay import plan as held
from rti_mpc_service.shipped import ROBOTS
from rti_mpc_service.view.plan import acting_bounds, cost_terms, is_plan

NEAR, FAR = 0.02, 2.0  # m, of the reference from the robot; far: it drives as fast as it may


@pytest.fixture(scope="module")
def pioneer() -> tuple[Config, Rti]:
    config = load(ROBOTS["pioneer_3dx"])
    return config, build_rti(config)


def solved(rti: Rti, away_m: float) -> Telemetry:
    """Telemetry of a plan towards a point ahead of a resting robot."""
    ocp = rti.ocp
    x0, y_ref = np.zeros(ocp.model.nx), np.zeros((ocp.N, ocp.model.ny))
    y_ref[:, 0] = away_m
    rti.reset(x0, np.zeros(ocp.model.nu))
    for _ in range(8):
        rti.prepare(y_ref, np.tile(ocp.model.p_nominal, (ocp.N + 1, 1)), shift=False)
        rti.feedback(x0)
    u = rti.u[np.minimum(np.arange(ocp.N), len(rti.u) - 1)].copy()
    stamps, numbers = (1, 1, 0, 1, 0), (1, 0.0, 0.0, rti.cost, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0, 0)
    return Telemetry(*stamps, Mode.TRACKING, QpStatus.SOLVED, *numbers, x0, rti.x.copy(), u, y_ref)


def info_of(rti: Rti) -> Info:
    document = {"role": "controller", **controller_info(rti.ocp, rti.ocp.model.np_, (rti.scale_x, rti.scale_u))}
    return Info.from_json(json.loads(json.dumps(document)))


@pytest.mark.parametrize("away_m", [NEAR, FAR])
def test_the_terms_of_a_cost_are_those_of_the_controller(pioneer: tuple[Config, Rti], away_m: float) -> None:
    config, rti = pioneer
    sample = solved(rti, away_m)
    terms, known = cost_terms(info_of(rti), sample, rti.u_prev), held.cost_terms(rti, config)
    told = {path.replace("/", " of "): value for path, value in terms.items() if "/" in path}
    assert known, "there is a cost"
    for name, value in known.items():
        if name in told:
            assert told[name] == pytest.approx(value, rel=1e-9), name
    rest = sum(value for name, value in known.items() if name not in told)
    assert sum(terms.values()) == pytest.approx(sample.cost, rel=1e-9)
    assert terms["rest"] == pytest.approx(rest, abs=1e-9 * sample.cost)  # of rounding in the sum


def test_the_bounds_that_act_are_those_of_the_controller(pioneer: tuple[Config, Rti]) -> None:
    config, rti = pioneer
    for away_m in (NEAR, FAR):
        sample = solved(rti, away_m)
        expected: dict[str, set[str]] = {}
        for bound in held.acting_bounds(rti, config):
            side = {"upper": "rises", "lower": "falls"}[bound["side"]] if bound["kind"] == "increment" else bound["side"]
            expected.setdefault(bound["name"], set()).add(side)
        said = acting_bounds(info_of(rti), sample, rti.u_prev)
        acting = {name: words for name, words in said.items() if words != "free"}
        assert acting.keys() == expected.keys()
        for name, words in acting.items():
            assert set(words.removesuffix(" later").split(", ")) <= expected[name]
    assert said["u_c"] != "free", "the far reference is driven to as fast as allowed"


@pytest.mark.parametrize(("away", "acts"), [(0.5, True), (2.0, False)])
def test_a_bound_acts_at_the_same_distance_for_both(pioneer: tuple[Config, Rti], away: float, acts: bool) -> None:
    """It was a hundredth of it in the controller's view, so that the viewer named bounds that `why` did not."""
    config, rti = pioneer
    sample, info = solved(rti, NEAR), info_of(rti)
    rti.u[:] = sample.u[: len(rti.u)] = rti.u_prev  # so that no increment is at its bound
    rti.u[2, 1] = sample.u[2, 1] = info.ubu[1] - away * DISTANCE * info.ubu[1]
    known = [bound["stages"] for bound in held.acting_bounds(rti, config) if (bound["kind"], bound["name"]) == ("input", "omega_c")]
    wide = replace(info, lbdu=(-np.inf,) * 2, ubdu=(np.inf,) * 2)
    assert known == [[2]] * acts
    assert acting_bounds(wide, sample, rti.u_prev)["omega_c"] == ("upper later" if acts else "free")


def test_a_bound_acts_now_or_later_in_the_plan(pioneer: tuple[Config, Rti]) -> None:
    _, rti = pioneer
    info, sample = info_of(rti), solved(rti, NEAR)
    u = np.zeros_like(sample.u)
    u[3, 0] = info.ubu[0]
    wide = replace(info, lbdu=(-np.inf,) * 2, ubdu=(np.inf,) * 2)
    assert acting_bounds(wide, replace(sample, u=u), None)["u_c"] == "upper later"
    u[0, 0] = info.lbu[0]
    assert acting_bounds(wide, replace(sample, u=u), None)["u_c"] == "lower"
    assert acting_bounds(wide, replace(sample, u=u), None)["omega_c"] == "free"
    away = np.array([0.3, 0.0])
    assert acting_bounds(wide, sample, None, (away,))["obstacle_0"] == "touched later"


@pytest.mark.parametrize("share", [1e-3, 1.0, 1e3])
def test_an_obstacle_is_touched_at_a_share_of_what_the_position_ranges_over(pioneer: tuple[Config, Rti], share: float) -> None:
    """Within 0.1 mm it was, of a robot that moves by millimetres as of one that moves by kilometres."""
    _, rti = pioneer
    info, sample = info_of(rti), solved(rti, NEAR)
    info = replace(info, scale_x=tuple(share * scale for scale in info.scale_x))
    for away, said in ((0.5, "touched"), (2.0, "free")):
        distances = np.full(len(sample.u), away * DISTANCE * info.scale_x[0])
        assert acting_bounds(info, sample, None, (distances,))["obstacle_0"] == said


def test_a_sample_without_a_plan_has_no_terms(pioneer: tuple[Config, Rti]) -> None:
    _, rti = pioneer
    sample = solved(rti, NEAR)
    assert is_plan(sample)
    assert not is_plan(replace(sample, mode=Mode.BRAKING))
    assert not is_plan(replace(sample, y_ref=sample.y_ref[:-1]))
    assert cost_terms(replace(info_of(rti), weights=None), sample, None) == {}


def test_a_path_s_window_is_where_the_path_is() -> None:
    from rti_mpc.model.path_following import path_following, window_place
    from rti_mpc.model.robots.unicycle import unicycle
    from rti_mpc.reference.path_source import PathSource
    from rti_mpc.reference.tracks import track
    from rti_mpc_service.view.path_window import path_window

    model, path = path_following(unicycle()), track("hairpin")
    place = window_place(model)
    assert place is not None
    source = PathSource([path], model.p_nominal, *place)
    edges = path_window(source.parameters(2.0, 1.0), *place)
    s = np.linspace(0.0, path.length, 4000)
    centre = path.position(s)
    away = np.array([np.hypot(*(centre - point).T).min() for point in edges[0]])
    assert away.max() < 0.02  # m: a spline through control points of the same path, and 4000 points of it
    widths = [np.hypot(*(edge - edges[0]).T) for edge in edges[1:]]
    assert [width.min() > 0.1 for width in widths] == [True, True]
    (along_x, along_y), (left_x, left_y) = np.diff(edges[0], axis=0).T, (edges[2] - edges[0])[:-1].T
    assert (along_x * left_y - along_y * left_x > 0.0).all(), "the left edge is to the left"


@pytest.mark.parametrize("of", [1e-6, 1.0, 1e6])
def test_an_input_with_one_bound_is_at_it_in_any_unit(of: float) -> None:
    """A cart that may only be pushed ahead; at a bound of zero there is nothing else to tell 0.01 N from far away."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    model = Model(name="cart", x=x, u=u, f_expl_expr=ca.vertcat(x[1], u / of - x[1]), y_expr=x[0], states=("r", "v"), inputs="F", outputs="r")
    rti = Rti(Ocp(model, N=8, dt=0.1, Q=1.0, R=1e-3 / of**2, lbu=0.0, ubu=np.inf), compile=False)
    info, sample = info_of(rti), solved(rti, NEAR)
    unit, far = rti.scale[2], np.full((8, 1), rti.scale[2])
    assert acting_bounds(info, replace(sample, u=far), None) == {"F": "free"}
    far[3] = 0.5 * DISTANCE * unit
    assert acting_bounds(info, replace(sample, u=far), None) == {"F": "lower later"}
    far[3] = 2.0 * DISTANCE * unit
    assert acting_bounds(info, replace(sample, u=far), None) == {"F": "free"}


def test_a_description_without_scales_names_bounds_all_the_same(pioneer: tuple[Config, Rti]) -> None:
    """As in recordings of earlier versions: half the range between two bounds is their scale."""
    _, rti = pioneer
    info, sample = info_of(rti), solved(rti, FAR)
    assert info.scale_u
    old = replace(info, scale_x=(), scale_u=())
    assert acting_bounds(old, sample, rti.u_prev) == acting_bounds(info, sample, rti.u_prev)
