# SPDX-License-Identifier: Apache-2.0
r"""
Case: the QP of one sample, with the guess at which it was linearized and the plan that came of it.

The QP is that of the simultaneous formulation with all softened bounds, whatever the
controller solves: :math:`\min \tfrac12 z^T P z + q^T z` subject to
:math:`l \le A z \le u`, :math:`z = (\Delta x_0, \dots, \Delta x_N, \Delta u_0, \dots,
\Delta u_{N_u - 1}, s)`, in deviations from the guess, scaled and normalised as solvers see it.

The file is NumPy's ``npz`` without pickles: any program reads the QP from it. Guess and
attached configuration let our own solver take it up as well.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.contract.message import Command
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError, MessageError, reason
from rti_mpc.rti.qp.osqp import Solver
from rti_mpc.rti.qp.qp import Guess, Qp, QpData, Step
from rti_mpc.rti.qp.simultaneous import simultaneous
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.scaled import Scaled
from rti_mpc_service.case_file import FORMAT, MATRICES, PLACE, VECTORS, check_about, contents


@dataclass(frozen=True)
class QpCase:
    """
    The QP of one sample.

    Attributes:
        about: What it is: seq, stamp_ns, why it was kept, solver, status, iterations; inputs, a list of name and unit; not_kept, how many failed or
            late samples before it were not; out of a recording also robot, owner, and the files attached for it, a text by name.
        qp: The QP, scaled and normalised.
        guess: Arrays of the guess by name, weights and initial state included, see `rti_mpc.rti.qp.qp.Guess`.
        columns: Scale of each variable, shape ``(n,)``.
        z: The plan of the sample as a scaled solution, shape ``(n,)``; the guess itself, zeros, where the sample has none.
    """

    about: dict[str, Any]
    qp: QpData
    guess: dict[str, Array]
    columns: Array
    z: Array

    @property
    def usable(self) -> bool:
        """Whether the sample had a plan."""
        return self.about["status"] in ("SOLVED", "INACCURATE")

    @property
    def sound(self) -> bool:
        """Whether all data of the QP is finite."""
        return all(bool(np.isfinite(data).all()) for data in (self.qp.P.data, self.qp.A.data, self.qp.q, self.qp.l, self.qp.u))

    def inputs(self, z: Array) -> Array:
        """Return the inputs of a scaled solution, in their units, shape ``(N_u, nu)``."""
        u = self.guess["u"]
        return u + (self.columns * z)[self._of_inputs].reshape(u.shape)

    def apart(self, z: Array) -> float:
        """Return the largest difference of an input of a scaled solution from the plan, relative to half the input's range."""
        return float(np.abs(z - self.z)[self._of_inputs].max())

    @property
    def _of_inputs(self) -> slice:
        return slice(self.guess["x"].size, self.guess["x"].size + self.guess["u"].size)

    def objective(self, z: Array) -> float:
        """Return the objective of a scaled solution: the normalised cost above that of the guess."""
        P = self.qp.P + sp.triu(self.qp.P, k=1).T
        return float(0.5 * z @ (P @ z) + self.qp.q @ z)

    def violation(self, z: Array) -> float:
        """Return the largest violation of a row by a scaled solution, relative to its scale."""
        value = self.qp.A @ z
        return float(np.maximum(np.maximum(value - self.qp.u, self.qp.l - value), 0.0).max())

    def encode(self, pause: Callable[[], object] = lambda: None) -> bytes:
        """Return the bytes of its file; `pause` is called after each array, so that others get the interpreter's lock meanwhile."""
        arrays: dict[str, Any] = {"about": json.dumps(self.about), "format": FORMAT, "columns": self.columns, "z": self.z}
        arrays |= {name: getattr(self.qp, name) for name in VECTORS}
        for name in MATRICES:
            matrix = getattr(self.qp, name)
            arrays |= {f"{name}_data": matrix.data, f"{name}_indices": matrix.indices, f"{name}_indptr": matrix.indptr}
        arrays |= {f"guess_{name}": array for name, array in self.guess.items()}
        content = BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, array in arrays.items():
                with archive.open(f"{name}.npy", "w") as file:
                    np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
                pause()
        return content.getvalue()

    @classmethod
    def decode(cls, content: bytes) -> QpCase:
        """
        Return a case from the bytes of its file.

        Raises:
            MessageError: They are none.
        """
        return cls(*contents(content))

    def save(self, path: Path) -> None:
        """
        Write the file.

        Raises:
            ConfigError: It cannot be written.
        """
        try:
            path.write_bytes(self.encode())
        except OSError as error:
            raise ConfigError(f"a case must be a file that can be written, got {path}: {error.strerror}") from error

    @classmethod
    def load(cls, path: Path) -> QpCase:
        """
        Read a file.

        Raises:
            ConfigError: It is no case.
        """
        try:
            case = cls.decode(path.read_bytes())
            check_about(case.about, PLACE)
        except (OSError, MessageError) as error:
            raise ConfigError(f"{path} must be a case, as rti-mpc why --case writes it: {reason(error)}") from error
        return case


