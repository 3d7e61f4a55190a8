# SPDX-License-Identifier: Apache-2.0
"""Place of a command in the journals of a recording: found by its time, by its number, or as the last one."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from rti_mpc.contract.message import Command
from rti_mpc.errors import ConfigError
from rti_mpc_service.replay.rebuild import Journaled, entries
from rti_mpc_service.replay.robot_time import check_time, first_stamp


class Unreached(ConfigError):
    """No replay reaches a command: the recording lacks a snapshot before it, or an entry since then."""


@dataclass(frozen=True)
class Place:
    """
    Place of a command in a journal.

    Attributes:
        entry: Number of the entry with which it was committed.
        command: The command.
    """

    entry: int
    command: Command


def choose(name: str | Path, journals: Sequence[Journaled], at_s: float | None, seq: int | None) -> tuple[Journaled, Place]:
    """
    Return the command that is asked for, and the journal of the controller that led then.

    Args:
        name: What a refusal calls the recording.
        journals: Controllers of the recording that are asked about.
        at_s: Time of the robot's clock; the first command from then on is meant.
        seq: Number of the command instead; None without a time: the last one whose sample is followed by another.

    Raises:
        ConfigError: There is no such command, or there are several: of several robots, or of the same number by several controllers.
        Unreached: There are not two commands, and neither a time nor a number is given.
    """
    robots = sorted({journal.robot for journal in journals})
    if len(robots) > 1:
        raise ConfigError(f"--robot must name the robot whose command is explained, one of {', '.join(robots)}")
    if at_s is not None:
        check_time("--at", at_s, journals)
    found = [(journal, place) for journal in journals if (place := find(journal, at_s, seq)) is not None]
    if not found:
        what = "two commands" if at_s is None else f"a command that acts from {at_s:.3f} s on"
        numbers = sorted(place.command.seq for journal in journals for place in acted(journal))
        held = f", got commands {numbers[0]} to {numbers[-1]}" if numbers else ", got none"
        what = what if seq is None else f"a command {seq}"
        refused = Unreached if at_s is None and seq is None else ConfigError
        raise refused(f"{name} must hold {what}, in the journal of a controller that led then{held}")
    if seq is not None and len(found) > 1:
        each = ", ".join(f"{journal.owner} at {1e-9 * place.command.stamp_ns:.3f} s" for journal, place in found)
        raise ConfigError(f"--controller must say whose command {seq} is explained: {each}")
    return (max if at_s is None else min)(found, key=lambda one: one[1].command.stamp_ns)


def find(journal: Journaled, at_s: float | None, seq: int | None) -> Place | None:
    """
    Return the place of a command that acted; None if there is none.

    Args:
        journal: The controller.
        at_s: Time of the robot's clock, from which on the first command is meant.
        seq: Its number instead; None without a time: the last command but one.
    """
    if at_s is None and seq is None:
        last = deque(acted(journal), 2)
        return last[0] if len(last) == 2 else None
    for place in acted(journal):
        if place.command.seq == seq or (at_s is not None and place.command.stamp_ns >= first_stamp(at_s)):
            return place
    return None


def acted(journal: Journaled) -> Iterator[Place]:
    """
    Yield the places of the commands that were committed while the controller led.

    A recording that begins later than the controller does not say whether it led: it did if it stands by from some entry on, which follows the
    first command that it hears of another leader; it did not if it leads from some entry on, or only hears another leader.
    """
    roles = (entry.name for entry in entries(journal) if entry.name in ("stand_by", "lead", "overhear"))
    first = next(roles, "stand_by")
    standing_by = next((role for role in chain((first,), roles) if role != "overhear"), first) != "stand_by"
    for entry in entries(journal):
        standing_by = entry.name == "stand_by" or (standing_by and entry.name != "lead")
        if entry.name == "commit" and not standing_by:
            yield Place(entry.seq, entry.args[0])
