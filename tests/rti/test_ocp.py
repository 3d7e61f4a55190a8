# SPDX-License-Identifier: Apache-2.0
"""The optimal control problem: what its arguments become, and what is refused."""

from __future__ import annotations

import pickle
import warnings
from copy import copy, deepcopy
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.control.controller import Controller, Timing
from rti_mpc.errors import OcpError
from rti_mpc.model.disturbance import with_disturbances
from rti_mpc.model.model import Model
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.linearization import shift
from rti_mpc.rti.ocp import Ocp, rest_fault
from rti_mpc.rti.rti import Rti
from tests.problems import INF, PAPER, double_integrator, pioneer


def test_diagonals_constants_and_defaults_become_arrays() -> None:
    ocp = double_integrator(N=4, N_u=2, delta=[1, 2, 3, 4], lambda_=0.5)
    np.testing.assert_array_equal(ocp.Q, [[1.0, 0.0], [0.0, 0.1]])
    np.testing.assert_array_equal(ocp.R, [[0.05]])
    np.testing.assert_array_equal(ocp.delta, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(ocp.lambda_, [0.5, 0.5])
    np.testing.assert_array_equal(ocp.ubu, [INF])
    np.testing.assert_array_equal(ocp.lbx, [-INF, -INF])
    assert ocp.soft == ()
    assert double_integrator(N=4).N_u == 4


def test_states_with_a_bound_on_either_side_are_soft() -> None:
    assert pioneer(ubx=[1.0, INF, INF, 0.5, INF], lbx=[-INF, -INF, -INF, -0.5, -1.0]).soft == (0, 3, 4)


def test_arrays_are_owned_and_read_only() -> None:
    Q = np.eye(2)
    ocp = double_integrator(Q=Q)
    Q[0, 0] = 9.0
    assert ocp.Q[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        ocp.Q[0, 0] = 9.0
    with pytest.raises(AttributeError):
        ocp.N = 3  # type: ignore[misc]


def test_control_horizon_is_blocks_of_one_stage_and_one_to_the_end() -> None:
    ocp = double_integrator(N=6, N_u=3)
    assert ocp.blocks == (1, 1, 4)
    assert ocp.held.tolist() == [0, 1, 2, 2, 2, 2]
    blocks = double_integrator(N=6, blocks=np.array([2, 1, 3]))
    assert (blocks.blocks, blocks.N_u) == ((2, 1, 3), 3)
    assert blocks.held.tolist() == [0, 0, 1, 2, 2, 2]
    assert blocks.starts.tolist() == [0, 2, 3]


@pytest.mark.parametrize("horizon", [{"N_u": 3}, {"blocks": [2, 1, 3]}, {}])
def test_problem_with_another_weight_keeps_its_blocks(horizon: dict[str, Any]) -> None:
    ocp = double_integrator(N=6, **horizon)
    assert replace(ocp, Q=np.ones(2)).blocks == ocp.blocks


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"N_u": 4}, "N_u must be left out where blocks are given.*; in a copy of another problem blocks=None makes them anew from N and N_u"),
        ({"N": 8}, "blocks must have N = 8 stages together, got 6 in .*; in a copy of another problem blocks=None makes them anew from N and N_u"),
        ({"N_u": 4, "blocks": None}, r"lambda_ must be a number or have shape \(4,\)"),
    ],
)
def test_copy_of_a_problem_with_another_horizon_is_refused_with_what_else_it_needs(changes: dict[str, Any], message: str) -> None:
    ocp = double_integrator(N=6)
    with pytest.raises(OcpError, match=message):
        replace(ocp, **changes)
    assert replace(ocp, N=8, N_u=4, blocks=None, delta=1.0, lambda_=1.0).blocks == (1, 1, 1, 5)


