# SPDX-License-Identifier: Apache-2.0
"""
The yardstick that everybody can run: IPOPT from the CasADi wheel, warm, on the same problem to convergence.

Scalar expressions, not compiled, exact Hessian, hard bounds; primal and dual
solutions shifted from sample to sample.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.ocp import Ocp

OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-8,
    "ipopt.mu_init": 1e-3,
    "ipopt.warm_start_init_point": "yes",
    **{f"ipopt.{name}": 1e-8 for name in ("bound_push", "bound_frac")},
    **{f"ipopt.warm_start_{name}": 1e-8 for name in ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")},
}


class Ipopt:
    """
    Converged NMPC: multiple shooting, states and inputs as variables, bounds on states hard.

    Attributes:
        u: First input of the last solution, shape ``(nu,)``.
    """

    def __init__(self, ocp: Ocp) -> None:
        model, N = ocp.model, ocp.N
        self._nx, self._nu, self._N = nx, nu, _ = model.nx, model.nu, N
        x, u = ca.SX.sym("x", nx, N + 1), ca.SX.sym("u", nu, N)
        x0, u_prev, y_ref = ca.SX.sym("x0", nx), ca.SX.sym("u_prev", nu), ca.SX.sym("y_ref", model.ny, N)
        phi, p = ocp.phi(), ca.DM(model.p_nominal)
        h = ca.Function("h", [model.x, model.p], [model.y_expr])
        cost, rows = ca.SX(0), [x[:, 0] - x0]
        for k in range(N):
            rows.append(phi(x[:, k], u[:, k], p) - x[:, k + 1])
            e = h(x[:, k + 1], p) - y_ref[:, k]
            du = u[:, k] - (u[:, k - 1] if k else u_prev)
            cost += ocp.delta[k] * ca.bilin(ca.DM(ocp.Q), e, e) + ocp.lambda_[k] * ca.bilin(ca.DM(ocp.R), du, du)
        nlp = {"x": ca.veccat(x, u), "f": cost, "g": ca.veccat(*rows), "p": ca.veccat(x0, u_prev, y_ref)}
        self._solver = ca.nlpsol("ipopt", "ipopt", nlp, OPTIONS)
        free = np.full(nx, np.inf)
        self._lb = np.concatenate([-free, np.tile(ocp.lbx, N), np.tile(ocp.lbu, N)])
        self._ub = np.concatenate([free, np.tile(ocp.ubx, N), np.tile(ocp.ubu, N)])
        self.u: Array = np.zeros(nu)

    def reset(self, x0: Array) -> None:
        """Start cold, where the robot is."""
        self._z = np.concatenate([np.tile(x0, self._N + 1), np.zeros(self._N * self._nu)])
        self._lam_z, self._lam_g = np.zeros_like(self._z), np.zeros((self._N + 1) * self._nx)

    def solve(self, x0: Array, u_prev: Array, y_ref: Array) -> Array:
        """Return the first input of the optimal plan, shape ``(nu,)``; `y_ref` at nodes 1 to N, shape ``(N, ny)``."""
        result = self._solver(
            x0=self._z,
            lam_x0=self._lam_z,
            lam_g0=self._lam_g,
            p=np.concatenate([x0, u_prev, y_ref.ravel()]),
            lbg=0,
            ubg=0,
            lbx=self._lb,
            ubx=self._ub,
        )
        z, lam_z, lam_g = (np.array(result[name]).ravel() for name in ("x", "lam_x", "lam_g"))
        to_u = (self._N + 1) * self._nx
        self.u = z[to_u : to_u + self._nu].copy()
        self._z, self._lam_z = (np.concatenate([shifted(v[:to_u], self._nx), shifted(v[to_u:], self._nu)]) for v in (z, lam_z))
        self._lam_g = shifted(lam_g, self._nx)
        return self.u


def shifted(values: Array, width: int) -> Array:
    """Return stages of a width moved on by one, the last repeated."""
    return np.concatenate([values[width:], values[-width:]])
