# SPDX-License-Identifier: Apache-2.0
"""Files of cases come from anybody: what is none is refused in one line, and nothing is read or written beyond an array."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp

from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.rti.qp.qp import QpData
from rti_mpc_service.case import QpCase
from rti_mpc_service.replay.solve import main

ABOUT: dict[str, Any] = {
    "seq": 7,
    "stamp_ns": 700_000_000,
    "why": "it was late",
    "solver": "riccati",
    "status": "SOLVED",
    "iterations": 1,
    "inputs": [{"name": "v", "unit": "m/s"}],
    "robot": "wheels",
    "owner": 5,
    "files": {},
}


def small() -> QpCase:
    """A case of one state and one input."""
    qp = QpData()
    qp.P, qp.A = sp.csc_matrix(np.eye(2)), sp.csc_matrix(np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]))
    qp.q, qp.l, qp.u = np.zeros(2), np.zeros(3), np.ones(3)
    return QpCase(dict(ABOUT), qp, {"x": np.zeros((1, 1)), "u": np.zeros((1, 1))}, np.ones(2), np.zeros(2))


def changed(**arrays: Any) -> bytes:
    """Return the file of the small case with other arrays; None: left out."""
    with np.load(BytesIO(small().encode())) as file:
        content = {name: file[name] for name in file.files} | arrays
    out = BytesIO()
    np.savez(out, **{name: array for name, array in content.items() if array is not None})
    return out.getvalue()


def about(**values: Any) -> str:
    """Return what a case says of itself with other values; None: left out."""
    return json.dumps({name: value for name, value in (ABOUT | values).items() if value is not None})


def test_small_case_is_read_as_it_was_written() -> None:
    case = QpCase.decode(small().encode())
    assert case.about == ABOUT
    np.testing.assert_array_equal(case.qp.A.toarray(), small().qp.A.toarray())


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("A_indices", [2_000_000_000, 2, 1, 2]),
        ("A_indices", [0, 3, 1, 2]),
        ("A_indices", [0, -1, 1, 2]),
        ("A_indices", [2**40, 2, 1, 2]),
        ("A_indices", [0.0, 2.0, 1.0, 2.0]),
        ("A_indices", [0, 2, 1]),
        ("A_indptr", [0, 2, 2_000_000_000]),
        ("A_indptr", [0, 5, 4]),
        ("A_indptr", [-1, 2, 4]),
        ("A_indptr", [0, 4]),
        ("A_data", [1.0, 1.0]),
        ("A_data", ["1.0"] * 4),
        ("A_data", [1j] * 4),
        ("P_indices", [0, 2]),
        ("P_indptr", [0, 1, 9]),
        ("q", [[0.0, 0.0]]),
        ("q", 0.0),
        ("l", []),
        ("u", [1.0, 1.0]),
        ("z", ["a", "b"]),
        ("columns", [1, 1]),
        ("guess_u", 0.0),
        ("guess_u", np.zeros((0, 1))),
        ("guess_u", np.zeros((1, 2))),
        ("guess_x", np.zeros((3, 1))),
        ("guess_x", None),
        ("A_data", None),
        ("about", None),
        ("about", about(status=None)),
        ("about", about(status=1)),
        ("about", about(seq="7")),
        ("about", about(stamp_ns=0.5)),
        ("about", about(inputs=[])),
        ("about", about(inputs=[{"name": "v"}])),
        ("about", about(inputs=["v"])),
        ("about", "[]"),
        ("format", "rti_mpc case 2"),
    ],
)
def test_case_whose_arrays_do_not_fit_is_refused_by_name(name: str, array: Any) -> None:
    with pytest.raises(MessageError, match=name.removeprefix("guess_")) as refusal:
        QpCase.decode(changed(**{name: array if array is None else np.array(array)}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("missing", ["robot", "owner", "files"])
def test_file_of_a_case_says_of_which_controller_it_is(missing: str, tmp_path: Path) -> None:
    """In a journal a case does not say so, since the recording does."""
    path = tmp_path / "case.npz"
    path.write_bytes(changed(about=np.array(about(**{missing: None}))))
    QpCase.decode(path.read_bytes())
    with pytest.raises(ConfigError, match=rf"must be a case.*{missing}"):
        main(path, ["osqp"])
