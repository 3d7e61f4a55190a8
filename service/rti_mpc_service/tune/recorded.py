# SPDX-License-Identifier: Apache-2.0
"""
Scenario of a recording: the reference that a robot followed, from the state where it began, and the robot as it was.

What is not known of the robot, `[sim]` in its file, is taken from the recording: without noise, delay and lag there would be nothing to tune.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import End
from rti_mpc.errors import ConfigError
from rti_mpc_service.config.build import build_model, with_initial_state
from rti_mpc_service.config.schema import Config
from rti_mpc_service.scenario import Scenario
from rti_mpc_service.tune.identified import identified
from rti_mpc_service.tune.recorded_robot import RecordedRobot
from rti_mpc_service.tune.windows import MIN_STEPS, MIN_WINDOWS, ROWS, windows_of

MIN_SAMPLES = 40  # of a part, half of which is its transient


def is_recording(name: str | None) -> bool:
    """Whether a scenario is a recording: a file ``.mcap``, or the folder of its segments."""
    return name is not None and (Path(name).suffix.lower() == ".mcap" or any(Path(name).glob("*.mcap")))


def recorded(config: Config, heard: RecordedRobot, part: tuple[float, float], duration_s: float | None) -> tuple[Config, Scenario]:
    """
    Return a part of the longest span over which a robot followed references without a break, and the robot at its start.

    Args:
        config: The robot's configuration.
        heard: The robot in the recording.
        part: Begin and end, as fractions of the span.
        duration_s: How much of this part is taken at most; None: all.

    Returns:
        The configuration with the recorded state as the initial one, and the scenario: a row a sample, what the controller followed one period on.

    Raises:
        ConfigError: The span is too short.
    """
    model, states = build_model(config), heard.states
    span = heard.part(part, config.ocp.dt_s, duration_s)
    if len(span) < MIN_SAMPLES:
        raise ConfigError(f"{heard.name} must hold {MIN_SAMPLES} samples that follow a reference without a break in each part, got {len(span)}")
    dt_ns = round(1e9 * config.ocp.dt_s)
    at = np.array([sample.stamp_ns + dt_ns for sample in span], np.int64)  # of row 0 of what was used, which belongs to node 1
    end_ns, ahead = int(at[-1]), span[-1].y_ref[1:]  # what was known at the end lets the controller look ahead there, as it did
    at = np.concatenate([at, end_ns + dt_ns * np.arange(1, len(ahead) + 1)])
    rows = np.concatenate([[sample.y_ref[0] for sample in span], ahead])
    model.rotations("outputs").unwrap(rows)
    grid = np.arange(at[0], at[-1] + 1, dt_ns)
    y: Array = np.column_stack([np.interp(grid, at, column) for column in rows.T])
    start = max((state for state in states if state.stamp_ns <= at[0]), key=lambda state: state.stamp_ns, default=states[0])
    placed = with_initial_state(config, [f"{signal.name}={value!r}" for signal, value in zip(model.states, start.x.tolist(), strict=True)])
    begin_s, end_s = (1e-9 * (stamp - heard.begin_ns) for stamp in (at[0], end_ns))
    title = f"{Path(heard.name).name} from {begin_s:.1f} to {end_s:.1f} s"
    return placed, Scenario(title, model.nx, partial(_given, y), config.ocp.dt_s, 1e-9 * (end_ns - int(at[0])), End.HOLD)


def _given(y: Array, x: Array) -> Array:
    """Return rows that are the same from any state; a function that other processes can be told."""
    return y


def as_recorded(config: Config, heard: RecordedRobot, part: tuple[float, float], duration_s: float | None = None) -> tuple[Config, str]:
    """
    Return the configuration with the noise, delay and lag of a recorded robot in `sim`, as far as the file says nothing of them.

    Args:
        config: The robot's configuration.
        heard: The robot in the recording.
        part: Begin and end, as fractions of the span that `recorded` takes.
        duration_s: How much of this part is taken at most; None: all.

    Returns:
        The configuration, and what was taken, in a line.

    Raises:
        ConfigError: A message of the recording cannot be read.
    """
    given, name = config.sim.model_fields_set, Path(heard.name).name
    model = build_model(config).with_parameters(**config.sim.parameters)
    if config.observer.measured:
        return config, f"{name}: noise, delay and lag are those of [sim], since some states of {config.robot} are not measured"
    span = heard.part(part, config.ocp.dt_s, duration_s)
    if not span:
        return config, kept(name)
    begin_ns, end_ns = span[0].state_stamp_ns, span[-1].stamp_ns
    commands = heard.commands_between(begin_ns - round(1e9 * ROWS * config.ocp.dt_s), end_ns)  # with what still acted when it began
    states = [state for state in heard.states if begin_ns <= state.stamp_ns <= end_ns and commands and state.epoch == commands[-1].state_epoch]
    windows = windows_of(model, states, commands, config.ocp.dt_s) if len(states) > MIN_STEPS else None
    if windows is None or len(windows.x) < MIN_WINDOWS:
        return config, kept(name)
    known = {"sensor_delay_s", "actuator_delay_s"} & given
    found = identified(
        windows,
        (config.sim.sensor_delay_s or 0.0) + (config.sim.actuator_delay_s or 0.0) if known else None,
        config.sim.actuator_lag_s if "actuator_lag_s" in given else None,
    )
    if found is None:
        return config, (
            f"{name}: noise, delay and lag are those of [sim], since the model predicts fewer than {MIN_WINDOWS} of {len(windows.x)} windows "
            f"to a finite end; look at the model and its parameters, or say noise_std, actuator_delay_s and actuator_lag_s there"
        )
    noise_std = {signal.name: _rounded(std) for signal, std in zip(model.states, found.noise, strict=True)}
    units = {signal.name: signal.unit for signal in model.states}
    values = {
        "noise_std": (noise_std, "noise " + ", ".join(f"{signal} {std:g} {units[signal]}" for signal, std in noise_std.items())),
        "actuator_delay_s": (_rounded(found.delay_s), f"delay {_rounded(found.delay_s):g} s"),
        "actuator_lag_s": (_rounded(found.lag_s), f"lag {_rounded(found.lag_s):g} s"),
    }
    taken = {key: value for key, value in values.items() if key not in given and not (key == "actuator_delay_s" and known)}
    if not taken:
        return config, "simulated robot as in [sim]"
    words = [said for _, said in taken.values()]
    if found.left_out:
        words.append(f"left out {found.left_out} of {len(windows.x)} windows, which the model does not predict to a finite end")
    sim = config.sim.model_copy(update={key: value for key, (value, _) in taken.items()})
    return config.model_copy(update={"sim": sim}), f"simulated robot as in {name}: {'; '.join(words)}"


def kept(name: str) -> str:
    """Return what is said where a recording is too short."""
    least = MIN_STEPS * MIN_WINDOWS
    return f"{name}: noise, delay and lag are those of [sim], since it must hold commands and {least} states without a gap in a part"


def _rounded(value: float) -> float:
    """Return a value as it is told, so that a study is the same on machines that round differently."""
    return float(f"{value:.3g}")
