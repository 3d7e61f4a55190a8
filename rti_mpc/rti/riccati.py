# SPDX-License-Identifier: Apache-2.0
r"""
Riccati recursion for the QP of a sample, with bounds as quadratic terms.

The increments couple an input to the one before, so the recursion is in
:math:`s_k = (\Delta x_k, \Delta u_{k-1})`. From the cost-to-go
:math:`\tfrac12 s^T P s + p^T s` after stage k follow the terms of its input,

.. math::

    \tfrac12 \Delta u_k^T Q_{uu} \Delta u_k + \Delta u_k^T (Q_{us} s_k + q_u) ,

and from these the gains. Each bounded *row*, an input, an increment or an expression
with softened bounds, adds :math:`\tfrac12 W d^2 + v d` in its deviation d from the guess;
the solver chooses the weight W and the linear term v, its *pull*. Once the gains are
known, other pulls cost only a sweep over vectors.

Stages are separate functions: *free* ones, whose input is a variable, and those where
the input before is *held*, after the control horizon or the first stage of a block.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import at_starts, repeated
from rti_mpc.rti.dense import backward_in_c, input_weights_shared
from rti_mpc.rti.linearization import Forms, Linearization, nonzeros
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.recursion import recur


@dataclass(frozen=True, eq=False)
class Rows:
    """
    One number for each bounded row.

    Attributes:
        u: Numbers of the inputs, shape ``(nu, N_u)``.
        du: Numbers of the increments, shape ``(nu, N_u)``.
        g: Numbers of the expressions with softened bounds, shape ``(ng, N)``.
    """

    u: ca.MX
    du: ca.MX
    g: ca.MX


class Riccati:
    """
    The recursion of an OCP, in expressions.

    Attributes:
        size: Entries of the gains of one stage: K and kappa of ``du = -K s - kappa``, and the Cholesky factor of ``Q_uu``.
        again: ``(*data, until, known_gain, known_P_before, known_p_before) -> (gain, P_before, p_before)``: gains, and the cost-to-go before each
            stage, its matrix as upper triangle, from those of other weights and pulls at the first stages; see `rti_mpc.rti.recursion.recur`.
        factorize: ``(stages, R, lambda_, weight_u, weight_du, weight_g, pull_u, pull_du, pull_g) -> gains``; compiled once for all.
        respond: ``(stages, gains, pull_u, pull_du, pull_g) -> (states, u, du, g)``: the change of states and rows that pulls alone cause.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        self._ocp, self._lin = ocp, lin
        nx, nu = ocp.model.nx, ocp.model.nu
        self._n = n = nx + nu
        self._ends = (nu * n, nu * (n + 1))
        self.size = nu * (n + 1) + nu * (nu + 1) // 2
        backward, sweep, forward = (
            repeated(free(ocp, lin), held(ocp, lin), ocp.blocks)
            for free, held in ((backward_free, backward_held), (sweep_free, sweep_held), (forward_free, forward_held))
        )
        carried, shared, kinds = {"P": "P_before", "p": "p_before"}, input_weights_shared(ocp), [stage for stage, _ in backward[:2]]
        self._backward = recur("backward", backward, carried, ["gain"], shared=shared, backward=True, in_c=backward_in_c(ocp, lin, *kinds))
        outputs, again = ["gain", *carried.values()], backward_in_c(ocp, lin, *kinds, resumed=True)
        self.again = recur("again", backward, carried, outputs, shared=shared, backward=True, resumed=True, in_c=again)
        self._sweep = recur("sweep", sweep, {"p": "p_before"}, ["kappa"], backward=True)
        self._forward = recur("forward", forward, {"s": "s_after"}, ["s_after", "g", "increment"])
        stages, gains, start = ca.MX.sym("stages", lin.stages.numel()), ca.MX.sym("gains", self.size, ocp.N_u), ca.MX.zeros(n)
        weight, pull = (
            Rows(*(ca.MX.sym(f"{name}_{of}", *like.shape) for of, like in (("u", lin.u), ("du", lin.u), ("g", lin.g)))) for name in ("weight", "pull")
        )
        weights, pulls = ({f"{name}_{of}": number for of, number in vars(rows).items()} for name, rows in (("weight", weight), ("pull", pull)))
        forms, matrices = lin.forms_in(stages), {name: lin.w[name] for name in ("R", "lambda_")}
        found = self._backward(**self.data(forms, weight, pull))["gain"]
        self.factorize = function("factorize", {"stages": stages, **matrices, **weights, **pulls}, {"gains": found})
        states, _, rows = self.rolled(forms, self._corrected(forms, gains, pull), start, defects=False)
        self.respond = function("respond", {"stages": stages, "gains": gains, **pulls}, {"states": states, **vars(rows)})

    def data(self, forms: Forms, weight: Rows, pull: Rows) -> dict[str, ca.MX]:
        """Return the arguments of the recursion backwards, by name; those in `Forms` are these."""
        n, lin = self._n, self._lin
        data = {"A": forms.A, "B": forms.B, "b": forms.b, "H": forms.H, "h": forms.h, "g_x": forms.g_x, "g_u": forms.g_u}
        rows = {"weight_u": weight.u, "pull_u": pull.u, "weight_du": weight.du, "pull_du": pull.du, "weight_g": weight.g, "pull_g": pull.g}
        R = {"R": nonzeros(lin.R), "lambda_k": lin.w["lambda_"].T} if self._ocp.lambda_.ndim == 1 else {"R": lin.R_k}
        cost = {**R, "damping": forms.damping, "force": forms.force}
        return {**data, **rows, **cost, "P": ca.MX.zeros(n * (n + 1) // 2), "p": ca.MX.zeros(n)}

    def _corrected(self, forms: Forms, gains: ca.MX, pull: Rows) -> ca.MX:
        """Return gains whose kappa comes from pulls only: rolled out from s = 0 without defects, they give the change that these pulls cause."""
        data = {"A": forms.A, "B": forms.B, "g_x": forms.g_x, "g_u": forms.g_u}
        pulls = {"pull_u": pull.u, "pull_du": pull.du, "pull_g": pull.g}
        kappa = self._sweep(**data, **pulls, gain=gains, p=ca.MX.zeros(self._n))["kappa"]
        K, _, L = ca.vertsplit(gains, [0, *self._ends, self.size])
        return ca.vertcat(K, kappa, L)

    def gains(self, stages: ca.MX, weight: Rows, pull: Rows) -> ca.MX:
        """Return the gains of all free stages, one column per stage, shape ``(size, N_u)``."""
        w = self._lin.w
        weights = {"weight_u": weight.u, "weight_du": weight.du, "weight_g": weight.g}
        found: ca.MX = self.factorize(stages=stages, R=w["R"], lambda_=w["lambda_"], **weights, pull_u=pull.u, pull_du=pull.du, pull_g=pull.g)[
            "gains"
        ]
        return found

    def response(self, stages: ca.MX, gains: ca.MX, pull: Rows) -> tuple[ca.MX, Rows]:
        """Return the change of states, shape ``(nx, N + 1)``, and of rows, that pulls alone cause."""
        found = self.respond(stages=stages, gains=gains, pull_u=pull.u, pull_du=pull.du, pull_g=pull.g)
        return found["states"], Rows(found["u"], found["du"], found["g"])

    def rolled(self, forms: Forms, gains: ca.MX, s: ca.MX, *, defects: bool) -> tuple[ca.MX, ca.MX, Rows]:
        """Return the steps in states, shape ``(nx, N + 1)``, and in inputs, shape ``(nu, N_u)``, and the rows, all in deviations, from s on."""
        nx, b = self._ocp.model.nx, forms.b if defects else ca.MX.zeros(forms.b.shape)
        data = {"A": forms.A, "B": forms.B, "b": b, "g_x": forms.g_x, "g_u": forms.g_u}
        after = self._forward(**data, gain=gains, s=s)
        ends = after["s_after"]
        du = at_starts(ends[nx:, :], self._ocp.blocks)
        return ca.horzcat(s[:nx], ends[:nx, :]), du, Rows(du, after["increment"], after["g"])


class Stage:
    """
    Symbols of one stage, and the linear forms made of them from nonzeros, every structural zero left out.

    Attributes:
        A: Sensitivities to the state; `B`, to the input; `b`, the defect.
        H: Hessian of the outputs at the end, in the state, or in s where outputs depend on inputs; `h`, their gradient.
        G: Sensitivities of what has softened bounds to s at the end, shape ``(ng, nx + nu)``.
        dynamics: Symbols of A and B, by the names in `rti_mpc.rti.linearization.Forms`.
        defect: That of b; `cost`, those of H and h; `softened`, those of G.
    """

    def __init__(self, ocp: Ocp, lin: Linearization) -> None:
        nx, nu = ocp.model.nx, ocp.model.nu
        self.nx, self.nu, self.n, self.ng = nx, nu, nx + nu, ocp.ng
        patterns = {"A": lin.A_k, "B": lin.B_k, "H": lin.H_i, "g_x": lin.G_x, "g_u": lin.G_u}
        nz = {name: ca.SX.sym(name, pattern.nnz()) for name, pattern in patterns.items()}
        self.A, self.B, self.H, G_x, G_u = (ca.SX(pattern, nz[name]) for name, pattern in patterns.items())
        self.G = ca.horzcat(G_x, G_u)
        self.b, self.h = ca.SX.sym("b", nx), ca.SX.sym("h", self.H.shape[0])
        self.dynamics = {"A": nz["A"], "B": nz["B"]}
        self.defect = {"b": self.b}
        self.cost = {"H": nz["H"], "h": self.h}
        self.softened = {"g_x": nz["g_x"], "g_u": nz["g_u"]}


class Gain:
    """
    Symbol of the gains of one stage, all in a column, and its parts.

    Attributes:
        column: The symbol.
        K: Feedback of ``du = -K s - kappa``, shape ``(nu, nx + nu)``; `kappa`, the rest of it, shape ``(nu, 1)``.
        L: Lower Cholesky factor of ``Q_uu``, shape ``(nu, nu)``.
    """

    def __init__(self, of: Stage) -> None:
        lower = ca.Sparsity.lower(of.nu)
        self.column = ca.SX.sym("gain", of.nu * (of.n + 1) + lower.nnz())
        K, self.kappa, L = ca.vertsplit(self.column, [0, of.nu * of.n, of.nu * (of.n + 1), self.column.numel()])
        self.K, self.L = ca.reshape(K, of.nu, of.n), ca.SX(lower, L)


class QFunction(NamedTuple):
    """Q-function of a stage, its cost-to-go in its state and its input, before the input is eliminated, and the symbols it depends on."""

    Qxx: ca.SX
    Qux: ca.SX
    Quu: ca.SX
    qx: ca.SX
    qu: ca.SX
    symbols: dict[str, ca.SX]


def q_function(of: Stage) -> QFunction:
    """Return the Q-function of a stage from the cost-to-go of the next one."""
    nx, upper = of.nx, ca.Sparsity.upper(of.n)
    P_nz, p = ca.SX.sym("P", upper.nnz()), ca.SX.sym("p", of.n)
    weight, pull = ca.SX.sym("weight_g", of.ng), ca.SX.sym("pull_g", of.ng)
    P = ca.triu2symm(ca.SX(upper, P_nz)) + of.G.T @ ca.diag(weight) @ of.G
    p_end = p + of.G.T @ pull

    if of.H.shape[0] > nx:
        P, p_end = P + of.H, p_end + of.h
    else:
        P[:nx, :nx] += of.H
        p_end[:nx] += of.h
    A, B = of.A, of.B
    Pxx, Pxu, Puu = P[:nx, :nx], P[:nx, nx:], P[nx:, nx:]
    PB = Pxx @ B + Pxu
    Qxx, Qux, Quu = A.T @ Pxx @ A, PB.T @ A, B.T @ PB + Pxu.T @ B + Puu
    px = p_end[:nx] + Pxx @ of.b
    qx, qu = A.T @ px, B.T @ px + p_end[nx:] + Pxu.T @ of.b
    symbols = {**of.dynamics, **of.defect, **of.cost, **of.softened, "weight_g": weight, "pull_g": pull, "P": P_nz, "p": p}
    return QFunction(Qxx, Qux, Quu, qx, qu, symbols)


def backward_held(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of the recursion whose input is that of the stage before: ``-> (P_before, p_before)``."""
    of = Stage(ocp, lin)
    Qxx, Qux, Quu, qx, qu, symbols = q_function(of)
    Qss, qs = ca.blockcat([[Qxx, Qux.T], [Qux, Quu]]), ca.vertcat(qx, qu)
    P_before, p_before = ca.cse([nonzeros(ca.densify(Qss)[ca.Sparsity.upper(of.n)]), ca.densify(qs)])
    return function("held", symbols, {"P_before": P_before, "p_before": p_before})


def backward_free(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of the recursion with an input: ``-> (P_before, p_before, gain)``."""
    of = Stage(ocp, lin)
    n, nu = of.n, of.nu
    Qxx, Qux, Quu, qx, qu, symbols = q_function(of)
    R_nz, factor = ca.SX.sym("R", lin.R.sparsity().nnz()), {"lambda_k": ca.SX.sym("lambda_k")} if ocp.lambda_.ndim == 1 else {}
    names = ("damping", "force", "weight_u", "pull_u", "weight_du", "pull_du")
    damping, force, weight_u, pull_u, weight_du, pull_du = own = [ca.SX.sym(name, nu) for name in names]
    R = ca.SX(lin.R.sparsity(), R_nz) * factor.get("lambda_k", 1) + ca.diag(weight_du)
    force = force + pull_du
    Quu, qu = Quu + R + ca.diag(weight_u + damping), qu + force + pull_u
    Qus = ca.horzcat(Qux, -R)
    L = cholesky(Quu)
    gain = cholesky_solve(L, ca.horzcat(Qus, qu))
    # The cost with du = -K s - kappa inserted.
    P_before = ca.diagcat(Qxx, R) - Qus.T @ gain[:, :n]
    p_before = ca.vertcat(qx, -force) - Qus.T @ gain[:, n]
    found = ca.vertcat(ca.vec(ca.densify(gain)), nonzeros(L))
    P_before, p_before, found = ca.cse([nonzeros(ca.densify(P_before)[ca.Sparsity.upper(n)]), ca.densify(p_before), found])
    inputs = {**symbols, "R": R_nz, **factor, **dict(zip(names, own, strict=True))}
    return function("free", inputs, {"P_before": P_before, "p_before": p_before, "gain": found})


def swept(of: Stage) -> tuple[ca.SX, ca.SX, dict[str, ca.SX]]:
    """Return the gradient of the cost-to-go of a stage in its state and its input, from pulls alone, and the symbols it depends on."""
    p, pull = ca.SX.sym("p", of.n), ca.SX.sym("pull_g", of.ng)
    p_end = p + of.G.T @ pull
    qx, qu = of.A.T @ p_end[: of.nx], of.B.T @ p_end[: of.nx] + p_end[of.nx :]
    return qx, qu, {**of.dynamics, **of.softened, "pull_g": pull, "p": p}


def sweep_held(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of the sweep for the pulls alone, the matrices known, whose input is that of the stage before: ``-> p_before``."""
    qx, qu, symbols = swept(Stage(ocp, lin))
    (p_before,) = ca.cse([ca.densify(ca.vertcat(qx, qu))])
    return function("sweep_held", symbols, {"p_before": p_before})


def sweep_free(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of that sweep with an input: ``-> (p_before, kappa)``."""
    of = Stage(ocp, lin)
    qx, qu, symbols = swept(of)
    gain = Gain(of)
    pull_u, pull_du = ca.SX.sym("pull_u", of.nu), ca.SX.sym("pull_du", of.nu)
    qu = qu + pull_u + pull_du
    p_before = ca.vertcat(qx, -pull_du) - gain.K.T @ qu
    p_before, kappa = ca.cse([ca.densify(p_before), ca.densify(cholesky_solve(gain.L, qu))])
    inputs = {**symbols, "gain": gain.column, "pull_u": pull_u, "pull_du": pull_du}
    return function("sweep_free", inputs, {"p_before": p_before, "kappa": kappa})


def softened_steps(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Return ``(g_x, g_u, dx, du) -> steps of the expressions with softened bounds`` at one node."""
    of = Stage(ocp, lin)
    dx, du = ca.SX.sym("dx", of.nx), ca.SX.sym("du", of.nu)
    return ca.Function("softened_steps", [*of.softened.values(), dx, du], [ca.densify(of.G @ ca.vertcat(dx, du))])


def forward_held(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of a roll-out without bounds whose input is that of the stage before: ``-> (s_after, g)``."""
    of = Stage(ocp, lin)
    s = ca.SX.sym("s", of.n)
    du = s[of.nx :]
    end = ca.vertcat(of.A @ s[: of.nx] + of.B @ du + of.b, du)
    after, g = ca.cse([ca.densify(end), ca.densify(of.G @ end)])
    return function("rolled_held", {**of.dynamics, **of.defect, **of.softened, "s": s}, {"s_after": after, "g": g})


def forward_free(ocp: Ocp, lin: Linearization) -> ca.Function:
    """Build a stage of a roll-out without bounds, with an input: ``-> (s_after, g, increment)``."""
    of = Stage(ocp, lin)
    s, gain = ca.SX.sym("s", of.n), Gain(of)
    du = -(gain.K @ s + gain.kappa)
    end = ca.vertcat(of.A @ s[: of.nx] + of.B @ du + of.b, du)
    after, g, increment = ca.cse([ca.densify(end), ca.densify(of.G @ end), du - s[of.nx :]])
    inputs = {**of.dynamics, **of.defect, **of.softened, "s": s, "gain": gain.column}
    return function("rolled_free", inputs, {"s_after": after, "g": g, "increment": increment})


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
