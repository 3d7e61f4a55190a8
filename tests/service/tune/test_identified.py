# SPDX-License-Identifier: Apache-2.0
"""The robot of a study as its recording shows it: noise, delay and lag that are known are found again."""

from __future__ import annotations

import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

pytest.importorskip("mcap")

from rti_mpc.contract.message import Command, Reference, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.model.model import Model
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.build import build_controller, build_model, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.rig.scenario import configured
from rti_mpc_service.scenario import find_scenario
from rti_mpc_service.tune.closed_loop import ClosedLoop, Course
from rti_mpc_service.tune.identified import identified, noise_of
from rti_mpc_service.tune.recorded import as_recorded
from rti_mpc_service.tune.recorded_robot import RecordedRobot, read
from rti_mpc_service.tune.windows import MIN_STEPS, MIN_WINDOWS, Windows, windows_of
from tests.robots import SHIPPED
from tests.slow import slow_but

NOISE = {"x": 0.005, "y": 0.005, "psi": 0.01, "u": 0.01, "omega": 0.02}
SIM = {"noise_std": NOISE, "actuator_delay_s": 0.06, "actuator_lag_s": 0.12}
WHOLE = (0.0, 1.0)


def heard(path: Path) -> RecordedRobot:
    config = load(SHIPPED)
    return read(str(path), config.robot, build_model(config), config.ocp.dt_s)


def with_sim(config: Config, **sim: object) -> Config:
    return config.model_copy(update={"sim": config.sim.model_copy(update=sim)})


