# SPDX-License-Identifier: Apache-2.0
"""
File of a model's signals, which `check` writes beside a robot's TOML file for those who load no model.

What the components of states and inputs are, only the model knows, which is the user's
code and may be on another machine. A guard reads it here, and an adapter of the user's
own may. So the file goes wherever the TOML file goes.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.text_file import read_text_file
from rti_mpc.whole_file import replaced
from rti_mpc.wire import document
from rti_mpc.wire.info import Label
from rti_mpc_service.config.schema import Config

if TYPE_CHECKING:
    from rti_mpc.model.model import Model

FILE_VERSION = 1


@dataclass(frozen=True)
class Signals:
    """
    States and inputs of a model.

    Attributes:
        model: Name of the model, as in the TOML file.
        states: Labels of the states, in the model's order.
        inputs: Labels of the inputs, in the model's order.
        u_rest: Inputs at rest, in the same order.
        quaternions: Names of w, x, y, z of each attitude among the states.
    """

    model: str
    states: tuple[Label, ...]
    inputs: tuple[Label, ...]
    u_rest: tuple[float, ...]
    quaternions: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def of(cls, name: str, model: Model) -> Signals:
        """Return those of a model of this name."""
        states = tuple(Label(signal.name, signal.unit, signal.angle) for signal in model.states)
        inputs = tuple(Label(signal.name, signal.unit) for signal in model.inputs)
        quaternions = tuple(tuple(states[i].name for i in places) for places in model.rotations("states").quaternions)
        return cls(name, states, inputs, tuple(map(float, model.u_rest)), quaternions)

    def to_text(self) -> str:
        """Return the content of the file."""
        rest = zip(self.inputs, self.u_rest, strict=True)
        content = {
            "version": FILE_VERSION,
            "model": self.model,
            "states": [{"name": label.name, "unit": label.unit, "angle": label.angle} for label in self.states],
            "inputs": [{"name": label.name, "unit": label.unit, "rest": value} for label, value in rest],
        }
        if self.quaternions:
            content["quaternions"] = self.quaternions
        return json.dumps(content, indent=1) + "\n"


def file_beside(path: Path) -> Path:
    """Return the file of signals of a robot's TOML file: ``robot.signals.json`` beside ``robot.toml``."""
    return path.with_suffix(".signals.json")


def write(path: Path, signals: Signals) -> Path:
    """
    Write the file of signals beside a TOML file, unless it is there already, word by word.

    Returns:
        The file.

    Raises:
        ConfigError: It cannot be written.
    """
    file, text = file_beside(path), signals.to_text()
    try:
        if not file.is_file() or file.read_bytes() != text.encode():
            with replaced(file) as fresh:  # a guard that starts meanwhile reads the one or the other
                fresh.write(text.encode())
    except OSError as error:
        cure = f"check a copy of {path.name} in a folder of your own"
        raise ConfigError(f"{file} must be a file that can be written, a guard reads the model's signals there: {error.strerror}; {cure}") from error
    return file


def read(path: Path, config: Config) -> Signals:
    """
    Read the file of signals beside a TOML file.

    Args:
        path: The TOML file.
        config: Its content.

    Raises:
        ConfigError: The file is missing, is none that `check` has written, or is of another model than the TOML file; one line that says the cure.
    """
    file = file_beside(path)
    try:
        signals = _signals(document.read(read_text_file(file, "JSON", document.MAX_DOCUMENT_BYTES).encode()))
        wrong = misfit(signals, config)
    except ConfigError as error:
        wrong = str(error).removeprefix(f"{file}: ")
    except (MessageError, LookupError, TypeError, ValueError):
        wrong = f"must be what rti-mpc check writes, version {FILE_VERSION}"
    if wrong:
        raise ConfigError(f"{file}: {wrong}; run rti-mpc check {path} where the model is, and copy both files")
    return signals


def misfit(signals: Signals, config: Config) -> str:
    """Return what of a configuration does not fit the signals, empty if all does."""
    inputs, states = ({label.name for label in labels} for labels in (signals.inputs, signals.states))
    if signals.model != config.model.name:
        return f"must be of model.name = {config.model.name!r}, got {signals.model!r}"
    if inputs != set(config.ocp.weights.R):
        return f"must have the inputs of ocp.weights.R, {', '.join(config.ocp.weights.R)}, got {', '.join(label.name for label in signals.inputs)}"
    if unknown := [name for name in config.ocp.bounds.states if name not in states]:
        return f"must have the states of ocp.bounds.states, {unknown[0]} is missing"
    for label, rest in zip(signals.inputs, signals.u_rest, strict=True):
        lower, upper = config.ocp.bounds.inputs[label.name]
        if not lower <= rest <= upper:
            return f"{label.name} rests at {rest:g}, which ocp.bounds.inputs.{label.name} = {[lower, upper]} must hold"
    return ""


def check_against(path: Path, signals: Signals) -> None:
    """
    Check that the file of signals beside a TOML file, if there is one, is of this model.

    Raises:
        ConfigError: It is not: a guard that reads it, or a copy, would take states and inputs for others.
    """
    file = file_beside(path)
    if file.exists() and file.read_bytes() != signals.to_text().encode():
        raise ConfigError(f"{file}: must be of the model as it is now; run rti-mpc check {path}, and copy the file to the guard")


def _signals(content: dict[str, object]) -> Signals:
    """Return the signals in the content of a file; what is none of them raises whatever it raises."""
    states, inputs = content["states"], content["inputs"]
    if content["version"] != FILE_VERSION or not isinstance(states, list) or not isinstance(inputs, list):
        raise ValueError
    return Signals(
        str(content["model"]),
        tuple(Label(str(state["name"]), str(state["unit"]), state["angle"] is True) for state in states),
        tuple(Label(str(input["name"]), str(input["unit"])) for input in inputs),
        tuple(float(input["rest"]) for input in inputs),
        quaternions_among(content, states),
    )


def quaternions_among(content: dict[str, object], states: list[dict[str, object]]) -> tuple[tuple[str, ...], ...]:
    """Return the quaternions in the content of a file, none if it has none; what is none of its states raises whatever it raises."""
    listed, known = content.get("quaternions", []), {str(state["name"]) for state in states}
    if not isinstance(listed, list):
        raise TypeError
    quaternions = tuple(tuple(map(str, names)) for names in listed)
    if not all(len(names) == 4 and known.issuperset(names) for names in quaternions):
        raise ValueError
    return quaternions
