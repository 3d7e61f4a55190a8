# SPDX-License-Identifier: Apache-2.0
"""Table of all robots: what is said of each, from messages that no bus has carried."""

from __future__ import annotations

import json

import numpy as np
import pytest
from rich.console import Console

from rti_mpc.contract.message import End, Event, Reference, Severity, State
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.info import Info
from rti_mpc_service.status.status import table
from rti_mpc_service.status.survey import Survey
from tests.recording.samples import INFO, KEYS, MS, telemetry
from tests.wire.fake_session import FakeSession

NOW_NS = 10**12


@pytest.fixture
def survey() -> Survey:
    survey = Survey(Bus(FakeSession(), KEYS))
    survey.present |= {"controller", "robot", "standby", "standby.7", "guard"}
    said = INFO | {"epoch": (5 << 20) + 42, "version": "0.1.0", "latch": {"stopped": False}}
    survey._infos[KEYS.info("controller")] = Info.from_json(said), said
    return survey


def shown(reports: dict) -> str:
    console = Console(width=200, record=True, force_terminal=False, file=open("/dev/null", "w"))
    with console.file:
        console.print(table(reports))
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
