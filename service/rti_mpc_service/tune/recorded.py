# SPDX-License-Identifier: Apache-2.0
"""
Scenario of a recording: the reference that a robot followed, from the state where it began, and the robot as it was.

What is not known of the robot, `[sim]` in its file, is taken from the recording: without noise, delay and lag there would be nothing to tune.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, End, State, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.model.model import Model
from rti_mpc.model.path_following import window_place
from rti_mpc_service.config.build import build_model, with_initial_state
from rti_mpc_service.config.schema import Config
from rti_mpc_service.scenario import Scenario
from rti_mpc_service.tune.identified import MIN_WINDOWS, ROWS, WINDOW, identified, windows_of

FOLLOWING = (Mode.TRACKING, Mode.HOLDING, Mode.FALLBACK)  # modes whose samples follow a reference; a fallback is followed over
MIN_SAMPLES = 40  # of a part, half of which is its transient
MAX_GAP_PERIODS = 2.5  # between two samples of one span


def is_recording(name: str | None) -> bool:
    """Whether a scenario is a recording: a file ``.mcap``, or the folder of its segments."""
    return name is not None and (Path(name).suffix.lower() == ".mcap" or any(Path(name).glob("*.mcap")))


def recorded(config: Config, name: str, part: tuple[float, float], duration_s: float | None) -> tuple[Config, Scenario]:
    """
    Return a part of the longest span over which a robot followed references without a break, and the robot at its start.

    Args:
        config: The robot's configuration, whose `robot` names it in the recording.
        name: The recording.
        part: Begin and end, as fractions of the span.
        duration_s: How much of this part is driven at most; None: all.

    Returns:
        The configuration with the recorded state as the initial one, and the scenario: a row a sample, what the controller followed one period on.

    Raises:
        ConfigError: It is no recording of this robot, or the span is too short.
    """
    model = build_model(config)
    states, samples, _ = _read(name, config.robot, model)
    span = _part(samples, config.ocp.dt_s, part)
    span = span if duration_s is None else span[: round(duration_s / config.ocp.dt_s)]
    if len(span) < MIN_SAMPLES:
        raise ConfigError(f"{name} must hold {MIN_SAMPLES} samples that follow a reference without a break in each part, got {len(span)}")
    dt_ns = round(1e9 * config.ocp.dt_s)
    at = np.array([sample.stamp_ns + dt_ns for sample in span], np.int64)  # of row 0 of what was used, which belongs to node 1
    end_ns, ahead = int(at[-1]), span[-1].y_ref[1:]  # what was known at the end lets the controller look ahead there, as it did
    at = np.concatenate([at, end_ns + dt_ns * np.arange(1, len(ahead) + 1)])
    rows = np.concatenate([[sample.y_ref[0] for sample in span], ahead])
    for j, output in enumerate(model.outputs):
        if output.angle:
            rows[:, j] = np.unwrap(rows[:, j])
    grid = np.arange(at[0], at[-1] + 1, dt_ns)
    y: Array = np.column_stack([np.interp(grid, at, column) for column in rows.T])
    start = max((state for state in states if state.stamp_ns <= at[0]), key=lambda state: state.stamp_ns, default=states[0])
    placed = with_initial_state(config, [f"{signal.name}={value!r}" for signal, value in zip(model.states, start.x.tolist(), strict=True)])
    begin_s, end_s = (1e-9 * (stamp - samples[0].stamp_ns) for stamp in (at[0], end_ns))
    title = f"{Path(name).name} from {begin_s:.1f} to {end_s:.1f} s"
    return placed, Scenario(title, model.nx, lambda x: y, config.ocp.dt_s, 1e-9 * (end_ns - int(at[0])), End.HOLD)


def as_recorded(config: Config, name: str, part: tuple[float, float]) -> tuple[Config, str]:
    """
    Return the configuration with the noise, delay and lag of a recorded robot in `sim`, as far as the file says nothing of them.

    Args:
        config: The robot's configuration, whose `robot` names it in the recording.
        name: The recording.
        part: Begin and end, as fractions of what `recorded` takes.

    Returns:
        The configuration, and what was taken, in a line.

    Raises:
        ConfigError: It is no recording of this robot.
    """
    given = config.sim.model_fields_set
    model = build_model(config).with_parameters(**config.sim.parameters)
    states, samples, commands = _read(name, config.robot, model)
    if config.observer.measured:
        return config, f"{name}: noise, delay and lag are those of [sim], since some states of {config.robot} are not measured"
    if span := _part(samples, config.ocp.dt_s, part):
        begin_ns, end_ns = span[0].state_stamp_ns, span[-1].stamp_ns
        before_ns = round(1e9 * ROWS * config.ocp.dt_s)  # what still acted when it began
        commands = [command for command in commands if begin_ns - before_ns <= command.stamp_ns <= end_ns]
        states = [state for state in states if begin_ns <= state.stamp_ns <= end_ns and commands and state.epoch == commands[-1].state_epoch]
    windows = windows_of(model, states, commands, config.ocp.dt_s) if len(states) > WINDOW and commands else None
    if windows is None or len(windows.x) < MIN_WINDOWS:
        return config, (
            f"{name}: noise, delay and lag are those of [sim], since it must hold commands and {WINDOW * MIN_WINDOWS} states without a gap in a part"
        )
    known = {"sensor_delay_s", "actuator_delay_s"} & given
    delay_s, lag_s, noise = identified(
        windows,
        (config.sim.sensor_delay_s or 0.0) + (config.sim.actuator_delay_s or 0.0) if known else None,
        config.sim.actuator_lag_s if "actuator_lag_s" in given else None,
    )
    noise_std = {signal.name: _rounded(std) for signal, std in zip(model.states, noise, strict=True)}
    units = {signal.name: signal.unit for signal in model.states}
    found = {
        "noise_std": (noise_std, "noise " + ", ".join(f"{signal} {std:g} {units[signal]}" for signal, std in noise_std.items())),
        "actuator_delay_s": (_rounded(delay_s), f"delay {_rounded(delay_s):g} s"),
        "actuator_lag_s": (_rounded(lag_s), f"lag {_rounded(lag_s):g} s"),
    }
    taken = {key: value for key, value in found.items() if key not in given and not (key == "actuator_delay_s" and known)}
    sim = config.sim.model_copy(update={key: value for key, (value, _) in taken.items()})
    words = "; ".join(said for _, said in taken.values())
    return config.model_copy(update={"sim": sim}), f"simulated robot as in {Path(name).name}: {words}" if taken else "simulated robot as in [sim]"


def _rounded(value: float) -> float:
    """Return a value as it is told, so that a study is the same on machines that round differently."""
    return float(f"{value:.3g}")


def _read(name: str, robot: str, model: Model) -> tuple[list[State], list[Telemetry], list[Command]]:
    """Return the states, samples and commands of a robot; of the guard that it obeyed, if there was one."""
    from rti_mpc.recording import Recording  # needs the extra `record`

    if window_place(model) is not None:
        raise ConfigError(f"--scenario {name} must be of a robot that follows references in time, {robot} follows a path")
    try:
        recording = Recording(Path(name))
        if robot not in recording.robots:
            raise ConfigError(f"{name} must hold the robot {robot}, got {', '.join(recording.robots) or 'none'}")
        messages = [(each.stream, each.message) for each in recording.messages(robot, ("state", "telemetry", "command", "actuation"))]
    except (OSError, MessageError) as error:
        raise ConfigError(f"{name} must be a recording: {error}") from error
    of = {stream: [message for each, message in messages if each == stream] for stream in ("state", "telemetry", "command", "actuation")}
    states = [message for message in of["state"] if len(message.x) == model.nx]
    samples = [message for message in of["telemetry"] if message.x0.size == model.nx and message.y_ref.shape[-1] == model.ny]
    if not states or not samples:
        raise ConfigError(f"{name} must hold states of {model.nx} and telemetry of {model.ny} outputs of {robot}, as its file says, got none")
    return states, samples, [message for message in of["actuation"] or of["command"] if len(message.u) and message.u.shape[1] == model.nu]


def _part(samples: Sequence[Telemetry], dt_s: float, part: tuple[float, float]) -> list[Telemetry]:
    """Return a part of the longest span."""
    span = _longest(samples, dt_s)
    return span[round(part[0] * len(span)) : round(part[1] * len(span))]


def _longest(samples: Sequence[Telemetry], dt_s: float) -> list[Telemetry]:
    """Return the longest run of samples of one controller that follow a reference, in order, without a gap."""
    best: list[Telemetry] = []
    span: list[Telemetry] = []
    for sample in samples:
        last = span[-1] if span else None
        joined = last is not None and sample.epoch == last.epoch and 0 < sample.stamp_ns - last.stamp_ns <= 1e9 * MAX_GAP_PERIODS * dt_s
        if sample.mode not in FOLLOWING or not len(sample.y_ref):
            span = []
        elif joined:
            span.append(sample)
        else:
            span = [sample]
        best = span if len(span) > len(best) else best
    return best
