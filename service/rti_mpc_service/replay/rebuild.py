# SPDX-License-Identifier: Apache-2.0
"""
Rebuilding of a recorded controller from the files that are attached to the recording.

Its configuration is the attached one. Its model is the one that is installed here, if
that has the same source and the same equations. The attached source is somebody else's
code, and runs only if it is trusted.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.message import Journal, JournalKind
from rti_mpc.control.controller import Controller
from rti_mpc.errors import ConfigError
from rti_mpc.journal.entry import JournalEntry, decode_entries
from rti_mpc.journal.replay import Difference, Replay, replay
from rti_mpc.rti.rti import Rti
from rti_mpc_service.config.build import build_controller, build_ocp, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_model, check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.opened import opened
from rti_mpc_service.origin import model_equations, model_source
from rti_mpc_service.replay.coverage import Heard, heard_commands
from rti_mpc_service.replay.maker import changes, fitting, versions

CONFIGURATION = "config.toml"  # name of the attached configuration


@dataclass(frozen=True)
class Journaled:
    """
    One controller of a recording.

    Attributes:
        robot: Name of its robot.
        owner: Number of the controller, the low bits of its epochs.
        messages: Its journal, in the order of its numbers.
        files: Text of each file attached for it, by name.
        heard: Its commands, as the recorder has heard them.
    """

    robot: str
    owner: int
    messages: list[Journal]
    files: dict[str, str]
    heard: Heard = field(default_factory=dict)


@dataclass(frozen=True)
class Rebuilt:
    """
    A controller built like a recorded one.

    Attributes:
        config: Its configuration.
        controller: The controller, before its first call.
        rti: Its real-time iteration.
        robot: Arguments of `rti_mpc_sim.settings.RobotSettings` for the configuration's simulated robot.
        others: What is not as it was when it was recorded, a line each: with nothing, every bit must be the same.
    """

    config: Config
    controller: Controller
    rti: Rti
    robot: dict[str, Any]
    others: list[str]


def journals(path: Path, robot: str | None = None, owner: int | None = None, *, name: str = "") -> list[Journaled]:
    """
    Return the controllers of a recording, in the order in which they appear.

    Args:
        path: The recording.
        robot: Name of a robot; None: all.
        owner: Number of a controller; None: all.
        name: What a refusal calls the recording; empty: its path.

    Raises:
        ConfigError: There is none, or the recording cannot be read.
    """
    recording = opened(path)
    found: dict[tuple[str, int], list[Journal]] = {}
    for recorded in recording.messages(None, ("journal",)):
        message = recorded.message
        found.setdefault((recorded.robot, message.epoch % (1 << NUMBER_BITS)), []).append(message)
    chosen = {key: messages for key, messages in found.items() if robot in (None, key[0]) and owner in (None, key[1])}
    if not chosen:
        known = ", ".join(f"--robot {name} --controller {number}" for name, number in found) or "none"
        whose = "a robot" if robot is None else repr(robot)
        raise ConfigError(f"{name or path} must hold the journal of {whose}{'' if owner is None else f', controller {owner}'}, got {known}")
    heard = heard_commands(recording, robot)
    return [
        Journaled(name, number, in_order(messages), files_of(recording.attachments, f"{name}/{number}/"), heard.get((name, number), {}))
        for (name, number), messages in chosen.items()
    ]


def in_order(messages: list[Journal]) -> list[Journal]:
    """Return messages by their numbers, each once: a recorder with a limit repeats some at the beginning of a segment."""
    return [message for _, message in sorted({message.seq: message for message in messages}.items())]


def files_of(attachments: Mapping[str, bytes], beginning: str) -> dict[str, str]:
    """Return the attached texts below a name."""
    return {name.removeprefix(beginning): content.decode(errors="replace") for name, content in attachments.items() if name.startswith(beginning)}


def rebuild(journal: Journaled, *, folder: Path, trust: bool = False) -> Rebuilt:
    """
    Build a controller like the recorded one.

    Args:
        journal: Controller of a recording.
        folder: Where a model of the user's own is looked for.
        trust: Whether to run the attached source of the model instead.

    Raises:
        ConfigError: Nothing is attached, or the model here is another one.
    """
    if CONFIGURATION not in journal.files:
        owner = f"controller {journal.owner} of {journal.robot}"
        raise ConfigError(f"the configuration of {owner} must be attached to the recording, got {[*journal.files]}")
    recorded = versions(journal.files)
    with tempfile.TemporaryDirectory(prefix="rti-mpc-replay-") as temporary:
        config = configuration(journal.files, Path(temporary), folder=folder, trust=trust)
        equations = sha256(model_equations(build_ocp(config).model).encode()).hexdigest()  # with obstacles and disturbances, as the controller's
        with fitting(journal.files):
            if recorded.get("model_sha256", equations) != equations:
                raise ConfigError(f"model {config.model.name} must have the equations that were recorded, got others")
        rti = build_rti(config)
        controller = build_controller(config, rti, check_stop(config))
        robot = robot_settings(config)
    return Rebuilt(config, controller, rti, robot, list(changes(recorded)))


def configuration(files: Mapping[str, str], temporary: Path, *, folder: Path, trust: bool) -> Config:
    """
    Return the attached configuration, with the folder of its model.

    Args:
        files: Attached files.
        temporary: Folder for them.
        folder: Where a model of the user's own is looked for.
        trust: Whether to run the attached source of the model instead.

    Raises:
        ConfigError: It is not valid, or the source of its model here is not the attached one.
    """
    path = temporary / CONFIGURATION
    path.write_text(files[CONFIGURATION], encoding="utf-8")
    with fitting(files):
        config = load(path, with_model=False)
    module, _, function = config.model.name.partition(":")
    if function:
        own = Path(module).stem if module.endswith(".py") else module
        if "/" in own or not all(own.split(".")):  # before it is made a path
            raise ConfigError(f"the recorded model must be of a module or of a file FILE.py, got {module!r}")
        attached = next((text for name, text in files.items() if name == f"{own.rpartition('.')[2]}.py"), None)
        if trust and attached is not None:
            source = temporary / f"{own.replace('.', '/')}.py"
            source.parent.mkdir(parents=True, exist_ok=True)
            source.write_text(attached, encoding="utf-8")
            folder = temporary
        config = config.model_copy(update={"model": config.model.model_copy(update={"folder": folder})})
        found = model_source(config)
        if found is None or found.read_text(encoding="utf-8", errors="replace") != attached:
            raise ConfigError(
                f"model {config.model.name} must be here as it was recorded, got {found or 'no file'}: --folder names the folder of its module, "
                "--trust runs the attached source, which is code of whoever made the recording"
            )
    check_model(config)
    return config


def repeat(journal: Journaled, on: Replay, start_seq: int = 0) -> Iterator[tuple[JournalEntry, Difference | None]]:
    """
    Repeat the journal of a controller, as `rti_mpc.journal.replay.replay` does.

    Raises:
        ConfigError: It does not fit the controller, and was recorded by other code.
        JournalError: It does not fit the controller.
    """
    with fitting(journal.files):
        yield from replay(on, journal.messages, start_seq)


def entries(journal: Journaled) -> Iterator[JournalEntry]:
    """
    Yield the entries of a controller's journal, without repeating them.

    Raises:
        ConfigError: They are no entries, and were recorded by other code.
        JournalError: They are no entries.
    """
    with fitting(journal.files):
        for message in journal.messages:
            if message.kind is JournalKind.CALLS:
                yield from decode_entries(message.data, message.seq)
