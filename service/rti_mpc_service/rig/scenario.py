# SPDX-License-Identifier: Apache-2.0
"""Configuration of a run on this machine: what a scenario changes in the robot's own."""

from __future__ import annotations

from rti_mpc.reference.trajectory import Heading, Trajectory, followed_roles
from rti_mpc.signals import POSE_ROLES
from rti_mpc_service.config.build import build_model, with_initial_state
from rti_mpc_service.config.schema import Config

BEST_HEADINGS: dict[str, Heading] = {"circle": "none", "positioning": "none"}  # heading with the smallest error; "consistent" for all others


def configured(config: Config, trajectory: Trajectory, heading: Heading, guard: bool) -> Config:
    """
    Return the configuration of a run: on loopback, from the scenario's pose, with a guard if `guard`, without weight on heading ``"none"``.

    Raises:
        ConfigError: The model has outputs that no path fills.
    """
    model = build_model(config)
    followed_roles(model.name, model.outputs)
    pose = dict(zip(POSE_ROLES, trajectory.pose0, strict=True))
    config = with_initial_state(config, [f"{state.name}={pose[state.role]!r}" for state in model.states if state.role in pose])
    content = config.model_dump(by_alias=True, exclude_unset=True, exclude={"bus"})
    if heading == "none":
        content["ocp"]["weights"]["Q"] |= {output.name: 0.0 for output in model.outputs if output.role == "heading"}
    if guard:
        content["guard"] = {**content.get("guard", {}), "enabled": True}
    return Config.model_validate(content)
