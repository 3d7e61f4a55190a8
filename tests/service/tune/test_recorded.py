# SPDX-License-Identifier: Apache-2.0
"""Tuning on what a robot has driven: reference and start come from its recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mcap")

from rti_mpc.contract.message import State, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.errors import ConfigError
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.build import build_model
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.tune.closed_loop import ClosedLoop, Course
from rti_mpc_service.tune.recorded import is_recording, recorded
from rti_mpc_service.tune.recorded_robot import RecordedRobot, read
from rti_mpc_service.tune.tune import parted
from tests.recording.samples import telemetry
from tests.robots import SHIPPED

DT_NS, SAMPLES, N = 100_000_000, 120, 20
START = [0.5, -0.25, 0.0, 0.2, 0.0]
SPEED = 0.2  # m/s


def sample(k: int, mode: Mode = Mode.TRACKING) -> Telemetry:
    """Telemetry of a robot whose reference drives straight on; row 0 is one period after the stamp."""
    x = START[0] + SPEED * (1e-9 * DT_NS) * (k + 1 + np.arange(N))
    y_ref = np.column_stack([x, np.full(N, START[1]), np.zeros(N)])
    return replace(
        telemetry(k), stamp_ns=k * DT_NS, mode=mode, x0=np.array(START), x=np.zeros((N + 1, 5)), u=np.zeros((N, 2)), y_ref=y_ref, y=y_ref[0]
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path, keys = tmp_path_factory.mktemp("recording") / "run.mcap", Keys(robot="pioneer")
    writer = RecordingWriter(path, 0, 0, "0.0")
    for k in range(1, SAMPLES + 30):
        mode = Mode.BRAKING if 15 <= k < 20 else Mode.TRACKING  # a break: what follows it is the longest span
        state = State(3, k, k * DT_NS, np.array([START[0] + SPEED * 1e-9 * DT_NS * k, *START[1:]]), np.zeros(2))
        for key, message in ((keys.state, state), (keys.telemetry, sample(k, mode))):
            writer.add("pioneer", key, k * DT_NS, encode(message), message.seq)
    writer.finish({})
    return path


def heard(config: Config, path: Path) -> RecordedRobot:
    return read(str(path), config.robot, build_model(config), config.ocp.dt_s)


def test_reference_and_start_are_those_of_the_longest_span_without_a_break(run: Path) -> None:
    placed, scenario = recorded(load(SHIPPED), heard(load(SHIPPED), run), (0.0, 1.0), None)
    assert placed.sim.x0["y"] == START[1]
    y = scenario.y(np.zeros(5))
    assert len(y) == SAMPLES + 30 - 20 + N - 1, "and what the last sample saw ahead"
    assert scenario.duration_s == pytest.approx(0.1 * (SAMPLES + 30 - 21))
    assert y[0] == pytest.approx([placed.sim.x0["x"], START[1], 0.0], abs=1e-12)  # the state and the reference of the same instant
    assert np.diff(y[:, 0]) == pytest.approx(SPEED * 0.1)
    assert scenario.title == "run.mcap from 2.0 to 14.9 s"


def test_the_second_half_of_a_recording_is_held_out_by_default(run: Path) -> None:
    study, other = parted(Course(str(run)), None, planar=True)
    assert (study.part, other.part) == ((0.0, 0.5), (0.5, 1.0))
    assert other.seed != study.seed
    loops = [ClosedLoop(load(SHIPPED), course, lockstep_robot) for course in (study, other)]
    ends = [loop.scenario.y(np.zeros(5))[[0, -N], 0] for loop in loops]
    assert ends[0][1] < ends[1][0], "the halves have no sample in common"
    assert parted(Course(str(run)), "circle", planar=True) == (Course(str(run)), Course("circle", seed=1))


def test_a_recorded_scenario_is_driven(run: Path) -> None:
    driven = ClosedLoop(load(SHIPPED), Course(str(run), duration_s=5.0), lockstep_robot).drive({})
    assert driven.outputs[0] < 1e-3  # m: a straight line, from its start, by the controller's own model


def test_what_is_no_recording_of_this_robot_is_refused(run: Path, tmp_path: Path) -> None:
    config = load(SHIPPED)
    (tmp_path / "none.mcap").write_bytes(b"nothing")
    for wrong, name, duration_s, words in (
        (config.model_copy(update={"robot": "ant"}), run, None, "must hold the robot ant, got pioneer"),
        (config, tmp_path / "none.mcap", None, r"none\.mcap must be an MCAP file, got one that begins with b'nothing'"),
        (config, run, 2.0, "40 samples that follow a reference without a break in each part, got 20"),
    ):
        with pytest.raises(ConfigError, match=words):
            recorded(wrong, heard(wrong, name), (0.0, 1.0), duration_s)
    assert not is_recording("eight")
    assert not is_recording(None)
    with pytest.raises(ConfigError, match="--heading"):
        ClosedLoop(config, Course(str(run), heading="tangent"), lockstep_robot)
