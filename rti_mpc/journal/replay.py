# SPDX-License-Identifier: Apache-2.0
"""
Replay of a journal on another controller, each of whose commands is compared with the recorded one.

The replay is open loop: states are those of the journal, and after each command the
recorded one counts as sent. So every sample is judged by itself, also with other
weights, or after a difference.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Journal, JournalKind
from rti_mpc.control.controller import Controller
from rti_mpc.errors import JournalError, RtiMpcError
from rti_mpc.journal.entry import JournalEntry, decode_entries
from rti_mpc.journal.snapshot import Camera, Snapshot
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti

PROPOSING = ("receive_state", "in_time", "tick", "standstill")  # methods that return a proposal
FIELDS = tuple(f.name for f in fields(Command))


@dataclass(frozen=True)
class Difference:
    """
    Difference of a command from the recorded one.

    Attributes:
        seq: Sequence number of the recorded command.
        stamp_ns: Its time.
        field: Name of the first field that differs; empty if one of the two commands does not exist.
        recorded: Recorded value, of an array the first element that differs.
        replayed: Value of the replay.
        size: Largest difference of an element, relative to its scale + its magnitude; infinity where values cannot be compared.
    """

    seq: int
    stamp_ns: int
    field: str
    recorded: Any
    replayed: Any
    size: float

    def __str__(self) -> str:
        """One line."""
        where = f"command {self.seq}, at {1e-9 * self.stamp_ns:.3f} s"
        if not self.field:
            return f"{where}: recorded {self.recorded}, replayed {self.replayed}"
        return f"{where}: {self.field} was recorded as {self.recorded!r}, replayed as {self.replayed!r}"


@dataclass(frozen=True)
class Gap:
    """
    Span of entries that no replay can cover.

    Attributes:
        first: Number of the first entry that is missing, or that cannot be repeated.
        last: Number of the last one.
        why: Reason, in words.
    """

    first: int
    last: int
    why: str

    def __str__(self) -> str:
        """In words."""
        return f"entries {self.first} to {self.last}: {self.why}"


@dataclass
class ReplayOutcome:
    """
    Outcome of a replay.

    Attributes:
        samples: Commands that were compared.
        entries: Entries that were repeated.
        differences: Commands that differ in any bit, up to `MAX_DIFFERENCES` of them.
        differing: Number of commands that differ.
        size: Largest of their sizes.
        gaps: Spans that were not covered.
        snapshots: Numbers of the snapshots that could be started from.
    """

    samples: int = 0
    entries: int = 0
    differences: list[Difference] = field(default_factory=list)
    differing: int = 0
    size: float = 0.0
    gaps: list[Gap] = field(default_factory=list)
    snapshots: list[int] = field(default_factory=list)


MAX_DIFFERENCES = 1000
OVERRIDE_VERSION = 2**32 - 1  # of weights that were never live


class Replay:
    """
    One controller that repeats what another one did.

    Attributes:
        controller: The controller that repeats.
        outcome: What has come out so far.
        wanted: The last command that the controller would have sent, and the recorded one; None before the first.

    Args:
        controller: A controller built like the recorded one, before its first call.
        rti: Its real-time iteration.
    """

    def __init__(self, controller: Controller, rti: Rti) -> None:
        self.controller = controller
        self.outcome = ReplayOutcome()
        self.wanted: tuple[Command, Command] | None = None
        self._rti = rti
        self._scales = scales(rti)
        self._camera = Camera(controller)
        self._override: dict[str, Any] = {}
        self._proposal: Command | None = None

    def start(self, message: Journal) -> None:
        """
        Take the state of a snapshot.

        Raises:
            JournalError: It is of another controller.
        """
        self._camera.restore(Snapshot.decode(message.data))
        self._proposal = None

    def override(self, **values: Any) -> None:
        """Plan with other weights and bounds, by their names in `Ocp`, from the next sample on, also after recorded changes of parameters."""
        self._override = values
        self.controller.retune(self._tuned(self.controller.wanted), OVERRIDE_VERSION)

    def _tuned(self, ocp: Ocp) -> Ocp:
        return ocp.retuned(**self._override)

    def repeat(self, entry: JournalEntry) -> Difference | None:
        """
        Repeat one entry, and return the difference if it is a command that differs.

        Raises:
            JournalError: It cannot be repeated.
        """
        name, args, controller = entry.name, entry.args, self.controller
        self.outcome.entries += 1
        try:
            if name == "commit":
                return self.commit(*args)
            if name == "inject":
                self._inject(*args)
                return None
            if name == "in_time":
                self._proposal = None if self._proposal is None else controller.in_time(self._proposal, args[1])
                return None
            if name == "retune":
                args = self._tuned(self._rti.ocp.retuned(**args[0])), args[1]
            result = getattr(controller, name)(*args)
        except JournalError:
            raise
        except RtiMpcError:
            return None  # it was refused when it was recorded, too
        if name in PROPOSING:
            self._proposal = result
        return None

    @property
    def proposal(self) -> Command | None:
        """The command that the controller has proposed last, and that is not committed yet."""
        return self._proposal

    def _inject(self, failure: str, samples: int) -> None:
        inject = getattr(self._rti, "inject", None)
        if inject is None:
            raise JournalError("a journal with injected failures must be replayed with debug.inject = true")
        inject({"failure": failure, "samples": samples})

    def commit(self, recorded: Command, left_ns: int | None) -> Difference | None:
        """Compare the proposal with the recorded command, which then counts as sent."""
        proposal, self._proposal = self._proposal, None
        self.outcome.samples += 1
        found = difference(recorded, proposal, self._scales)
        if proposal is None:
            proposal = recorded
        self.wanted = copy_of(proposal), recorded
        if found is not None:
            self._note(found)
            for name in FIELDS:  # in place: the controller knows its proposal by its identity
                setattr(proposal, name, getattr(recorded, name))
        self.controller.commit(proposal, left_ns)
        return found

    def _note(self, found: Difference) -> None:
        outcome = self.outcome
        outcome.differing += 1
        outcome.size = max(outcome.size, found.size)
        if len(outcome.differences) < MAX_DIFFERENCES:
            outcome.differences.append(found)


def replay(on: Replay, messages: Iterable[Journal], start_seq: int = 0) -> Iterator[tuple[JournalEntry, Difference | None]]:
    """
    Repeat a journal from its first usable snapshot on, and yield each entry after it was repeated.

    Entries that are missing end a span; it goes on with the next snapshot. Commands before the first snapshot are a span, too.

    Args:
        on: The controller that repeats.
        messages: Messages of one controller, in the order of their numbers.
        start_seq: Number from which on a snapshot is used.
    """
    outcome, next_seq = on.outcome, None
    lost: int | None = None  # first entry of a span that is not covered
    why = "commands before the first snapshot"
    for message in messages:
        if message.kind is JournalKind.SNAPSHOT:
            outcome.snapshots.append(message.seq)
            if next_seq != message.seq and message.seq >= start_seq:
                on.start(message)
                if lost is not None:
                    outcome.gaps.append(Gap(lost, message.seq - 1, why))
                lost = None
                next_seq = message.seq + 1
            elif next_seq is not None:
                next_seq = message.seq + 1
            continue
        if message.kind is JournalKind.CASE:  # no command depends on it
            next_seq = message.seq + 1 if next_seq == message.seq else next_seq
            continue
        if next_seq is not None and message.seq != next_seq:
            lost, next_seq, why = next_seq, None, "entries are missing"
        if next_seq is None:
            if lost is None and message.seq >= start_seq and holds_command(message):
                lost = message.seq
            continue
        for entry in decode_entries(message.data, message.seq):
            found = on.repeat(entry)
            next_seq = entry.seq + 1
            yield entry, found
    if lost is not None:
        outcome.gaps.append(Gap(lost, message.seq, f"{why}, and no snapshot follows"))


def holds_command(message: Journal) -> bool:
    """Whether a command was sent in the span of a message."""
    return any(entry.name == "commit" for entry in decode_entries(message.data, message.seq))


def copy_of(command: Command) -> Command:
    """Return a copy whose fields may be overwritten."""
    return Command(*(getattr(command, name) for name in FIELDS))


def scales(rti: Rti) -> dict[str, Array]:
    """Return what differences of the arrays of a command are relative to, by field: the solvers' scales of states and inputs."""
    nx, nu, solved_nx = rti.ocp.model.nx, rti.ocp.model.nu, rti.problem.model.nx
    x, u = rti.scale[:nx], rti.scale[solved_nx : solved_nx + nu]
    return {"u": u, "u_rest": u, "x_rest": x, "K": u[:, None] / x}


