# SPDX-License-Identifier: Apache-2.0
r"""
Scale of each variable: its unit inside the solvers, so that the units of a model do not matter.

The scale of an input is half the range between its bounds, or the sum of its largest
increments over the control horizon, or follows from the curvature of the cost. The
scale of a state is half the range between its bounds, or its reach: how far the inputs
can move it over the horizon; one SI unit where nothing moves it. A general constraint has half its range, or what states and
inputs, each as far as it reaches, change it by in whichever direction does most: along the
one motion at which this is computed it may hardly change. A second difference has the
scale of its input, as an increment has. Every tolerance is relative to these scales.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.rti.linearization import constraints, gauss_newton, linearize
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.second_difference import Remembering
from rti_mpc.si import HasUnit, ones, read


def scale(ocp: Ocp, x: Array, u: Array, y_ref: Array, p: Array) -> Array:
    """
    Return the scales of states, inputs and softened bounds, then the reach of the states, shape ``(2 nx + nu + ng,)``, all positive.

    The reach is how far inputs move a state over the horizon, whatever its bounds; the scale of one that they do not move.

    Args:
        ocp: The problem.
        x: States of a plan at which reach and curvature are computed, shape ``(N + 1, nx)``.
        u: Its inputs, shape ``(N_u, nu)``.
        y_ref: Reference of that plan, shape ``(N, ny)``.
        p: Stage parameters, shape ``(N + 1, np)``.
    """
    model, N = ocp.model, ocp.N
    held = u[ocp.held]
    stage, A_k, B_k = linearize(ocp)
    columns = np.array(stage.map(N)(x[:-1].T, held.T, p[:-1].T))[model.nx :]
    A, B = dense(A_k, columns[: A_k.nnz()]), dense(B_k, columns[A_k.nnz() :])
    response = np.zeros((N + 1, model.nx, model.nu))  # response of the states to a step of each input
    for k in range(N):
        response[k + 1] = A[k] @ response[k] + B[k]
    response = response[1:]

    node, H_i = gauss_newton(ocp)
    W = np.hstack([ocp.Q_at(k) + (ocp.Q_e if k == N - 1 else 0.0) for k in range(N)])
    nv = H_i.size1()
    at = (x[1:].T, held.T) if nv > model.nx else (x[1:].T,)
    H = dense(H_i, np.array(node.map(N)(*at, p[1:].T, y_ref.T, W))[nv + 1 :])
    seen = np.concatenate([response, np.tile(np.eye(model.nu), (N, 1, 1))], axis=1)[:, :nv]
    curvature = np.einsum("kai,kab,kbi->i", seen, H, seen) + ocp.lambda_.sum(axis=0) * np.diag(ocp.R) + ocp.N_u * np.atleast_2d(ocp.R_u).mean(axis=0)

    with np.errstate(divide="ignore"):  # an input that costs nothing reaches any distance
        reach_cost = 1.0 / np.sqrt(curvature)
    reach_u = first(
        half(ocp.widest("lbu"), ocp.widest("ubu")),
        half(ocp.widest("lbdu"), ocp.widest("ubdu")) * ocp.N_u,
        beyond(ocp.widest("lbu"), ocp.widest("ubu"), np.array(model.u_rest)),
        reach_cost,
        ones(model.inputs),
    )
    reach = shared(np.abs(response * reach_u).sum(axis=2).max(axis=0), model.states)
    lbx, ubx = ocp.widest("lbx"), ocp.widest("ubx")
    scale_x = first(half(lbx, ubx), reach, beyond(lbx, ubx, np.zeros(model.nx)), ones(model.states))

    constraint, G_x, G_u = constraints(ocp)
    ng = ocp.ng
    columns = np.array(constraint.map(N)(x[1:].T, held.T, p[1:].T)).reshape(-1, N)[ng:]
    by_x, by_u = dense(G_x, columns[: G_x.nnz()]), dense(G_u, columns[G_x.nnz() :])
    reach_g = np.linalg.norm(np.concatenate([by_x * reach, by_u * reach_u], axis=2), axis=2).max(axis=0, initial=0.0)
    scale_g = first(half(ocp.widest("lg"), ocp.widest("ug")), reach_g, beyond(ocp.widest("lg"), ocp.widest("ug"), np.zeros(ng)))
    scale_g[: len(ocp.soft)], scale_g[ocp.ng_path :] = scale_x[list(ocp.soft)], scale_x[list(ocp.soft_e)]
    if isinstance(ocp, Remembering):
        remembered = list(ocp.remembered)
        scale_g[ocp.ng_path - len(remembered) : ocp.ng_path] = reach_u[remembered]
    return np.concatenate([scale_x, reach_u, scale_g, np.where(reach > 0.0, reach, scale_x)])


def shared(reach: Array, states: Sequence[HasUnit]) -> Array:
    """
    Return for each state the largest reach of all states of its kind of unit: x and y of a position have one scale, whichever way the robot faces.

    Kilometres and millimetres are of one kind.
    """
    units = [read(state.unit) for state in states]
    size = np.array([unit.size for unit in units])
    alike = np.array([[a.dimension == b.dimension != () for b in units] for a in units]) | np.eye(len(units), dtype=bool)
    return np.asarray(np.where(alike, size * reach, 0.0).max(axis=1) / size)


def half(lower: Array, upper: Array) -> Array:
    """Return half the range between bounds; infinite where one is absent."""
    return np.asarray(0.5 * (upper - lower))


def beyond(lower: Array, upper: Array, origin: Array) -> Array:
    """Return the distance from an origin to the nearest finite bound."""
    return np.asarray(np.minimum(np.abs(upper - origin), np.abs(lower - origin)))


def first(*candidates: Array) -> Array:
    """Return for each component the first candidate that can be a scale, finite and positive, or 1."""
    chosen = np.ones_like(candidates[0])
    for candidate in reversed(candidates):
        chosen = np.where(np.isfinite(candidate) & (candidate > 0.0), candidate, chosen)
    return chosen


def dense(pattern: ca.Sparsity, nonzeros: Array) -> Array:
    """Return dense matrices of a pattern from their nonzeros, a matrix per column; shape ``(columns, rows of the pattern, its columns)``."""
    rows, cols = pattern.get_triplet()
    matrices = np.zeros((nonzeros.shape[1], *pattern.shape))
    matrices[:, rows, cols] = nonzeros.T
    return matrices
