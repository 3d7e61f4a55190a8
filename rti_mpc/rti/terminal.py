# SPDX-License-Identifier: Apache-2.0
r"""
Terminal weight from the linear-quadratic regulator: the cost after the horizon, as if it went on for ever.

Around a point of motion the dynamics are :math:`x^+ = A x + B u`, the outputs
:math:`y = C x`, or :math:`y = C x + D u` where they depend on the input before. With the previous input as a further state, and the increments
:math:`v` as inputs,

.. math::

    \begin{bmatrix} x \\ u \end{bmatrix}^+ =
    \begin{bmatrix} A & B \\ 0 & I \end{bmatrix} \begin{bmatrix} x \\ u \end{bmatrix} + \begin{bmatrix} B \\ I \end{bmatrix} v ,

the cost to go is :math:`\xi^T S \xi`, with S from the Riccati equation. A reference
gives no values for states that are not outputs. The cost is minimised over them, which
leaves the Schur complement of S in the outputs.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.tangent import tangent

MAX_RADIUS = 1.0 - 1e-9  # of the eigenvalues of a regulated robot: slower than 1e9 samples is not at all


def lqr_weight(ocp: Ocp, x: Array, u: Array) -> Array:
    """
    Return the terminal weight `Q_e` that continues a horizon for ever.

    Args:
        ocp: The problem, of which the dynamics, `Q`, `R` and the last of `delta` and `lambda_` are used.
        x: State to linearize at, shape ``(nx,)``; a wheeled robot must be in motion, or it cannot be stabilized.
        u: Input there, shape ``(nu,)``.

    Returns:
        The weight, shape ``(ny, ny)``, symmetric, without the last stage's own ``delta_N Q``.

    Raises:
        OcpError: The linearization cannot be stabilized, or an argument is none.
        ShapeError: A shape does not fit.
    """
    model = given.instance("ocp", ocp, Ocp).model
    x, u = given.array("x", x, (model.nx,)), given.array("u", u, (model.nu,))
    phi, p, space = ocp.phi(), np.array(model.p_nominal), tangent(model)
    y_ref = ca.SX.sym("y_ref", model.ny)
    changes = phi(model.x, model.u, model.p), model.residual(model.y_expr, y_ref)
    sensitivities = ca.Function(
        "sensitivities",
        [model.x, model.u, model.p, y_ref],
        [*(ca.jacobian(expr, z) for expr in changes for z in (model.x, model.u)), space.basis, space.inverse],
    )
    at = x, u, p
    A, B, C, D, basis, inverse = (np.array(M) for M in sensitivities(*at, model.outputs_at()(*at)))
    A, B, C = inverse @ A @ basis, inverse @ B, C @ basis
    weighed = [j for j in range(model.ny) if j not in {places[0] for places in model.rotations("outputs").quaternions}]
    nx, nu = B.shape
    F = np.block([[A, B], [np.zeros((nu, nx)), np.eye(nu)]])
    G = np.vstack([B, np.eye(nu)])
    C, Q = np.hstack([C, D])[weighed], ocp.Q_at(ocp.N - 1)[np.ix_(weighed, weighed)]
    try:
        of_inputs = np.diag([*np.zeros(nx), *np.atleast_2d(ocp.R_u)[-1]])
        R = ocp.R_at(ocp.N_u - 1)
        S = solve_discrete_are(F, G, C.T @ Q @ C + of_inputs, R)
        # Whether an equation without a stabilizing solution is noticed above depends on rounding; its closed loop never contracts.
        radius = abs(np.linalg.eigvals(F - G @ np.linalg.solve(R + G.T @ S @ G, G.T @ S @ F))).max()
        if not radius < MAX_RADIUS:
            raise LinAlgError(f"a motion is left that decays by {max(1.0 - radius, 0.0):.2g} per sample")
    except (LinAlgError, ValueError) as error:
        raise OcpError(f"model {model.name} must be stabilizable where a terminal weight is wanted, at x = {x}, u = {u}: {error}") from error
    # The least of xi' S xi over all xi of one output y is y' (C S^-1 C')^-1 y.
    weight: Array = np.zeros((model.ny, model.ny))
    size = np.sqrt(np.where(np.diag(S) > 0.0, np.diag(S), 1.0))  # the pseudo-inverse leaves out what is small, whatever its unit
    C = C / size
    weight[np.ix_(weighed, weighed)] = np.linalg.inv(C @ np.linalg.pinv(S / np.outer(size, size)) @ C.T) - Q
    return np.asarray((weight + weight.T) / 2)
