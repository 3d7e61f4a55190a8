# SPDX-License-Identifier: Apache-2.0
"""Configuration of a run on this machine: what a scenario changes in the robot's own, and its files."""

from __future__ import annotations

from pathlib import Path

from rti_mpc.reference.trajectory import Heading
from rti_mpc.signals import POSE_ROLES
from rti_mpc_service.config import signals_file, toml
from rti_mpc_service.config.build import build_model, build_signals, with_initial_state
from rti_mpc_service.config.fit import check_tree
from rti_mpc_service.config.schema import Config
from rti_mpc_service.scenario import Scenario

BEST_HEADINGS: dict[str, Heading] = {"circle": "none", "positioning": "none"}  # heading with the smallest error; "consistent" for all others


def configured(config: Config, scenario: Scenario, guard: bool = False) -> Config:
    """
    Return the configuration of a run: on loopback, from the start of a path, with a guard if `guard`, without weight on heading ``"none"``.

    Raises:
        ConfigError: An input has no bounds, which a guard needs.
    """
    model = build_model(config)
    if scenario.pose0 is not None:
        pose = dict(zip(POSE_ROLES, scenario.pose0, strict=True))
        config = with_initial_state(config, [f"{state.name}={pose[state.role]!r}" for state in model.states if state.role in pose])
    content = config.model_dump(by_alias=True, exclude_unset=True, exclude={"bus"})
    if scenario.heading == "none":
        content["ocp"]["weights"]["Q"] |= {output.name: 0.0 for output in model.outputs if output.role == "heading"}
    if guard:
        content["guard"] = {**content.get("guard", {}), "enabled": True}
    config = Config.model_validate(content)
    check_tree(config)
    return config


def path_options(
    name: str, path_limits: tuple[float, float, float, float] | None, waypoint_speed_m_s: float, waypoint_smoothing_m: float | None
) -> tuple[object, ...]:
    """Return the options with which `rti-mpc reference` sends a path."""
    limits = () if path_limits is None else ("--path-limits", *path_limits)
    smoothing = () if waypoint_smoothing_m is None else ("--waypoint-smoothing", waypoint_smoothing_m)
    return ("--path", name, *limits, "--waypoint-speed", waypoint_speed_m_s, *smoothing)


def reference_options(
    name: str | None, scenario: Scenario, duration_s: float, waypoint_speed_m_s: float, waypoint_smoothing_m: float | None
) -> tuple[object, ...]:
    """Return the options with which `rti-mpc reference` follows for a time the scenario that was found by a name, or by none."""
    options = {
        "--scenario": name,
        "--heading": scenario.heading,
        "--duration": duration_s,
        "--waypoint-speed": waypoint_speed_m_s,
        "--waypoint-smoothing": waypoint_smoothing_m,
    }
    return tuple(word for option, value in options.items() if value is not None for word in (option, value))


def write_files(path: Path, config: Config) -> None:
    """
    Write a run's configuration and, for its guard if it has one, the signals of its model.

    Raises:
        OSError: The configuration cannot be written.
        ConfigError: The signals cannot be written.
    """
    path.write_text(toml.write(config), encoding="utf-8")
    if config.guard.enabled:
        signals_file.write(path, build_signals(config))
