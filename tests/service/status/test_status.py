# SPDX-License-Identifier: Apache-2.0
"""Table of all robots: what is said of each, from messages that no bus has carried."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pytest
from rich.console import Console

from rti_mpc.contract.latch import Latch
from rti_mpc.contract.message import End, Event, Reference, Severity, State
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.info import Info
from rti_mpc_service.status.status import Robots
from rti_mpc_service.status.status import shown as table
from rti_mpc_service.status.survey import Survey
from tests.recording.samples import INFO, KEYS, MS, telemetry
from tests.wire.fake_session import FakeSession

NOW_NS = 10**12


@pytest.fixture
def survey() -> Survey:
    survey = Survey(Bus(FakeSession(), KEYS))
    survey.present |= {"controller", "robot", "standby", "standby.7", "guard"}
    said = INFO | {"epoch": (5 << 20) + 42, "version": "0.1.0", "latch": asdict(Latch())}
    survey._infos[KEYS.info("controller")] = Info.from_json(said), said
    return survey


def shown(reports: dict, width: int = 200) -> str:
    console = Console(width=width, record=True, force_terminal=False, file=open("/dev/null", "w"))
    with console.file:
        console.print(table(reports, console))
    return console.export_text()


def test_report_says_mode_error_ages_times_leader_agreement_and_the_last_event(survey: Survey) -> None:
    first, second = telemetry(1), telemetry(2)
    first.y_ref[0], second.y, second.second_difference = 0.25, np.array([0.2]), 2e-3
    survey._take(State(3, 1, 2000 * MS, np.zeros(2)), NOW_NS)
    survey._take(Reference(2, 1, 0, 100 * MS, End.HOLD, np.zeros((31, 1)), np.zeros((31, 0))), NOW_NS)
    survey._take(first, NOW_NS)
    survey._take(second, NOW_NS)
    survey._take(Event(7, 1, 0, "controller", Severity.WARNING, "state_old", "states were too old"), NOW_NS)
    report = json.loads(json.dumps(survey.report(NOW_NS + 500 * MS)))
    assert (report["mode"], report["qp"], report["standby"]) == ("TRACKING", "SOLVED", 1)
    assert report["error"]["x"]["value"] == pytest.approx(-0.05, abs=1e-12)  # rounding
    assert report["error"]["x"]["unit"] == "m"
    assert report["state_age_s"] == pytest.approx(0.5, abs=1e-9)
    assert report["reference_left_s"] == pytest.approx(1.0, abs=1e-9)
    assert report["times_us"]["feedback"] == {"p50": 50.0, "max": 50.0}
    assert report["leader"] == {"epoch": (5 << 20) + 42, "owner": 42}
    assert report["agreement"] == {"max_difference": 2e-3, "judged": 1, "samples": 2}
    text = shown({"wheels": report})
    for words in ("tracking", "x -0.05 m", "0.50 s", "1 s left", "feedback 50/50", "controller 42", "guard", "0.002", "0.1.0", "states were too old"):
        assert words in text, words


def test_error_is_not_said_across_a_sample_that_is_missing(survey: Survey) -> None:
    survey._take(telemetry(1), NOW_NS)
    survey._take(telemetry(3), NOW_NS)
    assert survey.report(NOW_NS)["error"] == {}


@pytest.mark.parametrize("latch", ["x", None, 3, [], {"stopped": "yes"}, {**asdict(Latch()), "counter": -1}], ids=str)
def test_latch_that_is_none_is_shown_as_not_said_and_the_table_goes_on(survey: Survey, latch: object) -> None:
    assert survey.report(NOW_NS)["stopped"] is False
    said = INFO | {"latch": latch}
    survey._infos[KEYS.info("controller")] = Info.from_json(said), said
    assert survey.report(NOW_NS)["stopped"] is None


@pytest.mark.parametrize("rows", [np.zeros((20, 2)), np.zeros((0, 1))], ids=["wider", "none"])
def test_samples_whose_rows_do_not_fit_one_another_are_not_compared(survey: Survey, rows: np.ndarray) -> None:
    first, second = telemetry(1), telemetry(2)
    first.y_ref = rows
    survey._take(first, NOW_NS)
    survey._take(second, NOW_NS)
    report = survey.report(NOW_NS)
    assert (report["error"], report["agreement"]["samples"]) == ({}, 2)


def test_robot_that_nobody_controls_is_shown_as_such(survey: Survey) -> None:
    survey.present.clear()
    survey.present.add("robot")
    assert not survey.complete
    survey._take(State(3, 1, 2000 * MS, np.zeros(2)), NOW_NS)
    assert survey.complete
    text = shown({"wheels": survey.report(NOW_NS + 3000 * MS)})
    assert "no controller" in text
    assert "3.00 s" in text


def test_versions_are_listed_where_they_differ(survey: Survey) -> None:
    survey._infos[KEYS.info("robot")] = Info.from_json(INFO | {"role": "robot"}), INFO | {"version": "0.0.9"}
    text = shown({"wheels": survey.report(NOW_NS)})
    assert "controller 0.1.0" in text
    assert "robot 0.0.9" in text


def test_router_is_no_robot_and_only_a_robot_that_was_named_is_shown_as_missing() -> None:
    for named, expected in ((set(), ["ant"]), ({"wheels"}, ["ant", "wheels"])):
        robots = Robots(Bus(FakeSession(), KEYS), named)
        for robot, role in (("pioneer", "router"), ("pioneer", "recorder"), ("ant", "robot")):
            robots._note(robot, role, True)
        reports = robots.report()
        assert list(reports) == expected
        text = shown(reports)
        assert ("not there" in text) == bool(named), text
        assert "no controller" in text


def test_last_event_is_the_newest_by_the_robots_clock_whichever_was_heard_first(survey: Survey) -> None:
    for source, stamp_ns in (("controller", 9500 * MS), ("robot", 2000 * MS), ("guard", 99_000 * MS)):
        survey._take(Event(7, 1, stamp_ns, source, Severity.INFO, "code", f"by {source}"), NOW_NS)
    survey._take(State(3, 1, 10_000 * MS, np.zeros(2)), NOW_NS)
    assert survey.report(NOW_NS)["event"]["text"] == "by controller", "the guard's is of an earlier life of the robot's clock"
    assert survey.report(NOW_NS + 100 * MS)["event"]["age_s"] == pytest.approx(0.6, abs=1e-9)  # rounding
    survey._take(Event(7, 2, 10_000 * MS, "robot", Severity.INFO, "code", "later"), NOW_NS)
    assert survey.report(NOW_NS)["event"]["text"] == "later"


def test_narrow_terminal_has_a_line_for_each_value(survey: Survey) -> None:
    survey._take(telemetry(1), NOW_NS)
    survey._take(Event(7, 1, 0, "controller", Severity.WARNING, "state_old", "states were too old"), NOW_NS)
    lines = shown({"wheels": survey.report(NOW_NS)}, 60).splitlines()
    assert max(map(len, lines)) <= 60
    for name, words in (("robot", "wheels"), ("mode", "tracking"), ("leads", "controller 42"), ("last event", "controller: states were too old")):
        assert any(line.startswith(f"{name} ") and words in line for line in lines), lines
