# SPDX-License-Identifier: Apache-2.0
"""Recursions in C, loops and dense kernels, against the expressions that the virtual machine evaluates."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc import codegen
from rti_mpc.array import Array
from rti_mpc.codegen import compiled, function, with_bodies
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model, Signal
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import eight, rows
from rti_mpc.rti.certificate import certificate
from rti_mpc.rti.dense import LEAST_SIZE
from rti_mpc.rti.ocp import ARGUMENTS, Ocp
from rti_mpc.rti.places import places
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.recursion import recur
from rti_mpc.rti.rti import Rti

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")


def problem(nx: int, nu: int, N: int, within: int | list[int], *, softened: bool = True, of_inputs: bool = False, by_stage: bool = False) -> Ocp:
    """
    A model with a sparse Jacobian, weights that are full matrices, and two states and an expression of states and inputs softly bounded.

    Inputs are free within a control horizon, or held in blocks.
    """
    rng = np.random.default_rng(nx)
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    A = rng.normal(size=(nx, nx)) * (rng.random((nx, nx)) < 0.4) - np.eye(nx)
    B = rng.normal(size=(nx, nu)) * (rng.random((nx, nu)) < 0.7)
    C = rng.normal(size=(3, nx)) * (rng.random((3, nx)) < 0.5)
    f = ca.DM(A) @ x + ca.DM(B) @ u + 0.1 * ca.sin(x) * u[0]
    signals = {name: tuple(Signal(f"{name}{i}", "1") for i in range(count)) for name, count in (("x", nx), ("u", nu), ("y", 3))}
    y_expr = ca.DM(C) @ x + (u[0] * ca.DM([1, 0, 2]) * x[0] if of_inputs else 0)
    model = Model(name="mixed", x=x, u=u, f_expl_expr=f, y_expr=y_expr, states=signals["x"], inputs=signals["u"], outputs=signals["y"])
    root, turn = rng.normal(size=(3, 3)), rng.normal(size=(nu, nu))
    room = np.array([1.0, 1.0, *[np.inf] * (nx - 2)])
    expression = x[0] * u[nu - 1] + x[nx - 1]
    given: dict[str, Any] = {"lbx": -room, "ubx": room, "h_expr": expression, "lh": -0.5, "uh": 0.5} if softened else {}
    weights: dict[str, Any] = {
        "Q": root @ root.T + np.eye(3),
        "R": turn @ turn.T + np.eye(nu),
        "lambda_": rng.uniform(0.5, 2.0, len(within) if isinstance(within, list) else within),
    }
    weights |= {"blocks": within} if isinstance(within, list) else {"N_u": within}
    bounds: dict[str, Any] = {"lbu": -1.0, "ubu": 1.0, "lbdu": -0.3, "ubdu": 0.3}
    if by_stage:
        N_u = len(weights["lambda_"])
        weights |= {"lambda_": rng.uniform(0.5, 2.0, (N_u, nu)), "R_u": rng.uniform(0.5, 2.0, (N_u, nu))}
        bounds |= {"ubu": rng.uniform(0.8, 1.0, (N_u, nu)), "lbdu": rng.uniform(-0.4, -0.3, (N_u, nu))}
        given |= {"ubx": room * rng.uniform(0.5, 1.0, (N, 1)), "uh": rng.choice([0.5, np.inf], (N, 1))}
    return Ocp(model, N=N, dt=0.05, method="euler", **weights, **bounds, **given)


def arguments(of: ca.Function, ocp: Ocp, rng: np.random.Generator, known: dict[str, ca.DM]) -> dict[str, ca.DM]:
    """Numbers for a function of the solver: the problem's weights and bounds, what is known, and random ones."""
    fixed = {name: np.clip(getattr(ocp, name), -INFINITY, INFINITY).T for name in ARGUMENTS}
    scale = np.ones(of.size1_in("scale"))
    scale[-ocp.model.nx :] = 1e3  # the reach: random references are within it, and steps damped as they are there
    fixed |= {"scale": scale} | known
    return {name: ca.DM(fixed[name]) if name in fixed else ca.DM(rng.normal(size=of.size_in(name))) for name in of.name_in()}


