# SPDX-License-Identifier: Apache-2.0
"""A journal as a recording holds it, made in lockstep: a controller of a configuration, its robot, and what happens to both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rti_mpc.contract.message import End, Journal, Reference, State
from rti_mpc.control.call import Call
from rti_mpc.control.controller import Controller
from rti_mpc.journal.book import Book
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.config.build import build_controller, build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_stop
from rti_mpc_service.controller.kept_case import KeptCase
from rti_mpc_service.injection import FaultyRti
from rti_mpc_service.origin import origin_files
from rti_mpc_service.replay.rebuild import Journaled
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, reference

Act = Callable[[Controller, Rti], object]


def straight(to_m: float, speed: float = 0.3) -> Reference:
    """Rows along the x axis, from 0 to a place, and then there."""
    x = np.minimum(speed * 0.1 * np.arange(400), to_m)
    y = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
    return Reference(1, 1, 0, 100 * MS, End.HOLD, y, np.zeros((len(y), 0)))


def journal_of(
    path: Path,
    samples: int = 60,
    acts: Mapping[int, Act] | None = None,
    sees: Callable[[int, State], State | None] = lambda _, state: state,
    follows: Reference | None = None,
    late_ms: Mapping[int, int] | None = None,
) -> Journaled:
    """
    Drive a robot, and return the journal of its controller.

    Args:
        path: Configuration.
        samples: States of the robot.
        acts: What is done before a sample, by its number.
        sees: What becomes of a state on its way.
        follows: Reference; None: the circle.
        late_ms: How long a sample takes, by its number.
    """
    config = load(path)
    rti = build_rti(config)
    controller = build_controller(config, rti, check_stop(config))
    book = Book(controller)
    book.epoch = 5
    case = KeptCase(rti, book)
    follows = reference(circle()) if follows is None else follows
    given = robot_settings(config)
    body = Lockstep(RobotSettings(**given | {"x0": [*follows.y[0], *given["x0"][len(follows.y[0]) :]]}))
    book.photograph(0)
    controller.lead(5)
    controller.receive_reference(follows)
    messages: list[Journal] = []
    for k in range(samples):
        (acts or {}).get(k, lambda *_: None)(controller, rti)
        state = body.tick()
        seen, now_ns = sees(k, state), body.now_ns
        command = proposal = controller.tick(now_ns) if seen is None else controller.receive_state(seen, now_ns)
        if proposal is not None and seen is not None:
            command = controller.in_time(proposal, now_ns + MS * (late_ms or {}).get(k, 1))
        if command is not None:
            body.accept(command, now_ns)
            controller.commit(command, now_ns)
        if seen is not None:
            if proposal is not None:
                case.note(proposal, command, now_ns)
            controller.prepare()
            while not controller.second_opinion():
                pass
        if k % 25 == 24:
            book.photograph(now_ns)
        messages += book.messages(now_ns)
    return Journaled(config.robot, 5, messages, origin_files(config, rti.ocp.model))


def failing(failure: str, samples: int) -> Act:
    """Inject a failure, as the process does on request."""

    def act(controller: Controller, rti: Rti) -> None:
        assert isinstance(rti, FaultyRti)
        rti.inject({"failure": failure, "samples": samples})
        controller.on_call(Call("inject", (failure, samples), {}))

    return act


def recorded(
    journal: Journaled,
    path: Path,
    states: Sequence[State] = (),
    also: Callable[[RecordingWriter], None] = lambda _: None,
    others: Sequence[Journaled] = (),
) -> Path:
    """Write journals as a recorder does, with the attached files, states that arrive at their stamps, and what `also` adds; return the file."""
    keys = Keys("rti_mpc", journal.robot)
    writer = RecordingWriter(path, 0, 0, "0")
    for one in (journal, *others):
        for name, text in one.files.items():
            writer.attach(f"{one.robot}/{one.owner}/{name}", "text/plain", text.encode(), 0)
        for message in one.messages:
            writer.add(one.robot, keys.journal, message.local_ns, encode(message), message.seq)
    for state in states:
        writer.add(journal.robot, keys.state, state.stamp_ns, encode(state), state.seq)
    also(writer)
    writer.finish({})
    return path
