# SPDX-License-Identifier: Apache-2.0
r"""
Random linear problems in any units, and their optimal costs by two solvers that know nothing of ours.

A structure has its sizes, its units and which bounds there are; its matrices are
parameters, so that one construction serves many sets of data. Data are made in
variables of the order of one, in which the truth is computed, and handed over in
units from 1e-6 to 1e6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import clarabel
import numpy as np
import piqp
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.ocp import Ocp

DT = 1.0
SHARE_BY_STAGE = 0.3  # of the structures, whose weights and bounds differ from stage to stage
LARGEST = 20, 6, 60  # states, inputs, stages
ROOMS = {  # least and largest distance of each bound from zero
    "lbu": (0.2, 1.0),
    "ubu": (0.2, 1.0),
    "lbdu": (0.05, 0.5),
    "ubdu": (0.05, 0.5),
    "lbx": (0.1, 1.5),
    "ubx": (0.1, 1.5),
    "lh": (0.1, 1.0),
    "uh": (0.1, 1.0),
}
Solution = tuple[Array, Array] | None  # minimum and multipliers of the inequalities; None where a solver finds none
SIGNS = {name: -1.0 if name.startswith("l") else 1.0 for name in ROOMS}


@dataclass(frozen=True, eq=False)
class Structure:
    """
    Sizes, units and bounds of a family of problems.

    Attributes:
        nx: Number of states.
        nu: Number of inputs.
        ny: Number of outputs.
        nh: Number of general constraints.
        N: Horizon.
        blocks: Stages of each block of held inputs; `N_u` of them.
        unit_x: Units of the states, shape ``(nx,)``.
        unit_u: Units of the inputs, shape ``(nu,)``.
        unit_y: Units of the outputs, shape ``(ny,)``.
        unit_h: Units of the general constraints, shape ``(nh,)``.
        finite: Which bounds are finite, by their names.
        by_stage: Whether weights and bounds differ from stage to stage.
    """

    nx: int
    nu: int
    ny: int
    nh: int
    N: int
    blocks: tuple[int, ...]
    unit_x: Array
    unit_u: Array
    unit_y: Array
    unit_h: Array
    finite: dict[str, Any]
    by_stage: bool

    @property
    def N_u(self) -> int:
        """Number of blocks."""
        return len(self.blocks)

    @property
    def block_of(self) -> Array:
        """Block of each stage, shape ``(N,)``."""
        return np.repeat(np.arange(self.N_u), self.blocks)


@dataclass(frozen=True, eq=False)
class Data:
    r"""
    A problem of a structure, in variables of the order of one: :math:`x^+ = Ax + Bu, y = Cx, h = Ex + Fu`.

    Attributes:
        A: Shape ``(nx, nx)``.
        B: Shape ``(nx, nu)``.
        C: Shape ``(ny, nx)``.
        E: Shape ``(nh, nx)``.
        F: Shape ``(nh, nu)``.
        values: Weights and bounds by the names of `Ocp`.
        x0: First state, shape ``(nx,)``.
        u_prev: Input before the plan, shape ``(nu,)``.
        y_ref: Reference, shape ``(N, ny)``.
    """

    A: Array
    B: Array
    C: Array
    E: Array
    F: Array
    values: dict[str, Array]
    x0: Array
    u_prev: Array
    y_ref: Array


def random_structure(rng: np.random.Generator) -> Structure:
    """Small sizes are frequent, matrices of one row among them."""
    nx, nu, N = (int(np.ceil(most * rng.random() ** 1.5)) for most in LARGEST)
    ny, nh = int(rng.integers(1, nx + 1)), int(rng.choice((0, 0, 1, 2)))
    N_u = int(rng.integers(1, N + 1)) if rng.random() < 0.5 else N
    units = [10.0 ** rng.uniform(-6.0, 6.0, size) for size in (nx, nu, ny, nh)]
    shares = {
        "lbu": (nu, 0.8),
        "ubu": (nu, 0.8),
        "lbdu": (nu, 0.5),
        "ubdu": (nu, 0.5),
        "lbx": (nx, 0.3),
        "ubx": (nx, 0.3),
        "lh": (nh, 0.7),
        "uh": (nh, 1.0),
    }
    (apart,) = rng.spawn(1)  # so that the other numbers are those of a structure with a control horizon
    inner = apart.choice(np.arange(1, N), N_u - 1, replace=False) if apart.random() < 0.5 else np.arange(1, N_u)
    blocks = tuple(np.diff([0, *sorted(inner.tolist()), N]).tolist())
    finite = {name: rng.random(size) < share for name, (size, share) in shares.items()}
    return Structure(nx, nu, ny, nh, N, blocks, *units, finite, bool(apart.random() < SHARE_BY_STAGE))


def random_data(s: Structure, rng: np.random.Generator) -> Data:
    """Data of a structure: unstable ones, starts outside softened bounds, and slack weights from 1 to 1e9 among them."""
    A = rng.normal(size=(s.nx, s.nx))
    A *= rng.uniform(0.4, 1.1) / max(1e-3, np.abs(eigenvalues := np.linalg.eigvals(A)).max())
    A /= max(1.0, np.abs(np.linalg.eigvals(A) * (eigenvalues.real < 0.0)).max())  # to grow in turns of sign is not for models of motion, and refused
    B, C = rng.normal(size=(s.nx, s.nu)) / np.sqrt(s.nu), rng.normal(size=(s.ny, s.nx)) / np.sqrt(s.nx)
    E, F = rng.normal(size=(s.nh, s.nx)) / np.sqrt(s.nx), rng.normal(size=(s.nh, s.nu)) * rng.choice((0.0, 0.3))
    root = rng.normal(size=(s.ny, int(rng.integers(1, s.ny + 1))))
    room = {name: rng.uniform(low, high, len(s.finite[name])) for name, (low, high) in ROOMS.items()}
    values = {name: np.where(s.finite[name], SIGNS[name] * size, SIGNS[name] * np.inf) for name, size in room.items()}
    values |= {
        "Q": root @ root.T / s.ny,
        "R": np.diag(10.0 ** rng.uniform(-3.0, 1.0, s.nu)),
        "delta": rng.uniform(0.5, 2.0, s.N),
        "lambda_": rng.uniform(0.5, 2.0, s.N_u),
        "Q_e": rng.choice((0.0, 5.0)) * np.eye(s.ny),
        **{name: 10.0 ** rng.uniform(0.0, 9.0, size) for name, size in (("z", s.nx), ("Z", s.nx), ("zh", s.nh), ("Zh", s.nh))},
    }
    u_prev = np.clip(0.3 * rng.normal(size=s.nu), values["lbu"], values["ubu"])
    (apart,) = rng.spawn(1)  # as above
    values |= rows_by_stage(s, values, apart) if s.by_stage else {}
    return Data(A, B, C, E, F, values, rng.normal(size=s.nx), u_prev, np.cumsum(0.5 * rng.normal(size=(s.N, s.ny)), axis=0))


def rows_by_stage(s: Structure, values: dict[str, Array], rng: np.random.Generator) -> dict[str, Array]:
    """Rows of weights and bounds for all stages; bounds of inputs widen, so that each can be reached from those before."""
    rows = {}
    for name in ROOMS:
        factors = rng.uniform(0.5, 2.0, (s.N_u if name.endswith("u") else s.N, 1))
        rows[name] = values[name] * (np.maximum.accumulate(factors / factors[0]) if name in ("lbu", "ubu") else factors)
    return rows | {"delta": rng.uniform(0.5, 2.0, (s.N, s.ny)), "lambda_": rng.uniform(0.5, 2.0, (s.N_u, s.nu))}


def parameters(s: Structure, data: Data) -> Array:
    """The matrices of a problem in its units, shape ``(np,)``."""
    x, u, y, h = s.unit_x, s.unit_u, s.unit_y, s.unit_h
    scaled = (
        (data.A - np.eye(s.nx)) * x[:, None] / x / DT,
        data.B * x[:, None] / u / DT,
        data.C * y[:, None] / x,
        data.E * h[:, None] / x,
        data.F * h[:, None] / u,
    )
    return np.concatenate([matrix.T.ravel() for matrix in scaled])


def in_units(s: Structure, data: Data) -> dict[str, Array]:
    """Weights and bounds of a problem in its units, by their names."""
    x, u, y, h = s.unit_x, s.unit_u, s.unit_y, s.unit_h
    units = {"lbu": u, "ubu": u, "lbdu": u, "ubdu": u, "lbx": x, "ubx": x, "lh": h, "uh": h}
    units |= {
        "z": 1.0 / x,
        "zh": 1.0 / h,
        "Z": x**-2.0,
        "Zh": h**-2.0,
        "Q": 1.0 / np.outer(y, y),
        "Q_e": 1.0 / np.outer(y, y),
        "R": 1.0 / np.outer(u, u),
    }
    return {name: value * units.get(name, 1.0) for name, value in data.values.items()}


def problem(s: Structure, data: Data) -> Ocp:
    """The problem of a structure, its matrices parameters with those of some data as nominal values."""
    x, u, p_nominal = ca.SX.sym("x", s.nx), ca.SX.sym("u", s.nu), parameters(s, data)
    p = ca.SX.sym("p", len(p_nominal))
    matrices, at = [], 0
    for rows, columns in ((s.nx, s.nx), (s.nx, s.nu), (s.ny, s.nx), (s.nh, s.nx), (s.nh, s.nu)):
        matrices.append(ca.reshape(p[at : at + rows * columns], rows, columns))
        at += rows * columns
    A, B, C, E, F = matrices

    def signals(name: str, count: int) -> tuple[Signal, ...]:
        return tuple(Signal(f"{name}_{i}", "1") for i in range(count))

    model = Model(
        name="random",
        x=x,
        u=u,
        p=p,
        f_expl_expr=A @ x + B @ u,
        y_expr=C @ x,
        states=signals("x", s.nx),
        inputs=signals("u", s.nu),
        outputs=signals("y", s.ny),
        parameters=signals("p", len(p_nominal)),
        p_nominal=tuple(p_nominal),
    )
    constraint = {"h_expr": E @ x + F @ u} if s.nh else {}
    values = {name: value for name, value in in_units(s, data).items() if s.nh or not name.endswith("h")}
    return Ocp(model, N=s.N, blocks=s.blocks, dt=DT, method="euler", **constraint, **values)


class Truth:
    """
    The quadratic program of one problem, in variables of the order of one: states at nodes 1 to N, inputs, slacks of all softened rows.

    Args:
        s: Its structure.
        data: Its data.
    """

    def __init__(self, s: Structure, data: Data) -> None:
        self._s, self._d, v = s, data, data.values
        self._soft = np.concatenate([np.tile(np.concatenate([v["z"], v["zh"]]), s.N), np.tile(np.concatenate([v["Z"], v["Zh"]]), s.N)]).reshape(2, -1)

    def cost(self, x: Array, u: Array) -> float:
        """Cost (4) of states at nodes 0 to N, shape ``(N + 1, nx)``, and inputs, shape ``(N_u, nu)``, its slacks as small as may be."""
        d, v = self._d, self._d.values
        e = x[1:] @ d.C.T - d.y_ref
        du = np.diff(np.vstack([d.u_prev, u]), axis=0)
        bounded = np.hstack([x[1:], x[1:] @ d.E.T + self._held(u) @ d.F.T])
        lower, upper = self._softened("lbx", "lh"), self._softened("ubx", "uh")
        slack = np.maximum(0.0, np.maximum(lower - bounded, bounded - upper)).ravel()
        cost = np.sum(e * self._weighed(e, "delta", "Q")) + e[-1] @ v["Q_e"] @ e[-1] + np.sum(du * self._weighed(du, "lambda_", "R"))
        return float(cost + self._soft[0] @ slack + 0.5 * self._soft[1] @ slack**2)

    def broken(self, x: Array, u: Array) -> float:
        """Largest amount by which dynamics, bounds on inputs or bounds on increments are broken."""
        d, v = self._d, self._d.values
        du = np.diff(np.vstack([d.u_prev, u]), axis=0)
        gaps = [np.abs(x[0] - d.x0), np.abs(x[1:] - x[:-1] @ d.A.T - self._held(u) @ d.B.T)]
        gaps += [v["lbu"] - u, u - v["ubu"], v["lbdu"] - du, du - v["ubdu"]]
        return max(float(np.max(gap)) for gap in gaps)

    def _softened(self, of_states: str, of_constraints: str) -> Array:
        """Softened bounds at all nodes, shape ``(N, nx + nh)``."""
        s, v = self._s, self._d.values
        return np.hstack([np.broadcast_to(v[of_states], (s.N, s.nx)), np.broadcast_to(v[of_constraints], (s.N, s.nh))])

    def _weighed(self, rows: Array, factors: str, weight: str) -> Array:
        """Each row times the weight of its stage, in the precision of the rows."""
        of_stages, matrix = (self._d.values[name].astype(rows.dtype) for name in (factors, weight))
        root = np.sqrt(of_stages.reshape(len(rows), -1))
        return np.asarray(root * ((root * rows) @ matrix))

    def _held(self, u: Array) -> Array:
        """Inputs of all stages."""
        return u[self._s.block_of]

    def rolled_out(self, u: Array) -> Array:
        """States that follow from inputs."""
        x = [self._d.x0]
        for row in self._held(u):
            x.append(self._d.A @ x[-1] + self._d.B @ row)
        return np.array(x)

    def program(self) -> tuple[sp.csc_matrix, Array, sp.csc_matrix, Array, sp.csc_matrix, Array]:
        """``P, q, A, b, G, h`` of: half z'Pz + q'z, least, where Az = b and Gz <= h."""
        s, d, v = self._s, self._d, self._d.values
        nx, nu, N, N_u = s.nx, s.nu, s.N, s.N_u
        hold = sp.csr_matrix((np.ones(N), (np.arange(N), s.block_of)), shape=(N, N_u))
        eye_N, down = sp.eye(N), sp.eye(N, k=-1)
        difference = sp.kron(sp.eye(N_u) - sp.eye(N_u, k=-1), sp.eye(nu))

        def along(name: str) -> Array:
            return np.broadcast_to(v[name], (N_u, nu)).ravel()

        first_u = np.concatenate([d.u_prev, np.zeros((N_u - 1) * nu)])
        to_states = sp.hstack([sp.eye(N * nx) - sp.kron(down, d.A), -sp.kron(hold, d.B), sp.csr_matrix((N * nx, N * (nx + s.nh)))])
        free = np.concatenate([d.A @ d.x0, np.zeros((N - 1) * nx)])

        roots = {name: np.sqrt(v[name].reshape(len(v[name]), -1)) for name in ("delta", "lambda_")}
        weigh = np.array([root[:, None] * v["Q"] * root for root in roots["delta"]])
        weigh[-1] += v["Q_e"]
        H = sp.block_diag([2.0 * d.C.T @ W @ d.C for W in weigh])
        gradient = np.concatenate([-2.0 * d.C.T @ W @ r for W, r in zip(weigh, d.y_ref, strict=True)])
        R = sp.block_diag([2.0 * root[:, None] * v["R"] * root for root in roots["lambda_"]])
        P = sp.block_diag([H, difference.T @ R @ difference, sp.diags(self._soft[1])])
        q = np.concatenate([gradient, -difference.T @ R @ first_u, self._soft[0]])

        rows_u = sp.hstack([sp.csr_matrix((N_u * nu, N * nx)), sp.eye(N_u * nu), sp.csr_matrix((N_u * nu, N * (nx + s.nh)))])
        rows_du = sp.hstack([sp.csr_matrix((N_u * nu, N * nx)), difference, sp.csr_matrix((N_u * nu, N * (nx + s.nh)))])
        bounded_x = sp.kron(eye_N, np.vstack([np.eye(nx), d.E]))
        bounded_u = sp.kron(hold, np.vstack([np.zeros((nx, nu)), d.F]))
        slack = sp.eye(N * (nx + s.nh))
        upper_soft = sp.hstack([bounded_x, bounded_u, -slack])
        lower_soft = sp.hstack([-bounded_x, -bounded_u, -slack])
        positive = sp.hstack([sp.csr_matrix((slack.shape[0], N * nx + N_u * nu)), -slack])
        G = sp.vstack([rows_u, -rows_u, rows_du, -rows_du, upper_soft, lower_soft, positive])
        h = np.concatenate(
            [
                along("ubu"),
                -along("lbu"),
                along("ubdu") + first_u,
                -along("lbdu") - first_u,
                self._softened("ubx", "uh").ravel(),
                -self._softened("lbx", "lh").ravel(),
                np.zeros(slack.shape[0]),
            ]
        )
        self._kept = kept = np.isfinite(h)
        return sp.csc_matrix(P), q, sp.csc_matrix(to_states), free, sp.csc_matrix(sp.csr_matrix(G)[kept]), h[kept]

    def solutions(self) -> list[Solution]:
        """Minima as clarabel and PIQP find them."""
        program = self.program()
        return [solve(*program) for solve in (by_clarabel, by_piqp)]

    def costs(self, solutions: list[Solution]) -> list[float]:
        """Costs of solutions; infinite where there is none. Inputs are put inside their bounds, and states follow from them."""
        return [np.inf if found is None else self._least(found[0]) for found in solutions]

    def excess(self, u: Array, multipliers: Array) -> float:
        """
        Upper bound on the cost of inputs above the least one, by convexity, in extended precision.

        Any multipliers give one; those of the optimum give zero there. An input without a bound is taken to be within one of the optimum's.

        Args:
            u: Inputs inside their bounds, shape ``(N_u, nu)``.
            multipliers: Multipliers of the inequalities of `program`.
        """
        s, d, long = self._s, self._d, np.longdouble
        v = {name: value.astype(long) for name, value in d.values.items()}
        A, B, C, E, F, u = (matrix.astype(long) for matrix in (d.A, d.B, d.C, d.E, d.F, u))
        all_multipliers = np.zeros(len(self._kept), dtype=long)
        all_multipliers[self._kept] = np.maximum(multipliers, 0.0)
        sizes = [s.N_u * s.nu] * 4 + [s.N * (s.nx + s.nh)] * 2
        _, _, upper_du, lower_du, upper, lower = np.split(all_multipliers, np.cumsum(sizes))[:6]
        upper_du, lower_du = upper_du.reshape(u.shape), lower_du.reshape(u.shape)
        upper, lower = upper.reshape(s.N, -1), lower.reshape(s.N, -1)

        held = self._held(u)
        x = [d.x0.astype(long)]
        for row in held:
            x.append(A @ x[-1] + B @ row)
        nodes = np.array(x[1:])
        e, pull = nodes @ C.T - d.y_ref, upper - lower
        by_x = 2.0 * self._weighed(e, "delta", "Q") @ C + pull[:, : s.nx] + pull[:, s.nx :] @ E
        by_x[-1] += 2.0 * (e[-1] @ v["Q_e"] @ C)
        by_u = pull[:, s.nx :] @ F
        r, costate = np.zeros_like(u), np.zeros(s.nx, dtype=long)
        for k in reversed(range(s.N)):
            costate = A.T @ costate + by_x[k] if k < s.N - 1 else by_x[k]
            r[s.block_of[k]] += B.T @ costate + by_u[k]
        du = np.diff(np.vstack([d.u_prev, u]), axis=0)
        force = 2.0 * self._weighed(du, "lambda_", "R") + upper_du - lower_du
        r += force
        r[:-1] -= force[1:]

        rooms = [np.where(np.isfinite(room), room, 1.0) for room in (u - v["lbu"], v["ubu"] - u)]
        slopes = [np.where(r > 0.0, r, 0.0), np.where(r < 0.0, -r, 0.0)]
        bound = sum(np.sum(slope * room) for slope, room in zip(slopes, rooms, strict=True))
        for multiplier, room in ((upper_du, v["ubdu"] - du), (lower_du, du - v["lbdu"])):
            bound += np.sum(multiplier * np.where(multiplier > 0.0, room, 0.0))
        values = np.hstack([nodes, nodes @ E.T + held @ F.T])
        over, under = values - self._softened("ubx", "uh"), self._softened("lbx", "lh") - values
        slack = np.maximum(0.0, np.maximum(over, under))
        z, Z = (soft.reshape(slack.shape).astype(long) for soft in self._soft)
        bound += np.sum(z * slack + Z * slack**2 / 2 + np.maximum(0.0, upper + lower - z) ** 2 / (2 * Z))
        for multiplier, beyond in ((upper, over), (lower, under)):
            bound -= np.sum(multiplier * np.where(multiplier > 0.0, beyond, 0.0))
        return float(bound)

    def _least(self, z: Array) -> float:
        s, v = self._s, self._d.values
        wanted = z[s.N * s.nx :][: s.N_u * s.nu].reshape(s.N_u, s.nu)
        u, last = np.empty_like(wanted), self._d.u_prev
        lbu, ubu, lbdu, ubdu = (np.broadcast_to(v[name], wanted.shape) for name in ("lbu", "ubu", "lbdu", "ubdu"))
        for k, row in enumerate(wanted):
            last = u[k] = np.clip(np.clip(row, last + lbdu[k], last + ubdu[k]), lbu[k], ubu[k])
        return self.cost(self.rolled_out(u), u)


def by_clarabel(P: sp.csc_matrix, q: Array, A: sp.csc_matrix, b: Array, G: sp.csc_matrix, h: Array) -> Solution:
    """The minimum by clarabel."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    settings.max_iter = 400
    cones = [clarabel.ZeroConeT(len(b)), clarabel.NonnegativeConeT(len(h))]
    found = clarabel.DefaultSolver(sp.triu(P, format="csc"), q, sp.csc_matrix(sp.vstack([A, G])), np.concatenate([b, h]), cones, settings).solve()
    return (np.array(found.x), np.array(found.z)[len(b) :]) if str(found.status) in ("Solved", "AlmostSolved", "InsufficientProgress") else None


def by_piqp(P: sp.csc_matrix, q: Array, A: sp.csc_matrix, b: Array, G: sp.csc_matrix, h: Array) -> Solution:
    """The minimum by PIQP."""
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-11
    solver.settings.max_iter = 400
    solver.setup(P, q, A, b, G, np.full(len(h), -np.inf), h)
    status = solver.solve()
    return (np.array(solver.result.x), np.array(solver.result.z_u)) if status in (piqp.PIQP_SOLVED, piqp.PIQP_MAX_ITER_REACHED) else None
