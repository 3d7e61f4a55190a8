# SPDX-License-Identifier: Apache-2.0
r"""
Riccati recursion for the QP of a sample, its bounds as quadratic terms: what the active set and the interior point are made of.

The increments couple an input to the one before, so the recursion is in
:math:`s_k = (\Delta x_k, \Delta u_{k-1})`. From the cost-to-go
:math:`\tfrac12 s^T P s + p^T s` behind stage k follow the terms of its input,

.. math::

    \tfrac12 \Delta u_k^T Q_{uu} \Delta u_k + \Delta u_k^T (Q_{us} s_k + q_u) ,

and from these the gains. Each bounded *row* d, an input, an increment or what has
softened bounds, adds :math:`\tfrac12 W d^2 + v d` in its deviation from the guess;
weight W and pull v are the solver's. With the gains known, other pulls cost a sweep
over vectors alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from rti_mpc.linearization import Linearization, nonzeros
from rti_mpc.ocp import Ocp

Columns = list[ca.MX]  # one expression per stage


@dataclass(frozen=True, eq=False)
class Rows:
    """A number for each bounded row: inputs and increments, shapes ``(nu, N_u)``, and what has softened bounds, shape ``(ng, N)``."""

    inputs: ca.MX
    increments: ca.MX
    softened: ca.MX

    def columns(self) -> tuple[Columns, Columns, Columns]:
        """Return these stage by stage."""
        return columns(self.inputs), columns(self.increments), columns(self.softened)


def columns(matrix: ca.MX) -> Columns:
    """Return a matrix column by column, one without rows as well."""
    return list(ca.horzsplit(matrix)) if matrix.size1() else [ca.MX(0, 1)] * matrix.size2()


class Riccati:
    """
    The recursion of an OCP, in expressions.

    Attributes:
        size: Entries of the gains of one stage: K and kappa of ``du = -K s - kappa``, and the Cholesky factor of ``Q_uu``.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        self._ocp, self._lin = ocp, lin
        nx, nu = ocp.model.nx, ocp.model.nu
        self._n = n = nx + nu
        self._ends = (nu * n, nu * (n + 1))
        self.size = nu * (n + 1) + nu * (nu + 1) // 2
        self._backward = [backward_stage(ocp, lin, free) for free in (False, True)]
        self._sweep = [sweep_stage(ocp, lin, free) for free in (False, True)]
        self._forward = [forward_stage(ocp, lin, free) for free in (False, True)]

    def gains(self, forms: list[ca.MX], weight: Rows, pull: Rows) -> ca.MX:
        """Return the gains of all stages with an input, one a column, shape ``(size, N_u)``."""
        N, N_u, n, w = self._ocp.N, self._ocp.N_u, self._n, self._lin.w
        A, B, b, H, h, force, _, _, g_x, g_u = (columns(form) for form in forms[:10])
        weights, pulls = weight.columns(), pull.columns()
        lambda_ = ca.vertsplit(w["lambda_"])
        R, damping = nonzeros(self._lin.R), forms[10]
        P, p = ca.MX.zeros(n * (n + 1) // 2), ca.MX.zeros(n)
        found = []
        for k in reversed(range(N)):
            stage = A[k], B[k], b[k], H[k], h[k], g_x[k], g_u[k], weights[2][k], pulls[2][k], P, p
            if k < N_u:
                P, p, gain = self._backward[1](*stage, R, damping, lambda_[k], force[k], weights[0][k], pulls[0][k], weights[1][k], pulls[1][k])
                found.append(gain)
            else:
                P, p = self._backward[0](*stage)
        return ca.horzcat(*reversed(found))

    def corrected(self, forms: list[ca.MX], gains: ca.MX, pull: Rows) -> ca.MX:
        """Return gains whose kappa is that of pulls alone: rolled out from s = 0 without defects they make the change that these pulls make."""
        A, B, _, _, _, _, _, _, g_x, g_u = (columns(form) for form in forms[:10])
        pulls, gain = pull.columns(), columns(gains)
        p = ca.MX.zeros(self._n)
        kappas = []
        for k in reversed(range(self._ocp.N)):
            stage = A[k], B[k], g_x[k], g_u[k], pulls[2][k], p
            if k < self._ocp.N_u:
                p, kappa = self._sweep[1](*stage, gain[k], pulls[0][k], pulls[1][k])
                kappas.append(kappa)
            else:
                p = self._sweep[0](*stage)
        K, _, L = ca.vertsplit(gains, [0, *self._ends, self.size])
        return ca.vertcat(K, ca.horzcat(*reversed(kappas)), L)

    def rolled(self, forms: list[ca.MX], gains: ca.MX, s: ca.MX, *, defects: bool) -> tuple[ca.MX, ca.MX, Rows]:
        """Return the steps in states, shape ``(nx, N + 1)``, and in inputs, shape ``(nu, N_u)``, and the rows, all in deviations, from s on."""
        A, B, b, _, _, _, _, _, g_x, g_u = (columns(form) for form in forms[:10])
        gain, nx = columns(gains), self._ocp.model.nx
        nothing = ca.MX.zeros(nx)
        states, inputs, increments, softened = [s[:nx]], [], [], []
        for k in range(self._ocp.N):
            stage = A[k], B[k], b[k] if defects else nothing, g_x[k], g_u[k], s
            if k < self._ocp.N_u:
                after, value, increment = self._forward[1](*stage, gain[k])
                increments.append(increment)
                inputs.append(after[nx:])
            else:
                after, value = self._forward[0](*stage)
            s = after
            states.append(s[:nx])
            softened.append(value)
        du = ca.horzcat(*inputs)
        return ca.horzcat(*states), du, Rows(du, ca.horzcat(*increments), ca.horzcat(*softened))


class Stage:
    """
    Symbols of one stage, and the linear forms made of them from nonzeros, every structural zero left out.

    Attributes:
        A: Sensitivities to the state; `B`, to the input; `b`, the defect.
        H: Hessian of the outputs at the end; `h`, their gradient.
        G: Sensitivities of what has softened bounds to s at the end, shape ``(ng, nx + nu)``.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        nx, nu = ocp.model.nx, ocp.model.nu
        self.nx, self.nu, self.n, self.ng = nx, nu, nx + nu, len(ocp.lg)
        patterns = {"A": lin.A_k, "B": lin.B_k, "H": lin.H_i, "G_x": lin.G_x, "G_u": lin.G_u}
        nz = {name: ca.SX.sym(name, pattern.nnz()) for name, pattern in patterns.items()}
        self.A, self.B, self.H, G_x, G_u = (ca.SX(pattern, nz[name]) for name, pattern in patterns.items())
        self.G = ca.horzcat(G_x, G_u)
        self.b, self.h = ca.SX.sym("b", nx), ca.SX.sym("h", nx)
        self.matrices = [nz["A"], nz["B"]]
        self.cost = [nz["H"], self.h]
        self.softened = [nz["G_x"], nz["G_u"]]

    def gain(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Return symbols of the gains of a stage, all in a column, and of these K, kappa and the Cholesky factor."""
        lower = ca.Sparsity.lower(self.nu)
        column = ca.SX.sym("gain", self.nu * (self.n + 1) + lower.nnz())
        K, kappa, L = ca.vertsplit(column, [0, self.nu * self.n, self.nu * (self.n + 1), column.numel()])
        return column, ca.reshape(K, self.nu, self.n), kappa, ca.SX(lower, L)


def backward_stage(ocp: Ocp, lin: Linearization, free: bool) -> ca.Function:
    """Build one stage of the recursion; not `free`: the input is that of the stage before."""
    of = Stage(ocp, lin)
    nx, nu, n = of.nx, of.nu, of.n
    upper = ca.Sparsity.upper(n)
    P_nz, p = ca.SX.sym("P", upper.nnz()), ca.SX.sym("p", n)
    weight, pull = ca.SX.sym("weight", of.ng), ca.SX.sym("pull", of.ng)
    P = ca.triu2symm(ca.SX(upper, P_nz)) + of.G.T @ ca.diag(weight) @ of.G
    p_end = p + of.G.T @ pull

    A, B = of.A, of.B
    Pxx, Pxu, Puu = P[:nx, :nx] + of.H, P[:nx, nx:], P[nx:, nx:]
    PB = Pxx @ B + Pxu
    Qxx, Qux, Quu = A.T @ Pxx @ A, PB.T @ A, B.T @ PB + Pxu.T @ B + Puu
    px = p_end[:nx] + of.h + Pxx @ of.b
    qx, qu = A.T @ px, B.T @ px + p_end[nx:] + Pxu.T @ of.b
    inputs = [*of.matrices, of.b, *of.cost, *of.softened, weight, pull, P_nz, p]
    if not free:
        Qss, qs = ca.blockcat([[Qxx, Qux.T], [Qux, Quu]]), ca.vertcat(qx, qu)
        return ca.Function("held", inputs, ca.cse([nonzeros(ca.densify(Qss)[upper]), ca.densify(qs)]))

    R_nz, lambda_ = ca.SX.sym("R", lin.R.sparsity().nnz()), ca.SX.sym("lambda")
    names = ("damping", "force", "weight_u", "pull_u", "weight_du", "pull_du")
    damping, force, weight_u, pull_u, weight_du, pull_du = symbols = [ca.SX.sym(name, nu) for name in names]
    R = ca.SX(lin.R.sparsity(), R_nz) * lambda_ + ca.diag(weight_du)
    force = force + pull_du
    Quu, qu = Quu + R + ca.diag(weight_u + damping), qu + force + pull_u
    Qus = ca.horzcat(Qux, -R)
    L = cholesky(Quu)
    gain = cholesky_solve(L, ca.horzcat(Qus, qu))
    # The cost with du = -K s - kappa in it.
    P_before = ca.diagcat(Qxx, R) - Qus.T @ gain[:, :n]
    p_before = ca.vertcat(qx, -force) - Qus.T @ gain[:, n]
    found = ca.vertcat(ca.vec(ca.densify(gain)), nonzeros(L))
    out = [nonzeros(ca.densify(P_before)[upper]), ca.densify(p_before), found]
    return ca.Function("free", [*inputs, R_nz, damping, lambda_, *symbols[1:]], ca.cse(out))


def sweep_stage(ocp: Ocp, lin: Linearization, free: bool) -> ca.Function:
    """Build one stage of the recursion for the pulls alone, the matrices known."""
    of = Stage(ocp, lin)
    p, pull = ca.SX.sym("p", of.n), ca.SX.sym("pull", of.ng)
    p_end = p + of.G.T @ pull
    qx, qu = of.A.T @ p_end[: of.nx], of.B.T @ p_end[: of.nx] + p_end[of.nx :]
    inputs = [*of.matrices, *of.softened, pull, p]
    if not free:
        return ca.Function("sweep_held", inputs, ca.cse([ca.densify(ca.vertcat(qx, qu))]))
    column, K, _, L = of.gain()
    pull_u, pull_du = ca.SX.sym("pull_u", of.nu), ca.SX.sym("pull_du", of.nu)
    qu = qu + pull_u + pull_du
    p_before = ca.vertcat(qx, -pull_du) - K.T @ qu
    return ca.Function("sweep_free", [*inputs, column, pull_u, pull_du], ca.cse([ca.densify(p_before), ca.densify(cholesky_solve(L, qu))]))


def forward_stage(ocp: Ocp, lin: Linearization, free: bool) -> ca.Function:
    """Build one stage of a roll-out without bounds: ``-> (s, softened rows)``, and the increment if there is an input."""
    of = Stage(ocp, lin)
    s = ca.SX.sym("s", of.n)
    column, K, kappa, _ = of.gain()
    du = -(K @ s + kappa) if free else s[of.nx :]
    end = ca.vertcat(of.A @ s[: of.nx] + of.B @ du + of.b, du)
    inputs, outputs = [*of.matrices, of.b, *of.softened, s], [ca.densify(end), ca.densify(of.G @ end)]
    if free:
        return ca.Function("rolled_free", [*inputs, column], ca.cse([*outputs, du - s[of.nx :]]))
    return ca.Function("rolled_held", inputs, ca.cse(outputs))


def cholesky(M: ca.SX) -> ca.SX:
    """Return the lower Cholesky factor of a small symmetric matrix, its lower triangle dense; NaN if it is not positive definite."""
    size = M.shape[0]
    L = ca.SX(ca.Sparsity.lower(size))
    for i in range(size):
        for j in range(i + 1):
            rest = M[i, j] - ca.dot(L[i, :j], L[j, :j])
            L[i, j] = ca.sqrt(rest) if i == j else rest / L[j, j]
    return L


def cholesky_solve(L: ca.SX, rhs: ca.SX) -> ca.SX:
    """Solve with a Cholesky factor."""
    size = L.shape[0]
    rows = [rhs[i, :] for i in range(size)]
    for i in range(size):
        rows[i] = (rows[i] - sum((L[i, k] * rows[k] for k in range(i)), ca.SX(1, rhs.shape[1]))) / L[i, i]
    for i in reversed(range(size)):
        rows[i] = (rows[i] - sum((L[k, i] * rows[k] for k in range(i + 1, size)), ca.SX(1, rhs.shape[1]))) / L[i, i]
    return ca.vertcat(*rows)
