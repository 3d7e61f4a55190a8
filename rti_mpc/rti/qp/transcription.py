# SPDX-License-Identifier: Apache-2.0
r"""
A QP with a fixed sparsity pattern, as expressions: what either formulation makes of an OCP.

Beside the QP itself there are two small functions of the feedback phase:
`embed` writes the initial state into it, `step` makes a plan of its solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from rti_mpc.codegen import function
from rti_mpc.rti.linearization import Linearization
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
        everything: ``(x, u, u_prev, y_ref, p, *WEIGHTS, scale) -> (q, P_data, A_data, lower, upper, memory, checksum, cost)``; `memory` is what
            `embed` and `step` want to know, and `checksum` is finite if and only if all the others are.
        varying: Which of these eight change from sample to sample, by name.
        data: As `everything`, but returns only what varies.
        embed: ``(x0, x, memory) -> `` what of the QP depends on the initial state, named as what it is a part of, with ``_embedded``.
        embedded: Where that goes: q, lower or upper, and place in it.
        step: ``(x, u, u_prev, solution, x0, memory, *WEIGHTS, scale) -> (x_plan, u_plan, violation, change)``: the full step, by how much it
            exceeds softened bounds, as it is and relative to their scale, and its size.
        columns: Which entry of the scale each variable is measured by, see `rti_mpc.rti.scale`; shape ``(n,)``.
        rows: Which entry each row is measured by; shape ``(m,)``.
        eliminable: States in z, which as many first rows determine.
        watched: For each softened row, the last rows of all, those by which it is known a stage earlier to act: itself and its like one stage
            later; for the sign of a slack, those of the bounds that it softens. Counted from the first of them; shape ``(rows, 4)``.
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

    CasADi and OSQP both count nonzeros column by column, so that one index vector, computed here once, makes ``A.data`` in compiled code.
    """

    def __init__(self) -> None:
        self._pool: list[ca.MX] = []
        self._pooled = 0
        self._entries: list[tuple[Any, Any, Any]] = []

    def place(self, row: int, col: int, block: Any) -> None:
        """Place a constant block with its corner at ``(row, col)``."""
        coo = sp.coo_array(block)
        coo.eliminate_zeros()  # kron stores those of dense blocks
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
        numbers = sp.csc_array((sources + 1, (rows, cols)), shape=(m, n))  # counted from 1, or the first would vanish
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
        Append rows whose left-hand side is `value` at the guess; None: no bound. Return the first of them.

        `scales` says which entry of the scale each row of a column of `value` is measured by.
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
        """Let each row from `first` on watch its like one stage, that is `width` rows, later."""
        for row in range(first, self.count - width):
            self.watched[row][1] = row + width

    def watched_from(self, first: int) -> np.ndarray[Any, Any]:
        """Return what the rows from `first` on watch, counted from there."""
        return np.array(self.watched[first : self.count], dtype=np.intp).reshape(-1, 4) - first

    def follow(self, first: int, ng: int, sides: list[tuple[int, list[int]]]) -> None:
        """Let the signs of slacks, ng a node from `first` on, watch the bounds they soften, each ``(first row, which of the ng)``."""
        for row in range(first, self.count):
            i, j = divmod(row - first, ng)
            watched = [start + i * len(at) + at.index(j) for start, at in sides if j in at]
            self.watched[row] = [seen for bound in watched for seen in self.watched[bound][:2]] * (2 if len(watched) == 1 else 1)


def input_rows(ocp: Ocp, lin: Linearization, rows: BoundRows, A: Blocks, to_du: int) -> None:
    """Append the bounds on inputs and on increments."""
    N_u, nu = ocp.N_u, ocp.model.nu
    difference = sp.eye_array(N_u) - sp.eye_array(N_u, k=-1)
    _, by_input, _ = measured_by(ocp)
    for lb, value, ub, over in (("lbu", lin.u, "ubu", sp.eye_array(N_u)), ("lbdu", lin.increments, "ubdu", difference)):
        at = finite(getattr(ocp, lb), getattr(ocp, ub))
        if at:
            row = rows.add(each(lin.w[lb][at], N_u), value[at, :], each(lin.w[ub][at], N_u), by_input[at])
            A.place(row, to_du, sp.kron(over, np.eye(nu)[at]))


