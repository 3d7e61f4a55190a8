# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import io
import json
import re
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from threading import Event

import pytest
from rich.console import Console
from rich.text import Text

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.config import load
from rti_mpc_service.faults import run
from rti_mpc_service.faults.measure import Measured
from rti_mpc_service.faults.report import MatrixReport, MatrixRow
from rti_mpc_service.faults.table import FAULTS
from rti_mpc_service.host.hold_up import Host, Unwitnessed
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import SHIPPED

BY_NAME = {fault.name: fault for fault in FAULTS}
STOPPED = Measured(0.2, 0.21, 0.4, 1.8, 0.25, 0, 1.0, 2.5, 30, 0.5, 0.5)
DRIVING = replace(STOPPED, brake_s=None, zero_s=None, still_s=None, missed=0, error_m=0.002, recovery_s=0.01)


def row(name: str, measured: Measured | None) -> MatrixRow:
    fault = BY_NAME[name]
    return MatrixRow(fault, measured, ["it was not there"] if measured is None else fault.promise.broken(measured))


def test_row_says_what_the_robot_did() -> None:
    assert row("controller_killed", STOPPED).did == "braked, stood, drove again"
    assert row("controller_paused", replace(STOPPED, still_s=None)).did == "braked, drove again"
    assert row("robot_killed", replace(STOPPED, brake_s=None)).did == "stood, drove again"
    assert row("viewer_killed", DRIVING).did == "drove on"
    assert row("viewer_killed", None).did == "unknown"


def test_row_holds_every_number_in_json_and_those_that_were_promised_in_the_table() -> None:
    stopped, driving = row("controller_killed", STOPPED), row("viewer_killed", DRIVING)
    document = json.loads(json.dumps(stopped.to_json()))
    assert (document["name"], document["kept"], document["brake_s"], document["error_m"]) == ("controller_killed", True, 0.21, 0.5)
    assert stopped.cells()[2:] == ("0.20", "210", "400", "1.80", "0.250", "100", "-", "2.50", "yes")
    assert driving.cells()[2:] == ("0.20", "-", "-", "-", "0.250", "100", "2.0", "-", "yes")
    assert row("viewer_killed", None).cells()[-1] == "NO"


def test_matrix_is_printed_with_what_was_not_kept() -> None:
    console = Console(file=io.StringIO(), width=40)
    with MatrixReport(console, 2) as report:
        report.add(row("controller_killed", replace(STOPPED, brake_s=0.31)))
        report.add(row("viewer_killed", DRIVING))
    report.conclude()
    printed = console.file.getvalue()  # type: ignore[attr-defined]
    assert "controller_killed: stops, and drives again when mended: brake_s must be at most 0.3, got 0.31\n" in printed
    assert "1 of 2 within their promise" in printed
    for cell in (*report.rows[0].cells(), *report.rows[1].cells()):
        assert cell in printed, "no number is cut off where the terminal is narrow"
    assert not report.kept


def report_on(console: Console) -> str:
    """Return what is printed of two faults."""
    with MatrixReport(console, 3) as report:
        report.add(row("guard_and_controller_killed", replace(STOPPED, brake_s=0.31)))
        report.add(row("viewer_killed", DRIVING))
        report.say(BY_NAME["controller_hung"], "starting peers")
    report.conclude()
    return Text.from_ansi(console.file.getvalue()).plain  # type: ignore[attr-defined]


def test_terminal_that_is_too_narrow_for_the_matrix_has_a_line_for_each_value() -> None:
    printed = report_on(Console(file=io.StringIO(), width=80, force_terminal=True))
    assert max(map(len, printed.splitlines())) <= 80
    assert "…" not in printed, "nothing is cut off, nor was while the matrix grew"
    end = re.sub(r" +", " ", printed).rpartition("fault guard_and_controller_killed")[2]
    assert [line.strip() for line in end.splitlines()[1:10]] == [
        *("the robot braked, stood, drove again", "speed 0.20 m/s", "braking 310 ms", "zero 400 ms", "standstill 1.80 s", "way 0.250 m"),
        *("step 100 %", "recovery 2.50 s", "kept NO"),
    ]
    assert "fault viewer_killed\n" in end.replace(" \n", "\n")
    assert " brake_s must be at most 0.3, got 0.31 stopped after 2 of 3 faults, " in " ".join(end.split())


