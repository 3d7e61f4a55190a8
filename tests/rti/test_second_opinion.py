# SPDX-License-Identifier: Apache-2.0
"""Second opinions: OSQP on the last QP of each sample, compared with the plan of another solver."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc import Model
from rti_mpc.contract.status import QpStatus
from rti_mpc.rti import second_opinion
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.osqp import Solver, SolverSettings
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.second_opinion import SecondOpinion
from rti_mpc_service.bench.families import FAMILIES, Family, discs_passed, paper, quadrotor
from tests.problems import arc, double_integrator, fenced, pioneer, solve

AGREEMENT = 1e-3  # of half an input's range


def form(opinion: SecondOpinion) -> SecondOpinion:
    """Form the opinion about the last plan."""
    opinion.keep()
    return finish(opinion)


def finish(opinion: SecondOpinion) -> SecondOpinion:
    while not opinion.done:
        opinion.step()
    return opinion


def differences(family: Family, samples: int, **options: Any) -> tuple[list[float], list[QpStatus]]:
    """Drive a closed loop, and return differences and statuses of the opinions about all plans that are certified."""
    rti = Rti(family.ocp, **options)
    opinion, found, statuses = SecondOpinion(rti), [], []
    x = family.u0
    for k in range(samples):
        if (start := family.start(k)) is not None:
            x = start
            rti.reset(x, family.u0)
        rti.prepare(*family.at(k))
        if rti.feedback(x) is QpStatus.SOLVED:
            form(opinion)
            found.append(opinion.difference)
            statuses.append(opinion.status)
        x = family.plant(x, rti.u[0])
    return found, statuses


def test_osqp_has_the_same_plans_for_the_first_samples_of_the_paper() -> None:
    for formulation in ("simultaneous", "sequential"):
        found, statuses = differences(paper(7), 30, formulation=formulation, compile=False)
        assert set(statuses) == {QpStatus.SOLVED}
        assert max(found) < AGREEMENT


@pytest.mark.slow
def test_osqp_has_the_same_plans_in_999_of_1000_samples_on_paper_discs_and_quadrotor() -> None:
    """Where OSQP comes to no opinion, its last iterate is compared."""
    found, statuses = [], []
    for make in (paper, discs_passed, quadrotor):
        family = make(20)
        more = differences(family, family.samples)
        found += more[0]
        statuses += more[1]
    assert len(found) == 1200 + 240 + 480
    assert np.mean(np.array(found) < AGREEMENT) >= 0.999
    assert statuses.count(QpStatus.SOLVED) >= 0.995 * len(statuses)
    assert max(one for one, status in zip(found, statuses, strict=True) if status is QpStatus.SOLVED) < AGREEMENT


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tight", "discs_blocked", "slalom", "quadrotor_bounded", "cart_pole", "chain_3"])
def test_an_opinion_of_osqp_is_right_on_harder_problems_too(name: str) -> None:
    """At most one in a hundred differs: where the cost hardly depends on an input, and some residual is left."""
    make, (N, *_) = FAMILIES[name]
    family = make(N)
    found, statuses = differences(family, family.samples)
    opinions = [one for one, status in zip(found, statuses, strict=True) if status is QpStatus.SOLVED]
    assert len(opinions) > 0.7 * len(found)
    assert np.mean(np.array(opinions) < AGREEMENT) > 0.99


@pytest.mark.parametrize("make", [pioneer, fenced])
def test_an_opinion_is_about_the_sample_it_was_kept_of_whatever_comes_next(make: Any) -> None:
    rti = Rti(make(), compile=False)
    opinion = SecondOpinion(rti)
    x, times = np.array([0.0, 0.02, 0.8, 0.0, 0.0]), 0.1 * np.arange(1, 8)
    rti.reset(x, np.zeros(2))
    rti.prepare(arc(times))
    rti.feedback(x)
    at_once = form(opinion).difference
    opinion.keep()
    opinion.step()
    rti.prepare(arc(times + 0.1))
    opinion.step()
    rti.feedback(rti.x[1].copy())
    assert opinion.status is QpStatus.NONE or opinion.iterations == second_opinion.PIECE_ITERATIONS
    assert finish(opinion).status is QpStatus.SOLVED
    assert opinion.difference == pytest.approx(at_once, abs=1e-7), "it starts elsewhere"
    assert opinion.difference < 1e-6


def test_opinions_without_softened_bounds_say_nothing_on_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    """OSQP tells there of each solution on which no bound acts, also if it is not verbose: before any JSON, and into a pipe that may be full."""
    rti = Rti(double_integrator(lbu=-1.0, ubu=1.0), formulation="sequential", compile=False)
    opinion, acting = SecondOpinion(rti), []
    for r in (5.0, 5.0, 0.05, 0.05, 5.0):
        rti.prepare(np.zeros((rti.ocp.N, 2)))
        rti.feedback(np.array([r, 0.0]))
        acting.append(bool((np.abs(rti.u) == 1.0).any()))
        assert form(opinion).status is QpStatus.SOLVED
        assert opinion.difference < 1e-5
        assert opinion.iterations < 200, "110: it still polishes"
    assert acting == [True, True, False, False, True]
    assert capsys.readouterr().out == ""


def integrator(**changes: Any) -> Ocp:
    """A position that its speed is commanded of, 1 state, 1 input."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model(name="integrator", x=x, u=u, f_expl_expr=u, y_expr=x, states="r", inputs="v", outputs="r")
    return Ocp(model, **{"dt": 0.1, "Q": 1.0, "R": 0.1, "lbu": -1.0, "ubu": 1.0, "lbdu": -0.5, "ubdu": 0.5} | changes)


