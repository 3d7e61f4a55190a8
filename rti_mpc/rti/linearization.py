# SPDX-License-Identifier: Apache-2.0
r"""
Linear-quadratic approximation of the OCP at a guess, stage by stage: the data of every formulation.

At a guess :math:`(x, u)`, in the deviations
:math:`\Delta x_k = x_k^+ - x_k`, :math:`\Delta u_k = u_k^+ - u_k`, the
dynamics and outputs of `rti_mpc.rti.ocp` become

.. math::

    \Delta x_0 &= \bar x_0 - x_0 \\
    \Delta x_{k+1} &= A_k \Delta x_k + B_k \Delta u_k + b_k, \qquad b_k = \phi(x_k, u_k, p_k) - x_{k+1} \\
    y_i &\approx y(x_i, u_{i-1}, p_i) + C_i \Delta v_i, \qquad v_i = x_i \text{, or } (x_i, u_{i-1}) \text{ where outputs depend on inputs,}

and the cost becomes its Gauss-Newton approximation. It is halved, to have the form
:math:`\tfrac12 z^T P z + q^T z` of a QP.

Gauss-Newton neglects a part of the curvature, residual times second derivative. Far from
the reference this is the larger part, and full steps oscillate. So steps are damped in
proportion to the cost at the guess (Levenberg-Marquardt [FanYuan2005]_): there is no
damping where the reference is met, and the optimum stays the same. Where the reference is
further away than inputs move the robot over the horizon, in proportion to the distance:
what is neglected grows no faster, and what a step saves does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.codegen import function
from rti_mpc.rti.blocks import all_inputs, at_each, at_starts, moved_on, summed
from rti_mpc.rti.columns import over_columns
from rti_mpc.rti.ocp import ARGUMENTS, Ocp

DAMPING_PER_COST = 0.005  # weight of half the square of a step, in half ranges of an input, per cost within reach at the guess; see docs/engine.md


class Forms(NamedTuple):
    """
    The part of a linearization that a structured solver needs, as expressions; see `Linearization` for each. Columns are stages or nodes.

    Attributes:
        A: Nonzeros of the sensitivities to the state, shape ``(nnz, N)``.
        B: Nonzeros of the sensitivities to the input, shape ``(nnz, N)``.
        b: Defects, shape ``(nx, N)``.
        H: Nonzeros of the Hessian of half the output cost, shape ``(nnz, N)``.
        h: Gradient of half the output cost, shape ``(nx, N)``, or ``(nx + nu, N)`` where outputs depend on inputs.
        force: Gradient of half the increment cost in the increments, shape ``(nu, N_u)``.
        increments: Increments, shape ``(nu, N_u)``.
        g: Expressions with softened bounds, shape ``(ng, N)``.
        g_x: Nonzeros of the sensitivities of g to the state, shape ``(nnz, N)``.
        g_u: Nonzeros of the sensitivities of g to the input, shape ``(nnz, N)``.
        damping: Weight of half the square of a step in each input, shape ``(nu, 1)``, or ``(nu, N_u)`` where `R_u` differs from block to block.
        checksum: A number that is finite if and only if all of this is.
        cost: The cost (4) at the guess.
    """

    A: ca.MX
    B: ca.MX
    b: ca.MX
    H: ca.MX
    h: ca.MX
    force: ca.MX
    increments: ca.MX
    g: ca.MX
    g_x: ca.MX
    g_u: ca.MX
    damping: ca.MX
    checksum: ca.MX
    cost: ca.MX


class Linearization:
    """
    Expressions of the linearization of one sample. Columns are stages or nodes.

    Attributes:
        x: State guess, shape ``(nx, N + 1)``.
        u: Input guess, shape ``(nu, N_u)``.
        u_prev: Input before the plan, shape ``(nu, 1)``.
        y_ref: Reference, shape ``(ny, N)``.
        p: Stage parameters, shape ``(np, N + 1)``.
        w: The weights and bounds, by the names in `ARGUMENTS`.
        scale_x: Scales of the states, see `rti_mpc.rti.scale`, shape ``(nx, 1)``; `scale_u` those of the inputs, `scale_g` those of g.
        A: Sensitivities to the state, nonzeros of `A_k` column by column, shape ``(nnz, N)``.
        B: Sensitivities to the input, nonzeros of `B_k`, shape ``(nnz, N)``.
        A_k: Sparsity of A at one stage, shape ``(nx, nx)``.
        B_k: Sparsity of B at one stage, shape ``(nx, nu)``.
        b: Defects, shape ``(nx, N)``.
        gradient: Gradient of half the output cost in the states at nodes 1 to N, shape ``(nx, N)``; where outputs depend on inputs, those in the
            inputs of the stages before follow, shape ``(nx + nu, N)``.
        hessian: Gauss-Newton Hessian of half the output cost, nonzeros of `H_i`, shape ``(nnz, N)``.
        H_i: Sparsity of the Hessian at one node, symmetric, shape ``(nx, nx)`` or ``(nx + nu, nx + nu)``.
        g: Expressions with softened bounds at nodes 1 to N: states, general constraints, then states bounded at node N alone; shape ``(ng, N)``.
        g_x: Sensitivities of g to the state of the node, nonzeros of `G_x`, shape ``(nnz, N)``.
        g_u: Sensitivities of g to the input of the stage before the node, nonzeros of `G_u`, shape ``(nnz, N)``.
        G_x: Sparsity of the sensitivities to the state at one node, shape ``(ng, nx)``.
        G_u: Sparsity of the sensitivities to the input at one node, shape ``(ng, nu)``.
        lg: Lower bounds on g, shape ``(ng, 1)``, or ``(ng, N)`` where they differ from stage to stage; `ug`, upper bounds; `zg` and `Zg`, weights of
            the slacks, likewise.
        increments: ``u_k - u_{k-1}``, shape ``(nu, N_u)``.
        force: ``lambda_k R (u_k - u_{k-1})``, shape ``(nu, N_u)``, and the gradient of half the cost of inputs, summed from the last stage on: force
            acts on increments.
        damping: Weight of half the square of a step in each input, shape ``(nu, 1)``: that of inputs, and a damping, zero for a linear model;
            ``(nu, N_u)`` where `R_u` differs from block to block.
        R: Increment weight, sparse, shape ``(nu, nu)``.
        cost: The cost (4) at the guess.
        checksum: A number that is finite if and only if all of the above is.
        forms: The part of these that a structured solver needs.
        stages: All forms in one column.
    """

    def __init__(self, ocp: Ocp) -> None:
        model, N, N_u = ocp.model, ocp.N, ocp.N_u
        nx, nu = model.nx, model.nu
        self._blocks = ocp.blocks
        self._by_input = ocp.lambda_.ndim > 1  # whether the penalty on increments has a number for each input
        self.x = ca.MX.sym("x", nx, N + 1)
        self.u = ca.MX.sym("u", nu, N_u)
        self.u_prev = ca.MX.sym("u_prev", nu)
        self.y_ref = ca.MX.sym("y_ref", model.ny, N)
        self.p = ca.MX.sym("p", model.np_, N + 1)
        self.w = {name: ca.MX.sym(name, *np.shape(getattr(ocp, name))[::-1]) for name in ARGUMENTS}
        self._scale = ca.MX.sym("scale", scale_size(ocp))
        self.scale_x, self.scale_u, self.scale_g, reach = ca.vertsplit(self._scale, np.cumsum([0, nx, nu, ocp.ng, nx]).tolist())

        stage, self.A_k, self.B_k = linearize(ocp)
        inputs = all_inputs(self.u, ocp.blocks)
        stages = over_columns(stage, N)(self.x[:, :-1], inputs, self.p[:, :-1])
        to_B = nx + self.A_k.nnz()
        self.A, self.B = stages[nx:to_B, :], stages[to_B:, :]
        self.b = stages[:nx, :] - self.x[:, 1:]

        node, self.H_i = gauss_newton(ocp)
        if ocp.delta.ndim == 1:
            W = ca.kron(self.w["delta"].T, self.w["Q"])
        else:
            root = ca.sqrt(self.w["delta"])  # a column per stage
            W = ca.repmat(self.w["Q"], 1, N) * ca.kron(root, ca.DM.ones(1, model.ny)) * ca.repmat(ca.vec(root).T, model.ny, 1)
        W = ca.horzcat(W[:, : -model.ny], W[:, -model.ny :] + self.w["Q_e"])
        nv = self.H_i.size1()
        nodes = over_columns(node, N)(self.x[:, 1:], *([inputs] if nv > nx else []), self.p[:, 1:], self.y_ref, W)
        self.gradient, self.hessian = nodes[:nv, :], nodes[nv + 1 :, :]

        w = self.w
        constraint, self.G_x, self.G_u = constraints(ocp)
        bounded = over_columns(constraint, N)(self.x[:, 1:], inputs, self.p[:, 1:])
        to_x, to_u = ocp.ng, ocp.ng + self.G_x.nnz()
        self.g, self.g_x, self.g_u = bounded[:to_x, :], bounded[to_x:to_u, :], bounded[to_u:, :]
        self.lg, self.ug = softened(ocp, w, "lbx", "lh", "lbx_e"), softened(ocp, w, "ubx", "uh", "ubx_e")
        self.zg, self.Zg = softened(ocp, w, "z", "zh", "z"), softened(ocp, w, "Z", "Zh", "Z")
        if ocp.soft_e:
            self._bound_at_the_end_alone(ocp)

        self.increments = self.u - ca.horzcat(self.u_prev, self.u[:, :-1])
        self.R = self.w["R"] * pattern(ocp.R)
        self.force = self.weighed(self.increments)
        self.cost = ca.sum2(nodes[nv, :]) + ca.dot(self.increments, self.force)
        if ocp.R_u.any():
            off = self.u - input_reference(ocp)(at_starts(self.p, ocp.blocks))
            gradient = at_each(w["R_u"], N_u) * off
            self.force += running_sum(gradient)
            self.cost += ca.dot(off, gradient)
        H, size = ca.MX(self.H_i, ca.sum2(self.hessian)), ca.vertcat(reach, self.scale_u)[:nv]
        within_reach = ca.dot(ca.diag(H), size**2)  # about the cost of outputs that are off by what inputs change over the horizon
        geometric_mean = ca.sqrt(ca.fmax(0, self.cost * within_reach))  # rounding takes a cost of zero below it
        self.damping = damping(ocp) * ca.fmin(self.cost, geometric_mean) / self.scale_u**2
        if ocp.R_u.any():
            self.damping = (self.damping if ocp.R_u.ndim == 1 else ca.repmat(self.damping, 1, N_u)) + w["R_u"]
        self.checksum = ca.sum1(ca.vec(stages)) + ca.sum1(ca.vec(nodes)) + self.cost + ca.sum1(ca.vec(self.b))
        self.checksum += ca.sum1(ca.vec(bounded))
        self.forms = Forms(
            A=self.A,
            B=self.B,
            b=self.b,
            H=self.hessian,
            h=self.gradient,
            force=self.force,
            increments=self.increments,
            g=self.g,
            g_x=self.g_x,
            g_u=self.g_u,
            damping=self.damping,
            checksum=self.checksum,
            cost=self.cost,
        )
        self.stages = ca.veccat(*self.forms)

    def _bound_at_the_end_alone(self, ocp: Ocp) -> None:
        """Let the rows of `soft_e` be inside their bounds, whatever the state is, at all nodes but the last."""
        rows = slice(ocp.ng_path, ocp.ng)
        above, below = (np.isfinite(ocp.tightest(name)[rows]).astype(float) for name in ("lg", "ug"))  # 1 where there is such a bound
        lower, upper = (bounds if bounds.size2() == 1 else bounds[:, -1] for bounds in (self.lg, self.ug))
        inside = lower[rows] * above + upper[rows] * below + self.scale_g[rows] * (above - below)
        inside = inside / (above + below)  # halfway between two bounds, or one scale from the only one
        early = ca.repmat(inside, 1, ocp.N - 1)
        self.g = ca.vertcat(self.g[: ocp.ng_path, :], ca.horzcat(early, self.g[rows, -1]))
        acts = np.ones((self.G_x.nnz(), ocp.N))
        acts[np.array(self.G_x.get_triplet()[0]) >= ocp.ng_path, :-1] = 0.0
        self.g_x = self.g_x * ca.DM(acts)

    @property
    def arguments(self) -> dict[str, ca.MX]:
        """Arguments of all data of a sample, by name, in the order of the compiled functions."""
        return self.sample | self.weights

    @property
    def weights(self) -> dict[str, ca.MX]:
        """Arguments that stay from sample to sample: weights and bounds, by the names in `ARGUMENTS`, and the scale."""
        return self.w | {"scale": self._scale}

    @property
    def sample(self) -> dict[str, ca.MX]:
        """Arguments that change from sample to sample: all but the weights."""
        return {"x": self.x, "u": self.u, "u_prev": self.u_prev, "y_ref": self.y_ref, "p": self.p}

    def forms_in(self, stages: ca.MX) -> Forms:
        """Return the forms from a column like `stages`."""
        return Forms(*divided(stages, self.forms))

    def begins(self) -> dict[str, int]:
        """Return where each form begins in a column like `stages`, by name."""
        ends = np.cumsum([form.numel() for form in self.forms]).tolist()
        return dict(zip(Forms._fields, [0, *ends], strict=False))

    def weighed(self, increments: ca.MX) -> ca.MX:
        """Return ``R_k du_k`` of increments, a column per block, shape ``(nu, N_u)``."""
        lambda_ = self.w["lambda_"]
        if not self._by_input:
            return ca.MX((self.R @ increments) * ca.repmat(lambda_.T, increments.size1(), 1))
        root = ca.sqrt(lambda_)
        return ca.MX(root * (self.R @ (root * increments)))

    @property
    def R_k(self) -> ca.MX:
        """Nonzeros of the increment weight of each block, a column per block, where these differ by more than a factor."""
        root, (rows, columns) = ca.sqrt(self.w["lambda_"]), self.R.sparsity().get_triplet()
        return ca.MX(at_each(nonzeros(self.R), root.size2()) * root[rows, :] * root[columns, :])

    def increment_gradient(self) -> ca.MX:
        """Return the gradient of half the increment cost in the inputs, and of what outputs cost by their inputs, shape ``(nu, N_u)``."""
        gradient = self.force - ca.horzcat(self.force[:, 1:], ca.MX.zeros(self.u_prev.numel()))
        if self.gradient.shape[0] > self.x.shape[0]:
            gradient += summed(self.gradient[self.x.shape[0] :, :], self._blocks)
        return ca.MX(gradient)

    def output_hessian(self, i: int) -> tuple[ca.MX, ca.MX]:
        """Return the blocks of the Hessian of half the output cost at node ``i + 1`` in state and input, and in the input alone."""
        H, nx = ca.MX(self.H_i, self.hessian[:, i]), self.x.shape[0]
        return H[:nx, nx:], H[nx:, nx:]

    def increment_hessian(self, k: int) -> tuple[ca.MX, ca.MX | None]:
        """
        Return the blocks ``(k, k)`` and ``(k, k + 1)`` of the Hessian of half the increment cost and the damping; None after the last stage.

        The former has what outputs cost by their inputs as well.
        """
        last = k == self.u.shape[1] - 1
        lambda_ = self.w["lambda_"]
        if not self._by_input:
            following = 0 if last else lambda_[k + 1]
            weight, beside = self.R * (lambda_[k] + following), -self.R * following
        else:
            here, after = (ca.MX(self.R.sparsity(), self.R_k[:, min(j, self.u.shape[1] - 1)]) for j in (k, k + 1))
            weight, beside = here if last else here + after, -after
        diagonal = weight + ca.diag(self.damping[:, k if self.damping.size2() > 1 else 0])
        if self.gradient.shape[0] > self.x.shape[0]:
            first = sum(self._blocks[:k])
            for i in range(first, first + self._blocks[k]):
                diagonal += self.output_hessian(i)[1]
        return diagonal, None if last else beside


_linearizations: WeakKeyDictionary[Ocp, Linearization] = WeakKeyDictionary()


def linearization(ocp: Ocp) -> Linearization:
    """Return the linearization of a problem, which all its functions share, built at the first call."""
    if ocp not in _linearizations:
        _linearizations[ocp] = Linearization(ocp)
    return _linearizations[ocp]


def scale_size(ocp: Ocp) -> int:
    """Return how many numbers `rti_mpc.rti.scale.scale` has: of states, inputs, softened bounds, and the reach of each state."""
    return 2 * ocp.model.nx + ocp.model.nu + ocp.ng


def input_reference(ocp: Ocp) -> ca.Function:
    """Build ``p -> u_ref`` for the first stages of all blocks, columns are blocks."""
    return ca.Function("u_ref", [ocp.model.p], [ca.densify(ocp.u_ref)]).map(ocp.N_u)


def running_sum(columns: ca.MX) -> ca.MX:
    """Return the sum of each column and of all after it."""
    backwards = ca.cumsum(columns[:, ::-1], 1)
    return ca.MX(backwards[:, ::-1])


def divided(flat: ca.MX, like: Sequence[ca.MX]) -> list[ca.MX]:
    """Divide a column into expressions of given shapes."""
    ends = np.cumsum([0, *(one.numel() for one in like)]).tolist()
    return [ca.reshape(part, one.shape) for part, one in zip(ca.vertsplit(flat, ends), like, strict=True)]


def linearize(ocp: Ocp) -> tuple[ca.Function, ca.Sparsity, ca.Sparsity]:
    """
    Linearize the dynamics over one stage.

    Returns:
        ``stage(x, u, p) -> [phi; nonzeros of A; nonzeros of B]``, with the patterns of A, shape ``(nx, nx)``, and of B, shape ``(nx, nu)``.
    """
    model = ocp.model
    x_next, A, B = ocp.stage(derivatives=True)
    out = ca.cse(ca.densify(ca.vertcat(x_next, nonzeros(A), nonzeros(B))))
    return ca.Function("stage", [model.x, model.u, model.p], [out]), A.sparsity(), B.sparsity()


def gauss_newton(ocp: Ocp) -> tuple[ca.Function, ca.Sparsity]:
    r"""
    Build the terms of :math:`\tfrac12 \|y(x, p) - y_{ref}\|_W^2` at one node, with the residual of the model for the difference.

    Returns:
        ``node(x, p, y_ref, W) -> [gradient in x; twice the term itself; nonzeros of C' W C]``, and the pattern of the last. Where outputs depend
        on inputs it is ``node(x, u, p, y_ref, W)``, with the gradient in (x, u).
    """
    model = ocp.model
    y_ref = ca.SX.sym("y_ref", model.ny)
    weight = ca.SX.sym("W", model.ny, model.ny)
    W = weight * output_pattern(ocp)
    e = model.residual(model.y_expr, y_ref)
    at = [model.x, model.u] if model.outputs_of_inputs else [model.x]
    C = ca.jacobian(e, ca.vertcat(*at))
    H = C.T @ W @ C
    out = ca.cse(ca.densify(ca.vertcat(C.T @ (W @ e), e.T @ (W @ e), nonzeros(H))))
    return ca.Function("node", [*at, model.p, y_ref, weight], [out]), H.sparsity()


def constraints(ocp: Ocp) -> tuple[ca.Function, ca.Sparsity, ca.Sparsity]:
    """
    Linearize the expressions with softened bounds: the bounded states, the general constraints, then the states bounded at the last node.

    Returns:
        ``constraint(x, u, p) -> [g; nonzeros of G_x; nonzeros of G_u]``, with their patterns.
    """
    model = ocp.model
    g = ca.vertcat(model.x[list(ocp.soft), 0], ocp.h_expr, model.x[list(ocp.soft_e), 0])
    G_x, G_u = ca.jacobian(g, model.x), ca.jacobian(g, model.u)
    out = ca.cse(ca.densify(ca.vertcat(g, nonzeros(G_x), nonzeros(G_u))))
    return ca.Function("constraint", [model.x, model.u, model.p], [out]), G_x.sparsity(), G_u.sparsity()


def along_rows(ocp: Ocp, inputs: Any, increments: Any, softened: Any) -> ca.MX:
    """Return numbers of all bounded rows, in the order of the places, from columns of inputs, increments and expressions with softened bounds."""
    return ca.MX(ca.veccat(at_each(inputs, ocp.N_u), at_each(increments, ocp.N_u), at_each(softened, ocp.N)))


def softened(ocp: Ocp, w: dict[str, Any], of_states: str, of_constraints: str, of_end: str) -> Any:
    """Return what the rows of `constraints` have by these names of weights or bounds, shape ``(ng, 1)``, or ``(ng, N)`` if any has rows."""
    if max(w[name].shape[1] for name in (of_states, of_constraints, of_end)) > 1:
        parts = w[of_states][list(ocp.soft), :], w[of_constraints], w[of_end][list(ocp.soft_e), :]
        return ca.vertcat(*(at_each(part, ocp.N) for part in parts))
    return ca.vertcat(w[of_states][list(ocp.soft), 0], w[of_constraints], w[of_end][list(ocp.soft_e), 0])


def where_bounded(numbers: Any, lower: Array, upper: Array) -> Any:
    """
    Return numbers that push down from an upper bound, above 0, or up from a lower one, below 0: zero where there is no such bound.

    Args:
        numbers: A column per stage or block.
        lower: The bounds, a row per stage or block, or one for all.
        upper: The upper ones, likewise.
    """
    most = [at_each(ca.DM(np.where(np.isfinite(bounds), np.inf, 0.0).T), numbers.shape[1]) for bounds in (lower, upper)]
    return ca.fmax(-most[0], ca.fmin(numbers, most[1]))


def partly(bounds: Array) -> Any:
    """Return which signals have a bound at some stages and none at others, shape ``(n,)``."""
    there = np.isfinite(np.atleast_2d(bounds))
    return there.any(axis=0) & ~there.all(axis=0)


def nonzeros(matrix: Any) -> Any:
    """Return the nonzeros of a matrix, column by column, as a column: CasADi's own `nz` is a row for a matrix of one row."""
    return ca.vec(matrix.nz[:])


def output_pattern(ocp: Ocp) -> ca.DM:
    """Return ones where the weight on outputs may become nonzero."""
    return pattern((ocp.Q != 0) | (ocp.Q_e != 0))


def pattern(weight: np.ndarray[Any, Any]) -> ca.DM:
    """Return ones where a weight matrix may become nonzero: on its diagonal, and where it is nonzero now."""
    return ca.DM(sp.csc_matrix(((weight != 0) | np.eye(len(weight), dtype=bool)).astype(float)))


def shift(ocp: Ocp) -> ca.Function:
    """
    Build ``(x, u, p) -> (x_next, u_next)``: a plan moved on by one stage, its last input repeated, with the state the model predicts.

    Each block has the input that acts where it begins then.
    """
    model, nodes = ocp.model, ocp.N + 1
    x, u, p = ca.MX.sym("x", model.nx, nodes), ca.MX.sym("u", model.nu, ocp.N_u), ca.MX.sym("p", model.np_, nodes)
    x_next = ocp.phi()(x[:, -1], u[:, -1], p[:, -1])
    moved = {"x_next": ca.horzcat(x[:, 1:], x_next), "u_next": moved_on(u, ocp.blocks)}
    return function("shift", {"x": x, "u": u, "p": p}, moved)


def change(lin: Linearization, u: Any) -> Any:
    """Return the size of a step from the guess to inputs `u` as an expression: the largest change of an input, relative to its scale."""
    return ca.mmax(ca.fabs(u - lin.u) / ca.repmat(lin.scale_u, 1, u.shape[1]))


def damping(ocp: Ocp) -> float:
    """Return the damping of a step as large as an input's scale, per cost: zero for a linear model, whose full step is exact."""
    model = ocp.model
    variables = ca.vertcat(model.x, model.u)
    first = ca.jacobian(ca.vertcat(model.rate_expr, model.y_expr), variables)
    linear = ca.jacobian(ca.vec(first), variables).nnz() == 0
    return 0.0 if linear else DAMPING_PER_COST


def plan_cost(ocp: Ocp) -> ca.Function:
    """Build ``(x, u, u_prev, y_ref, p, *ARGUMENTS, scale) -> cost``: the cost (4) of a plan and its penalties, nothing of it linearized."""
    lin = linearization(ocp)
    lg, ug, zg, Zg = (at_each(e, ocp.N) for e in (lin.lg, lin.ug, lin.zg, lin.Zg))
    s = ca.fmax(0, ca.fmax(lin.g - ug, lg - lin.g))
    return function("cost", lin.arguments, {"cost": lin.cost + ca.dot(zg, s) + ca.dot(Zg, s**2) / 2})
