# SPDX-License-Identifier: Apache-2.0
r"""Explicit integrator over one stage, :math:`x_{k+1} = \phi(x_k, u_k, p)`, with the input held constant."""

from __future__ import annotations

import casadi as ca

from rti_mpc import given
from rti_mpc.model.model import Model

# Butcher tableaus (A, b) of the explicit schemes: Euler is equation (11) of [Rosales]_.
TABLEAUS: dict[str, tuple[list[list[float]], list[float]]] = {
    "euler": ([[]], [1.0]),
    "rk4": ([[], [1 / 2], [0, 1 / 2], [0, 0, 1]], [1 / 6, 1 / 3, 1 / 3, 1 / 6]),
}


def integrator(model: Model, method: str = "rk4", substeps: int = 1) -> ca.Function:
    """
    Build one integration step.

    Args:
        model: The dynamics f(x, u, p).
        method: ``"euler"`` or ``"rk4"``.
        substeps: Number of equal steps into which `dt` is divided.

    Returns:
        SX function ``phi(x, u, p, dt) -> x_next``; `dt` in seconds, of either sign.

    Raises:
        OcpError: The method is unknown, or `substeps` is below 1.
    """
    given.instance("model", model, Model)
    given.one_of("integrator", method, TABLEAUS)
    substeps = given.whole("substeps", substeps, 1)
    rows, weights = TABLEAUS[method]
    f = ca.Function("f", [model.x, model.u, model.p], [model.f_expl_expr])
    dt = ca.SX.sym("dt")
    h = dt / substeps
    x = model.x
    for _ in range(substeps):
        slopes: list[ca.SX] = []
        for row in rows:
            increment = sum((a * slope for a, slope in zip(row, slopes, strict=False) if a), start=ca.SX(0))
            slopes.append(f(x + h * increment, model.u, model.p))
        x = x + h * sum((b * slope for b, slope in zip(weights, slopes, strict=True)), start=ca.SX(0))
    return ca.Function("phi", [model.x, model.u, model.p, dt], [x], ["x", "u", "p", "dt"], ["x_next"])
