# SPDX-License-Identifier: Apache-2.0
"""
Replay of a recording: each recorded controller, built again, repeats its journal, and each command is compared with the recorded one.

On the same code, packages and processor every bit must be the same. Otherwise that is
said first, and commands are compared within a tolerance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from rti_mpc.array import Array
from rti_mpc.contract.message import JournalKind
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.journal.entry import JournalEntry
from rti_mpc.journal.replay import Difference, Replay
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS, Ocp
from rti_mpc.signals import quantity
from rti_mpc_service.config import toml
from rti_mpc_service.config.assignments import assigned
from rti_mpc_service.config.build import retuned
from rti_mpc_service.config.fit import check_names, check_tree
from rti_mpc_service.config.refusal import explain
from rti_mpc_service.config.schema import Config
from rti_mpc_service.json_text import json_text
from rti_mpc_service.replay import coverage
from rti_mpc_service.replay.closed_loop import compare
from rti_mpc_service.replay.coverage import uncovered
from rti_mpc_service.replay.drive import Drive, MakePlacedBody, drive
from rti_mpc_service.replay.rebuild import CONFIGURATION, Journaled, Rebuilt, journals, rebuild, repeat
from rti_mpc_service.replay.robot_time import check_time, first_stamp

TOLERANCE = 1e-6  # of commands on another machine, relative to their scale + their magnitude
TUNABLE = ("ocp.weights.", "ocp.bounds.")  # beginnings of the keys that `--set` takes


@dataclass
class Account:
    """
    What a replay of one controller has shown.

    Attributes:
        journal: The recorded controller.
        built: The one that repeats.
        on: The replay.
        wanted: Time of each command, s of the robot, and its first row as it would be with other weights, and as it was; only with such.
        compared: Epoch and sequence number of each command that was compared.
        start_s: Time of the robot's clock from which on it was replayed; None: all of it.
    """

    journal: Journaled
    built: Rebuilt
    on: Replay
    wanted: list[tuple[float, Array, Array]] = field(default_factory=list)
    compared: set[tuple[int, int]] = field(default_factory=set)
    start_s: float | None = None

    @property
    def uncovered(self) -> list[int]:
        """Stamps of the commands that the recorder has heard, and that were not compared."""
        return uncovered(self.journal.heard, self.compared, from_the_first=self.start_s is not None)


def main(
    path: Path,
    *,
    robot: str | None = None,
    owner: int | None = None,
    start_s: float | None = None,
    assignments: Sequence[str] = (),
    folder: Path = Path(),
    trust: bool = False,
    tolerance: float = TOLERANCE,
    json_path: Path | None = None,
    make_body: MakePlacedBody | None = None,
    out: Path | None = None,
) -> int:
    """
    Replay a recording, and print what it shows.

    Args:
        path: The recording.
        robot: Name of a robot; None: all.
        owner: Number of a controller; None: all.
        start_s: Time of the robot's clock from which on it is replayed, from the last snapshot before it; None: all of it.
        assignments: Other weights and bounds, each ``key=value`` as in the TOML file.
        folder: Where a model of the user's own is looked for.
        trust: Whether to run the attached source of a model.
        tolerance: Largest difference on another machine, relative to scale + magnitude.
        json_path: File for the results.
        make_body: Maker of the simulated robot that is driven in closed loop, with `assignments`, if any; None: open loop.
        out: Folder for a figure and a recording of each closed loop beside the recorded one.

    Returns:
        Exit status: 0 if every command was repeated, else 1; with `assignments` in open loop always 0.

    Raises:
        ConfigError: The recording cannot be replayed here.
    """
    if out is not None and make_body is None:
        raise ConfigError("--out must come with --closed-loop, whose figure and recording it is for")
    if out is not None and out.exists() and not out.is_dir():
        raise ConfigError(f"--out must be a folder, or a name that is free, got the file {out}")
    accounts, closed_loops = [], []
    changed = () if make_body is not None else assignments  # of what is replayed in open loop
    status = 0
    found = journals(path, robot, owner)
    if start_s is not None:
        check_time("--from", start_s, found)
    for journal in found:
        print(f"{journal.robot}, controller {journal.owner}")
        if len(found) > 1 and CONFIGURATION not in journal.files:
            print("  not covered: it was dead before the recorder had its configuration")
            status = 1
            continue
        built = rebuild(journal, folder=folder, trust=trust)
        for line in built.others:
            print(f"  {line}")
        if built.others and not changed:
            print(f"  so commands are compared within {tolerance:g}, relative to half their range + their magnitude, not bit by bit")
        override = overridden(built.config, built.rti.ocp, assignments)  # refused before anything is replayed
        recorded = None if make_body is None else Drive(built, first_stamp(start_s))
        account = play(journal, built, start_s, changed, recorded)
        accounts.append(account)
        limit = tolerance if built.others else 0.0
        for line in lines(account, limit, changed):
            print(f"  {line}")
        if recorded is not None and make_body is not None:
            on = Drive(rebuild(journal, folder=folder, trust=trust), recorded.start_ns, make_body, override)
            drive(on, journal, snapshot_before(journal, start_s))
            closed_loops.append(compare(path, journal, recorded, on, assignments, start_s, out))
        outcome = account.on.outcome
        if not changed and (not outcome.samples or outcome.size > limit or (outcome.differing and not built.others)):
            status = 1
    if json_path is not None:
        driven = closed_loops or [None] * len(accounts)
        results = [summary(account) | ({} if loop is None else {"closed_loop": loop}) for account, loop in zip(accounts, driven, strict=True)]
        json_path.write_text(json_text(results))
    return status


def play(journal: Journaled, built: Rebuilt, start_s: float | None = None, assignments: Sequence[str] = (), on: Replay | None = None) -> Account:
    """Replay one controller, by a replay of its own if none is given."""
    on = on or Replay(built.controller, built.rti)
    account = Account(journal, built, on, start_s=start_s)
    override = overridden(built.config, built.rti.ocp, assignments) if assignments else {}
    steps: Iterator[tuple[JournalEntry, Difference | None]] = repeat(journal, on, snapshot_before(journal, start_s))
    if override and (first := next(steps, None)) is not None:
        on.override(**override)
        steps = chain([first], steps)
    for entry, _ in steps:
        if entry.name != "commit" or on.wanted is None:
            continue
        wanted, recorded = on.wanted
        account.compared.add((recorded.epoch, recorded.seq))
        if override:
            account.wanted.append((1e-9 * recorded.stamp_ns, wanted.u[0].copy(), recorded.u[0].copy()))
    return account


def snapshot_before(journal: Journaled, start_s: float | None) -> int:
    """Return the number from which on snapshots are used, so that the replay covers all from a time of the robot's clock on."""
    before = max((message.seq for message in journal.messages if message.stamp_ns < first_stamp(start_s)), default=0)  # of a clock's last life
    return max((message.seq for message in journal.messages if message.kind is JournalKind.SNAPSHOT and message.seq <= before), default=0)


