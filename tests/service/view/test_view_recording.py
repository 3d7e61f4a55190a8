# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rerun")
import rerun as rr
from rerun.chunk import RrdReader

from rti_mpc.contract.message import Command, End, Event, Reference, Severity, State, Telemetry
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.wire.info import Info
from rti_mpc_service.view.playback import Actuation
from rti_mpc_service.view.recording import Entry, RerunRecording
from rti_mpc_service.view.scene import Scene

SECOND = 1_000_000_000
STATES = [("x", "m"), ("y", "m"), ("psi", "rad"), ("u", "m/s"), ("omega", "rad/s")]
INPUTS = [("u_c", "m/s"), ("omega_c", "rad/s")]
ROLES = {"x": "x", "y": "y", "psi": "heading"}
LIMITS = {"lbu": [-0.2, -1.2], "ubu": [0.5, None]}


def described(role: str, states: list[tuple[str, str]], inputs: list[tuple[str, str]], outputs: list[tuple[str, str]], **rest: Any) -> Info:
    vectors = {"states": states, "inputs": inputs, "outputs": outputs}
    commanded = {"u_c": "u", "omega_c": "omega"}
    labels = {
        k: [{"name": name, "unit": unit, "angle": unit == "rad", "role": ROLES.get(name, ""), "state": commanded.get(name, name)} for name, unit in v]
        for k, v in vectors.items()
    }
    return Info.from_json({"role": role, "model": "pioneer_3dx", "dt_s": 0.1, **labels, **rest})


PIONEER = described("controller", STATES, INPUTS, STATES[:3], **LIMITS)


def state(k: int, x: list[float], epoch: int = 1) -> State:
    return State(epoch, k, k * SECOND, np.array(x))


def telemetry(k: int, mode: Mode = Mode.TRACKING, nx: int = 5, nu: int = 2, ny: int = 3) -> Telemetry:
    grid = np.full((4, nx), float(k))
    times = {"prepare_us": 100.0 + k, "feedback_us": 200.0, "latency_us": 300.0, "state_age_s": 0.1, "slack_s": 0.09}
    counts = {"iterations": 5, "skipped": 0, "fallbacks": k, "parameter_version": 1}
    residuals = {"res_prim": 1e-6, "res_dual": 1e-6, "cost": 2.0, "violation": 0.0}
    arrays = {"x0": grid[0], "x": grid, "u": np.zeros((3, nu)), "y_ref": np.zeros((3, ny))}
    lanes = {"mode": mode, "status": QpStatus.SOLVED}
    return Telemetry(epoch=2, seq=k, stamp_ns=k * SECOND, state_seq=k, state_stamp_ns=k * SECOND, **lanes, **times, **counts, **residuals, **arrays)


def command(k: int, u: list[float]) -> Command:
    stamp = k * SECOND
    return Command(2, k, stamp, 1, k, stamp, stamp + SECOND, 9, Mode.TRACKING, QpStatus.SOLVED, SECOND, np.array([u, u]))


def reference(y: list[list[float]], stamp_ns: int = 0) -> Reference:
    return Reference(5, 1, stamp_ns, SECOND, End.HOLD, np.array(y), np.zeros((len(y), 0)))


