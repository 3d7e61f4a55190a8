# SPDX-License-Identifier: Apache-2.0
"""`rti-mpc check`: what it compares, and what it lets pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from service import check
from service.config import load
from tests.service.test_config import MINIMAL


@pytest.mark.parametrize(("first", "second"), [("riccati", "daqp"), ("osqp", "daqp"), ("daqp", "osqp")])
def test_two_solvers_are_compared_tightly_whatever_the_controllers_tolerance(first: str, second: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    loose = "eps = 0.01\n" if first != "daqp" else ""
    path.write_text(MINIMAL + f"[ocp.bounds]\ninputs = {{ u_c = [-0.2, 0.2] }}\n[solver]\nname = '{first}'\n{loose}")
    report = check.check(load(path))
    assert report.second == second
    assert report.opinions == check.OPINIONS
    assert report.agree
    assert report.difference < 1e-6
    assert (report.deviation > 1e-4) is (first == "osqp"), "what the tolerance costs is told apart from whether the QP is right"


def test_a_qp_that_is_not_the_other_formulations_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(MINIMAL)
    right = check.answer
    monkeypatch.setattr(check, "answer", lambda one, *sample: right(one, *sample) + (1e-4 if one.formulation == "simultaneous" else 0.0))
    report = check.check(load(path))
    assert not report.agree
    np.testing.assert_allclose(report.difference, 1e-4, rtol=0.01)
