# SPDX-License-Identifier: Apache-2.0
r"""
Transcription of an OCP to a QP with a fixed sparsity pattern, as expressions, for both formulations.

Besides the data of the QP there are two small functions for the feedback phase:
`embed` writes the initial state into the data, `step` makes a plan from the solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.codegen import function
from rti_mpc.rti.blocks import all_inputs, at_each
from rti_mpc.rti.linearization import Linearization, softened
from rti_mpc.rti.ocp import Ocp

KIND_NAMES = {False: "relaxed", True: "whole"}  # key: whether the QP has softened bounds; functions compiled together need different names
INFINITY = 1e30  # OSQP's own: a bound of this magnitude is absent
SLACK_UNIT = 0.1  # a slack variable counts tenths of its state's unit, which makes its penalty as stiff as the other terms, see docs/engine.md


@dataclass(frozen=True, eq=False)
class Transcription:
    """
    The QP of an OCP: patterns, and the functions that fill it.

    Attributes:
        P: Pattern of the upper triangle of the Hessian, shape ``(n, n)``.
        A: Pattern of the constraint matrix, shape ``(m, n)``.
        everything: ``(x, u, u_prev, y_ref, p, *ARGUMENTS, scale) -> (q, P_data, A_data, lower, upper, memory, checksum, cost)``;
            `memory` holds the further arguments of `embed` and `step`, and `checksum` is finite if and only if all the others are.
        varying: Names of those of these eight that change from sample to sample.
        data: As `everything`, but returns only those in `varying`.
        embed: ``(x0, x, memory) -> `` the parts of the QP that depend on the initial state, with the name of the vector and ``_embedded``.
        embedded: Vector (q, lower or upper) and slice that each of these parts is written to.
        step: ``(x, u, u_prev, solution, x0, memory, *ARGUMENTS, scale) -> (x_plan, u_plan, violation, change)``: the plan after
            the full step, its largest violation of softened bounds, in their unit and relative to their scale, and the size of the step.
        columns: Index of each variable's scale, see `rti_mpc.rti.scale`; shape ``(n,)``.
        rows: Index of each row's scale; shape ``(m,)``.
        eliminable: Number of states in z, which are determined by as many first rows.
        watched: For each softened row the rows whose last multipliers show whether it acts: itself and the same row one stage later; for
            ``s >= 0``, the rows of the bounds that the slack softens. Counted from the first softened row; shape ``(rows, 4)``.
    """

    P: sp.csc_array[Any]
    A: sp.csc_array[Any]
    everything: ca.Function
    varying: tuple[str, ...]
    data: ca.Function
    embed: ca.Function
    embedded: tuple[tuple[str, slice], ...]
    step: ca.Function
    columns: np.ndarray[Any, Any]
    rows: np.ndarray[Any, Any]
    eliminable: int
    watched: np.ndarray[Any, Any]


class Blocks:
    """
    A sparse matrix under assembly, its nonzeros gathered from a pool of values.

    CasADi and OSQP both store nonzeros column by column, so compiled code fills ``A.data`` by one index vector, which is computed here once.
    """

    def __init__(self) -> None:
        self._pool: list[ca.MX] = []
        self._pooled = 0
        self._entries: list[tuple[Any, Any, Any]] = []

    def place(self, row: int, col: int, block: Any) -> None:
        """Place a constant block with its corner at ``(row, col)``."""
        coo = sp.coo_array(block)
        coo.eliminate_zeros()  # kron stores the zeros of dense blocks
        values, sources = np.unique(coo.data, return_inverse=True)
        self._entries.append((coo.row + row, coo.col + col, self._pooled + sources))
        self._pooled += len(values)
        self._pool.append(ca.MX(ca.DM(values)))

    def place_values(self, values: ca.MX, corners: list[tuple[int, int, ca.Sparsity]]) -> None:
        """Place values that vary: the nonzeros of one pattern after the other, each with its corner ``(row, col)``."""
        for row, col, sparsity in corners:
            rows, cols = (np.array(places, dtype=int) for places in sparsity.get_triplet())
            self._entries.append((rows + row, cols + col, self._pooled + np.arange(len(rows))))
            self._pooled += len(rows)
        self._pool.append(values)

    def finish(self, m: int, n: int) -> tuple[sp.csc_array[Any], ca.MX]:
        """Return the pattern, shape ``(m, n)``, and its nonzeros as an expression."""
        rows, cols, sources = (np.concatenate(parts) for parts in zip(*self._entries, strict=True))
        numbers = sp.csc_array((sources + 1, (rows, cols)), shape=(m, n))  # counted from 1, since an entry of 0 would vanish
        numbers.sort_indices()
        ones = sp.csc_array((np.ones(numbers.nnz), numbers.indices, numbers.indptr), shape=(m, n))
        return ones, ca.vertcat(*self._pool)[(numbers.data - 1).tolist()]


class BoundRows:
    """Bounds of the rows of a QP under assembly, in deviations from a guess."""

    def __init__(self) -> None:
        self.lower: list[ca.MX] = []
        self.upper: list[ca.MX] = []
        self.count = 0
        self.watched: list[list[int]] = []
        self.scales: list[int] = []

    def add(self, lb: ca.MX | None, value: ca.MX, ub: ca.MX | None, scales: np.ndarray[Any, Any]) -> int:
        """
        Append rows whose left-hand side is `value` at the guess, and return the index of the first one.

        A bound of None is absent. `scales` holds the index of the scale for each row of a column of `value`.
        """
        first = self.count
        absent = ca.MX(ca.DM.ones(value.numel()) * INFINITY)
        self.lower.append(-absent if lb is None else ca.vec(lb - value))
        self.upper.append(absent if ub is None else ca.vec(ub - value))
        self.count += value.numel()
        self.scales += scales.tolist() * value.size2()
        self.watched += [[row] * 4 for row in range(first, self.count)]
        return first

    def chain(self, first: int, width: int) -> None:
        """Let each row from `first` on also watch the same row of the next stage, `width` rows later."""
        for row in range(first, self.count - width):
            self.watched[row][1] = row + width

    def watched_from(self, first: int) -> np.ndarray[Any, Any]:
        """Return the rows that the rows from `first` on watch, counted from `first`."""
        return np.array(self.watched[first : self.count], dtype=np.intp).reshape(-1, 4) - first

    def add_slacks(self, ng: int, N: int, scales: np.ndarray[Any, Any], sides: list[tuple[int, list[int]]]) -> int:
        """
        Append the rows ``s >= 0``, ng for each of N nodes, and return the index of the first one.

        They watch the bounds that the slacks soften, each ``(first row, which of the ng)``.
        """
        none = ca.MX.zeros(ng, N)
        first = self.add(none, none, None, scales)
        for row in range(first, self.count):
            i, j = divmod(row - first, ng)
            watched = [start + i * len(at) + at.index(j) for start, at in sides if j in at]
            seen = [seen for bound in watched for seen in self.watched[bound][:2]]
            self.watched[row] = (seen * (2 if len(watched) == 1 else 1)) or [row] * 4  # a general constraint may have no bound
        return first


def input_rows(ocp: Ocp, lin: Linearization, rows: BoundRows, A: Blocks, to_du: int) -> None:
    """Append the bounds on inputs and on increments."""
    N_u, nu = ocp.N_u, ocp.model.nu
    difference = sp.eye_array(N_u) - sp.eye_array(N_u, k=-1)
    _, by_input, _ = measured_by(ocp)
    for lb, value, ub, over in (("lbu", lin.u, "ubu", sp.eye_array(N_u)), ("lbdu", lin.increments, "ubdu", difference)):
        at = finite(ocp.tightest(lb), ocp.tightest(ub))
        if at:
            row = rows.add(at_each(of_signals(lin.w[lb], at), N_u), value[at, :], at_each(of_signals(lin.w[ub], at), N_u), by_input[at])
            A.place(row, to_du, sp.kron(over, np.eye(nu)[at]))


def measured_by(ocp: Ocp) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the indices of the scales of states, of inputs and of softened bounds."""
    nx, nu = ocp.model.nx, ocp.model.nu
    return np.arange(nx), nx + np.arange(nu), nx + nu + np.arange(ocp.ng)