def assert_equal(of: ca.Function, fast: ca.Function, given: dict[str, ca.DM]) -> dict[str, ca.DM]:
    """Hold a compiled function against the interpreted one, and return its results."""
    assert fast.class_name() == "External"
    expected, got = of(**given), fast(**given)
    for name in of.name_out():
        value = np.array(expected[name])
        largest = np.abs(value).max(initial=1.0)
        np.testing.assert_allclose(np.array(got[name]), value, rtol=0, atol=1e-10 * largest, err_msg=f"{of.name()}: {name}")  # rounding, amplified
    return dict(expected)


@needs_compiler
@pytest.mark.parametrize(
    ("nx", "nu", "N", "within", "softened", "by_stage"),
    [
        (3, 2, 5, 2, True, False),
        (LEAST_SIZE - 2, 2, 4, 3, True, False),
        (3, 2, 5, 2, True, True),
        *(
            pytest.param(*shape, marks=pytest.mark.slow)
            for shape in (
                (3, 2, 5, 5, True, False),
                (3, 2, 6, [1, 2, 1, 2], True, False),
                (2, 1, 1, 1, True, False),
                (13, 4, 3, 3, True, False),
                (21, 3, 2, 1, True, False),
                (30, 1, 2, 2, False, False),
                (13, 4, 6, [2, 1, 3], True, False),
                (13, 4, 6, [2, 1, 3], True, True),
            )
        ),
    ],
)
def test_compiled_recursions_equal_the_expressions(nx: int, nu: int, N: int, within: int | list[int], softened: bool, by_stage: bool) -> None:
    """Of few states as scalars, of many as dense columns; held inputs, blocks, full weights, outputs of inputs, rows by stage, no softened bounds."""
    ocp = problem(nx, nu, N, within, softened=softened, of_inputs=nx >= LEAST_SIZE - 2, by_stage=by_stage)
    rng, functions, judged = np.random.default_rng(5), places(ocp), certificate(ocp)
    fast = compiled(functions.gains, functions.roll_out, functions.refine, judged)
    known = {"stages": functions.linearize(**arguments(functions.linearize, ocp, rng, {}))["stages"]}
    known["places"] = ca.DM(rng.choice([0.0, 0.0, 1.0], functions.gains.numel_in("places")))
    known |= assert_equal(functions.gains, fast[0], arguments(functions.gains, ocp, rng, known))
    assert np.isfinite(np.array(known["gains"])).all()
    for of, compiled_of in zip((functions.roll_out, functions.refine, judged), fast[1:], strict=True):
        assert_equal(of, compiled_of, arguments(of, ocp, rng, known))


@needs_compiler
@pytest.mark.parametrize(
    ("nx", "within"),
    [(3, 4), (LEAST_SIZE - 2, 4), (3, [1, 2, 1, 2]), pytest.param(13, [2, 1, 3], marks=pytest.mark.slow), pytest.param(3, 6, marks=pytest.mark.slow)],
)
def test_gains_of_other_places_go_on_from_the_last_stage_whose_places_differ(nx: int, within: int | list[int]) -> None:
    """To the last bit as if they were computed anew, and nothing after that stage is computed again."""
    ocp = problem(nx, 2, 6, within)
    rng, functions = np.random.default_rng(7), places(ocp)
    (fast,) = compiled(functions.gains)
    known = {"stages": functions.linearize(**arguments(functions.linearize, ocp, rng, {}))["stages"]}
    known["places"] = ca.DM(rng.choice([0.0, 1.0], fast.numel_in("places")))
    given = arguments(fast, ocp, rng, known)

    def of(placed: Array, before: dict[str, ca.DM]) -> dict[str, ca.DM]:
        return dict(fast(**given | {"places": ca.DM(placed)} | {f"{name}_known": value for name, value in before.items()}))

    none = {name: ca.DM(value.shape[0], value.shape[1]) for name, value in fast(**given).items()} | {"places_of": ca.DM.nan(given["places"].shape)}
    first = of(np.array(given["places"]).ravel(), none)
    nu, ng, N_u = 2, ocp.ng, ocp.N_u
    starts = [ocp.held.tolist().index(block) for block in range(N_u)]
    rows = [*np.repeat(starts, nu), *np.repeat(starts, nu), *np.repeat(range(ocp.N), ng)]  # the stage of each
    for row, stage in enumerate(rows):
        placed = np.array(given["places"]).ravel()
        placed[row] = 1.0 - placed[row]
        anew, again = of(placed, none), of(placed, first)
        assert all((np.array(again[name]) == np.array(value)).all() for name, value in anew.items()), f"row {row}"
        marked = {name: value if name == "places_of" else 1.0 + value for name, value in first.items()}
        after = of(placed, marked)
        for name, last in (("gains", ocp.held[stage]), ("P", stage), ("p", stage)):
            assert (np.array(after[name] == marked[name]).all(axis=0)[last + 1 :]).all(), f"{name}, row {row}"
            assert not np.array(after[name] == marked[name]).all(axis=0)[: last + 1].any(), f"{name}, row {row}"


