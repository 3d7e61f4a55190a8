# SPDX-License-Identifier: Apache-2.0
"""Laws of ways to rest, kept between starts."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.cache import cache_dir
from rti_mpc.rti import kept_law
from rti_mpc.rti.kept_law import find_kept_stop_law, fingerprint
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.way_to_rest import StopLaw
from tests.movers import arm, law_of, ocp_of
from tests.problems import new_pioneer, pioneer

NONE = np.zeros(0)


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Ocp]:
    """Problems whose laws are found, not read; in an empty cache."""
    problems, law = list[Ocp](), law_of("arm")

    def find(ocp: Ocp, disturbances: object, delay_s: float) -> StopLaw | None:
        problems.append(ocp)
        return law if ocp.model.name == "arm" else None

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept_law, "find_stop_law", find)
    return problems


def same(law: StopLaw | None, other: StopLaw | None) -> bool:
    assert law is not None
    assert other is not None
    pairs = [(getattr(law, field.name), getattr(other, field.name)) for field in fields(StopLaw)]
    return all(type(a) is type(b) and np.array_equal(a, b) for a, b in pairs)


def test_law_that_a_start_has_found_is_the_same_bit_for_bit_at_the_next(found: list[Ocp]) -> None:
    assert same(find_kept_stop_law(ocp_of("arm")), law_of("arm"))
    assert same(find_kept_stop_law(arm()), law_of("arm")), "an equal problem, built anew"
    assert len(found) == 1


def test_law_of_another_problem_disturbance_delay_or_code_is_found_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    ocp = ocp_of("arm")
    keys = [fingerprint(ocp, NONE, 0.0), fingerprint(ocp, np.ones(1), 0.0), fingerprint(ocp, NONE, 0.01)]
    keys += [fingerprint(arm(lbu=[-30, -14.999999999999998]), NONE, 0.0), fingerprint(arm(dt=0.03), NONE, 0.0), fingerprint(ocp_of("car"), NONE, 0.0)]
    monkeypatch.setattr(kept_law, "code", lambda: "changed")
    keys.append(fingerprint(ocp, NONE, 0.0))
    assert len(set(keys)) == len(keys)


def test_file_that_was_changed_is_not_believed(found: list[Ocp]) -> None:
    find_kept_stop_law(ocp_of("arm"))
    (path,) = cache_dir().glob("stop-*.npz")
    content = path.read_bytes()
    path.write_bytes(bytes([*content[:200], content[200] ^ 1, *content[201:]]))
    assert same(find_kept_stop_law(ocp_of("arm")), law_of("arm"))
    assert len(found) == 2
    assert path.read_bytes() == content, "and is written anew"


def test_robot_is_stopped_without_a_folder_to_keep_its_law_in(found: list[Ocp], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert same(find_kept_stop_law(ocp_of("arm")), law_of("arm"))


def test_robot_that_needs_no_law_is_not_tried_again_at_the_next_start(found: list[Ocp]) -> None:
    assert [find_kept_stop_law(pioneer()), find_kept_stop_law(new_pioneer())] == [None, None]
    assert len(found) == 1