def record(path: Path, config: Config, duration_s: float) -> Path:
    """Drive the eight in lockstep with the robot of `[sim]`, and record it as a recorder does."""
    scenario = find_scenario(config, "eight", None, duration_s, 0.25, None)
    placed = configured(config, scenario)
    controller, body = build_controller(placed, build_rti(placed), None), lockstep_robot(robot_settings(placed))
    rows = scenario.y(body.x.copy())
    controller.receive_reference(Reference(1, 1, 0, round(1e9 * scenario.period_s), scenario.end, rows, np.empty((len(rows), 0))))
    writer, keys = RecordingWriter(path, 0, 0, "0.0"), Keys(robot=config.robot)
    while body.now_ns < round(1e9 * duration_s):
        state = body.tick()
        writer.add(config.robot, keys.state, body.now_ns, encode(state), state.seq)
        if (command := controller.receive_state(state, body.now_ns)) is not None:
            body.accept(command)
            controller.commit(command)
            told = controller.telemetry(prepare_us=0.0, feedback_us=0.0, latency_us=0.0, slack_s=0.0)
            for key, message in ((keys.command, command), (keys.telemetry, told)):
                writer.add(config.robot, key, body.now_ns, encode(message), message.seq)
            controller.prepare()
    writer.finish({})
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot of `SIM`, driven with small weights of increments: inputs that move much tell delay from lag."""
    config = with_sim(load(SHIPPED), **SIM)
    weights = config.ocp.weights.model_copy(update={"R": {"u_c": 0.01, "omega_c": 0.01}})
    return record(
        tmp_path_factory.mktemp("identified") / "run.mcap",
        config.model_copy(update={"ocp": config.ocp.model_copy(update={"weights": weights})}),
        60.0,
    )


def test_noise_delay_and_lag_of_a_recorded_robot_are_found_again(run: Path) -> None:
    config, said = as_recorded(load(SHIPPED), heard(run), WHOLE)
    for name, std in NOISE.items():
        assert config.sim.noise_std[name] == pytest.approx(std, rel=0.15), "5 % is one sigma"
    assert config.sim.actuator_delay_s == pytest.approx(0.06, abs=0.02)  # s: a fifth of a period
    assert config.sim.actuator_lag_s == pytest.approx(0.12, abs=0.02)
    assert said.startswith("simulated robot as in run.mcap: noise x 0.00")
    assert "; delay 0.0" in said


def test_what_the_file_says_of_the_robot_is_kept(run: Path) -> None:
    config, said = as_recorded(with_sim(load(SHIPPED), actuator_delay_s=0.06, noise_std={}), heard(run), WHOLE)
    assert (config.sim.actuator_delay_s, config.sim.noise_std) == (0.06, {})
    assert config.sim.actuator_lag_s == pytest.approx(0.12, abs=0.02), "s: found with the delay that is known"
    assert re.fullmatch(r"simulated robot as in run\.mcap: lag 0\.1\d* s", said)
    config, said = as_recorded(with_sim(load(SHIPPED), **SIM), heard(run), WHOLE)
    assert (said, config.sim.noise_std) == ("simulated robot as in [sim]", NOISE)


def test_robot_that_is_its_model_has_no_noise_delay_or_lag(tmp_path: Path) -> None:
    config, said = as_recorded(load(SHIPPED), heard(record(tmp_path / "ideal.mcap", load(SHIPPED), 15.0)), WHOLE)
    assert (config.sim.actuator_delay_s, config.sim.actuator_lag_s) == (0.0, 0.0), said
    assert not any(config.sim.noise_std.values()), said


def test_recording_that_is_too_short_says_so_and_leaves_the_robot_of_the_file(tmp_path: Path) -> None:
    config, said = as_recorded(load(SHIPPED), heard(record(tmp_path / "short.mcap", load(SHIPPED), 6.0)), WHOLE)
    assert config == load(SHIPPED)
    assert "are those of [sim], since it must hold commands and 80 states without a gap" in said


def tank(below: int, windows: int = 30, delay: int = 2) -> Windows:
    """Windows of a tank that flows out with the root of its level; so many of them have a level measured below zero, where that is no number."""
    rng, ms, steps = np.random.default_rng(1), 1_000_000, MIN_STEPS * windows
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model("tank", x, u, u - 0.5 * ca.sqrt(x), x, "h", "q", "h")
    v, level = rng.uniform(0.3, 0.9, steps), np.ones(steps + 1)
    for k in range(steps):
        level[k + 1] = level[k]
        for _ in range(50):  # of 2 ms
            level[k + 1] += 0.002 * (v[max(k - delay, 0)] - 0.5 * np.sqrt(level[k + 1]))
    level += 1e-3 * rng.standard_normal(steps + 1)
    level[3 : MIN_STEPS * below : MIN_STEPS] = -0.5
    states = [State(3, k + 1, 100 * ms * k, level[[k]]) for k in range(steps + 1)]
    commands = [
        Command(7, k + 1, t := 100 * ms * k, 3, k + 1, t, t + 250 * ms, 1, Mode.TRACKING, QpStatus.SOLVED, 100 * ms, np.full((20, 1), v[k]))
        for k in range(steps)
    ]
    return windows_of(model, states, commands, 0.1)


def motor(dt_ms: int, delay_ms: int = 60, lag_ms: float = 120.0, duration_ms: int = 40_000) -> Windows:
    """Windows of a motor whose torque follows smooth commands late and with a lag, from a noisy speed."""
    from scipy.ndimage import gaussian_filter1d

    rng, ms = np.random.default_rng(1), 1_000_000
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    model = Model("motor", x, u, u - x, x, "speed", "torque", "speed")
    asked = gaussian_filter1d(rng.uniform(-1.0, 1.0, duration_ms // 400 + 1).repeat(400), 300.0)
    speed, torque = np.zeros(duration_ms + 1), 0.0
    for k in range(duration_ms):
        torque += (asked[max(k - delay_ms, 0)] - torque) / lag_ms
        speed[k + 1] = speed[k] + 0.001 * (torque - speed[k])
    states = [State(3, k + 1, dt_ms * ms * k, speed[[dt_ms * k]] + 0.01 * rng.standard_normal(1)) for k in range(duration_ms // dt_ms)]
    commands = [
        Command(
            7,
            k + 1,
            t := dt_ms * ms * k,
            3,
            k + 1,
            t,
            t + 250 * ms,
            1,
            Mode.TRACKING,
            QpStatus.SOLVED,
            dt_ms * ms,
            np.full((40, 1), asked[dt_ms * k]),
        )
        for k in range(len(states))
    ]
    return windows_of(model, states, commands, 0.001 * dt_ms)


@pytest.mark.parametrize("dt_ms", slow_but([20, 10], 20))
def test_delay_and_lag_are_found_in_seconds_whatever_the_period(dt_ms: int) -> None:
    """At 100 Hz a delay of 60 ms was found as none: a window lasted 80 ms."""
    found = identified(motor(dt_ms))
    assert found is not None
    assert found.delay_s == pytest.approx(0.06, abs=0.01)
    assert found.lag_s == pytest.approx(0.12, abs=0.01)
    assert found.noise == pytest.approx([0.01], rel=0.1)


def test_recording_of_a_fast_robot_with_many_gaps_is_cut_into_shorter_windows() -> None:
    """Of 80 steps in a row one is missing nearly always, of 10 seldom."""
    whole = motor(10)
    rng, ms = np.random.default_rng(2), 1_000_000
    kept = rng.random(4000) > 0.05
    states = [State(3, k + 1, 10 * ms * k, np.zeros(1)) for k in range(4000) if kept[k]]
    commands = [Command(7, 1, 0, 3, 1, 0, 250 * ms, 1, Mode.TRACKING, QpStatus.SOLVED, 10 * ms, np.zeros((40, 1)))]
    windows = windows_of(whole.model, states, commands, 0.01)
    assert whole.steps == 80
    assert windows.steps < 80
    assert len(windows.x) >= MIN_WINDOWS


def test_windows_that_the_model_does_not_predict_to_a_finite_end_are_left_out_and_counted() -> None:
    for below in (0, 4):
        found = identified(tank(below))
        assert found is not None
        assert found.left_out == below
        assert found.delay_s == pytest.approx(0.2, abs=0.01)  # s: a tenth of a period
        assert found.noise == pytest.approx([1e-3], rel=0.2)  # 5 % is one sigma
    assert identified(tank(21)) is None, "9 are too few"


def test_noise_is_told_from_what_the_model_carries_on() -> None:
    rng, std = np.random.default_rng(1), np.array([0.005, 0.01, 0.02])
    A = np.array([[1.0, 0.1, 0.3], [0.0, 1.0, 0.1], [0.0, 0.0, 0.5]])
    n = std * rng.standard_normal((2000, 9, 3))
    drift = np.array([0.1, -0.2, 0.3])  # a wrong parameter
    np.testing.assert_allclose(noise_of(n[:, 1:] - n[:, :-1] @ A.T + drift, np.broadcast_to(A, (2000, 8, 3, 3))), std, rtol=0.05)  # 1 % is one sigma


@pytest.mark.slow
def test_study_of_a_recording_beats_the_shipped_weights_on_its_held_out_half_and_for_the_robot_itself(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("optuna")
    from rti_mpc_service.tune.tune import main

    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text(encoding="utf-8"), encoding="utf-8")
    ranges = ("ocp.weights.R.u_c=0.1:100", "ocp.weights.R.omega_c=0.1:100")
    assert main(path, Course(str(run)), None, lockstep_robot, vary=ranges, trials=8) == 0
    said, text = capsys.readouterr().out, (tmp_path / "robot.tuned.toml").read_text(encoding="utf-8")
    gained = re.search(r"on the held-out run\.mcap from .*: error \S+ -> \S+ m \((-\d+\.\d) %\), effort \S+ -> \S+ % \((-\d+\.\d) %\)", said)
    assert gained is not None, said
    assert float(gained[1]) < -5.0, said
    assert "simulated robot as in run.mcap: noise x 0.00" in said
    assert "# Simulated robot as in run.mcap: noise x 0.00" in text
    robot = with_sim(load(SHIPPED), **SIM)
    before, after = (
        ClosedLoop(robot.model_copy(update={"ocp": load(file).ocp}), Course("circle", duration_s=40.0, seed=7), lockstep_robot).drive({})
        for file in (path, tmp_path / "robot.tuned.toml")
    )
    assert after.error < before.error, "on a path that the recording has not, too"
    assert after.effort < before.effort