def difference(recorded: Command, replayed: Command | None, scales: Mapping[str, Array]) -> Difference | None:
    """Return the first difference of two commands in any bit, its size relative to scales by field; None if they are the same."""
    if replayed is None:
        return Difference(recorded.seq, recorded.stamp_ns, "", "a command", "none", np.inf)
    for name in FIELDS:
        ours, theirs = getattr(replayed, name), getattr(recorded, name)
        if not isinstance(theirs, np.ndarray):
            if ours != theirs:
                return Difference(recorded.seq, recorded.stamp_ns, name, theirs, ours, np.inf)
            continue
        if not ours.size and not theirs.size:
            continue
        if ours.shape != theirs.shape:
            return Difference(recorded.seq, recorded.stamp_ns, f"shape of {name}", theirs.shape, ours.shape, np.inf)
        unequal = np.ascontiguousarray(ours).view(np.uint64) != np.ascontiguousarray(theirs).view(np.uint64)
        if unequal.any():
            first = tuple(int(i) for i in np.argwhere(unequal)[0])
            size = float((np.abs(ours - theirs) / (scales[name] + np.abs(theirs))).max())
            place = f"{name}[{', '.join(map(str, first))}]"
            return Difference(recorded.seq, recorded.stamp_ns, place, float(theirs[first]), float(ours[first]), size)
    return None
