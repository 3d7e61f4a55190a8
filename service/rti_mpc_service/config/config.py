# SPDX-License-Identifier: Apache-2.0
"""
Loading of a robot's configuration: a TOML file, read once into a frozen tree.

Everything is checked here, so that no later code has to check again: the
tree by itself (`rti_mpc_service.config.schema`), then its keys against each other and its names
against the model (`rti_mpc_service.config.fit`), which ends with building the `Ocp`
(`rti_mpc_service.config.build`). Each refusal is one line (`rti_mpc_service.config.refusal`).
"""

from __future__ import annotations

import os
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.text_file import read_text_file
from rti_mpc_service.config import toml
from rti_mpc_service.config.fit import check_model, check_tree
from rti_mpc_service.config.refusal import explain
from rti_mpc_service.config.schema import Config
from rti_mpc_service.shipped import ROBOTS


def load(path: Path, *, with_model: bool = True) -> Config:
    """
    Read, check and freeze a robot's configuration.

    Args:
        path: TOML file.
        with_model: Whether to check it against the model, too, which loads CasADi.

    Raises:
        ConfigError: One line: the file, the key, what must hold, what was got.
    """
    try:
        content = read_text_file(path, "TOML")
    except ConfigError as error:
        raise ConfigError(f"{error}{meant_by(path)}") from error
    document: dict[str, Any] = {}
    try:
        document = toml.read(content)
        config = Config.model_validate(document)
        beside = {name: path.parent / value for name in ("config", "tls") if (value := getattr(config.bus, name)) is not None}
        if beside:
            config = config.model_copy(update={"bus": config.bus.model_copy(update=beside)})
        if (scenario := config.reference.scenario or "").lower().endswith(".csv"):
            followed = config.reference.model_copy(update={"scenario": os.path.abspath(path.parent / scenario)})
            config = config.model_copy(update={"reference": followed})
        if ":" in config.model.name:  # a model of the user's own, which no process looks for anywhere else, wherever it is started
            folder = Path(os.path.abspath(path.parent / (config.model.folder or "")))
            config = config.model_copy(update={"model": config.model.model_copy(update={"folder": folder})})
        check_tree(config)
        if with_model:
            check_model(config)
    except ValidationError as error:
        raise ConfigError(f"{path}: {explain(error, Config, document)}") from error
    except (ConfigError, OcpError) as error:
        raise ConfigError(f"{path}: {error}") from error
    return config


def meant_by(path: Path) -> str:
    """Return which file was probably meant by one that is missing, in the same folder or of a robot that ships, to be appended; empty if none was."""
    if os.path.lexists(path):
        return ""
    beside = {file.stem: file for file in sorted(path.parent.glob("*.toml"))}
    near = [beside[stem] for stem in get_close_matches(path.stem, beside, 1)] or [ROBOTS[name] for name in ROBOTS if name == path.stem]
    return f", perhaps {near[0]} is meant" if near else ""
