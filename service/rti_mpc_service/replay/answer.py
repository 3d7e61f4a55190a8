# SPDX-License-Identifier: Apache-2.0
"""Answers of solvers to the QP of a case: our own one, OSQP, or any other of qpsolvers."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.rti.qp.qp import QpData
from rti_mpc.rti.qp.qpsolvers import check_name, solve_once
from rti_mpc.rti.rti import Rti
from rti_mpc_service.case import QpCase, qp_at, solution

OURS = "riccati"


@dataclass(frozen=True)
class Answer:
    """
    What a solver answers.

    Attributes:
        solver: Its name.
        status: Outcome; UNSOUND data is FAILED without a solve.
        iterations: Iterations, 0 if it does not report them.
        time_s: Time of the solve, setup included for other solvers than ours, s.
        z: Scaled solution, shape ``(n,)``; empty without one.
        residuals: By name: violation and, of ours, the gap of its certificate, of others the dual residual; relative to the scales.
    """

    solver: str
    status: QpStatus
    iterations: int = 0
    time_s: float = 0.0
    z: Array = field(default_factory=lambda: np.zeros(0))
    residuals: dict[str, float] = field(default_factory=dict)


def answer(case: QpCase, solver: str, *, folder: Path = Path(), trust: bool = False) -> Answer:
    """
    Let a solver solve the QP of a case, cold.

    Args:
        case: The case.
        solver: ``"riccati"``, ``"osqp"``, or another one's name in qpsolvers.
        folder: Where a model of the user's own is looked for, as our own solver needs it.
        trust: Whether to run the attached source of the model instead.

    Raises:
        ConfigError: The model of the case is not here.
    """
    if not case.sound:
        return Answer(solver, QpStatus.FAILED)
    return of_ours(case, rebuilt(case, folder=folder, trust=trust)) if solver == OURS else of_other(case.qp, solver)


def check_solver(name: str) -> None:
    """
    Refuse a solver that `answer` cannot ask.

    Raises:
        ConfigError: It is neither our own one, nor OSQP, nor one that is installed for qpsolvers.
    """
    if name not in (OURS, "osqp"):
        try:
            check_name(name)
        except OcpError as error:
            raise ConfigError(f"--solver: {error}") from error


def of_other(qp: QpData, solver: str) -> Answer:
    """Let a solver of qpsolvers solve a QP."""
    start = time.perf_counter()
    try:
        status, iterations, z, dual = solve_once(qp, solver)
    except OcpError as error:
        raise ConfigError(f"--solver: {error}") from error
    residuals = {"dual": dual} if math.isfinite(dual) else {}
    return Answer(solver, status, iterations, time.perf_counter() - start, z, residuals)


def rebuilt(case: QpCase, *, folder: Path, trust: bool) -> Rti:
    """
    Return a real-time iteration of the case's problem, with our own solver.

    Raises:
        ConfigError: As `rti_mpc_service.replay.rebuild.rebuild`.
    """
    from rti_mpc_service.replay.rebuild import Journaled, rebuild

    about = case.about
    built = rebuild(Journaled(about["robot"], about["owner"], [], about["files"]), folder=folder, trust=trust)
    return built.rti


def of_ours(case: QpCase, rti: Rti, changed: Mapping[str, Array] | None = None) -> Answer:
    """
    Let our own solver solve a QP from the guess, with no bound held acting.

    Args:
        case: The case.
        rti: Real-time iteration of its problem. Its arrays are overwritten.
        changed: Weights and bounds by name that differ from the case's.

    Raises:
        ConfigError: It is not the problem's, or it has another solver.
    """
    if rti.active_set is None:
        raise ConfigError(f"--solver {OURS} needs a problem whose [solver] name is {OURS!r}, got another one in the case")
    here = rti.guess.arguments | {"x0": rti.guess.x0}
    if {name: array.shape for name, array in here.items()} != {name: array.shape for name, array in case.guess.items()}:
        raise ConfigError("the guess of the case must have the arrays of its problem, got others")
    for name, array in here.items():
        array[:] = case.guess[name] if changed is None else changed.get(name, case.guess[name])
    own = rti.active_set
    start = time.perf_counter()
    own.forget()
    own.linearize()
    own.gain()
    own.begin(1)
    status = own.certified() if own.solve() else QpStatus.FAILED
    taken_s = time.perf_counter() - start
    if not status.usable:
        return Answer(OURS, status, own.iterations, taken_s)
    z = solution(qp_at(rti, here), rti.guess.plan.x - here["x"], rti.u - here["u"]) / case.columns
    return Answer(OURS, status, own.iterations, taken_s, z, {"gap": own.res_dual})


def compared(case: QpCase, given: Answer) -> dict[str, Any]:
    """Return an answer in numbers, beside the plan of the sample."""
    if not len(given.z):
        return {"solver": given.solver, "status": given.status.name, "iterations": given.iterations, "time_us": 1e6 * given.time_s}
    first = {signal["name"]: float(value) for signal, value in zip(case.about["inputs"], case.inputs(given.z)[0], strict=True)}
    return {
        "solver": given.solver,
        "status": given.status.name,
        "iterations": given.iterations,
        "time_us": 1e6 * given.time_s,
        "objective": case.objective(given.z),
        "violation": case.violation(given.z),
        **given.residuals,
        "inputs": first,
        "difference": case.apart(given.z) if case.usable else None,
    }
