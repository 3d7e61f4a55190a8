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
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.qp.qp import Guess, Qp, QpData, Step
from rti_mpc.rti.qp.simultaneous import simultaneous
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.scaled import Scaled
from rti_mpc.wire import document

FORMAT = "rti_mpc case 1"
MAX_ABOUT_BYTES = 1 << 24
MATRICES, VECTORS = ("P", "A"), ("q", "l", "u")


@dataclass(frozen=True)
class QpCase:
    """
    The QP of one sample.

    Attributes:
        about: What it is: robot, owner, seq, stamp_ns, why it was kept, solver, status, iterations; inputs, a list of name and unit; and the texts
            attached to the recording, by name.
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

    def save(self, path: Path) -> None:
        """
        Write the file.

        Raises:
            ConfigError: It cannot be written.
        """
        arrays: dict[str, Any] = {name: getattr(self.qp, name) for name in VECTORS}
        for name in MATRICES:
            matrix = getattr(self.qp, name)
            arrays |= {f"{name}_data": matrix.data, f"{name}_indices": matrix.indices, f"{name}_indptr": matrix.indptr}
        arrays |= {f"guess_{name}": array for name, array in self.guess.items()}
        try:
            with path.open("wb") as file:
                np.savez_compressed(file, about=json.dumps(self.about), format=FORMAT, columns=self.columns, z=self.z, **arrays)
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
            with path.open("rb") as raw:
                if not zipfile.is_zipfile(raw):
                    raise ValueError("what is no npz file")
            with np.load(path, allow_pickle=False) as file:
                if str(file["format"]) != FORMAT:
                    raise ValueError(f"format {file['format']}")
                qp, n, m = QpData(), len(file["q"]), len(file["l"])
                qp.q, qp.l, qp.u = (file[name] for name in VECTORS)
                qp.P, qp.A = (
                    sp.csc_matrix(tuple(file[f"{name}_{part}"] for part in ("data", "indices", "indptr")), shape=(rows, n))
                    for name, rows in zip(MATRICES, (n, m), strict=True)
                )
                guess = {name.removeprefix("guess_"): file[name] for name in file.files if name.startswith("guess_")}
                case = cls(document.read(str(file["about"]).encode(), most=MAX_ABOUT_BYTES), qp, guess, file["columns"], file["z"])
            if case.qp.u.shape != (m,) or case.columns.shape != (n,) or case.z.shape != (n,) or guess["x"].size + guess["u"].size > n:
                raise ValueError("arrays of different lengths")
        except (OSError, MessageError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
            raise ConfigError(f"{path} must be a case, as rti-mpc why --case writes it, got {error}") from error
        return case


def take(rti: Rti, about: Mapping[str, Any]) -> QpCase:
    """
    Return the case of the last sample, before the next one is prepared.

    Args:
        rti: Real-time iteration of the sample.
        about: As `QpCase.about`; status, solver and inputs are filled in.
    """
    arrays = {name: array.copy() for name, array in (rti.guess.arguments | {"x0": rti.x0}).items()}
    qp = qp_at(rti.ocp, arrays)
    scaled = Scaled(qp)
    inputs = [{"name": signal.name, "unit": signal.unit} for signal in rti.ocp.model.inputs]
    case = QpCase({"inputs": inputs, **about}, scaled, arrays, qp.scales()[0].copy(), np.zeros_like(scaled.q))
    if case.usable:
        case.z[:] = solution(qp, rti.x - arrays["x"], rti.u - arrays["u"]) / case.columns
    return case


def qp_at(ocp: Ocp, arrays: Mapping[str, Array]) -> Qp:
    """Return the QP linearized at a guess, its initial state embedded."""
    sample = {name: arrays[name] for name in ("x", "u", "u_prev", "y_ref", "p")}
    weights = {name: array for name, array in arrays.items() if name not in sample and name != "x0"}
    plan = Step(np.zeros_like(arrays["x"]), np.zeros_like(arrays["u"]), np.zeros(2), np.zeros(1))
    qp = Qp(simultaneous(ocp), Guess(sample, weights, arrays["x0"], plan), lambda function: function)
    qp.fill()
    qp.embed()
    return qp


def solution(qp: Qp, dx: Array, du: Array) -> Array:
    """
    Return a plan as a solution, its slacks as small as the softened bounds allow.

    Args:
        qp: The QP in the units of the model.
        dx: Deviations of the states from the guess, shape ``(N + 1, nx)``.
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