@needs_compiler
@pytest.mark.slow
def test_step_of_the_interior_point_is_the_same_compiled() -> None:
    """It calls the recursions with data of its own, and does not take all of their results."""
    ocp = problem(10, 2, 3, 2)
    rng, functions = np.random.default_rng(6), places(ocp)
    stages = functions.linearize(**arguments(functions.linearize, ocp, rng, {}))["stages"]
    start = arguments(functions.enter, ocp, rng, {"stages": stages, "start": ca.DM(1.0)})
    known = {"stages": stages, "least": ca.DM(1e-6), **functions.enter(**start)}
    assert_equal(functions.step, compiled(functions.step)[0], arguments(functions.step, ocp, rng, known))


@needs_compiler
def test_code_of_a_recursion_does_not_grow_with_the_horizon() -> None:
    generated = []
    for N in (10, 100):
        ocp = problem(3, 2, N, N)
        generator = ca.CodeGenerator("functions", {"with_header": False})
        generator.add(places(ocp).roll_out)
        generated.append(len(with_bodies(generator.dump()).splitlines()))
    assert generated[0] == generated[1]


@needs_compiler
def test_result_that_nobody_takes_is_still_carried_on() -> None:
    """A carried result that is also returned has no column to lie in if the caller does not want it."""
    s, a = ca.SX.sym("s", 2), ca.SX.sym("a", 2)
    stage = function("turned", {"s": s, "a": a}, {"s_after": ca.vertcat(s[1] + a[0], s[0] * a[1]), "sum": s[0] + s[1]})
    s_0, along = ca.MX.sym("s_0", 2), ca.MX.sym("along", 2, 5)
    turned = recur("turning", [(stage, 5)], {"s": "s_after"}, ["s_after", "sum"])(s=s_0, a=along)
    wanted = function("wanted", {"s_0": s_0, "along": along}, {"sums": turned["sum"]})
    assert_equal(wanted, compiled(wanted)[0], {"s_0": ca.DM([1, 2]), "along": ca.DM(np.arange(10.0).reshape(2, 5))})