def clipped(u: ca.MX, u_prev: ca.MX, w: dict[str, ca.MX]) -> ca.MX:
    """
    Return inputs clipped exactly to their bounds, as an actuator needs them: a solver's iterate keeps them only to its tolerance.

    Increments are clipped first: after an input inside its bounds, both are then satisfied.
    """
    nu, N_u = u.shape
    last, wanted, lbdu, ubdu, lbu, ubu = (ca.SX.sym(name, nu) for name in ("last", "wanted", "lbdu", "ubdu", "lbu", "ubu"))
    met = ca.fmax(ca.fmin(wanted, last + ubdu), last + lbdu)
    met = ca.fmax(ca.fmin(met, ubu), lbu)
    clip = ca.Function("clip", [last, wanted, lbdu, ubdu, lbu, ubu], [met])
    if N_u > 1:
        clip = clip.mapaccum("clips", N_u)
    return ca.MX(clip(u_prev, u, *(at_each(w[name], N_u) for name in ("lbdu", "ubdu", "lbu", "ubu"))))


class Remembered:
    """
    The linearization of the softened constraints in the head of `memory`, as symbols for the full step.

    Attributes:
        memory: The whole memory, shape ``(remembered, 1)``.
        rest: The memory after its head.
    """

    def __init__(self, ocp: Ocp, lin: Linearization, remembered: int) -> None:
        self._ocp, self._lin = ocp, lin
        self.memory = ca.MX.sym("memory", remembered)
        shapes = [e.shape for e in head(lin)]
        ends = np.cumsum([0, *(rows * columns for rows, columns in shapes)]).tolist()
        self._parts = [ca.reshape(self.memory[a:b], *shape) for (a, b), shape in zip(pairwise(ends), shapes, strict=True)]
        self.rest = self.memory[ends[-1] :]

    def violation(self, dx: ca.MX, du: ca.MX, w: dict[str, ca.MX]) -> ca.MX:
        """
        Return the largest violation of the linearized constraints by a plan, in their unit and relative to their scale; `dx` from node 0 on.

        Negative if the plan keeps all of them.
        """
        ocp, lin = self._ocp, self._lin
        N = ocp.N
        above, below = finite(ocp.tightest("ug")), finite(ocp.tightest("lg"))
        if not (above or below):  # a general constraint may have no bound
            return ca.MX(ca.DM([-INFINITY, -INFINITY]))
        names = ("g", "g_x", "g_u", "lg", "ug", "scale")
        g, g_x, g_u, lg, ug, scale = (ca.SX.sym(n, e.shape[0]) for n, e in zip(names, (*head(lin), lin.lg, lin.ug, lin.scale_g), strict=True))
        dx_i, du_i = ca.SX.sym("dx", dx.shape[0]), ca.SX.sym("du", du.shape[0])
        value = g + ca.SX(lin.G_x, g_x) @ dx_i + ca.SX(lin.G_u, g_u) @ du_i
        excess = [(value - ug)[j] for j in above] + [(lg - value)[j] for j in below]
        scales = [scale[j] for j in (*above, *below)]
        shares = [by / one for by, one in zip(excess, scales, strict=True)]
        worst = ca.Function("worst", [g, g_x, g_u, dx_i, du_i, lg, ug, scale], [ca.vertcat(*(ca.mmax(ca.vertcat(*of)) for of in (excess, shares)))])
        limits = (*softened_bounds(ocp, w), lin.scale_g)
        found = worst.map(N)(*self._parts, dx[:, 1:], all_inputs(du, ocp.blocks), *(at_each(limit, N) for limit in limits))
        return ca.vertcat(*(ca.mmax(row) for row in ca.vertsplit(found)))