def test_matrix_is_a_table_on_a_terminal_that_is_wide_enough_and_in_a_pipe_however_narrow() -> None:
    tables = [report_on(console) for console in (Console(file=io.StringIO(), width=150, force_terminal=True), Console(file=io.StringIO(), width=80))]
    for printed in tables:
        (of_guard,) = {line.strip() for line in printed.splitlines() if line.startswith(" guard_and_controller_killed ")}
        assert re.split("  +", of_guard)[2:] == ["0.20", "310", "400", "1.80", "0.250", "100", "-", "2.50", "NO"]


def test_wait_that_lasts_is_told_in_a_line_and_a_run_that_ends_in_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    t, console = [0.0], Console(file=io.StringIO())
    monkeypatch.setattr(time, "monotonic", lambda: t[0])
    with MatrixReport(console, 2) as report:
        report.add(row("controller_killed", STOPPED))
        report.say(BY_NAME["controller_hung"], "starting peers")
        for t[0] in range(9):
            report.waiting("waiting for controller and robot to be there: no controller yet")
        for t[0] in range(10, 70):
            report.waiting("waiting for the robot to be driven: the controller is braking")
    report.conclude()
    said = "controller_hung, waiting for the robot to be driven: the controller is braking"
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert [line for line in lines if line.startswith(said)] == [f"{said}, for {s} s" for s in (10, 20, 40)]
    assert lines[-2] == f"stopped after 1 of 2 faults, in {said}"
    assert lines[-1].startswith("1 of 1 within their promise")
    assert not report.complete


class Dumb:
    """A witness of the host that says nothing from the start."""

    def __enter__(self) -> Dumb:
        raise Unwitnessed("the host's witness has ended with status -9")

    def __exit__(self, *_: object) -> None:
        pass


def test_run_without_a_witness_of_the_host_is_one_line_and_status_1(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(run, "Host", Dumb)
    monkeypatch.setattr(run, "stop_on_signals", Event)
    assert run.main(SHIPPED, (), None) == 1
    assert capsys.readouterr() == ("", "rti-mpc: the host's witness has ended with status -9\n")


def test_row_in_which_the_witness_falls_silent_is_not_kept_and_says_why(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def silent(*_: object) -> MatrixRow:
        raise Unwitnessed("silent for 10 s")

    monkeypatch.setattr(run, "System", lambda config, wiring, *_: ExitStack())
    monkeypatch.setattr(run, "make_ready", silent)
    report = MatrixReport(Console(file=io.StringIO()), 1)
    config = load(SHIPPED)
    run.inject(run.prepared(config, find_scenario(config)), [BY_NAME["controller_killed"]], tmp_path, report, Event(), Host())
    assert [row.broken for row in report.rows] == [["silent for 10 s"]]
    assert not report.kept


def test_faults_are_chosen_by_name_in_the_order_of_the_table() -> None:
    assert [fault.name for fault in run.chosen(("link_cut", "controller_killed"))] == ["controller_killed", "link_cut"]
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize(
    ("misspelt", "answer"),
    [
        ("link_cutt", "perhaps link_cut is meant (the controller's link is cut)"),
        ("controller-killed", "perhaps controller_killed is meant (SIGKILL of the controller)"),
        ("earthquake", "the names are in: rti-mpc faults --help"),
    ],
)
def test_misspelt_name_of_a_fault_is_answered_by_the_nearest(misspelt: str, answer: str) -> None:
    with pytest.raises(ConfigError) as refused:
        run.chosen(("link_cut", misspelt))
    assert str(refused.value) == f"--only must be the name of a fault, {answer}, got '{misspelt}'"


def test_faults_of_a_viewer_are_left_out_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run, "find_spec", lambda name: None)
    assert [fault.name for fault in run.chosen(())] == [fault.name for fault in FAULTS if not fault.viewer]
    with pytest.raises(ModuleNotFoundError):
        run.chosen(("viewer_killed", "link_cut"))
