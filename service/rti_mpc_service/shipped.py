# SPDX-License-Identifier: Apache-2.0
"""Files that come with the package: those of a deployment, of robots, and the templates of a user's own robot."""

from __future__ import annotations

from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path

from rti_mpc.errors import ConfigError

PACKAGE = Path(str(files("rti_mpc_service")))
DEPLOY = PACKAGE / "deploy" if (PACKAGE / "deploy").is_dir() else PACKAGE.parents[1] / "deploy"  # in the wheel, in a clone
TEMPLATES = PACKAGE / "templates"
ROBOTS = {path.stem: path for path in (DEPLOY / "pioneer_3dx.toml", *sorted((DEPLOY / "robots").glob("*.toml")))}
SHIPPED = ROBOTS["pioneer_3dx"]


def robot_file(name: str) -> Path:
    """
    Return the TOML file of a robot that ships.

    Raises:
        ConfigError: There is none of this name.
    """
    if name not in ROBOTS:
        near = get_close_matches(name, ROBOTS, n=1)
        raise ConfigError(f"--robot must be one of {', '.join(ROBOTS)}, {f'perhaps {near[0]} is meant, ' if near else ''}got {name!r}")
    return ROBOTS[name]