def measured_by(ocp: Ocp) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return the entries of the scale that belong to states, to inputs and to what has softened bounds."""
    nx, nu = ocp.model.nx, ocp.model.nu
    return np.arange(nx), nx + np.arange(nu), nx + nu + np.arange(len(ocp.lg))


def clipped(u: ca.MX, u_prev: ca.MX, w: dict[str, ca.MX]) -> ca.MX:
    """
    Return inputs that meet their bounds exactly, as an actuator wants them: a solver's iterate does so to its tolerance.

    Increments first: from an input inside its bounds, that leaves both satisfied.
    """
    nu, N_u = u.shape
    last, wanted, lbdu, ubdu, lbu, ubu = (ca.SX.sym(name, nu) for name in ("last", "wanted", "lbdu", "ubdu", "lbu", "ubu"))
    met = ca.fmax(ca.fmin(wanted, last + ubdu), last + lbdu)
    met = ca.fmax(ca.fmin(met, ubu), lbu)
    clip = ca.Function("clip", [last, wanted, lbdu, ubdu, lbu, ubu], [met])
    if N_u > 1:
        clip = clip.mapaccum("clips", N_u)
    return ca.MX(clip(u_prev, u, *(each(w[name], N_u) for name in ("lbdu", "ubdu", "lbu", "ubu"))))


class Remembered:
    """
    What the full step wants to know of the linearization of the softened constraints: the head of `memory`, as symbols.

    Attributes:
        memory: All of it, shape ``(remembered, 1)``.
        rest: What comes behind.
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
        Return by how much a plan exceeds the linearized constraints at most, as it is and relative to their scale; `dx` from node 0 on.

        Negative if it keeps them all.
        """
        ocp, lin = self._ocp, self._lin
        ng, N = len(ocp.lg), ocp.N
        if not ng:
            return ca.MX(ca.DM([-INFINITY, -INFINITY]))
        names = ("g", "g_x", "g_u", "lg", "ug", "scale")
        g, g_x, g_u, lg, ug, scale = (ca.SX.sym(n, e.shape[0]) for n, e in zip(names, (*head(lin), lin.lg, lin.ug, lin.scale_g), strict=True))
        dx_i, du_i = ca.SX.sym("dx", dx.shape[0]), ca.SX.sym("du", du.shape[0])
        value = g + ca.SX(lin.G_x, g_x) @ dx_i + ca.SX(lin.G_u, g_u) @ du_i
        excess = [(value - ug)[j] for j in finite(ocp.ug)] + [(lg - value)[j] for j in finite(ocp.lg)]
        scales = [scale[j] for j in (*finite(ocp.ug), *finite(ocp.lg))]
        shares = [by / one for by, one in zip(excess, scales, strict=True)]
        worst = ca.Function("worst", [g, g_x, g_u, dx_i, du_i, lg, ug, scale], [ca.vertcat(*(ca.mmax(ca.vertcat(*of)) for of in (excess, shares)))])
        limits = (*softened_bounds(ocp, w), lin.scale_g)
        held = ca.horzcat(du, ca.repmat(du[:, -1], 1, N - ocp.N_u))
        found = worst.map(N)(*self._parts, dx[:, 1:], held, *(each(limit, N) for limit in limits))
        return ca.vertcat(*(ca.mmax(row) for row in ca.vertsplit(found)))


def softened_bounds(ocp: Ocp, w: dict[str, Any]) -> tuple[Any, Any]:
    """Return lower and upper bounds of everything softened, as expressions."""
    soft = list(ocp.soft)
    return ca.vertcat(w["lbx"][soft, 0], w["lh"]), ca.vertcat(w["ubx"][soft, 0], w["uh"])


def head(lin: Linearization) -> list[ca.MX]:
    """Return the head of `memory`, see `Remembered`."""
    return [lin.g, lin.g_x, lin.g_u]


def picked(sparsity: ca.Sparsity, rows: list[int]) -> tuple[list[int], ca.Sparsity]:
    """Return which nonzeros of a pattern lie in some rows, and the pattern of these rows alone."""
    at = [(i, rows.index(row), col) for i, (row, col) in enumerate(zip(*sparsity.get_triplet(), strict=True)) if row in rows]
    return [i for i, _, _ in at], ca.Sparsity.triplet(len(rows), sparsity.size2(), [row for _, row, _ in at], [col for _, _, col in at])


def finite(*bounds: np.ndarray[Any, Any]) -> list[int]:
    """Return where any of these bounds is present."""
    return [int(j) for j in np.flatnonzero(np.any(np.isfinite(bounds), axis=0))]


def each(column: ca.MX, times: int) -> ca.MX:
    """Repeat a column for every stage."""
    return ca.repmat(column, 1, times)


def data_functions(lin: Linearization, kind: str, **data: ca.MX) -> tuple[ca.Function, tuple[str, ...], ca.Function]:
    """Return the function of all data of a QP, the cost among them, which of them vary with the sample, and the function of these."""
    outputs = {name: ca.densify(output) for name, output in (data | {"cost": lin.cost}).items()}
    sample = ca.veccat(*lin.sample.values())
    varying = tuple(name for name, output in outputs.items() if output.numel() and ca.depends_on(output, sample))
    return (
        function("everything", lin.arguments, outputs),
        varying,
        function(f"data_{kind}", lin.arguments, {name: outputs[name] for name in varying}),
    )
