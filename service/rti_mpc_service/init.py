# SPDX-License-Identifier: Apache-2.0
"""
Files of a robot of one's own: a configuration, a model, a test and a page of next steps, which work as they are.

The templates are a working robot called `my_robot`; another name takes that one's
place in names and contents. Nothing that exists is overwritten: all files are
looked for before the first one is written.
"""

from __future__ import annotations

import keyword
import re
from importlib.util import find_spec
from pathlib import Path

from rti_mpc.errors import ConfigError
from rti_mpc_service.shipped import DEPLOY, TEMPLATES

TEMPLATE_NAME = "my_robot"
MODULE_NAME = r"[a-z][a-z0-9_]*"
KINDS = tuple(sorted(path.stem for path in TEMPLATES.glob("*.toml")))
SHARED = {"robot.test": f"test_{TEMPLATE_NAME}.py", "next_steps.md": f"{TEMPLATE_NAME}.md"}  # template: file


def main(name: str | None, kind: str, folder: Path, *, deploy: bool = False) -> list[Path]:
    """
    Write the files of a robot, of a deployment, or of both.

    Args:
        name: Of the robot and its Python module; None: no robot.
        kind: Which template it is like, one of `KINDS`.
        folder: Where to.
        deploy: Whether to write systemd units, configurations of Zenoh, message definitions and the runbook into its folder ``deploy``.

    Returns:
        The files that were written.

    Raises:
        ConfigError: There is nothing to write, the name is none for a module, there is no such template, or a file exists or cannot be written.
    """
    if name is None and not deploy:
        raise ConfigError("init must be given the name of a robot, such as my_robot, or --deploy")
    contents = {} if name is None else {folder / file: text for file, text in robot_files(name, kind).items()}
    if deploy:
        shipped = [path for path in sorted(DEPLOY.rglob("*")) if path.is_file() and path.parent.name != "robots"]
        contents |= {folder / "deploy" / path.relative_to(DEPLOY): path.read_text(encoding="utf-8") for path in shipped}
    if existing := [path for path in contents if path.exists() or path.is_symlink()]:
        raise ConfigError(f"init must not overwrite a file, got {existing[0]}, which exists")
    if name is not None and find_spec(name) is not None:
        raise ConfigError(f"init must be given a name that no installed module has, got {name!r}")
    for path, text in contents.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("x", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            raise ConfigError(f"init must be able to write {path}: {error.strerror}") from error
    return list(contents)


def robot_files(name: str, kind: str) -> dict[str, str]:
    """
    Return the contents of a robot's files by their names.

    Raises:
        ConfigError: The name is none for a module, or there is no such template.
    """
    if not re.fullmatch(MODULE_NAME, name) or keyword.iskeyword(name):
        meant = re.sub(r"[^a-z0-9_]+", "_", name.lower())
        near = f", perhaps {meant} is meant" if re.fullmatch(MODULE_NAME, meant) and not keyword.iskeyword(meant) else ""
        rule = "of small letters, digits and _, with a letter first, and no word of Python's"
        raise ConfigError(f"init must be given a name {rule}, for it is that of a module, too, got {name!r}{near}")
    if kind not in KINDS:
        raise ConfigError(f"--like must be {' or '.join(KINDS)}, got {kind!r}")
    templates = {f"{kind}.toml": f"{TEMPLATE_NAME}.toml", f"{kind}.model": f"{TEMPLATE_NAME}.py", **SHARED}
    read = {file: (TEMPLATES / template).read_text(encoding="utf-8") for template, file in templates.items()}
    return {file.replace(TEMPLATE_NAME, name): text.replace(TEMPLATE_NAME, name) for file, text in read.items()}
