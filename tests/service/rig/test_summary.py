# SPDX-License-Identifier: Apache-2.0
"""Summary of a run made up by hand, whose figures are known."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.contract.message import End, Event, Reference, Severity, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.reference.trajectory import circle
from rti_mpc.wire.info import Info, Label
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.robot_log import COUNTERS, RobotLog
from rti_mpc_service.rig.summary import Outcome, excess, excess_share, summarize
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.shipped import SHIPPED

MS = 1_000_000
ANCHOR_NS = 700 * MS
CONFIG = load(SHIPPED)
OCP = build_ocp(CONFIG)
INFO = Info(
    role="controller",
    states=(Label("x", "m", role="x"), Label("y", "m", role="y"), Label("psi", "rad", True, "heading"), Label("u", "m/s"), Label("omega", "rad/s")),
    inputs=(Label("u_c", "m/s", state="u"), Label("omega_c", "rad/s", state="omega")),
    outputs=(Label("x", "m", role="x"), Label("y", "m", role="y"), Label("psi", "rad", True, "heading")),
    dt_s=0.1,
    lbu=(-0.5, -0.745),
    ubu=(0.5, 0.745),
)


def sample(seq: int, **changes: Any) -> Telemetry:
    stamp_ns = ANCHOR_NS + (seq - 1) * 100 * MS
    values: dict[str, Any] = dict.fromkeys(Telemetry.__slots__, 0)
    values |= {"seq": seq, "stamp_ns": stamp_ns, "state_seq": seq, "state_stamp_ns": stamp_ns, "mode": Mode.TRACKING, "status": QpStatus.SOLVED}
    values |= {"prepare_us": 300.0, "feedback_us": 500.0, "latency_us": 600.0, "slack_s": 0.09}
    return Telemetry(
        **{**values, "x0": np.zeros(5), "x": np.zeros((21, 5)), "u": np.tile([0.1, -0.1], (20, 1)), "y_ref": np.zeros((20, 3)), **changes}
    )


@pytest.fixture
def outcome() -> Outcome:
    """Two laps of the circle: 100 mm beside it for 20 s, 2 mm until the second lap, then 1 mm; and a second of standing around it."""
    duration_s = 40 * np.pi
    stamp_ns = np.arange(0, ANCHOR_NS + round(1e9 * duration_s) + 1000 * MS, 100 * MS)
    t = 1e-9 * (stamp_ns - ANCHOR_NS)
    beside = np.select([t < 20.0, t < 20 * np.pi - 0.1], [0.1, 0.002], 0.001)
    position = circle().position(t) * (1.0 + beside)[:, None]
    seq = np.arange(1, len(stamp_ns) + 1) - 7
    return Outcome(
        scenario=find_scenario(CONFIG, "circle", "none"),
        reference=Reference(1, 1, ANCHOR_NS, 50 * MS, End.STOP, np.zeros((2, 3)), np.zeros((2, 0))),
        plant=OCP.model,
        anchor_ns=ANCHOR_NS,
        duration_s=duration_s,
        speed=4.0,
        ocp=OCP,
        info=INFO,
        log=RobotLog(
            stamp_ns,
            seq,
            np.column_stack([position, 0 * t, 0 * t + 0.1, 0 * t - 0.1]),
            np.tile([0.1, -0.1], (len(t), 1)),
            1000.0 + 0 * t,
            dict.fromkeys(COUNTERS, 0),
        ),
        telemetry=[sample(k) for k in range(1, round(duration_s / 0.1) + 5)],
        unheard=0,
        events=[Event(1, 1, 900 * MS, "robot", Severity.WARNING, "late", "a command was late"), Event(1, 2, 0, "robot", Severity.INFO, "mode", "on")],
        echo_us=[200.0, 220.0, 240.0],
    )


def test_errors_are_of_the_true_position_at_the_same_stamp(outcome: Outcome) -> None:
    summary = summarize(outcome)
    assert summary["max_error_mm"] == pytest.approx(2.0)
    assert 1.0 < summary["rms_error_mm"] < 2.0
    assert summary["last_lap_max_error_mm"] == pytest.approx(1.0)
    assert summary["final_error_mm"] == pytest.approx(1.0)
    assert summary["final_speed_mm_s"] == pytest.approx(100.1, rel=1e-3)  # of a circle of 1.001 m, every 20 pi s
    assert (summary["scenario"], summary["driven"], summary["samples"], summary["states"]) == ("circle", True, 1257, 1257)


def test_error_is_of_the_outputs_not_of_states_of_the_same_role(outcome: Outcome) -> None:
    """A point a metre aside of the state that has the role of its y."""
    model = OCP.model
    aside = replace(model, y_expr=ca.vertcat(model.y_expr[0], model.y_expr[1] + 1.0, model.y_expr[2]))
    assert summarize(replace(outcome, plant=aside))["max_error_mm"] == pytest.approx(1000.0, abs=3.0)


def test_robot_that_follows_no_path_is_summed_up_by_its_outputs(outcome: Outcome) -> None:
    """Angles within pi; the reference holds its last row."""
    outputs = (Label("q1", "rad", True), Label("z", "m"), Label("q3", "rad", True))
    reference = replace(outcome.reference, y=np.array([[0.0, 0.0, 0.0], [0.5, 0.25, 2 * np.pi]]))
    log = replace(outcome.log, x=np.tile([0.5 - 2 * np.pi, 0.35, 0.1, 0.0, 0.0], (len(outcome.log.stamp_ns), 1)))
    no_path = replace(outcome.scenario, path=None)
    summary = summarize(replace(outcome, scenario=no_path, info=replace(INFO, outputs=outputs), reference=reference, log=log))
    assert summary["final_error_mm"] is None
    assert summary["outputs"]["q1"]["max"] == pytest.approx(0.0, abs=1e-9)
    assert (summary["outputs"]["z"]["unit"], summary["outputs"]["z"]["rms"]) == ("m", pytest.approx(0.1))
    assert summary["outputs"]["q3"]["final"] == pytest.approx(0.1)


def test_reference_begins_where_it_is_anchored(outcome: Outcome) -> None:
    """At 0.1 m/s, an anchor 100 ms off is 10 mm."""
    assert summarize(replace(outcome, anchor_ns=ANCHOR_NS + 100 * MS))["max_error_mm"] == pytest.approx(10.0, rel=0.1)


def test_share_in_period_counts_what_was_missed_and_what_was_skipped(outcome: Outcome) -> None:
    samples = [sample(k, skipped=3 * (k > 600), slack_s=-0.02 if k in (400, 500) else 0.09) for k in range(1, 1258)]
    summary = summarize(replace(outcome, telemetry=samples))
    assert summary["in_period_share"] == pytest.approx(1255 / 1260)
    assert [miss["at_s"] for miss in summary["misses"]] == pytest.approx([1e-9 * samples[k - 1].state_stamp_ns for k in (400, 500)])
    assert summary["skipped"] == 3


def test_events_are_told_until_the_end_and_not_what_follows_when_processes_are_stopped(outcome: Outcome) -> None:
    """The robot then runs out of commands, and says so."""
    late = replace(outcome.events[0], stamp_ns=outcome.end_ns)
    after = replace(late, stamp_ns=outcome.end_ns + 1, severity=Severity.ERROR)
    events = summarize(replace(outcome, events=[*outcome.events, late, after]))["events"]
    assert [(event["at_s"], event["severity"]) for event in events] == [(0.9, "WARNING"), (pytest.approx(1e-9 * outcome.end_ns), "WARNING")]


def test_second_opinions_that_came_to_an_end_are_summed_up(outcome: Outcome) -> None:
    assert summarize(outcome)["second_opinion"] == {"share": 0.0, "max_difference": None, "us": {"p50": None, "p99": None, "max": None}}
    solved = {"second_status": QpStatus.SOLVED, "second_us": 700.0}
    kinds = [
        solved | {"second_difference": 1e-9},
        solved | {"second_difference": 2e-9},
        {"second_status": QpStatus.MAX_ITER, "second_difference": 1.0},
    ]
    samples = [sample(k, **(kinds[k % 4] if k % 4 < 3 else {})) for k in range(1, 1257)]
    opinion = summarize(replace(outcome, telemetry=samples))["second_opinion"]
    assert (opinion["share"], opinion["max_difference"], opinion["us"]["p99"]) == (0.5, 2e-9, 700.0)


@pytest.mark.parametrize(("value", "inside"), [(0.5, True), (np.nextafter(0.5, 1.0), False), (-0.5, True), (np.nextafter(-0.5, -1.0), False)])
def test_inputs_are_compared_with_their_bounds_exactly(outcome: Outcome, value: float, inside: bool) -> None:
    applied = outcome.log.u.copy()
    applied[300, 0] = value
    log = replace(outcome.log, u=applied)
    assert summarize(replace(outcome, log=log))["applied_inputs_in_bounds"] is inside
    commanded = np.tile([value, -0.1], (20, 1))
    summary = summarize(replace(outcome, telemetry=[*outcome.telemetry[:-1], sample(1257, u=commanded)]))
    assert summary["commanded_inputs_in_bounds"] is inside
    assert summary["commanded_increments_in_bounds"]


def test_increments_of_a_plan_are_compared_with_their_bounds(outcome: Outcome) -> None:
    u = np.zeros((20, 2))
    u[5:, 0] = 0.2501
    summary = summarize(replace(outcome, telemetry=[sample(1, u=u), *outcome.telemetry[1:]]))
    assert (summary["commanded_inputs_in_bounds"], summary["commanded_increments_in_bounds"]) == (True, False)


def test_states_over_their_bounds_are_a_share_of_them(outcome: Outcome) -> None:
    x = outcome.log.x.copy()
    x[40, 3] = 0.505
    assert summarize(replace(outcome, log=replace(outcome.log, x=x)))["states_over_share"] == pytest.approx(0.01)


def test_bounds_that_are_infinite_or_zero_are_no_trouble() -> None:
    values, lower, upper = np.array([[9.0, -0.1, 0.3]]), np.array([-np.inf, 0.0, -1.0]), np.array([np.inf, 0.5, 0.0])
    assert excess(values, lower, upper).tolist() == [[0.0, 0.1, 0.3]]
    assert excess_share(values, lower, upper)[0] == pytest.approx([0.0, 0.2, 0.3])


def test_latency_is_that_of_the_robot_and_is_listed_with_its_parts_and_the_echo(outcome: Outcome) -> None:
    latency_us = outcome.log.latency_us.copy()
    latency_us[10::100] = np.nan
    summary = summarize(replace(outcome, log=replace(outcome.log, latency_us=latency_us)))
    assert summary["prepare_us"] == {"p50": 300.0, "p99": 300.0, "max": 300.0}
    assert summary["feedback_us"]["p50"] == 500.0
    assert summary["latency_us"]["max"] == 1000.0
    assert summary["echo_us"] == {"p50": 220.0, "p99": 239.6, "max": 240.0}


def test_faults_are_listed_and_news_are_not(outcome: Outcome) -> None:
    assert [(event["at_s"], event["code"]) for event in summarize(outcome)["events"]] == [(0.9, "late")]


@pytest.mark.parametrize("fault", ["short", "braking", "silent"])
def test_robot_that_did_not_get_to_the_end_was_not_driven_there(outcome: Outcome, fault: str) -> None:
    changed = {
        "short": replace(outcome, log=outcome.log.part(outcome.log.stamp_ns < outcome.end_ns)),
        "braking": replace(outcome, telemetry=[sample(k, mode=Mode.BRAKING if k > 1000 else Mode.TRACKING) for k in range(1, 1258)]),
        "silent": replace(outcome, telemetry=outcome.telemetry[:1200]),
    }[fault]
    assert outcome.driven
    assert not changed.driven
    assert summarize(changed)["driven"] is False


def test_robot_that_brakes_at_the_end_while_the_host_is_held_up_was_driven_there(outcome: Outcome) -> None:
    """For a second of the clock on the wall: four of the robot's, at four times real speed."""
    held_up = [sample(k, mode=Mode.BRAKING if k > 1225 else Mode.TRACKING) for k in range(1, 1258)]
    assert replace(outcome, telemetry=held_up, speed=4.0).driven
    assert not replace(outcome, telemetry=held_up, speed=2.0).driven
    braking = [sample(k, mode=Mode.BRAKING) for k in range(1, 1258)]
    assert not replace(outcome, telemetry=braking, speed=4.0, duration_s=2.0).driven, "a run shorter than that in which nothing was driven"


def test_run_that_is_too_short_says_nothing_where_it_knows_nothing(outcome: Outcome) -> None:
    summary = summarize(replace(outcome, log=outcome.log.part(outcome.log.stamp_ns < 5000 * MS), telemetry=outcome.telemetry[:30]))
    assert (summary["max_error_mm"], summary["last_lap_max_error_mm"], summary["driven"]) == (None, None, False)
    assert summary["final_error_mm"] == pytest.approx(100.0)
    assert summarize(replace(outcome, telemetry=[]))["samples"] == 0


def test_summary_is_json_without_nan(outcome: Outcome) -> None:
    for changed in (outcome, replace(outcome, echo_us=[]), replace(outcome, scenario=find_scenario(CONFIG, "positioning"), telemetry=[])):
        json.dumps(summarize(changed), allow_nan=False)