@needs_compiler
@pytest.mark.slow
def test_native_portable_and_interpreted_solvers_command_the_same_on_1000_samples_each_certified() -> None:
    """On one closed loop, each from its own last plan."""
    model = pioneer_3dx()
    bounds: dict[str, Any] = {"lbu": [-0.5, -0.745], "ubu": [0.5, 0.745], "lbdu": [-0.25, -0.4], "ubdu": [0.25, 0.4]}
    ocp = Ocp(model, N=10, dt=0.1, method="euler", Q=[1, 1, 0.05], R=[1.0, 1.0], delta=28.0, lambda_=0.8, **bounds)
    phi, reference = ocp.phi(), eight()
    y = rows(reference.lasting(0.1 * (1000 + 12)), 0.1, "tangent")
    y[:, 2] = np.unwrap(y[:, 2])
    x, u = np.array([*reference.pose0, 0.0, 0.0]), np.zeros(2)
    solvers = [Rti(ocp, build="portable"), Rti(ocp, build="native"), Rti(ocp, compile=False)]
    for rti in solvers:
        rti.reset(x, u)
    for k in range(1000):
        for rti in solvers:
            rti.prepare(y[k + 1 : k + 1 + ocp.N], shift=k > 0, u_prev=u)
            assert rti.feedback(x) is QpStatus.SOLVED, (k, rti)
        for rti in solvers[:2]:
            mine, theirs = rti.u / ocp.ubu, solvers[2].u / ocp.ubu  # in half their range
            np.testing.assert_allclose(mine[0], theirs[0], rtol=0, atol=1e-9, err_msg=f"sample {k}")
            # Later inputs of a robot that turns on the spot hardly matter to the cost: rounding of fused operations is 1.4e-9 on one processor.
            np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-8, err_msg=f"sample {k}")
        u = solvers[0].u[0].copy()
        x = np.array(phi(x, u, model.p_nominal)).ravel()


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("nx", [3, LEAST_SIZE])
def test_portable_code_gives_the_same_bits_with_longer_vectors_and_without(nx: int, monkeypatch: pytest.MonkeyPatch) -> None:
    ocp, rng = problem(nx, 2, 6, 4), np.random.default_rng(8)
    functions = places(ocp)
    stages = functions.linearize(**arguments(functions.linearize, ocp, rng, {}))["stages"]
    inside = functions.enter(**arguments(functions.enter, ocp, rng, {"stages": stages, "start": ca.DM(1.0)}))
    known = {"stages": stages, "least": ca.DM(1e-6), **inside}
    chosen = functions.linearize, functions.roll_out, functions.step, certificate(ocp)
    given = [arguments(function, ocp, rng, known) for function in chosen]
    found = []
    for processor in ("flags: sse2", "flags: sse2 avx") if "avx" in codegen.processor_flags().split() else ("flags: sse2",):
        monkeypatch.setattr(codegen, "processor_flags", lambda processor=processor: processor)
        found.append([one(**arrays) for one, arrays in zip(compiled(*chosen), given, strict=True)])
    for results in zip(*found, strict=True):
        for name in results[0]:
            assert all((np.array(result[name]) == np.array(results[0][name])).all() for result in results), name


@needs_compiler
def test_native_code_is_kept_by_what_compiler_and_processor_make_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    x = ca.SX.sym("x")
    twice = ca.Function("twice", [x], [2 * x])
    for processor in ("flags: fma", "flags: fma avx2", "flags: fma"):
        monkeypatch.setattr(codegen, "processor_flags", lambda processor=processor: processor)
        compiled(twice, build="native")
    compiled(twice)
    assert len(list((tmp_path / "rti_mpc").iterdir())) == 3
    assert "march" in codegen.resolved(shutil.which("cc") or "cc", codegen.flags_of("native"))


def test_unknown_build_is_refused() -> None:
    with pytest.raises(OcpError, match="build must be one of portable, native, got 'fast'"):
        Rti(problem(3, 2, 3, 3), build="fast")


@pytest.mark.parametrize(("outputs", "backward"), [(["s_next"], False), (["y"], True)], ids=["forward", "without what is carried"])
def test_recursion_that_cannot_go_on_from_an_earlier_call_is_refused(outputs: list[str], backward: bool) -> None:
    s, a = ca.SX.sym("s"), ca.SX.sym("a")
    stage = ca.Function("stage", [s, a], [s + a, s * a], ["s", "a"], ["s_next", "y"])
    assert recur("sums", [(stage, 3)], {"s": "s_next"}, ["s_next"], backward=True, resumed=True).n_in() == 4
    with pytest.raises(OcpError, match="recursion sums must be backward and return s_next to be resumed, got outputs"):
        recur("sums", [(stage, 3)], {"s": "s_next"}, outputs, backward=backward, resumed=True)
