# SPDX-License-Identifier: Apache-2.0
"""
Reader of the file of a case, which anybody may have made.

Compiled code of SciPy and of solvers trusts the indices of a sparse matrix, so each one is checked here.
"""

from __future__ import annotations

import zipfile
from io import BytesIO
from typing import Any

import numpy as np
import scipy.sparse as sp

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import MessageError
from rti_mpc.rti.qp.qp import QpData
from rti_mpc.wire import document

FORMAT = "rti_mpc case 1"
MAX_ABOUT_BYTES = 1 << 24
MAX_BYTES = 1 << 28  # of all arrays
MATRICES, VECTORS = ("P", "A"), ("q", "l", "u")
ABOUT = {"seq": int, "stamp_ns": int, "why": str, "solver": str, "status": str, "iterations": int, "inputs": list}  # kinds of what each case says
PLACE = {"robot": str, "owner": int, "files": dict}  # what one that is no entry of a journal says as well

Contents = tuple[dict[str, Any], QpData, dict[str, Array], Array, Array]  # the attributes of a case


def contents(content: bytes) -> Contents:
    """
    Return what the bytes of a file hold: the attributes of a case, in their order.

    Raises:
        MessageError: They are no case.
    """
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            if (size := sum(entry.file_size for entry in archive.infolist())) > MAX_BYTES:
                raise MessageError(f"{size} bytes, more than {MAX_BYTES}")
        with np.load(BytesIO(content), allow_pickle=False) as file:
            return _contents(file)
    except MessageError:
        raise
    except Exception as error:  # NumPy's and Python's readers of archives raise errors of a dozen kinds
        raise MessageError(str(error).partition("\n")[0] or type(error).__name__) from error


def _contents(file: Any) -> Contents:
    if (got := str(_array(file, "format"))) != FORMAT:
        raise MessageError(f"format {got!r} instead of {FORMAT!r}")
    qp = QpData()
    qp.q, qp.l = _floats(file, "q", (None,)), _floats(file, "l", (None,))
    n, m = len(qp.q), len(qp.l)
    qp.u, columns, z = (_floats(file, name, (size,)) for name, size in (("u", m), ("columns", n), ("z", n)))
    qp.P, qp.A = _matrix(file, "P", (n, n)), _matrix(file, "A", (m, n))
    names = [name for name in file.files if name.startswith("guess_")]
    guess = {name.removeprefix("guess_"): _floats(file, name) for name in names}
    try:
        about = document.read(str(_array(file, "about")).encode(errors="replace"), most=MAX_ABOUT_BYTES)
    except MessageError as error:
        raise MessageError(f"about: {error}") from error
    check_about(about, ABOUT)
    inputs = about["inputs"]
    if not inputs or not all(isinstance(one, dict) and isinstance(one.get("name"), str) and isinstance(one.get("unit"), str) for one in inputs):
        raise MessageError("about must name its inputs, each with its unit")
    if about["status"] not in QpStatus.__members__:
        raise MessageError(f"status in about must be one of {', '.join(QpStatus.__members__)}, got {about['status'][:20]!r}")
    x, u = (guess.get(name, np.zeros(0)) for name in ("x", "u"))
    if x.ndim != 2 or u.ndim != 2 or not len(u) or u.shape[1] != len(inputs) or x.size + u.size > n:
        raise MessageError(
            f"x and u of the guess must be rows of states and of {len(inputs)} inputs, together {n} at most, got {x.shape} and {u.shape}"
        )
    return about, qp, guess, columns, z


def check_about(about: dict[str, Any], kinds: dict[str, type]) -> None:
    """
    Check what a case says of itself.

    Raises:
        MessageError: Something is missing, or of another kind.
    """
    for name, kind in kinds.items():
        if type(about.get(name)) is not kind:
            raise MessageError(f"about must have {name} of type {kind.__name__}, got {type(about.get(name)).__name__}")
    if not all(isinstance(text, str) for text in about.get("files", {}).values()):
        raise MessageError("files in about must be texts by name")


def _array(file: Any, name: str) -> Any:
    if name not in file.files:
        raise MessageError(f"an archive without {name}")
    return file[name]


def _floats(file: Any, name: str, shape: tuple[int | None, ...] | None = None) -> Array:
    """Return an array of numbers; its shape may be given, None for a length of 1 or more."""
    array: Array = _array(file, name)
    fits = shape is None or (array.ndim == len(shape) and all(got == want if want else got for got, want in zip(array.shape, shape, strict=True)))
    if array.dtype != np.float64 or not fits:
        raise MessageError(f"{name} must be float64 of shape {'any' if shape is None else shape}, got {array.dtype} of shape {array.shape}")
    return array


def _matrix(file: Any, name: str, shape: tuple[int, int]) -> sp.csc_matrix[Any]:
    """Return a sparse matrix, all of whose indices lie in it."""
    data = _floats(file, f"{name}_data")
    indices, starts = (_array(file, f"{name}_{part}") for part in ("indices", "indptr"))
    if not (indices.ndim == starts.ndim == data.ndim == 1 and indices.dtype.kind == starts.dtype.kind == "i" and len(indices) == len(data)):
        raise MessageError(f"{name}_data, {name}_indices and {name}_indptr must be numbers and two lists of integers, one index a number")
    try:
        matrix = sp.csc_matrix((data, indices, starts), shape=shape)
        matrix.check_format(full_check=True)
    except ValueError as error:
        raise MessageError(f"{name}_indices and {name}_indptr must be those of a matrix of shape {shape}: {error}") from error
    return matrix