@pytest.mark.parametrize(
    "ocp", [double_integrator(), integrator(N=1), integrator(N=4, blocks=[1, 3])], ids=["without bounds", "of one stage", "with blocks"]
)
def test_opinions_about_a_robot_that_comes_to_rest_say_nothing_on_standard_output(ocp: Ocp, capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing acts there any more, or what seems to act has a multiplier that is rounding alone."""
    rti = Rti(ocp, formulation="sequential", compile=False)
    opinion, x = SecondOpinion(rti), np.zeros(ocp.model.nx)
    x[0] = 1.0
    rti.reset(x, np.zeros(1))
    for _ in range(60):
        rti.prepare(np.zeros((ocp.N, ocp.model.ny)))
        rti.feedback(x)
        assert form(opinion).status is QpStatus.SOLVED
        assert opinion.difference < AGREEMENT
        x = rti.x[1].copy()
    assert capfd.readouterr() == ("", "")


def test_plans_are_the_same_bit_for_bit_with_second_opinions_and_without() -> None:
    plans = []
    for opinions in (False, True):
        rti = Rti(pioneer(), compile=False)
        opinion = SecondOpinion(rti) if opinions else None
        x = np.array([0.0, 0.05, 0.8, 0.0, 0.0])
        rti.reset(x, np.zeros(2))
        for k in range(20):
            rti.prepare(arc(0.1 * np.arange(k + 1, k + 8)))
            rti.feedback(x)
            x = rti.x[1] + 1e-3 * np.sin(np.arange(5) + k)
            plans.append((rti.x.tobytes(), rti.u.tobytes()))
            if opinion is not None:
                form(opinion)
    assert plans[:20] == plans[20:]


def test_other_weights_and_bounds_are_those_of_the_next_opinion() -> None:
    rti = Rti(pioneer(), compile=False)
    opinion = SecondOpinion(rti)
    x = np.array([0.0, 0.2, 0.8, 0.0, 0.0])
    rti.reset(x, np.zeros(2))
    for weights in ({}, {"R": np.diag([0.1, 5.0])}, {"ubu": np.array([0.3, 0.4])}, {"delta": np.full(7, 1.0)}):
        rti.retune(weights)
        rti.prepare(arc(0.1 * np.arange(1, 8)), shift=False)
        assert rti.feedback(x) is QpStatus.SOLVED
        before = rti.u.copy()
        assert form(opinion).status is QpStatus.SOLVED
        assert opinion.difference < 1e-6
        np.testing.assert_array_equal(rti.u, before)


@pytest.mark.parametrize("make", [pioneer, fenced])
def test_the_backup_starts_from_the_last_opinion(make: Any) -> None:
    """A half and less of the iterations: its own last solution is long ago."""
    iterations = []
    for opinions in (False, True):
        rti = Rti(make(), SolverSettings(max_iter=10_000), compile=False)
        opinion = SecondOpinion(rti)
        x = np.array([0.0, 0.1, 0.8, 0.0, 0.0])
        rti.reset(x, np.zeros(2))
        for k in range(6):
            rti.prepare(arc(0.1 * np.arange(k + 1, k + 8)))
            rti.feedback(x)
            x = rti.x[1].copy()
            if opinions:
                assert form(opinion).status is QpStatus.SOLVED
        rti.prepare(arc(0.1 * np.arange(7, 14)))
        rti.x0[:] = x
        rti.use_whole_qp()
        assert rti.solve_qp().usable
        iterations.append(rti.solver.iterations)
    assert 2 * iterations[1] <= iterations[0]


def test_an_opinion_that_comes_to_no_end_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(second_opinion, "MAX_ITERATIONS", 20)
    monkeypatch.setattr(second_opinion, "MAX_RESIDUAL", 0.0)
    rti = Rti(pioneer(), compile=False)
    opinion = SecondOpinion(rti)
    solve(rti, seed=1)
    assert form(opinion).status is QpStatus.MAX_ITER
    assert opinion.iterations == 20


def test_numbers_that_are_no_problem_give_no_opinion_and_spoil_no_later_one() -> None:
    rti = Rti(pioneer(), compile=False)
    opinion = SecondOpinion(rti)
    solve(rti, seed=1)
    rti.guess.sample["x"][3, 2] = np.nan
    assert form(opinion).status is QpStatus.FAILED
    assert np.isnan(opinion.difference)
    solve(rti, seed=2)
    assert form(opinion).status is QpStatus.SOLVED


def test_step_sizes_take_turns_while_osqp_does_not_converge(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[int] = []
    take = Solver._take_step_size

    def taking(self: Solver) -> None:
        taken.append(self._changes)
        take(self)

    monkeypatch.setattr(Solver, "_take_step_size", taking)
    monkeypatch.setattr(second_opinion, "MAX_RESIDUAL", 0.0)
    rti = Rti(pioneer(), compile=False)
    opinion = SecondOpinion(rti)
    solve(rti, seed=1)
    form(opinion)
    form(opinion)
    assert taken == [1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4, 5, 6], "at 100, 200, 300, 500, 700 and 900 iterations; each opinion begins with the first"


def test_plans_of_any_other_solver_are_judged() -> None:
    found, statuses = differences(paper(7), 10, solver="daqp", compile=False)
    assert statuses == [QpStatus.SOLVED] * 10
    assert max(found) < AGREEMENT
