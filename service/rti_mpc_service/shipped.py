# SPDX-License-Identifier: Apache-2.0
"""Files that come with the package: those of a deployment, and the templates of a user's own robot."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

PACKAGE = Path(str(files("rti_mpc_service")))
DEPLOY = PACKAGE / "deploy" if (PACKAGE / "deploy").is_dir() else PACKAGE.parents[1] / "deploy"  # in the wheel, in a clone
TEMPLATES = PACKAGE / "templates"
