# SPDX-License-Identifier: Apache-2.0
"""Problem families of the benchmark, and the yardstick they are measured by."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.rti.active_set import MAX_GAP
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.families import FAMILIES, Family
from rti_mpc_service.bench.family_bench import drive
from rti_mpc_service.bench.yardstick import Ipopt
from tests.command import command
from tests.problems import double_integrator
from tests.processes.system import rti_mpc

N = 5  # stages; what is tested here holds at any horizon


@pytest.mark.parametrize("name", [name for name in FAMILIES if name != "chain_7"])  # which is chain_5 with more masses, and slow to differentiate
def test_every_sample_of_a_family_has_a_reference_of_the_problems_shape(name: str) -> None:
    family = FAMILIES[name][0](N)
    model = family.ocp.model
    assert family.start(0) is not None, "a loop begins somewhere"
    for k in (0, 1, family.samples // 2, family.samples - 1):
        y_ref, p = family.at(k)
        assert y_ref.shape == (N, model.ny)
        assert p is None or p.shape == (N + 1, model.np_)
        start = family.start(k)
        assert start is None or start.shape == (model.nx,)


@pytest.mark.parametrize("name", ["chain_3", "quadrotor"])
def test_a_family_that_rests_stays_where_it_rests(name: str) -> None:
    family = FAMILIES[name][0](N)
    rest = np.zeros(family.ocp.model.nx) if name == "chain_3" else family.start(0)
    np.testing.assert_allclose(family.plant(rest, family.u0), rest, rtol=0, atol=1e-9, err_msg="an equilibrium, to the root finder's tolerance")


def test_converged_and_real_time_iteration_agree_where_softened_bounds_and_slew_limits_act() -> None:
    """IPOPT solves the problem with its slacks, increments and parameters: iterated to convergence, both give the same command."""
    family = FAMILIES["slalom"][0](10)
    x, u = np.array([0.3, 0.0, 0.0, 0.3, 0.0]), np.array([0.3, 0.0])
    y_ref, p = family.at(12)
    assert p is not None
    rti, ipopt = Rti(family.ocp, compile=False, iterations=50, tolerance=1e-10), Ipopt(family.ocp, softened=True)
    rti.reset(x, u)
    for _ in range(10):
        rti.prepare(y_ref, p, shift=False, u_prev=u)
        rti.feedback(x)
    ipopt.reset(x, u)
    np.testing.assert_allclose(ipopt.solve(x, u, y_ref, p), rti.u[0], rtol=0, atol=1e-5, err_msg="IPOPT stops at 1e-8 of its own scaled optimality")


def test_a_period_costs_what_the_problem_says() -> None:
    ocp = double_integrator(N=2, Q=[2.0, 0.0], R=[3.0], delta=5.0, lambda_=7.0, lbx=[-1.0, -np.inf], ubx=[1.0, np.inf], z=10.0, Z=4.0)
    family = Family(ocp, 1, lambda _: (np.zeros((2, 2)), None), lambda _: np.zeros(2))
    cost = family.cost(np.array([1.5, 0.0]), np.array([0.2]), np.array([0.1]), np.zeros(2), None)
    assert cost == pytest.approx(5 * 2 * 1.5**2 + 7 * 3 * 0.1**2 + 10 * 0.5 + 0.5 * 4 * 0.5**2, rel=1e-12)


@pytest.mark.parametrize("solver", ["riccati", "osqp"])
def test_each_run_of_a_family_drives_the_same_closed_loop(solver: str) -> None:
    """So the shortest of their times is that of one sample."""
    family = FAMILIES["tight"][0](N)
    first, second = (drive(family, Rti(family.ocp, solver=solver, compile=False), 20, lambda: None) for _ in range(2))
    for same in ("cost", "iterations", "certificate_max", "unsolved"):
        assert first[same] == second[same]


@pytest.mark.slow
def test_the_command_writes_a_row_for_each_family_and_solver(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    done = rti_mpc("bench", "--problem", "tight", "--quick", "-n", "7", "--json", str(path), timeout_s=300.0)
    assert done.returncode == 0, done.stderr
    rows = json.loads(path.read_text())
    assert [(row["problem"], row["N"], row["solver"]) for row in rows] == [("tight", 7, "riccati"), ("tight", 7, "osqp")]
    for row in rows:
        assert row["cpu_us"].keys() == {"p50", "p99", "max"}
        assert 1.0 <= row["in_medians"]["p99"] <= row["in_medians"]["max"]
        assert row["samples"] == 40
        assert {"cost_over_converged", "unsolved", "iterations", "compile_s", "compile_mib", "ipopt_us"} <= row.keys()
        assert 0.0 < row["certificate_max"] < (MAX_GAP if row["solver"] == "riccati" else np.inf)  # OSQP may stop at its limit
        assert f"{row['cost_over_converged']:+.2%}" in done.stdout, "a pipe cuts no number off"


def test_an_unknown_family_is_answered_by_the_nearest() -> None:
    done = command("bench", "--problem", "slalm")
    assert done.returncode == 2
    assert "perhaps slalom is meant, got 'slalm'" in done.stderr
    assert "Traceback" not in done.stderr