def softened_bounds(ocp: Ocp, w: dict[str, Any]) -> tuple[Any, Any]:
    """Return the softened lower and upper bounds as expressions, each of shape ``(ng, 1)``, or ``(ng, N)``."""
    return softened(ocp, w, "lbx", "lh", "lbx_e"), softened(ocp, w, "ubx", "uh", "ubx_e")


def head(lin: Linearization) -> list[ca.MX]:
    """Return the head of `memory`, see `Remembered`."""
    return [lin.g, lin.g_x, lin.g_u]


def picked(sparsity: ca.Sparsity, rows: list[int]) -> tuple[list[int], ca.Sparsity]:
    """Return which nonzeros of a pattern lie in some rows, and the pattern of these rows alone."""
    at = [(i, rows.index(row), col) for i, (row, col) in enumerate(zip(*sparsity.get_triplet(), strict=True)) if row in rows]
    return [i for i, _, _ in at], ca.Sparsity.triplet(len(rows), sparsity.size2(), [row for _, row, _ in at], [col for _, _, col in at])


def finite(*bounds: np.ndarray[Any, Any]) -> list[int]:
    """Return the indices at which any of these bounds is finite."""
    return [int(j) for j in np.flatnonzero(np.any(np.isfinite(bounds), axis=0))]


def of_signals(bounds: ca.MX, at: list[int]) -> ca.MX:
    """Return the bounds of some signals, a column for all stages or one for each."""
    return bounds[at] if bounds.size2() == 1 else bounds[at, :]


def data_functions(lin: Linearization, kind: str, **data: ca.MX) -> tuple[ca.Function, tuple[str, ...], ca.Function]:
    """Return the function of all data of a QP, cost included; the names of the data that vary with the sample; and the function of these."""
    outputs = {name: ca.densify(output) for name, output in (data | {"cost": lin.cost}).items()}
    sample = ca.veccat(*lin.sample.values())
    varying = tuple(name for name, output in outputs.items() if output.numel() and ca.depends_on(output, sample))
    return (
        function("everything", lin.arguments, outputs),
        varying,
        function(f"data_{kind}", lin.arguments, {name: outputs[name] for name in varying}),
    )
