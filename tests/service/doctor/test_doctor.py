# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from itertools import count
from typing import Any

import numpy as np
import pytest

from rti_mpc_service.doctor import doctor
from rti_mpc_service.doctor.doctor import PERIOD_MARGIN_FACTOR, finding_rows, period_verdict
from rti_mpc_service.host.jitter import bare_timer
from rti_mpc_service.shipped import SHIPPED
from tests.processes.system import rti_mpc

PARTS = ("prepare_us", "feedback_us", "timer_us", "round_trip_us")


@pytest.fixture(scope="module")
def examined(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, str, Any]:
    """Exit status, output and report on a period that no host can keep."""
    folder = tmp_path_factory.mktemp("doctor")
    (folder / "robot.toml").write_text(SHIPPED.read_text().replace("dt_s = 0.1 ", "dt_s = 0.0001 "))
    done = rti_mpc("doctor", folder / "robot.toml", "--json", folder / "report.json")
    assert done.stderr == ""
    return done.returncode, done.stdout, json.loads((folder / "report.json").read_text())


@pytest.mark.slow
def test_doctor_measures_what_the_loop_needs_and_says_that_the_period_is_too_short(examined: tuple[int, str, Any]) -> None:
    status, printed, report = examined
    for part in PARTS:
        assert 0.0 < report[part]["p50"] <= report[part]["p99"] <= report[part]["max"], part
    assert report["loop"]["shortest_period_us"] == pytest.approx(
        PERIOD_MARGIN_FACTOR * sum(report[part]["p99"] for part in PARTS), rel=1e-9
    )  # rounding
    assert (status, report["loop"]["fits"]) == (1, False)
    assert "a period of 0.1 ms CANNOT be kept here" in printed


@pytest.mark.slow
def test_doctor_tells_what_the_host_grants_and_has(examined: tuple[int, str, Any]) -> None:
    _, printed, report = examined
    assert set(report["realtime"]) == {"priority", "cores", "lock_memory"}
    assert report["cache"]["error"] is None
    for what, *_ in finding_rows(report):
        assert f"\n{what} " in printed, what


@pytest.mark.parametrize(("dt_s", "fits"), [(0.0061, True), (0.0059, False)])
def test_a_period_fits_that_holds_one_and_a_half_times_all_parts_at_p99(dt_s: float, fits: bool) -> None:
    assert period_verdict({part: {"p99": 1000.0} for part in PARTS}, dt_s)["fits"] is fits


def test_no_number_and_no_word_is_cut_off_in_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    times = dict.fromkeys(("p50", "p99", "max"), 123456789.0)
    granted = {"text": "SCHED_FIFO 20", "granted": True}
    report = {
        "machine": {"processor": "a processor of a long name", "cores": 2, "load": 16.2, "governor": "unknown", "python": "3.11.7", "system": "Linux"}
        | {"packages": {"numpy": "987654321.0"}},
        "realtime": {"lock_memory": granted},
        "clock": {"source": "tsc", "resolution_ns": 1.0, "reading_ns": 67.0, "timer_slack_us": 50.0},
        **dict.fromkeys(PARTS, times),
        "compiler": "cc",
        "cache": {"path": "/a/folder", "error": None},
        "extras": {"rerun-sdk": None},
        "loop": {"margin": 1.5, "shortest_period_us": 987654321.0, "fits": True},
    }
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setattr(doctor, "examine", lambda config: report)
    assert doctor.main(SHIPPED) == 0
    printed = capsys.readouterr().out
    assert printed.count("p50 123456789, p99 123456789, max 123456789 us") == len(PARTS)
    assert printed.count("987654.3 ms") == 2
    assert "pip install 'rti-mpc[view]'" in printed, "what is in brackets, too"
    assert "1.5 times preparation, feedback, timer and round trip at p99" in printed
    assert "…" not in printed


def test_nothing_is_promised_where_a_part_could_not_be_measured() -> None:
    loop = period_verdict({**{part: {"p99": 1.0} for part in PARTS}, "round_trip_us": {"p99": None}}, 10.0)
    assert (loop["shortest_period_us"], loop["fits"]) == (None, False)


def test_a_bare_timer_stays_on_its_grid_and_never_wakes_early() -> None:
    ticks = count()
    due_ns, late_ns = bare_timer(0.001, lambda: next(ticks) < 50).T
    assert len(due_ns) == 50
    assert not np.any(np.diff(due_ns) % 1_000_000)
    assert late_ns.min() >= 0
