# SPDX-License-Identifier: Apache-2.0
"""Coverage of a replay: which of the commands that a recorder has heard no entry of the journal repeats."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.recording.reader import Recording

Heard = dict[tuple[int, int], int]  # stamp of each command by its epoch and its sequence number


def heard_commands(recording: Recording, robot: str | None) -> dict[tuple[str, int], Heard]:
    """Return the commands of a recording, by robot and by the number of the controller that sent them."""
    found: dict[tuple[str, int], Heard] = {}
    for recorded in recording.messages(robot, ("command",)):
        command = recorded.message
        found.setdefault((recorded.robot, command.epoch % (1 << NUMBER_BITS)), {})[command.epoch, command.seq] = command.stamp_ns
    return found


def uncovered(heard: Mapping[tuple[int, int], int], compared: Collection[tuple[int, int]], *, from_the_first: bool = False) -> list[int]:
    """
    Return the stamps of the commands that were heard, and not compared.

    Args:
        heard: Commands that were heard.
        compared: Epochs and sequence numbers of those that were compared.
        from_the_first: Whether only those after the first that was compared are meant.
    """
    first = min(compared, default=(0, 0)) if from_the_first else (0, 0)
    return sorted(stamp_ns for name, stamp_ns in heard.items() if name not in compared and name >= first)


def told(stamps: list[int]) -> Iterator[str]:
    """Yield a line about such commands, if there are any."""
    if len(stamps) == 1:
        yield f"not covered: the command that was heard at {1e-9 * stamps[0]:.3f} s"
    elif stamps:
        yield f"not covered: {len(stamps)} commands that were heard, from {1e-9 * stamps[0]:.3f} s to {1e-9 * stamps[-1]:.3f} s"
