# SPDX-License-Identifier: Apache-2.0
"""Cases: the QP of a failed or late sample, in a file that any solver solves, with our own plan beside it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import JournalKind
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError
from rti_mpc.rti.scaled import Scaled
from rti_mpc_service.case import QpCase, qp_at
from rti_mpc_service.config.build import build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.replay.answer import answer, of_other, rebuilt
from rti_mpc_service.replay.place import find
from rti_mpc_service.replay.rebuild import Journaled, rebuild
from rti_mpc_service.replay.solve import main
from rti_mpc_service.replay.trouble import cases_of_one, kept, troubles
from rti_mpc_service.replay.why import explained
from rti_mpc_service.replay.why import main as why
from rti_mpc_service.replay.without import moved, without
from rti_mpc_service.shipped import SHIPPED
from tests.service.replay.driven import failing, journal_of, recorded, straight

SOLVERS = ("riccati", "osqp", "daqp", "clarabel", "piqp")


@pytest.fixture(scope="module")
def journal(tmp_path_factory: pytest.TempPathFactory) -> Journaled:
    """Two samples of it fail on request, another one is late."""
    path = tmp_path_factory.mktemp("robot") / "robot.toml"
    path.write_text(SHIPPED.read_text() + "\n[debug]\ninject = true\n")
    return journal_of(path, samples=34, acts={20: failing("qp", 2)}, late_ms={32: 90})


@pytest.fixture(scope="module")
def cases(journal: Journaled) -> list[QpCase]:
    return list(troubles(journal, rebuild(journal, folder=Path())))


def test_each_failed_and_each_late_sample_is_a_case(cases: list[QpCase]) -> None:
    assert [(case.about["seq"], case.about["why"], case.usable) for case in cases] == [
        (21, "it failed", False),
        (22, "it failed", False),
        (32, "it was late", True),
    ]


def test_controller_keeps_one_case_a_second_with_every_bit_that_a_replay_makes_and_counts_the_others(journal: Journaled, cases: list[QpCase]) -> None:
    was = list(kept(journal))
    assert [(case.about["seq"], case.about["not_kept"]) for case in was] == [(21, 0), (32, 1)], "that of sample 22 came in the same second"
    for one, made in zip(was, (cases[0], cases[2]), strict=True):
        assert {name: value for name, value in one.about.items() if name != "not_kept"} == made.about
        assert [array.tobytes() for array in arrays_of(one)] == [array.tobytes() for array in arrays_of(made)]
        assert one.guess.keys() == made.guess.keys()


def arrays_of(case: QpCase) -> list[np.ndarray[Any, Any]]:
    matrices = [getattr(matrix, part) for matrix in (case.qp.P, case.qp.A) for part in ("data", "indices", "indptr")]
    return [*matrices, case.qp.q, case.qp.l, case.qp.u, case.columns, case.z, *case.guess.values()]


def test_kept_cases_are_solved_where_nothing_can_be_replayed(journal: Journaled, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(replace(journal, files={}), tmp_path / "run.mcap")
    assert main(path, ["daqp"]) == 0
    said = capsys.readouterr()
    assert [line.split(":")[0] for line in said.out.splitlines() if line.startswith("sample")] == [
        "sample 21 of pioneer, at 2.100 s",
        "sample 32 of pioneer, at 3.200 s",
    ]
    assert "the same plan: inputs differ by" in said.out
    assert "only the cases that it kept are solved: the configuration of controller 5 of pioneer must be attached" in said.err


@pytest.mark.slow  # builds a controller again
def test_kept_cases_fill_a_gap_of_the_journal(journal: Journaled) -> None:
    late = next(k for k, message in enumerate(journal.messages) if message.kind is JournalKind.CALLS and message.stamp_ns == 2_800_000_000)
    holed = replace(journal, messages=[message for k, message in enumerate(journal.messages) if k != late])
    assert [case.about["seq"] for case in troubles(holed, rebuild(holed, folder=Path()))] == [21, 22], "sample 32 is beyond the gap"
    assert [case.about["seq"] for case in cases_of_one(holed, Path(), trust=False)] == [21, 22, 32]


@pytest.mark.slow  # compiles a problem of its own
def test_controllers_of_few_inputs_keep_cases_of_the_same_form(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("N = 20", "N = 5\nN_u = 2") + "\n[debug]\ninject = true\n")
    config = load(path)
    assert build_rti(config).formulation == "sequential"
    (case,) = kept(journal_of(path, samples=8, acts={5: failing("qp", 1)}))
    assert case.qp.A.shape[1] == 6 * 5 + 2 * 2 + 5 * 2, "states, inputs and slacks"
    assert answer(case, "daqp").status is QpStatus.SOLVED


def test_case_of_a_recording_that_is_none_is_left_out_with_a_line(journal: Journaled, capsys: pytest.CaptureFixture[str]) -> None:
    message = next(message for message in journal.messages if message.kind is JournalKind.CASE)
    assert not list(kept(replace(journal, messages=[replace(message, data=b"no case"), replace(message, data=b"")])))
    assert f"entry {message.seq} of controller 5 of pioneer must be a case, got File is not a zip file" in capsys.readouterr().err


def test_file_holds_every_bit_of_a_case(cases: list[QpCase], tmp_path: Path) -> None:
    path = tmp_path / "case.npz"
    cases[2].save(path)
    again = QpCase.load(path)
    assert again.about == cases[2].about
    for name in ("q", "l", "u"):
        np.testing.assert_array_equal(getattr(again.qp, name), getattr(cases[2].qp, name))
    for matrix in ("P", "A"):
        assert not (getattr(again.qp, matrix) != getattr(cases[2].qp, matrix)).nnz
    assert all(np.array_equal(again.guess[name], array) for name, array in cases[2].guess.items())
    np.testing.assert_array_equal(again.z, cases[2].z)


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_makes_of_the_case_the_plan_that_the_sample_made(cases: list[QpCase], solver: str) -> None:
    case = cases[2]
    given = answer(case, solver)
    assert given.status is QpStatus.SOLVED
    assert case.apart(given.z) < 1e-5, "OSQP's tolerance of 1e-9 leaves 1e-6 in an input that the cost hardly depends on"
    assert case.violation(given.z) < 1e-9
    assert case.objective(given.z) == pytest.approx(case.objective(case.z), abs=1e-9)


def test_solvers_find_a_plan_for_a_sample_that_failed_on_request(cases: list[QpCase]) -> None:
    assert not cases[0].usable
    plans = [answer(cases[0], solver).z for solver in ("riccati", "daqp")]
    np.testing.assert_allclose(*plans, atol=1e-8)  # both are exact but for rounding in 20 stages


def test_data_that_is_not_finite_is_said_and_not_solved(cases: list[QpCase], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cases[0].save(tmp_path / "case.npz")
    case = QpCase.load(tmp_path / "case.npz")
    case.qp.q[0] = np.nan
    case.save(tmp_path / "nan.npz")
    assert main(tmp_path / "nan.npz", ["daqp"]) == 1
    assert "its data is not finite" in capsys.readouterr().out


@pytest.mark.slow  # builds a controller again
def test_command_solves_all_cases_of_a_recording(journal: Journaled, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(journal, tmp_path / "run.mcap")
    assert main(path, ["riccati", "daqp"]) == 0
    text = capsys.readouterr().out
    assert "sample 21 of pioneer, at 2.100 s: it failed; a QP of 185 variables" in text
    assert "riccati had no plan: INFEASIBLE" in text
    assert "it finds a plan where the sample had none" in text
    assert "sample 32 of pioneer, at 3.200 s: it was late" in text
    assert "daqp: SOLVED in" in text
    assert "the same plan: inputs differ by" in text
    assert main(path, ["daqp"], as_json=True) == 0
    results = json.loads(capsys.readouterr().out)
    assert [result["seq"] for result in results] == [21, 22, 32]
    assert results[2]["answers"][0]["difference"] < 1e-9


@pytest.mark.slow  # builds a controller again
def test_why_writes_the_case_of_any_sample(journal: Journaled, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(journal, tmp_path / "run.mcap")
    assert why(path, seq=10, case_path=tmp_path / "ten.npz") == 0
    assert main(tmp_path / "ten.npz", ["piqp"]) == 0
    assert "sample 10 of pioneer, at 1.000 s: asked for" in capsys.readouterr().out


@pytest.mark.parametrize("content", [b"", b"no archive", None])
def test_file_that_is_no_case_is_refused_in_one_line(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "case.npz"
    if content is None:
        np.savez(path, format=np.array([object()], dtype=object))  # a pickle, which is not loaded
    else:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match="must be a case") as refusal:
        QpCase.load(path)
    assert "\n" not in str(refusal.value)


def test_solver_that_is_not_installed_is_refused_whether_or_not_there_is_a_case(tmp_path: Path) -> None:
    path = recorded(journal_of(SHIPPED, samples=5, follows=straight(5.0)), tmp_path / "run.mcap")
    with pytest.raises(ConfigError, match=r"--solver: solver must be riccati, osqp, or one that is installed.*'cplex'"):
        main(path, ["riccati", "cplex"])


@pytest.mark.slow  # builds a controller again
def test_without_a_bound_that_acts_our_solver_plans_what_another_one_does() -> None:
    journal = journal_of(SHIPPED, samples=5, follows=straight(5.0, 0.45))
    built, place = rebuild(journal, folder=Path()), find(journal, None, 1)
    assert place is not None
    facts, case = explained(journal, built, place)
    assert case is not None
    assert len(facts["bounds"]) == 3
    rti, config = rebuilt(case, folder=Path(), trust=False), load(SHIPPED)
    for bound in facts["bounds"]:
        other = of_other(Scaled(qp_at(rti, case.guess | moved(case, rti, config, bound))), "daqp")
        theirs = dict(zip(facts["inputs"], case.inputs(other.z)[0], strict=True))
        assert without(case, rti, config, bound) == pytest.approx(theirs, abs=1e-6)  # rounding, with a bound 1e6 scales away
