# SPDX-License-Identifier: Apache-2.0
"""
Yardstick: IPOPT from the CasADi wheel, warm-started, on the same problem, to convergence.

It uses scalar expressions that are not compiled, the exact Hessian, and hard bounds
unless softened; primal and dual solutions are shifted from sample to sample.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.rti.ocp import Ocp

IPOPT_OPTIONS: dict[str, Any] = {
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
    Converged NMPC: multiple shooting, states, inputs and slacks as variables.

    Attributes:
        u: First input of the last solution, shape ``(nu,)``.

    Args:
        ocp: The problem.
        softened: Whether bounds on states and general constraints have slacks, at the problem's weights; hard otherwise.
    """

    def __init__(self, ocp: Ocp, *, softened: bool = False) -> None:
        model, N, N_u, soft = ocp.model, ocp.N, ocp.N_u, list(ocp.soft)
        ng = ocp.ng if softened else 0
        self._nx, self._nu, self._ng, self._N, self._N_u = model.nx, model.nu, ng, N, N_u
        x, u, s = ca.SX.sym("x", model.nx, N + 1), ca.SX.sym("u", model.nu, N_u), ca.SX.sym("s", ng, N)
        x0, u_prev = ca.SX.sym("x0", model.nx), ca.SX.sym("u_prev", model.nu)
        y_ref, p = ca.SX.sym("y_ref", model.ny, N), ca.SX.sym("p", model.np_, N + 1)
        phi = ocp.phi()
        outputs = ca.Function("outputs", [model.x, model.u, model.p], [model.y_expr, model.x[soft], ocp.h_expr])
        z, Z = np.concatenate([ocp.z[soft], ocp.zh]), np.concatenate([ocp.Z[soft], ocp.Zh])
        slewed = bool(np.isfinite([ocp.lbdu, ocp.ubdu]).any())
        none: Array = np.zeros(model.nx)
        cost, rows = ca.SX(0), [(x[:, 0] - x0, none, none)]
        for k in range(N):
            j = int(ocp.held[k])
            held = u[:, j]
            rows.append((phi(x[:, k], held, p[:, k]) - x[:, k + 1], none, none))
            y, bounded, h = outputs(x[:, k + 1], held, p[:, k + 1])
            e = y - y_ref[:, k]
            cost += ca.bilin(ca.DM(ocp.Q_at(k) + (ocp.Q_e if k == N - 1 else 0.0)), e, e)
            if softened:
                g, infinite = ca.vertcat(bounded, h), np.full(ng, np.inf)
                rows += [(g + s[:, k], ocp.lg, infinite), (g - s[:, k], -infinite, ocp.ug)]
                cost += ca.dot(z, s[:, k]) + 0.5 * ca.dot(Z, s[:, k] ** 2)
            else:
                rows.append((h, ocp.lh, ocp.uh))
            if k == ocp.starts[j]:
                du = held - (u[:, j - 1] if j else u_prev)
                cost += ca.bilin(ca.DM(ocp.R_at(j)), du, du)
                if slewed:
                    rows.append((du, ocp.lbdu, ocp.ubdu))
        nlp = {"x": ca.veccat(x, u, s), "f": cost, "g": ca.veccat(*(row for row, _, _ in rows)), "p": ca.veccat(x0, u_prev, y_ref, p)}
        self._solver = ca.nlpsol("ipopt", "ipopt", nlp, IPOPT_OPTIONS)
        self._lbg, self._ubg = (np.concatenate(bounds) for bounds in list(zip(*rows, strict=True))[1:])
        free, slack = np.full(model.nx, np.inf), np.zeros(N * ng)
        lbx, ubx = (-free, free) if softened else (ocp.lbx, ocp.ubx)
        self._lb = np.concatenate([-free, np.tile(lbx, N), np.tile(ocp.lbu, N_u), slack])
        self._ub = np.concatenate([free, np.tile(ubx, N), np.tile(ocp.ubu, N_u), slack + np.inf])
        self._p: Array = np.tile(np.array(model.p_nominal), (N + 1, 1))
        self.u: Array = np.zeros(model.nu)

    def reset(self, x0: Array, u0: Array | None = None) -> None:
        """Start cold from the state `x0`, with the inputs at `u0`, shape ``(nu,)``, 0 if left out."""
        inputs = np.zeros(self._nu) if u0 is None else u0
        self._z = np.concatenate([np.tile(x0, self._N + 1), np.tile(inputs, self._N_u), np.zeros(self._N * self._ng)])
        self._lam_z, self._lam_g = np.zeros_like(self._z), np.zeros_like(self._lbg)

    def solve(self, x0: Array, u_prev: Array, y_ref: Array, p: Array | None = None) -> Array:
        """
        Return the first input of the optimal plan, shape ``(nu,)``.

        Args:
            x0: State at node 0, shape ``(nx,)``.
            u_prev: Input before the plan, shape ``(nu,)``.
            y_ref: Reference at nodes 1 to N, shape ``(N, ny)``.
            p: Stage parameters at nodes 0 to N, shape ``(N + 1, np)``; nominal ones if left out.
        """
        result = self._solver(
            x0=self._z,
            lam_x0=self._lam_z,
            lam_g0=self._lam_g,
            p=np.concatenate([x0, u_prev, y_ref.ravel(), (self._p if p is None else p).ravel()]),
            lbg=self._lbg,
            ubg=self._ubg,
            lbx=self._lb,
            ubx=self._ub,
        )
        z, lam_z, lam_g = (np.array(result[name]).ravel() for name in ("x", "lam_x", "lam_g"))
        to_u = (self._N + 1) * self._nx
        to_s = to_u + self._N_u * self._nu
        self.u = z[to_u : to_u + self._nu].copy()
        widths = (slice(0, to_u), self._nx), (slice(to_u, to_s), self._nu), (slice(to_s, None), self._ng)
        self._z, self._lam_z = (np.concatenate([shifted(v[part], width) for part, width in widths]) for v in (z, lam_z))
        first, stages = lam_g[: self._nx], lam_g[self._nx :]
        if self._N_u == self._N:  # as many rows in each stage, the dynamics first
            first, stages = stages[: self._nx], shifted(stages, len(stages) // self._N)
        self._lam_g = np.concatenate([first, stages])
        return self.u


def shifted(values: Array, width: int) -> Array:
    """Return stages of `width` values each, shifted by one stage, with the last one repeated."""
    return np.concatenate([values[width:], values[-width:]]) if width else values
