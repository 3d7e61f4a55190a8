# SPDX-License-Identifier: Apache-2.0
"""Output of `rti-mpc demo` on a narrow terminal and in a pipe."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.model.model import Signal
from rti_mpc_service.console import plain_console, widened
from rti_mpc_service.demo.board import Board, print_summary

LARGE = 123456789.0
TIMES = {"p50": LARGE, "p99": LARGE, "max": LARGE}
SUMMARY: dict[str, Any] = {
    "transient_s": 15.0,
    "final_error_mm": None,
    "max_error_mm": None,
    "rms_error_mm": None,
    "last_lap_max_error_mm": None,
    "final_speed_mm_s": None,
    "outputs": {"force [left]": {"unit": "N", "max": 1.23, "rms": 0.456}},
    "path": {"length_m": 12.5, "driven_m": 30.25, "laps_s": [4.125, 5.0], "profile_s": 3.75, "closest_to_edge_mm": 148.0},
    "in_period_share": 1.0,
    "samples": 987654321,
    "skipped": 9,
    **dict.fromkeys(("commanded_inputs_in_bounds", "commanded_increments_in_bounds", "applied_inputs_in_bounds"), True),
    "states_over_share": 0.0,
    "fallbacks": 192837465,
    **dict.fromkeys(("lost", "late", "expired", "refused"), 918273645),
    **dict.fromkeys(("prepare_us", "feedback_us", "latency_us", "echo_us"), TIMES),
    "second_opinion": {"share": 0.5, "max_difference": 2.1e-9, "us": {"p50": 918.0, "p99": 4321.0, "max": None}},
    "misses": [],
    "events": [{"severity": "WARNING", "source": "robot", "at_s": 1.0, "text": "a sentence of many words [of the robot], on one line"}],
}


@pytest.mark.parametrize("columns", ["20", "80"])
def test_summary_loses_no_number_and_no_word(columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    print_summary(widened(plain_console()), SUMMARY)
    printed = capsys.readouterr().out
    lines = [line.rstrip() for line in printed.splitlines()]
    assert any(line.startswith("error of force [left] after 15 s ") and line.endswith(" max 1.23 N, rms 0.456 N") for line in lines)
    assert printed.count("123456789") == 12
    assert printed.count("918273645") == 4
    assert "30.2 m of 12.5 m, laps of 4.12, 5.00 s; 3.8 s by the speed profile" in printed
    assert "at least 148 mm away" in printed
    assert "100.00% of 987654330 samples, 9 skipped" in printed
    assert "192837465 samples without a new plan" in printed
    assert "50.00% of the samples, at most 2e-09 of half a range off, p50 918.0, p99 4321.0 us" in printed
    assert "WARNING of the robot at 1.0 s: a sentence of many words [of the robot], on one line" in lines
    assert "…" not in printed


def test_event_of_a_process_that_does_not_know_the_robots_time_has_none(capsys: pytest.CaptureFixture[str]) -> None:
    event = {"severity": "WARNING", "source": "recorder", "at_s": 0.0, "text": "4 messages are missing"}
    print_summary(widened(plain_console()), SUMMARY | {"events": [event]})
    assert capsys.readouterr().out.splitlines()[-1] == "WARNING of the recorder: 4 messages are missing"


def test_summary_of_a_busy_host_is_not_hidden_by_its_faults(capsys: pytest.CaptureFixture[str]) -> None:
    miss = {"slack_s": -0.02, "prepare_us": 100.0, "feedback_us": 200.0}
    misses, events = [{"at_s": float(k), **miss} for k in range(72)], [{**SUMMARY["events"][0], "at_s": float(k)} for k in range(10)]
    print_summary(widened(plain_console()), SUMMARY | {"misses": misses, "events": events})
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("missed its period: the sample at 9.0 s")]
    assert not [line for line in lines if line.startswith("missed its period: the sample at 10.0 s")]
    assert [line for line in lines if line.startswith("and ")] == ["and 62 more misses, in summary.json"]


def test_progress_in_a_pipe_is_one_whole_line_each(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    numbers = (5, 0.0, 0.0, 1.0, 0.0, LARGE, LARGE, 30.0, 0.0, 0.0, 0, 0, 1)
    sample = Telemetry(1, 1, 1, 1, 1, Mode.TRACKING, QpStatus.SOLVED, *numbers, *np.zeros((2, 1, 1)), np.ones((2, 1)), np.zeros((2, 2)))
    with Board(plain_console(), "sines", (Signal("torque [1]", "Nm"),), 126.0) as board:
        board.wait("starting controller, echo, reference, viewer")
        board.show(0.0, "q_1 +0.1 rad", [sample], [])
    assert capsys.readouterr().out.splitlines() == [
        "starting controller, echo, reference, viewer",
        (
            "    0 of 126 s: mode tracking, error q_1 +0.1 rad, command torque [1] +1.000 Nm, preparation 123456789 us, feedback 123456789 us, "
            "computed in period 100.00%, fallbacks 0"
        ),
    ]