class Writer:
    """Records messages at their stamps, reads them back as lists of (seconds, values) by entity."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stream = rr.RecordingStream("test", recording_id="test")
        self.stream.save(path)
        self.recording = RerunRecording(self.stream)

    def send(self, *messages: Any) -> None:
        stamped = [(getattr(message, "command", message), message) for message in messages]
        self.recording.send([Entry(getattr(inner, "stamp_ns", 0), message) for inner, message in stamped])

    def read(self) -> dict[str, list[tuple[float, Any]]]:
        self.recording.finish()
        self.stream.flush(timeout_sec=10.0)
        self.stream.disconnect()
        rows = defaultdict(list)
        for chunk in RrdReader(self.path).stream().to_chunks():
            if not chunk.is_static:
                batch = chunk.to_record_batch()
                times = batch.column("robot_time").to_numpy(zero_copy_only=False).astype("timedelta64[ns]").astype(float) / SECOND
                rows[chunk.entity_path.lstrip("/")] += zip(times, batch.column(batch.num_columns - 1).to_pylist(), strict=True)
        return rows


@pytest.fixture
def writer(tmp_path: Path) -> Iterator[Writer]:
    rr.set_strict_mode(True)
    yield Writer(tmp_path / "run.rrd")
    rr.set_strict_mode(False)


def test_states_are_recorded_by_name_on_the_robots_timeline(writer: Writer) -> None:
    writer.send(PIONEER, *(state(k, [k, 2.0 * k, 0.1, 0.2, 0.3]) for k in range(3)))
    rows = writer.read()
    assert rows["state/y"] == [(0.0, [0.0]), (1.0, [2.0]), (2.0, [4.0])]
    assert {"state/x", "state/psi", "state/u", "state/omega", "world/robot", "world/trail"} <= rows.keys()


def test_error_is_the_distance_from_the_interpolated_reference_in_mm(writer: Writer) -> None:
    writer.send(PIONEER, reference([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], stamp_ns=SECOND))
    writer.recording.send([Entry(k * SECOND // 2, State(1, k, k * SECOND // 2, np.array([0.0, 0.003, 0.0, 0.0, 0.0]))) for k in range(1, 7)])
    assert [(t, pytest.approx(v)) for t, v in writer.read()["error/position"]] == [
        (1.0, [3.0]),
        (1.5, [1e3 * np.hypot(1.0, 0.003)]),
        (2.0, [1e3 * np.hypot(2.0, 0.003)]),
        (2.5, [1e3 * np.hypot(2.0, 0.003)]),  # held: its last row
        (3.0, [1e3 * np.hypot(2.0, 0.003)]),
    ]


def test_while_an_operator_has_stopped_the_robot_there_is_no_error_and_its_line_is_broken(writer: Writer) -> None:
    modes = {4: Mode.STOPPED, 5: Mode.STOPPED, 6: Mode.STOPPED, 7: Mode.TRACKING, 8: Mode.TRACKING}
    writer.send(PIONEER, reference([[float(k), 0.0, 0.0] for k in range(30)]))
    for together in (range(1, 6), range(6, 9)):  # the last sample before the present messages counts, too
        writer.send(*(state(k, [3.0, 0.0, 0.0, 0.0, 0.0]) for k in together), *(telemetry(k, modes.get(k, Mode.TRACKING)) for k in together))
    rows = writer.read()
    stopped = [(t, [pytest.approx(1e3 * abs(t - 3.0))]) for t in (1.0, 2.0, 3.0)]
    again = [(t, [pytest.approx(1e3 * abs(t - 3.0))]) for t in (7.0, 8.0)]
    assert rows["error/position"] == [*stopped, (4.0, []), *again], "the reference goes on, the robot is not to follow it"
    assert len(rows["state/x"]) == 8


def test_a_reference_that_is_sent_again_and_again_leaves_no_gap_in_the_error(writer: Writer) -> None:
    writer.send(PIONEER, reference([[0.0, 0.0, 0.0]] * 2))
    for first in (1, 6):  # as a file is written, many messages together
        anew = [reference([[0.0, 0.0, 0.0]] * 2, stamp_ns=k * SECOND) for k in range(first, first + 5)]
        writer.send(*anew, *(state(k, [0.001 * k, 0.0, 0.0, 0.0, 0.0]) for k in range(first, first + 5)))
    assert [(t, pytest.approx(v)) for t, v in writer.read()["error/position"]] == [(float(k), [float(k)]) for k in range(1, 11)]


def test_heading_error_does_not_jump_where_the_angle_wraps(writer: Writer) -> None:
    writer.send(PIONEER, reference([[0.0, 0.0, 3.1], [0.0, 0.0, -3.1]]))
    writer.send(state(0, [0, 0, -3.1, 0, 0]), state(1, [0, 0, 3.1, 0, 0]))
    [(_, first), (_, second)] = writer.read()["error/psi"]
    assert first == pytest.approx([2 * np.pi - 6.2])
    assert second == pytest.approx([6.2 - 2 * np.pi])


def test_commands_lie_between_the_limits_there_are(writer: Writer) -> None:
    writer.send(PIONEER, command(0, [0.1, -1.0]), command(1, [0.2, 1.0]))
    rows = writer.read()
    assert rows["command/u_c"] == [(0.0, [0.1]), (1.0, [0.2])]
    assert [v for _, v in rows["command/u_c/max"]] == [[0.5], [0.5]]
    assert [v for _, v in rows["command/omega_c/min"]] == [[-1.2], [-1.2]]
    assert "command/omega_c/max" not in rows


def test_what_the_guard_let_through_lies_beside_what_was_commanded(writer: Writer) -> None:
    writer.send(PIONEER, command(0, [0.1, -1.0]), Actuation(command(0, [0.1, -1.0])))
    writer.send(command(1, [0.5, 1.0]), Actuation(command(1, [0.2, 0.0])))
    rows = writer.read()
    assert rows["command/u_c"] == [(0.0, [0.1]), (1.0, [0.5])]
    assert rows["actuation/u_c"] == [(0.0, [0.1]), (1.0, [0.2])]
    assert rows["actuation/omega_c"] == [(0.0, [-1.0]), (1.0, [0.0])]


def test_the_guards_lane_is_the_mode_of_what_acts(writer: Writer) -> None:
    writer.send(PIONEER, telemetry(0), Actuation(command(0, [0.5, 0.0])))
    writer.send(Actuation(replace(command(1, [0.0, 0.0]), mode=Mode.BRAKING)))
    writer.send(telemetry(2), Actuation(command(2, [0.5, 0.0])))
    rows = writer.read()
    assert rows["lane/mode"] == [(0.0, ["TRACKING"])]
    assert rows["lane/guard"] == [(0.0, ["TRACKING"]), (1.0, ["BRAKING"]), (2.0, ["TRACKING"])]


def test_without_a_guard_nothing_of_it_is_recorded(writer: Writer) -> None:
    writer.send(PIONEER, state(0, [0.0] * 5), command(0, [0.1, 0.1]), telemetry(0))
    assert not [path for path in writer.read() if "guard" in path or "actuation" in path]


def test_a_takeover_is_a_change_in_the_leaders_lane(writer: Writer) -> None:
    writer.send(PIONEER, telemetry(0), telemetry(1))
    writer.send(replace(telemetry(2), epoch=7), replace(telemetry(3), epoch=7))
    assert writer.read()["lane/leader"] == [(0.0, ["epoch 2"]), (2.0, ["epoch 7"])]


def test_obstacles_are_where_the_reference_says_and_by_themselves_without(writer: Writer) -> None:
    discs = [{"at": 7, "x": 1.0, "y": 2.0, "r": 0.3}, {"at": 10, "x": 3.0, "y": 4.0, "r": 0.2}]
    writer.send(described("controller", STATES, INPUTS, STATES[:3], obstacles=discs), telemetry(0))
    moves = reference([[0.0, 0.0, 0.0]] * 2, stamp_ns=SECOND)
    moves.p = np.array([[0.0] * 7 + [1.0, 2.0, 0.3] + [3.0, 4.0, 0.2], [0.0] * 7 + [1.0, 2.0, 0.3] + [3.0, 2.0, 0.2]])
    writer.send(moves)
    writer.recording.send([Entry(t, replace(telemetry(1), stamp_ns=t)) for t in (SECOND, SECOND * 3 // 2, 9 * SECOND)])
    rows = writer.read()
    assert [place for _, place in rows["world/obstacle_0"]] == [[[1.0, 2.0, 0.0]]] * 4
    assert [place for _, place in rows["world/obstacle_1"]] == [[[3.0, y, 0.0]] for y in (4.0, 4.0, 3.0, 2.0)]


def test_every_scalar_of_the_telemetry_is_recorded(writer: Writer) -> None:
    writer.send(PIONEER, telemetry(0), telemetry(1))
    rows = writer.read()
    assert rows["telemetry/prepare_us"] == [(0.0, [100.0]), (1.0, [101.0])]
    assert rows["telemetry/fallbacks"] == [(0.0, [0.0]), (1.0, [1.0])]
    assert {f"telemetry/{name}" for name in ("softened", "shifted", "braked", "rested", "delay_s")} <= rows.keys()
    assert [v for _, v in rows["slack"]] == [[pytest.approx(90.0)]] * 2
    assert [v for _, v in rows["slack/period"]] == [[pytest.approx(100.0)]] * 2
    assert [np.shape(strips) for _, strips in rows["world/horizon"]] == [(1, 4, 3)] * 2


def test_the_mode_lane_holds_changes_only_across_batches(writer: Writer) -> None:
    writer.send(PIONEER, telemetry(0, Mode.WAITING), telemetry(1), telemetry(2))
    writer.send(telemetry(3), telemetry(4, Mode.FALLBACK))
    assert writer.read()["lane/mode"] == [(0.0, ["WAITING"]), (1.0, ["TRACKING"]), (4.0, ["FALLBACK"])]


def test_a_lane_ends_with_what_was_told_last(writer: Writer) -> None:
    """The ramp of a stale state is told to begin later than the sample that makes it unnecessary."""
    writer.send(PIONEER, telemetry(0), telemetry(3, Mode.BRAKING))
    writer.send(telemetry(2), telemetry(4))
    assert writer.read()["lane/mode"] == [(0.0, ["TRACKING"]), (3.0, ["BRAKING"]), (pytest.approx(3.0, abs=1e-6), ["TRACKING"])]


def test_the_trail_joins_batches_but_not_two_lives_of_the_robot(writer: Writer) -> None:
    writer.send(PIONEER, state(0, [0.0] * 5), state(1, [1.0] * 5))
    writer.send(state(2, [2.0] * 5), state(3, [7.0] * 5, epoch=2))
    ends = [tuple(point[0] for point in strip) for _, [strip] in writer.read()["world/trail"]]
    assert ends == [(0.0, 0.0), (0.0, 1.0), (1.0, 2.0), (7.0, 7.0)]


def test_events_become_text_without_waiting_for_a_description(writer: Writer) -> None:
    writer.send(Event(1, 1, SECOND, "robot", Severity.ERROR, "command_late", "a command came late"))
    rows = writer.read()
    assert [t for t, _ in rows["event/robot"]] == [1.0]


def test_what_comes_before_its_description_is_held_and_then_written(writer: Writer) -> None:
    writer.send(state(0, [0.0] * 5), telemetry(0))
    writer.send(PIONEER, state(1, [1.0] * 5))
    assert [t for t, _ in writer.read()["state/x"]] == [0.0, 1.0]


def test_a_recording_without_description_is_written_under_numbers(writer: Writer) -> None:
    writer.send(state(0, [0.0] * 5), telemetry(0), command(0, [0.5, 0.5]))
    rows = writer.read()
    assert {"state/state_4", "command/input_1", "telemetry/prepare_us"} <= rows.keys()


def test_messages_of_another_models_width_are_left_out(writer: Writer) -> None:
    writer.send(PIONEER, state(0, [0.0] * 4), state(1, [1.0] * 5), telemetry(1, nx=6))
    rows = writer.read()
    assert [t for t, _ in rows["state/x"]] == [1.0]
    assert "telemetry/cost" not in rows


def test_a_controllers_description_replaces_the_robots_but_not_the_other_way(writer: Writer) -> None:
    writer.send(described("robot", STATES, INPUTS, STATES[:3]))
    writer.send(PIONEER)
    writer.send(described("robot", STATES, INPUTS, STATES[:3]))
    assert writer.recording.info is not None
    assert writer.recording.info.ubu[0] == 0.5
    writer.read()


def test_a_model_without_position_has_time_series_only(writer: Writer) -> None:
    pendulum = described("controller", [("theta", "rad"), ("rate", "rad/s")], [("torque", "N m")], [("theta", "rad")])
    writer.send(pendulum, reference([[0.0], [0.1]]), state(0, [0.2, 0.0]), telemetry(0, nx=2, nu=1, ny=1))
    rows = writer.read()
    assert rows["error/theta"] == [(0.0, [pytest.approx(0.2)])]
    assert not any(path.startswith("world") for path in rows)


def test_outputs_that_are_no_state_are_drawn_from_the_telemetry(writer: Writer) -> None:
    """The tip of an arm: where it is, only the controller knows, who has the model."""
    signals = {
        "states": [{"name": name, "unit": "rad", "angle": True} for name in ("q_1", "q_2")],
        "inputs": [{"name": name, "unit": "rad/s", "angle": False} for name in ("w_1", "w_2")],
        "outputs": [
            *({"name": f"tip_{role}", "unit": "m", "angle": False, "role": role} for role in "xy"),
            {"name": "q_1", "unit": "rad", "angle": True, "state": "q_1"},
        ],
    }
    writer.send(Info.from_json({"role": "controller", "model": "arm", "dt_s": 0.1, **signals}), reference([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]]))
    writer.send(state(0, [0.1, 0.0]), *(replace(telemetry(k, nx=2), y=np.array([1.003, k - 0.004, 9.0])) for k in range(2)), telemetry(2, nx=2))
    writer.send(replace(telemetry(3, nx=2), y=np.array([1.0, 0.5, 9.0])))
    rows = writer.read()
    assert rows["output/tip_y"] == [(0.0, [-0.004]), (1.0, [0.996]), (3.0, [0.5])], "and none where none was computed"
    assert [(t, pytest.approx(v)) for t, v in rows["error/position"]] == [(0.0, [5.0]), (1.0, [5.0]), (3.0, [500.0])]
    assert rows["error/q_1"] == [(0.0, [pytest.approx(0.1)])], "from the state"
    assert [np.array(strip)[:, 1].tolist() for _, [strip] in rows["world/output"]] == [
        pytest.approx(ends) for ends in ([-0.004, -0.004], [-0.004, 0.996], [0.996, 0.5])
    ]
    assert "world/reference" in rows
    assert not {"output/q_1", "world/robot", "world/trail", "world/horizon"} & rows.keys()


def test_the_recording_carries_a_blueprint_for_its_application(writer: Writer) -> None:
    writer.send(PIONEER, reference([[-3.0, 0.0, 0.0], [3.0, 1.0, 0.0]]), state(0, [0.0] * 5))
    writer.read()
    assert RrdReader(writer.path).blueprints()


def test_absurd_numbers_are_written_or_left_out_and_what_is_honest_stays(writer: Writer) -> None:
    """Values that receivers accept: any number in telemetry, elsewhere magnitudes up to 1e18, and stamps up to 2^62."""
    largest, last_ns = 1e18, 2**62 - 1
    writer.send(PIONEER, state(1, [1.0, 2.0, 0.1, 0.2, 0.3]))
    for k, value in enumerate((np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324, -0.0)):
        sample = telemetry(2 + k)
        arrays = {name: np.full_like(getattr(sample, name), value) for name in ("x0", "x", "u", "y_ref")}
        scalars = dict.fromkeys(("prepare_us", "slack_s", "cost", "state_age_s"), value)
        writer.send(replace(sample, **arrays, **scalars, skipped=2**64 - 1, stamp_ns=last_ns, state_stamp_ns=-last_ns))
    for value in (largest, -largest, 5e-324):
        writer.send(reference([3 * [value], 3 * [-value]], stamp_ns=-last_ns))
        writer.send(replace(reference([3 * [value]], stamp_ns=last_ns), period_ns=1), state(10, 5 * [value]), command(10, 2 * [value]))
        writer.send(Actuation(replace(command(10, 2 * [value]), valid_until_ns=last_ns, period_ns=100_000)))
    writer.send(state(12, [3.0, 4.0, 0.1, 0.2, 0.3], epoch=2))
    rows = writer.read()
    assert [row for row in rows["state/y"] if abs(row[1][0]) < 10.0 and row[1][0] > 1e-3] == [(1.0, [2.0]), (12.0, [4.0])]


def test_bounds_of_inputs_have_lanes_others_from_when_they_act_on_and_parameters_from_their_first_change(writer: Writer) -> None:
    limits = {"lbx": [None] * 5, "ubx": [None, None, None, 3.0, 9.0]}
    fast = {k: np.array([[0.5 if k == 2 else 0.1, 0.0]] * 3) for k in range(4)}
    writer.send(described("controller", STATES, INPUTS, STATES[:3], **LIMITS, **limits))
    speeds = {k: np.array([[0.0, 0.0, 0.0, 0.0 if i < 3 or k != 2 else 3.0, 0.0] for i in range(4)]) for k in range(4)}
    writer.send(*(replace(telemetry(k), x=speeds[k], u=fast[k], parameter_version=k // 3) for k in range(2)))
    writer.send(*(replace(telemetry(k), x=speeds[k], u=fast[k], parameter_version=k // 3) for k in (2, 3)))
    rows = writer.read()
    assert rows["bound/u_c"] == [(0.0, ["free"]), (2.0, ["upper"]), (3.0, ["free"])]
    assert rows["bound/u"] == [(2.0, ["upper later"]), (3.0, ["free"])], "a state, from when it acts on"
    assert "bound/omega" not in rows
    assert rows["lane/parameters"] == [(2.0, ["version 0"]), (3.0, ["version 1"])]


def test_cost_by_term_needs_weights_and_leaves_the_rest(writer: Writer) -> None:
    weights = {"Q": np.eye(3).tolist(), "R": np.eye(2).tolist(), "delta": [2.0] * 3, "lambda_": [1.0] * 3}
    writer.send(described("controller", STATES, INPUTS, STATES[:3], **LIMITS, weights=weights))
    writer.send(*(replace(telemetry(k), x=np.full((4, 5), 0.1), u=np.full((3, 2), 0.1 * k)) for k in range(2)))
    rows = writer.read()
    assert rows["cost/error/y"] == [(k, [pytest.approx(3 * 2.0 * 0.01)]) for k in range(2)]
    assert [value for _, [value] in rows["cost/changes/u_c"]] == [0.0, pytest.approx(0.01)], "against the sample before"
    assert [value for _, [value] in rows["cost/rest"]] == [pytest.approx(2.0 - 0.18), pytest.approx(2.0 - 0.2)]


def test_a_followed_path_is_drawn_with_its_edges(writer: Writer) -> None:
    knots = [(0.5 * i, 0.0, 0.2, 0.3, 1.0) for i in range(6)]
    parameters = [
        ("path_start", "path_start"),
        ("path_step", ""),
        *((f"path_{i}_{part}", "path_x" * (part == "x")) for i in range(6) for part in "xyrls"),
    ]
    labels = [{"name": name, "unit": "m", "angle": False, "role": role} for name, role in parameters]
    writer.send(described("controller", STATES, INPUTS, [("contour", "m")], stage_parameters=labels))
    p = np.array([[0.0, 0.5, *(value for knot in knots for value in knot)]] * 2)
    writer.send(replace(reference([[0.0], [0.0]]), p=p), replace(reference([[0.0], [0.0]]), p=p[:, :5]))
    rows = writer.read()
    for path, y in (("world/path", 0.0), ("world/path/right", -0.2), ("world/path/left", 0.3)):
        [(_, [strip])] = rows[path]
        assert np.array(strip)[:, 1] == pytest.approx(y, abs=1e-6)  # single precision
        assert (strip[0][0], strip[-1][0]) == (0.5, 2.0), "where its knots say it all"


def test_robots_that_share_a_view_have_trails_of_different_colors(tmp_path: Path) -> None:
    stream = rr.RecordingStream("test", recording_id="test")
    stream.save(tmp_path / "run.rrd")
    scene = Scene(stream, ("ant", "bee"))
    scene.send([Entry(0, PIONEER, root) for root in ("ant", "bee")])
    scene.finish()
    stream.flush(timeout_sec=10.0)
    stream.disconnect()
    colors = [
        chunk.to_record_batch().column("LineStrips3D:colors").to_pylist()
        for chunk in RrdReader(tmp_path / "run.rrd").stream().to_chunks()
        if chunk.entity_path in ("/ant/world/trail", "/bee/world/trail")
    ]
    assert len(colors) == 2
    assert colors[0] != colors[1]
