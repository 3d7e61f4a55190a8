# SPDX-License-Identifier: Apache-2.0
r"""
Bounds on the second difference of inputs, as general constraints of a model that remembers its last inputs.

Of each input that has such a bound, three further states hold the inputs before a node,

.. math::

    v^1_{k+1} = u_k, \qquad v^2_{k+1} = v^1_k, \qquad v^3_{k+1} = v^2_k ,

so that :math:`u_k - 2 v^2_{k+1} + v^3_{k+1}` is the second difference at stage k: a general
constraint like any other, softened, in both formulations, all solvers and their
certificate. At node 0 the states are the inputs that were sent before, so that the first
stage is bounded as well. Where inputs are held in blocks the states remember those of
blocks, and the constraint acts where a block begins; parameters of the stages say where.

Only solvers see these states. A problem without such bounds is solved as it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.model.integrator import steps
from rti_mpc.model.model import Model, Signal
from rti_mpc.rti.nominal import nominal_state
from rti_mpc.rti.ocp import ARGUMENTS, Ocp

REMEMBERED = 3  # inputs before a node
OF_STATES, OF_CONSTRAINTS = ("lbx", "ubx", "z", "Z", "lbx_e", "ubx_e"), ("lh", "uh", "zh", "Zh")
AMONG_CONSTRAINTS = {"lbddu": "lh", "ubddu": "uh", "zddu": "zh", "Zddu": "Zh"}  # at their end


class Remembering(Ocp):
    """
    A problem as solvers have it: its model remembers inputs, and its last general constraints are the second differences.

    Attributes:
        own: The model as it was given.
        remembered: Indices of the inputs that are remembered; `model` has them after its own states, the latest first.
        flags: The parameters after the model's own, at nodes 0 to N: whether a block has begun a stage before, and whether one begins; shape
            ``(N + 1, 0, 1 or 2)``, without those on which nothing depends.
    """

    own: Model
    remembered: tuple[int, ...]
    flags: Array

    def stage(self, *, derivatives: bool = False) -> tuple[ca.SX, ...]:
        """As `Ocp.stage`."""
        x_next, *more = steps(self.own, self.dt, self.method, derivatives=derivatives)
        u, past = self.model.u, self.model.x[self.own.nx :]
        n = len(self.remembered)
        latest, earlier = u[list(self.remembered)], past[:-n]
        if self.flags.shape[1] == 2:
            moved = ca.vertcat(latest, past[n:] + self.model.p[-1] * (earlier - past[n:]))
        else:
            moved = ca.vertcat(latest, earlier)
        if not derivatives:
            return (ca.vertcat(x_next, moved),)
        return ca.vertcat(x_next, moved), ca.diagcat(more[0], ca.jacobian(moved, past)), ca.vertcat(more[1], ca.jacobian(moved, u))


def as_solved(ocp: Ocp) -> Ocp:
    """
    Return a problem as solvers have it: one that remembers inputs where second differences are bounded, else itself.

    Raises:
        OcpError: As `rti_mpc.rti.nominal.nominal_state`.
    """
    if not ocp.soft_ddu:
        return ocp
    if ocp not in _known:
        _known[ocp] = remembering(ocp)
    return _known[ocp]


_known: WeakKeyDictionary[Ocp, Remembering] = WeakKeyDictionary()  # so that one problem is built and compiled once


def remembering(ocp: Ocp) -> Remembering:
    """Build the problem that remembers inputs."""
    model, bounded = ocp.model, list(ocp.soft_ddu)
    flags = flags_of(ocp)
    past, marks = ca.SX.sym("past", REMEMBERED * len(bounded)), ca.SX.sym("marks", flags.shape[1])
    standing = ca.SX(past.numel(), 1) if model.dt is None else past  # what really becomes of them is in `Remembering.stage`
    dynamics: dict[str, Any] = {name: ca.vertcat(expression, standing) for name, expression in model.dynamics.items()}
    names = [f"{model.inputs[j].name}[-{age}]" for age in range(1, REMEMBERED + 1) for j in bounded]
    extended = replace(
        model,
        x=ca.vertcat(model.x, past),
        p=ca.vertcat(model.p, marks),
        states=(*model.states, *(Signal(name, "") for name in names)),
        parameters=(*model.parameters, *(Signal(f"[block {i}]", "1") for i in range(marks.numel()))),
        p_nominal=(*model.p_nominal, *np.ones(marks.numel())),
        x_nominal=(*nominal_state(ocp), *(model.u_rest[j] for j in bounded * REMEMBERED)),
        **dynamics,
    )
    n = len(bounded)
    second = model.u[bounded] - 2 * past[n : 2 * n] + past[2 * n :]
    problem = object.__new__(Remembering)
    vars(problem).update(vars(ocp))
    none = np.full(model.nu, np.inf)
    h_expr = ca.vertcat(ocp.h_expr, (marks[0] if marks.numel() else 1) * second)
    changed = {"model": extended, "own": model, "remembered": ocp.soft_ddu, "flags": flags, "h_expr": h_expr, "lbddu": -none, "ubddu": none}
    sizes = dict.fromkeys(OF_STATES, extended.nx) | dict.fromkeys(OF_CONSTRAINTS, h_expr.numel())
    unbounded = {"lbx": -np.inf, "lbx_e": -np.inf, "ubx": np.inf, "ubx_e": np.inf}
    arrays = {
        name: np.full((*np.shape(getattr(ocp, name))[:-1], sizes[name]), unbounded.get(name, 0.0)) if name in sizes else getattr(ocp, name).copy()
        for name in ARGUMENTS
    }
    for name, (part, entries) in parts(ocp, arrays).items():
        part[...] = getattr(ocp, name)[..., entries]
    for name, value in (changed | arrays).items():
        object.__setattr__(problem, name, value)
    return problem


def flags_of(ocp: Ocp) -> Array:
    """Return the parameters of a problem's stages that say where blocks begin, see `Remembering.flags`."""
    begins = np.isin(np.arange(ocp.N), ocp.starts)
    flags = np.column_stack([np.append(True, begins), np.append(begins, True)]).astype(np.float64)
    blocks = ocp.blocks
    # While inputs are held to the end, no constraint acts any more, whatever is remembered.
    return flags[:, : 2 if any(length > 1 for length in blocks[:-1]) else 1 if blocks[-1] > 1 else 0]


def parts(ocp: Ocp, arrays: Mapping[str, Array]) -> dict[str, tuple[Array, slice | list[int]]]:
    """
    Return where solvers have the weights and bounds of a problem, by the names in `rti_mpc.rti.ocp.WEIGHTS_AND_BOUNDS`.

    Args:
        ocp: The problem as it was given.
        arrays: Those of the problem as it is solved, by the names in `rti_mpc.rti.ocp.ARGUMENTS`.

    Returns:
        For each a part of one of the arrays, with rows of stages if that has them, and which of its entries are there.
    """
    nx, nh, every = ocp.model.nx, ocp.h_expr.numel(), slice(None)
    found: dict[str, tuple[Array, slice | list[int]]] = {name: (arrays[name], every) for name in ARGUMENTS}
    found |= {name: (arrays[name][..., :nx], every) for name in OF_STATES}
    found |= {name: (arrays[name][..., :nh], every) for name in OF_CONSTRAINTS}
    return found | {name: (arrays[among][..., nh:], list(ocp.soft_ddu)) for name, among in AMONG_CONSTRAINTS.items()}