def test_plan_in_blocks_is_moved_on_as_each_block_begins_a_stage_later() -> None:
    ocp = double_integrator(N=8, blocks=[2, 1, 3, 2])
    x, u = np.zeros((2, 9)), np.array([[10.0, 20.0, 30.0, 40.0]])
    moved = shift(ocp)(x=x, u=u)["u_next"]
    np.testing.assert_array_equal(np.array(moved), [[10.0, 30.0, 30.0, 40.0]])  # at stages 1, 3, 4 and 7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"N_u": 0}, "N_u must be a whole number of at least 1, got 0"),
        ({"N_u": 8}, "1 <= N_u <= N, got N_u = 8, N = 7"),
        ({"N": 0}, "N must be a whole number of at least 1, got 0"),
        ({"blocks": [1, 2, 3]}, r"blocks must have N = 7 stages together, got 6 in \[1, 2, 3\]"),
        ({"blocks": [1, 0, 6]}, "each of blocks must be a whole number of at least 1, got 0"),
        ({"blocks": []}, "blocks must be a list of the stages of each block"),
        ({"blocks": [1, 2, 4], "N_u": 2}, "N_u must be left out where blocks are given: it is their number, got N_u = 2"),
        ({"blocks": [1, 2, 4], "lambda_": [1.0] * 7}, r"lambda_ must be a number or have shape \(3,\)"),
        ({"dt": 0.0}, "dt must be a positive number of seconds, got 0.0"),
        ({"dt": INF}, "dt must be a positive"),
        ({"method": "heun"}, "method must be one of euler, rk4, irk, got 'heun'"),
        ({"Q": [1.0, 1.0]}, r"Q must have shape \(3, 3\) or be its diagonal \(3,\), got shape \(2,\)"),
        ({"Q": [1.0, 1.0, -0.05]}, "Q must be finite, symmetric and positive semidefinite"),
        ({"R": [[1.0, 0.1], [0.2, 1.0]]}, "R must be finite, symmetric and positive semidefinite"),
        ({"R": [1.0, np.nan]}, "R must be finite"),
        ({"delta": [1.0] * 6}, r"delta must be a number or have shape \(7,\), got shape \(6,\)"),
        ({"delta": np.ones((3, 7))}, r"delta must be a number or have shape \(7,\), or \(7, 3\), a row per stage, got shape \(3, 7\)"),
        ({"delta": -np.ones((7, 3))}, "delta must be finite and not negative"),
        ({"N_u": 3, "lambda_": np.ones((7, 2))}, r"lambda_ must be a number or have shape \(3,\), or \(3, 2\), a row per stage, got shape \(7, 2\)"),
        ({"N_u": 3, "lambda_": [1.0] * 7}, r"lambda_ must be a number or have shape \(3,\)"),
        ({"lambda_": -1.0}, "lambda_ must be finite and not negative"),
        ({"z": INF}, "z must be finite and not negative"),
        ({"lbu": [0.6, -0.745]}, "lbu must not lie above ubu"),
        ({"ubx": [INF, INF, INF, -0.5, 0.745]}, "lbx must lie below ubx"),
        ({"ubu": [np.nan, 1.0]}, "ubu must not be NaN"),
        ({"lbdu": 0.1}, "lbdu <= 0 <= ubdu must hold, or no input could be kept"),
        ({"lbddu": 0.0}, "lbddu < 0 < ubddu must hold, or no increment could be kept and changed"),
        ({"ubddu": [1.0, -0.1]}, "lbddu < 0 < ubddu must hold"),
        ({"zddu": -1.0}, "zddu must be finite and not negative"),
        ({"ubddu": [1.0] * 3}, r"ubddu must be a number or have shape \(2,\)"),
        ({"lbx": [0.0, 0.0]}, r"lbx must be a number or have shape \(5,\)"),
        ({"lbx": np.zeros((8, 5))}, r"lbx must be a number or have shape \(5,\), or \(7, 5\), a row per stage, got shape \(8, 5\)"),
        ({"N_u": 3, "ubu": np.ones((7, 2))}, r"ubu must be a number or have shape \(2,\), or \(3, 2\), a row per stage, got shape \(7, 2\)"),
        ({"ubu": [[1.0, 1.0]] * 4 + [[0.5, -0.8]] * 3}, r"lbu must not lie above ubu, got \[-0.5   -0.745\] and \[ 0.5 -0.8\] in row 4"),
        ({"ubx": [[INF, INF, INF, -0.5, 0.745]] * 7}, "lbx must lie below ubx, got .* in row 0"),
        ({"lbdu": [[-0.1, 0.1]] * 7}, "lbdu <= 0 <= ubdu must hold, .* in row 0"),
        (
            {"ubu": [[0.5, 0.7]] * 6 + [[-0.4, 0.7]], "lbdu": -0.1},
            r"bounds of input u_c must be reached in every block from anywhere .* from \[-0.5, 0.2\] alone",
        ),
    ],
)
def test_argument_that_does_not_fit_is_refused_by_name(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(OcpError, match=message):
        pioneer(**changes)


def test_bounds_by_stage_have_rows_on_both_sides_and_a_widest_and_a_tightest_one() -> None:
    ocp = pioneer(ubu=[[0.5, INF]] * 3 + [[0.4, 0.2]] * 4, lbdu=-INF)
    assert ocp.lbu.shape == ocp.ubu.shape == (7, 2)
    assert not ocp.lbu.flags.writeable
    np.testing.assert_array_equal(ocp.widest("ubu"), [0.5, INF])
    np.testing.assert_array_equal(ocp.tightest("ubu"), [0.4, 0.2])
    np.testing.assert_array_equal(ocp.widest("lbu"), ocp.tightest("lbu"))
    np.testing.assert_array_equal(ocp.retuned(ubu=[0.3, 0.3]).ubu, [[0.3, 0.3]] * 7)
    by_node = pioneer(lbx=[[-INF] * 3 + [-0.5, -INF]] * 6 + [[-INF] * 3 + [-0.3, -0.7]], ubx=INF)
    assert by_node.soft == (3, 4)
    assert by_node.lg.shape == by_node.ug.shape == (7, 2)


def test_bounds_that_leave_out_a_declared_rest_are_refused_with_the_input_and_its_rest() -> None:
    model = replace(pioneer_3dx(), u_rest=(0.1, 0.0))
    limits = {name: value for name, value in PAPER.items() if name not in ("lbu", "ubu")}
    assert Ocp(model, **limits, lbu=[0.1, 0.0], ubu=[0.3, 0.5])
    with pytest.raises(OcpError, match=r"bounds of input u_c must hold its rest, 0.1 m/s, or it could not be stopped, got \[0.2, 0.3\]"):
        Ocp(model, **limits, lbu=[0.2, -0.5], ubu=[0.3, 0.5])
    with pytest.raises(OcpError, match="bounds of input omega_c must hold its rest, 0 rad/s"):
        Ocp(model, **limits, lbu=[0.0, 0.1], ubu=[0.3, 0.5])


def test_bounds_without_zero_are_a_problem_but_none_to_stop_a_robot_in() -> None:
    """The library may solve it; the service, which must be able to stop the robot, refuses it."""
    ocp = pioneer(lbu=[0.2, -0.745])
    assert "bounds of input u_c must hold its rest, 0 m/s" in rest_fault(ocp)
    assert "increments of input omega_c must hold lower < 0 < upper" in rest_fault(pioneer(lbdu=[-0.25, 0.0]))
    assert rest_fault(pioneer()) == rest_fault(pioneer(lbdu=-INF, ubdu=INF, lbu=-INF, ubu=INF)) == ""
    with pytest.raises(OcpError, match="u_c must hold its rest"):
        Controller(Rti(ocp, compile=False), Timing(), compile=False)


def test_papers_problem_is_accepted_without_increment_bounds() -> None:
    ocp = pioneer(lbdu=-INF, ubdu=INF, method="euler")
    assert (ocp.N, ocp.N_u, ocp.dt) == (PAPER["N"], PAPER["N"], 0.1)
    assert ocp.soft == (3, 4)


def test_retuned_problem_is_checked_alike_and_leaves_the_first_as_it_was() -> None:
    ocp = pioneer()
    Q, other = ocp.Q, ocp.retuned(Q=[1.0, 2.0, 3.0], ubu=[0.4, 0.7])
    assert (other.Q.diagonal().tolist(), other.ubu.tolist()) == ([1.0, 2.0, 3.0], [0.4, 0.7])
    assert ocp.Q is Q
    assert not other.Q.flags.writeable
    with pytest.raises(OcpError, match="Q must be finite, symmetric and positive semidefinite"):
        ocp.retuned(Q=[1.0, 2.0, -3.0])
    with pytest.raises(OcpError, match="lbu must not lie above ubu"):
        ocp.retuned(ubu=[-0.6, 0.7])


def test_problem_of_a_model_in_discrete_time_has_its_period_and_no_integrator() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model(name="d", x=x, u=u, disc_dyn_expr=0.5 * x + u, dt=0.1, y_expr=x, states="x", inputs="u", outputs="x")
    with pytest.raises(OcpError, match="dt must be the period of model d, which is in discrete time"):
        Ocp(model, N=5, dt=0.2, Q=1, R=1)
    with pytest.raises(OcpError, match="model d is in discrete time: integrator, stages and steps must be left out, got rk4"):
        Ocp(model, N=5, dt=0.1, Q=1, R=1, method="rk4")
    assert float(Ocp(model, N=5, dt=0.1, Q=1, R=1).phi()(2.0, 3.0, [])) == 4.0


def test_reference_of_inputs_is_of_the_parameters_alone() -> None:
    with pytest.raises(OcpError, match="u_ref must be 1 numbers, or SX of the model's p, in a column"):
        double_integrator(u_ref=double_integrator().model.x[0])
    with pytest.raises(OcpError, match="R_u must be finite and not negative"):
        double_integrator(R_u=-1.0)


def pickled_problem() -> Ocp:
    """A problem with parameters, obstacles, and a general constraint and a reference of inputs of its own."""
    model = with_obstacles(with_disturbances(pioneer_3dx(), ["u_c"]), [(1.0, 0.5, 0.3)])
    h_expr, u_ref = ca.vertcat(model.h_expr, model.x[3] * model.x[4]), ca.vertcat(model.p[-4], 0.1)
    return Ocp(model, **PAPER, h_expr=h_expr, lh=[0.0, -0.2], uh=[INF, 0.2], R_u=0.1, u_ref=u_ref)


def test_problem_from_a_pickle_commands_the_same_and_is_as_read_only() -> None:
    ocp = pickled_problem()
    again: Ocp = pickle.loads(pickle.dumps(ocp))
    commands = []
    for problem in (ocp, again, again.retuned(R_u=0.1)):
        rti = Rti(problem, compile=False)
        rti.prepare(np.add(rti.y_ref, [1.0, 0.2, 0.1]))
        assert rti.feedback(rti.x[0]).usable
        commands.append(rti.u.tobytes())
    assert len(set(commands)) == 1
    with pytest.raises(ValueError, match="read-only"):
        again.Q[0, 0] = 9.0
    assert not ca.depends_on(again.h_expr, ocp.model.x), "its symbols are its own"


def test_model_in_discrete_time_comes_from_a_pickle_with_its_period() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model(name="sampled", x=x, u=u, disc_dyn_expr=0.5 * x + u, dt=0.1, y_expr=x, states="x", inputs="u", outputs="x", stop_expr=-x)
    again: Model = pickle.loads(pickle.dumps(model))
    assert (again.dt, again.f_expl_expr, again.states) == (0.1, None, model.states)
    f = ca.Function("f", [again.x, again.u], [again.disc_dyn_expr, again.stop_expr])
    assert [float(value) for value in f(2.0, 3.0)] == [4.0, -2.0]


def test_copy_of_a_problem_keeps_the_symbols_that_its_owner_writes_expressions_in() -> None:
    ocp = double_integrator()
    for other in (copy(ocp), deepcopy(ocp), deepcopy(ocp.model), deepcopy({"ocp": ocp})["ocp"]):
        model = other.model if isinstance(other, Ocp) else other
        assert ca.is_equal(model.x, ocp.model.x)


def test_inputs_that_cost_nothing_are_no_division_by_zero() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rti = Rti(double_integrator(Q=[0.0, 0.0], R=0.0), compile=False)
    assert np.isfinite(rti.scale).all()
