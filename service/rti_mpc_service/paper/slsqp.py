# SPDX-License-Identifier: Apache-2.0
"""
The paper's two algorithms as it describes them, by SLSQP, the sequential quadratic programming that comes with SciPy.

*Sequential*: the inputs are the variables (5), the model is rolled out inside
the cost, and gradients are numeric. *Simultaneous*: states and inputs are the
variables (6), the model is an equality constraint, and the gradients (7), (8)
are analytic. Both start from their last plan, shifted.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import Bounds, minimize

from rti_mpc.array import Array
from rti_mpc.codegen import bind, function
from rti_mpc.rti.ocp import Ocp
from rti_mpc_service.bench.yardstick import shifted


class Slsqp:
    """
    One of the paper's algorithms, with SciPy's default tolerance and limit of iterations.

    Args:
        ocp: The problem, `N_u` being `N`.
        formulation: ``"sequential"`` or ``"simultaneous"``.
    """

    def __init__(self, ocp: Ocp, formulation: str) -> None:
        model, N = ocp.model, ocp.N
        self._nx, self._nu, self._N = nx, nu, _ = model.nx, model.nu, N
        self._sequential = formulation == "sequential"
        x0, u_prev, y_ref = ca.SX.sym("x0", nx), ca.SX.sym("u_prev", nu), ca.SX.sym("y_ref", model.ny, N)
        x, u = ca.SX.sym("x", nx, N), ca.SX.sym("u", nu, N)
        phi, p = ocp.phi(), ca.DM(model.p_nominal)
        if self._sequential:
            states = [x0]
            for k in range(N):
                states.append(phi(states[-1], u[:, k], p))
            x, z = ca.horzcat(*states[1:]), ca.vec(u)
            speeds = x[list(ocp.soft), :]
            constraint = ca.veccat(
                speeds - ca.DM(np.tile(ocp.lbx[list(ocp.soft)], (N, 1)).T), ca.DM(np.tile(ocp.ubx[list(ocp.soft)], (N, 1)).T) - speeds
            )
            lower, upper = np.tile(ocp.lbu, N), np.tile(ocp.ubu, N)
        else:
            z, before = ca.veccat(x, u), ca.horzcat(x0, x[:, :-1])
            constraint = ca.vec(ca.horzcat(*(phi(before[:, k], u[:, k], p) for k in range(N))) - x)
            lower, upper = np.concatenate([np.tile(ocp.lbx, N), np.tile(ocp.lbu, N)]), np.concatenate([np.tile(ocp.ubx, N), np.tile(ocp.ubu, N)])
        h = ca.Function("h", [model.x, model.p], [model.y_expr])
        cost = ca.SX(0)
        for k in range(N):
            e, du = h(x[:, k], p) - y_ref[:, k], u[:, k] - (u[:, k - 1] if k else u_prev)
            cost += ocp.delta[k] * ca.bilin(ca.DM(ocp.Q), e, e) + ocp.lambda_[k] * ca.bilin(ca.DM(ocp.R), du, du)
        self._sample: tuple[Array, Array, Array] = (np.zeros(nx), np.zeros(nu), np.zeros((N, model.ny)))
        self._variables = np.zeros(z.numel())

        def evaluator(expr: ca.SX, shape: tuple[int, ...]) -> Any:
            """Return a function of the variables, at the present sample."""
            out = np.zeros(shape)
            symbols = {"z": z, "x0": x0, "u_prev": u_prev, "y_ref": y_ref}
            evaluate = bind(
                function("f", symbols, {"value": ca.densify(expr)}),
                dict(zip(symbols, (self._variables, *self._sample), strict=True)),
                {"value": out},
            )

            def value(variables: Array) -> Array:
                self._variables[:] = variables
                evaluate()
                return out.copy()

            return value

        value = evaluator(cost, (1,))
        self._problem: dict[str, Any] = {
            "fun": lambda variables: float(value(variables)[0]),
            "bounds": Bounds(lower, upper),
            "constraints": {"type": "ineq" if self._sequential else "eq", "fun": evaluator(constraint, (constraint.numel(),))},
        }
        if not self._sequential:
            self._problem["jac"] = evaluator(ca.gradient(cost, z), (z.numel(),))
            self._problem["constraints"]["jac"] = evaluator(ca.jacobian(constraint, z).T, (constraint.numel(), z.numel()))

    def reset(self, x0: Array) -> None:
        """Start cold, where the robot is."""
        self._z = np.concatenate([np.zeros(0) if self._sequential else np.tile(x0, self._N), np.zeros(self._N * self._nu)])

    def solve(self, x0: Array, u_prev: Array, y_ref: Array) -> Array:
        """Return the first input of the plan, shape ``(nu,)``; `y_ref` at nodes 1 to N, shape ``(N, ny)``."""
        for now, value in zip(self._sample, (x0, u_prev, y_ref), strict=True):
            now[:] = value
        z = minimize(x0=self._z, method="SLSQP", **self._problem).x
        x, u = z[: -self._N * self._nu], z[-self._N * self._nu :]
        self._z = np.concatenate([shifted(x, self._nx) if x.size else x, shifted(u, self._nu)])
        return np.asarray(u[: self._nu])