def overridden(config: Config, ocp: Ocp, assignments: Sequence[str]) -> dict[str, Array]:
    """
    Return the weights and bounds that differ, by their names in `Ocp`.

    Raises:
        ConfigError: A key is none of a weight or a bound, or its value does not fit.
    """
    document = config.model_dump(by_alias=True)
    rule = f"--set must be KEY=VALUE with a key below {' or '.join(TUNABLE)}, whose values are not compiled in"
    for key, value in assigned(rule, assignments).items():
        if not key.startswith(TUNABLE):
            raise ConfigError(f"{rule}, got {f'{key}={value}'!r}")
        table: Any = document
        *steps, name = key.split(".")
        for step in steps:
            table = table.get(step) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            raise ConfigError(f"--set must name a key of the configuration, got {key}")
        try:
            table[name] = toml.read_value(value)
        except ConfigError:
            raise ConfigError(f"--set must be KEY=VALUE, the value as in the file, got {f'{key}={value}'!r}{toml.advice(f'{key}={value}')}") from None
    try:
        changed = Config.model_validate(document)
        check_tree(changed)
        check_names(changed, ocp.model)
        other = retuned(changed, ocp)
    except ValidationError as error:
        raise ConfigError(f"--set: {explain(error, Config, document)}") from error
    except OcpError as error:
        raise ConfigError(f"--set: {error}") from error
    return {name: getattr(other, name) for name in WEIGHTS_AND_BOUNDS if not np.array_equal(getattr(other, name), getattr(ocp, name))}


def lines(account: Account, limit: float, assignments: Sequence[str]) -> Iterator[str]:
    """Yield what a replay has shown."""
    outcome = account.on.outcome
    times = [message.local_ns for message in account.journal.messages]
    yield f"{outcome.samples} commands of {1e-9 * (times[-1] - times[0]):.1f} s, {outcome.entries} entries, {len(outcome.snapshots)} snapshots"
    for gap in outcome.gaps:
        yield f"not covered: {gap}"
    yield from coverage.told(account.uncovered)
    if assignments:
        yield from open_loop(account, assignments)
    elif not outcome.samples:
        yield "nothing could be compared"
    elif not outcome.differing:
        yield "0 bits differ"
    elif outcome.size <= limit:
        yield f"{outcome.differing} commands differ, by {outcome.size:.1e} at most"
    else:
        yield f"{outcome.differing} commands differ; the first is {outcome.differences[0]}"


def open_loop(account: Account, assignments: Sequence[str]) -> Iterator[str]:
    """Yield how far the commands would have been from those that were sent, in the same states."""
    yield f"with {', '.join(assignments)}, in the same states, its first inputs would have been"
    if not account.wanted:
        return
    times = np.array([t for t, _, _ in account.wanted])
    other, was = (np.array([row[i] for row in account.wanted]) for i in (1, 2))
    for j, signal in enumerate(account.built.rti.ocp.model.inputs):
        apart = np.abs(other[:, j] - was[:, j])
        rms, most = float(np.sqrt((apart**2).mean())), int(apart.argmax())
        average, largest = (quantity(away, signal.unit) for away in (rms, apart[most]))
        yield f"  {signal.name}: {average} away on average (rms), at most {largest}, at {times[most]:.3f} s"


def summary(account: Account) -> dict[str, Any]:
    """Return the results of one controller, for JSON."""
    outcome = account.on.outcome
    first = outcome.differences[0] if outcome.differences else None
    return {
        "robot": account.journal.robot,
        "controller": account.journal.owner,
        "other": account.built.others,
        "commands": outcome.samples,
        "entries": outcome.entries,
        "differing": outcome.differing,
        "largest_difference": outcome.size if np.isfinite(outcome.size) else None,
        "first_difference": None if first is None else {"seq": first.seq, "robot_s": 1e-9 * first.stamp_ns, "field": first.field, "text": str(first)},
        "not_covered": [{"first": gap.first, "last": gap.last, "why": gap.why} for gap in outcome.gaps],
        "commands_not_covered": len(account.uncovered),
        "snapshots": outcome.snapshots,
    }