def take(rti: Rti, about: Mapping[str, Any]) -> QpCase:
    """
    Return the case of the last sample, before the next one is prepared.

    Args:
        rti: Real-time iteration of the sample.
        about: As `QpCase.about`; the inputs are filled in.
    """
    arrays = {name: array.copy() for name, array in (rti.guess.arguments | {"x0": rti.guess.x0}).items()}
    return case_of(qp_on(rti, arrays), arrays, rti.guess.plan.x, rti.u, {"inputs": inputs_of(rti), **about})


def case_of(qp: Qp, arrays: dict[str, Array], x: Array, u: Array, about: dict[str, Any], pause: Callable[[], object] = lambda: None) -> QpCase:
    """
    Return the case of a QP.

    Args:
        qp: The QP in the units of the model, to be filled.
        arrays: Arrays of its guess by name.
        x: States of the plan, shape ``(N + 1, nx)``.
        u: Inputs of the plan, shape ``(N_u, nu)``.
        about: As `QpCase.about`.
        pause: Called often, so that others get the interpreter's lock meanwhile.
    """
    for fill in (qp.fill, qp.embed):
        fill()
        pause()
    scaled = Scaled(qp)
    pause()
    case = QpCase(about, scaled, arrays, qp.scales()[0].copy(), np.zeros_like(scaled.q))
    if case.usable:
        case.z[:] = solution(qp, x - arrays["x"], u - arrays["u"]) / case.columns
        pause()
    return case


def inputs_of(rti: Rti) -> list[dict[str, str]]:
    """Return name and unit of each input."""
    return [{"name": signal.name, "unit": signal.unit} for signal in rti.ocp.model.inputs]


def about_sample(rti: Rti, command: Command, why: str) -> dict[str, Any]:
    """Return what a case says of its sample: that of a command, before the next one is prepared."""
    return {
        "seq": command.seq,
        "stamp_ns": command.stamp_ns,
        "why": why,
        "solver": solver_of(rti),
        "status": command.status.name,
        "iterations": rti.solver.iterations,
    }


def trouble_of(proposal: Command, sent: Command | None) -> str:
    """Return why the sample of a proposed command is a case, empty if it is none: it failed, or another command was sent in its place."""
    if proposal.status is QpStatus.NONE:
        return ""
    return "it failed" if not proposal.status.usable else "it was late" if sent is not proposal else ""


def solver_of(rti: Rti) -> str:
    """Return the name of the solver of the last QP."""
    if rti.solver is rti.active_set:
        return "riccati"
    whole = " with softened bounds" if rti.solver is rti.solvers[-1] and len(rti.solvers) > 1 else ""
    return ("osqp" if isinstance(rti.solver, Solver) else "another solver") + whole


def qp_on(rti: Rti, arrays: Mapping[str, Array]) -> Qp:
    """Return the QP of the simultaneous formulation with all softened bounds, on the arrays of a guess; not filled."""
    sample, weights = ({name: arrays[name] for name in names} for names in (rti.guess.sample, rti.guess.weights))
    guess = Guess(sample, weights, arrays["x0"], Step(*map(np.zeros_like, rti.guess.plan)))
    if rti.formulation == "simultaneous":
        return rti.solvers[-1].qp.on(guess)
    return Qp(simultaneous(rti.problem), guess, lambda function: function)


def qp_at(rti: Rti, arrays: Mapping[str, Array]) -> Qp:
    """Return the QP linearized at a guess, its initial state embedded."""
    qp = qp_on(rti, arrays)
    qp.fill()
    qp.embed()
    return qp


def solution(qp: Qp, dx: Array, du: Array) -> Array:
    """
    Return a plan as a solution, its slacks as small as the softened bounds allow.

    Args:
        qp: The QP in the units of the model.
        dx: Deviations of the states from the guess, shape ``(N + 1, nx)``; empty for a QP of the sequential formulation.
        du: Deviations of the inputs, shape ``(N_u, nu)``.
    """
    z = np.zeros_like(qp.q)
    to_s = dx.size + du.size
    z[:to_s] = np.concatenate([dx.ravel(), du.ravel()])
    value = qp.A @ z
    excess = np.maximum(np.maximum(value - qp.u, qp.l - value), 0.0)
    softened = qp.A[:, to_s:].tocoo()
    np.maximum.at(z[to_s:], softened.col, excess[softened.row] / np.abs(softened.data))
    return z
