# SPDX-License-Identifier: Apache-2.0
"""
Drive of a recorded controller: its journal once more, as it was, or in closed loop with a simulated robot.

In closed loop every entry is repeated at its recorded time, but for two: the states are
those of the simulated robot at the recorded stamps, and the commands are the
controller's own, which that robot gets. References, requests, parameters, the delays
of states and of commands stay as they were.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Event, Journal, Reference, State, Telemetry
from rti_mpc.contract.robot_clock import RobotClock
from rti_mpc.contract.schedule import NO_COMMAND
from rti_mpc.journal.entry import JournalEntry
from rti_mpc.journal.replay import Difference, Replay
from rti_mpc.rotation import Rotations
from rti_mpc_service.case import solver_of
from rti_mpc_service.replay.rebuild import Journaled, Rebuilt, repeat
from rti_mpc_service.rig.run_data import wanted


class PlacedBody(Protocol):
    """Simulated robot that its caller places and advances, see `rti_mpc_sim.lockstep.Lockstep`."""

    def place(self, x: Array, now_ns: int) -> None:
        """Advance to a time, and go on from another state there."""

    def state_at(self, stamp_ns: int) -> State:
        """Advance to a time, and return the state that is measured then."""

    def accept(self, command: Command, arrival_ns: int | None = None) -> str:
        """Receive a command; return the reason if it is refused."""


class MakePlacedBody(Protocol):
    """Maker of a simulated robot."""

    def __call__(self, settings: dict[str, Any], epoch: int, now_ns: int) -> PlacedBody:
        """Make it from the arguments of `rti_mpc_sim.settings.RobotSettings`, the epoch of its states, and its present time."""
        ...


@dataclass
class Passage:
    """
    States, commands and samples of one drive, from the state on where it begins.

    Attributes:
        states: States as the controller received them.
        commands: Commands that were sent.
        samples: Telemetry of the samples; phase times are those of this process.
        wanted: Outputs that the reference asks for at the stamp of each sample, shape ``(ny,)``; NaN without a reference.
        references: References that were followed, with their real stamps, and the place of the state from which on.
        events: Events of the controller.
        solved: Samples by the solver of their plan, or by the mode of those without one; of some the command was not there in time.
        unsent: Samples whose command was not sent, because none was when it was recorded.
    """

    states: list[State] = field(default_factory=list)
    commands: list[Command] = field(default_factory=list)
    samples: list[Telemetry] = field(default_factory=list)
    wanted: list[Array] = field(default_factory=list)
    references: list[tuple[int, Reference]] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    solved: Counter[str] = field(default_factory=Counter)
    unsent: int = 0


class Drive(Replay):
    """
    Replay that keeps what happened, from its begin to its end.

    It begins at the first state after `start_s` that a leading controller receives, and
    ends where the journal has a gap, the robot another life, or another controller leads.

    Attributes:
        ocp: The recorded problem.
        passage: What happened.
        start_ns: Robot time of its first state, at the earliest.
        begun: Whether it has begun.
        ended: Whether it has ended.
    """

    def __init__(self, built: Rebuilt, start_ns: int, make_body: MakePlacedBody | None = None, override: Mapping[str, Any] | None = None) -> None:
        """
        Prepare.

        Args:
            built: The controller, before its first call.
            start_ns: Robot time of the first state.
            make_body: Maker of the simulated robot; None: the recorded states are repeated.
            override: Other weights and bounds, from the begin on, by their names in `Ocp`.
        """
        super().__init__(built.controller, built.rti)
        self.ocp = built.rti.ocp
        self.passage = Passage()
        self.begun = self.ended = False
        self.start_ns = start_ns
        self._other = dict(override or {})
        self._built = built
        self._make_body = make_body
        self._body: PlacedBody | None = None
        self._clock = RobotClock(round(1e9 * built.config.stale_s))
        self._delay_ns = round(1e9 * (built.config.sim.sensor_delay_s or 0.0))  # from the stamp of a state to its sending
        self._epoch: int | None = None  # of the states
        self._known = {NO_COMMAND}  # commands that the simulated robot has got
        self._followed: Reference | None = None
        self._rows: Reference | None = None  # the same, with angles that do not jump
        self._waits = self._sent = False  # whether a proposal waits to be sent; whether the last one was
        self._solver = ""  # of the last plan
        self._spent_us = {"receive_state": 0.0, "prepare": 0.0}

    @property
    def closed(self) -> bool:
        """Whether the loop is closed."""
        return self.begun and not self.ended and self._body is not None

    def start(self, message: Journal) -> None:
        """Take the state of a snapshot: after the begin, because entries are missing."""
        self.ended |= self.begun
        super().start(message)

    def repeat(self, entry: JournalEntry) -> Difference | None:
        """Repeat one entry, with the state of the simulated robot in place of the recorded one."""
        name = entry.name
        if name == "receive_state":
            state, arrival_ns = entry.args
            entry = entry._replace(args=(self._receive(state, arrival_ns), arrival_ns))
        elif name == "stand_by":
            self.ended |= self.begun
        elif name == "overhear" and not self.begun and self._body is not None:
            self._hand_over(entry.args[0], entry.args[0].state_stamp_ns)
        if self._waits and name not in ("in_time", "commit"):
            self._waits = False
            self.passage.unsent += self.closed
        begun_ns = time.perf_counter_ns()
        found = super().repeat(entry)
        spent_us = 1e-3 * (time.perf_counter_ns() - begun_ns)
        if self.begun and not self.ended:
            self._keep(entry, spent_us)
        else:
            self.controller.notices()
        return found

    def _receive(self, recorded: State, arrival_ns: int) -> State:
        """Return the state that the controller gets in place of a recorded one."""
        if self._epoch is None:
            self._epoch = recorded.epoch
            if self._make_body is not None:
                self._body = self._make_body(self._built.robot | {"dropout": 0.0, "sensor_delay_s": 0.0}, recorded.epoch, recorded.stamp_ns)
        if recorded.epoch != self._epoch:
            self.ended |= self.begun
            return recorded
        self._clock.observe(recorded.seq, recorded.stamp_ns, arrival_ns)
        last = self.passage.states[-1] if self.passage.states else recorded
        self.ended |= self.begun and (self._clock.leapt or (recorded.stamp_ns < last.stamp_ns and recorded.seq > last.seq))
        if not self.begun and recorded.stamp_ns >= self.start_ns and not self.controller.standing_by and self._knows(recorded):
            self.begun = True
            if self._other:
                self.override(**self._other)
        elif self.closed and recorded.stamp_ns > last.stamp_ns:
            assert self._body is not None
            return replace(self._body.state_at(recorded.stamp_ns), seq=recorded.seq)
        if self._body is not None and not self.ended and not self.passage.states:
            self._body.place(recorded.x, recorded.stamp_ns)
        return recorded

    def _knows(self, state: State) -> bool:
        """Whether the simulated robot has got the command that acts at a state."""
        source = state.command_epoch, state.command_seq
        if not len(state.u):
            return len(self._known) > 1 or self.controller.at_rest
        return source in self._known and (source != NO_COMMAND or np.array_equal(state.u, self.ocp.model.u_rest))

    def _hand_over(self, command: Command, arrival_ns: int) -> None:
        """Hand a command to the simulated robot."""
        assert self._body is not None
        self._known.add((command.epoch, command.seq))
        self._body.accept(command, arrival_ns)

    def commit(self, recorded: Command, left_ns: int | None) -> Difference | None:
        """Let the recorded command count as sent; in closed loop the controller's own, which the simulated robot gets."""
        stamp_ns = recorded.state_stamp_ns if left_ns is None else self._clock.latest_ns(left_ns)
        found, sent = None, recorded
        if self.closed:
            proposal, self._proposal = self._proposal, None
            if proposal is None:
                return None
            self.controller.commit(proposal, left_ns)
            sent = proposal
        else:
            found = super().commit(recorded, left_ns)
        self._known.add((sent.epoch, sent.seq))
        if self._body is not None:
            self._hand_over(sent, stamp_ns + self._delay_ns)
        if self.begun and not self.ended:
            self.passage.commands.append(sent)
        self._sent = True
        return found

    def _keep(self, entry: JournalEntry, spent_us: float) -> None:
        """Keep what an entry has led to."""
        passage, controller = self.passage, self.controller
        if entry.name == "receive_state":
            passage.states.append(entry.args[0])
            self._sent, self._waits = False, self.proposal is not None
            if self.proposal is not None:
                self._solver, self._spent_us["receive_state"] = solver_of(self._rti), spent_us
        elif entry.name == "in_time":
            self._waits = self.proposal is not None
            mode = None if self.proposal is None else self.proposal.mode
            passage.solved["none in time" if mode is None else self._solver if mode.planned else mode.name.lower()] += 1
        elif entry.name == "commit":
            self._waits = False
        if controller.followed is not self._followed and (followed := controller.followed) is not None:
            self._followed, self._rows = followed, unwrapped(followed, self.ocp.model.rotations("outputs"))
            passage.references.append((max(len(passage.states) - 1, 0), followed))
        if entry.name == "prepare" and self._sent:
            self._sample()
            self._spent_us["prepare"] = spent_us
        for notice in controller.notices():
            stamp_ns = passage.states[-1].stamp_ns if passage.states else 0
            passage.events.append(Event(1, len(passage.events) + 1, stamp_ns, "controller", notice.severity, notice.code, notice.text))

    def _sample(self) -> None:
        """Keep the telemetry of the last sample, and what its reference asks for."""
        self._sent = False
        spent = {"prepare_us": self._spent_us["prepare"], "feedback_us": self._spent_us["receive_state"]}
        sample = self.controller.telemetry(**spent, latency_us=np.nan, slack_s=np.nan)
        self.passage.samples.append(sample)
        nothing = np.full(self.ocp.model.ny, np.nan)
        self.passage.wanted.append(nothing if self._rows is None else wanted(self._rows, np.array(sample.stamp_ns, np.int64)))


def unwrapped(reference: Reference, outputs: Rotations) -> Reference:
    """Return a reference whose rotations do not jump, so that it may be interpolated."""
    y = reference.y.copy()
    outputs.unwrap(y)
    return replace(reference, y=y)


def drive(on: Drive, journal: Journaled, start_seq: int) -> Passage:
    """Drive a journal from a snapshot on to the end of the drive, and return what happened."""
    for _ in repeat(journal, on, start_seq):
        if on.ended:
            break
    return on.passage
