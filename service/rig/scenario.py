# SPDX-License-Identifier: Apache-2.0
"""Configuration of a run on this machine: what a scenario changes in the robot's own."""

from __future__ import annotations

from rti_mpc.trajectory import Heading, Trajectory
from service.build import build_model, with_initial_state
from service.schema import Config

HEADINGS: dict[str, Heading] = {"circle": "none", "positioning": "none"}  # what ends nearest; "consistent" for all others


def configured(config: Config, trajectory: Trajectory, heading: Heading, guard: bool) -> Config:
    """Return the configuration of a run: on loopback, from the scenario's pose, guarded if asked for, without weight on a heading that is none."""
    config = with_initial_state(config, [f"{name}={value!r}" for name, value in zip(("x", "y", "psi"), trajectory.pose0, strict=True)])
    content = config.model_dump(by_alias=True, exclude_unset=True, exclude={"bus"})
    if heading == "none":
        content["ocp"]["weights"]["Q"] |= {output.name: 0.0 for output in build_model(config).outputs if output.angle}
    if guard:
        content["guard"] = {**content.get("guard", {}), "enabled": True}
    return Config.model_validate(content)
