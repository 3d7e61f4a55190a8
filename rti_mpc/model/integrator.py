# SPDX-License-Identifier: Apache-2.0
r"""
Integrators over one stage, :math:`x_{k+1} = \phi(x_k, u_k, p)`, with the input held constant.

Euler and RK4 are explicit. ``irk`` is Radau IIA, the collocation at Radau's points
[HairerWanner1996]_: its stages solve

.. math::

    K_i = f(x + h \sum_j a_{ij} K_j, u, p)

by a fixed number of Newton steps. It is stable for any stage, however fast a motion of the
model decays, and such a motion ends within one step. Its sensitivities are those of the
implicit function theorem. Where its Newton steps have not converged the state is NaN,
which whoever uses it treats as a model that is not finite.

A model in discrete time is its own integrator. Between two of its samples its state is
interpolated.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from rti_mpc import given
from rti_mpc.model.model import IRK, Model

# Butcher tableaus (A, b) of the explicit schemes: Euler is equation (11) of [Rosales]_.
TABLEAUS: dict[str, tuple[list[list[float]], list[float]]] = {
    "euler": ([[]], [1.0]),
    "rk4": ([[], [1 / 2], [0, 1 / 2], [0, 0, 1]], [1 / 6, 1 / 3, 1 / 3, 1 / 6]),
}
NEWTON_STEPS = 5  # of an implicit step
NEWTON_TOLERANCE = 1e-6  # on what a stage's rates do not fulfil of its equations, relative to the magnitude of their terms, which knows no unit


def integrator(model: Model, method: str | None = None, substeps: int = 1) -> ca.Function:
    """
    Build one integration step.

    Args:
        model: The dynamics.
        method: ``"euler"``, ``"rk4"`` or ``"irk"``; the model's own by default, with its own number of steps.
        substeps: Number of equal steps into which `dt` is divided; of them each is divided into the model's own.

    Returns:
        SX function ``phi(x, u, p, dt) -> x_next``; `dt` in seconds, of either sign.

    Raises:
        OcpError: The method is unknown, or `substeps` is below 1.
    """
    dt = ca.SX.sym("dt")
    x_next = steps(model, dt, method, substeps, derivatives=False)[0]
    return ca.Function("phi", [model.x, model.u, model.p, dt], [x_next], ["x", "u", "p", "dt"], ["x_next"])


def sensitivities(model: Model, dt: Any, method: str | None = None, substeps: int = 1) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """
    Return the state after a step, with its sensitivities to state, input and parameters, as expressions of the model's symbols.

    Args:
        model: As for `integrator`, and the same for the others.
        dt: Duration in s, a number or a symbol.
        method: As there.
        substeps: As there.

    Returns:
        Shapes ``(nx, 1)``, ``(nx, nx)``, ``(nx, nu)``, ``(nx, np)``.
    """
    x_next, A, B, D = steps(model, dt, method, substeps, derivatives=True)
    return x_next, A, B, D


def steps(model: Model, dt: Any, method: str | None = None, substeps: int = 1, *, derivatives: bool = False) -> tuple[ca.SX, ...]:
    """Return `sensitivities`; without derivatives the state alone matters."""
    given.instance("model", model, Model)
    substeps = given.whole("substeps", substeps, 1)
    if model.dt is not None:
        x_next = interpolated(model, dt, substeps)
    else:
        method = given.one_of("integrator", model.method if method is None else method, (*TABLEAUS, IRK))
        substeps *= model.sim_method_num_steps
        if method == IRK:
            return implicit(model, dt, substeps, derivatives=derivatives)
        x_next = explicit(model, dt, method, substeps)
    about = (model.x, model.u, model.p) if derivatives else ()
    return x_next, *(ca.jacobian(x_next, symbol) for symbol in about)


def explicit(model: Model, dt: Any, method: str, substeps: int) -> ca.SX:
    """Return the state after explicit steps."""
    rows, weights = TABLEAUS[method]
    f = ca.Function("f", [model.x, model.u, model.p], [model.rate_expr])
    h = dt / substeps
    x = model.x
    for _ in range(substeps):
        slopes: list[ca.SX] = []
        for row in rows:
            increment = sum((a * slope for a, slope in zip(row, slopes, strict=False) if a), start=ca.SX(0))
            slopes.append(f(x + h * increment, model.u, model.p))
        x = x + h * sum((b * slope for b, slope in zip(weights, slopes, strict=True)), start=ca.SX(0))
    return x


def interpolated(model: Model, dt: Any, periods: int) -> ca.SX:
    """Return the state of a model in discrete time after so many equal steps, each of one period, or interpolated within it."""
    assert model.dt is not None
    after = ca.Function("after", [model.x, model.u, model.p], [model.disc_dyn_expr])
    share = dt / (periods * model.dt)
    x = model.x
    for _ in range(periods):
        x_next = after(x, model.u, model.p)
        x = x_next if isinstance(share, float) and share == 1.0 else x + share * (x_next - x)
    return x


def radau(stages: int) -> np.ndarray[Any, Any]:
    """Return the matrix of Radau IIA, shape ``(stages, stages)``; its last row is that of the weights."""
    c = np.array(ca.collocation_points(stages, "radau"))
    powers = np.arange(stages)
    return np.asarray(np.linalg.solve((c[:, None] ** powers).T, (c[:, None] ** (powers + 1) / (powers + 1)).T).T)


def implicit(model: Model, dt: Any, substeps: int, *, derivatives: bool) -> tuple[ca.SX, ...]:
    """Return `sensitivities` of implicit steps: those of the implicit function theorem, one step after the other."""
    h = ca.SX.sym("h")
    one = ca.Function("step", [model.x, model.u, model.p, h], implicit_step(model, h, derivatives=derivatives))
    x = model.x
    S = [ca.SX.eye(model.nx), ca.SX(model.nx, model.nu), ca.SX(model.nx, model.np_)] if derivatives else []
    for _ in range(substeps):
        x, *more = one.call([x, model.u, model.p, ca.SX(dt / substeps)])
        if derivatives:
            A, B, D = more
            S = [A @ S[0], A @ S[1] + B, A @ S[2] + D]
    return x, *S


def implicit_step(model: Model, h: ca.SX, *, derivatives: bool) -> list[ca.SX]:
    """
    Return one implicit step of `h` seconds and, if they are asked for, its sensitivities.

    Backwards, the step forwards is mirrored: to go back along a motion that decays fast would blow errors up.
    """
    x, u, p = model.x, model.u, model.p
    nx, stages, a = model.nx, model.sim_method_num_stages, radau(model.sim_method_num_stages)
    rates = ca.Function("rates", [x, u, p], [model.rate_expr, *(ca.jacobian(model.rate_expr, symbol) for symbol in (x, u, p))])
    span = ca.fabs(h)

    def equations(K: ca.SX) -> tuple[Any, Any, Any, Any]:
        """Return the residual of the stages, their matrix, the sensitivities of their rates to x, u and p at fixed K, and the size of their terms."""
        K_i = ca.horzsplit(ca.reshape(K, nx, stages))
        x_i = [x + span * sum((a[i, j] * K_i[j] for j in range(stages)), start=ca.SX(0)) for i in range(stages)]
        at = [rates(x_i[i], u, p) for i in range(stages)]
        residual = ca.vertcat(*(K_i[i] - at[i][0] for i in range(stages)))
        blocks = [[ca.SX.eye(nx) * (i == j) - span * a[i, j] * at[i][1] for j in range(stages)] for i in range(stages)]
        sizes = [
            sum((ca.fabs(J) @ ca.fabs(of) for J, of in zip(at[i][1:], (x_i[i], u, p), strict=True)), start=ca.fabs(K_i[i])) for i in range(stages)
        ]
        terms = ca.vertcat(*(ca.fabs(x) + span * size for size in sizes))
        return residual, ca.sparsify(ca.blockcat(blocks)), ca.vertcat(*(ca.horzcat(*at[i][1:]) for i in range(stages))), terms

    K = ca.SX.zeros(nx * stages)
    for _ in range(NEWTON_STEPS):
        residual, matrix, _, _ = equations(K)
        K = K - eliminated(matrix, residual)
    residual, matrix, by, terms = equations(K)
    weights = ca.sparsify(ca.DM(np.kron(a[-1:], np.eye(nx))))
    solved = ca.logic_and(ca.mmax(span * ca.fabs(residual) - NEWTON_TOLERANCE * terms) <= 0, ca.sum1(terms) < np.inf)
    failed = ca.logic_not(solved)
    found = [x + h * (weights @ K) + ca.if_else(failed, np.nan, 0.0)]
    if derivatives:
        S = h * (weights @ eliminated(matrix, by))
        found += [ca.SX.eye(nx) + S[:, :nx], S[:, nx : nx + model.nu], S[:, nx + model.nu :]]
    return list(ca.cse(found))


def eliminated(matrix: ca.SX, rhs: ca.SX) -> ca.SX:
    """
    Solve linear equations by elimination in expressions, structural zeros left out.

    Without pivots: those of ``I - h a J`` are at least 1 where motions decay, and the residual of the stages is checked.
    """
    n = matrix.shape[0]
    rows, right = [matrix[i, :] for i in range(n)], [rhs[i, :] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            if rows[i].sparsity().has_nz(0, k):
                factor = rows[i][k] / rows[k][k]
                rows[i], right[i] = rows[i] - factor * rows[k], right[i] - factor * right[k]
                rows[i][k] = 0
                rows[i] = ca.sparsify(rows[i])
    for k in reversed(range(n)):
        right[k] = right[k] / rows[k][k]
        for i in range(k):
            if rows[i].sparsity().has_nz(0, k):
                right[i] = right[i] - rows[i][k] * right[k]
    return ca.vertcat(*right)
