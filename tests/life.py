# SPDX-License-Identifier: Apache-2.0
"""A controller's life in lockstep with all that can happen in it: late samples, losses, standing by, a stop, other weights and references."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, State
from rti_mpc.control.controller import Controller
from rti_mpc.reference.trajectory import circle, eight
from rti_mpc.rti.ocp import Ocp
from rti_mpc.wire.cdr import encode
from tests.loop import MS, reference, robot

SAMPLES = 160


def live_through(
    controller: Controller,
    leader: Controller,
    problem: Ocp,
    *,
    samples: int = SAMPLES,
    before: Callable[[int], object] = lambda k: None,
    jumped_ns: Callable[[int], int] = lambda k: 0,
) -> list[bytes]:
    """
    Let a controller live, and return its commands as they were sent, encoded.

    Args:
        controller: The controller.
        leader: An equal one, whose commands it hears while it stands by.
        problem: Problem with the weights that it takes in sample 40.
        samples: Number of samples.
        before: Is called before each sample, with its number.
        jumped_ns: By how much the stamps of a sample's state have jumped; the robot then takes no command.
    """
    body, rng, pieces, sent = robot(circle()), np.random.default_rng(1), np.random.default_rng(2), list[bytes]()
    controller.receive_reference(reference(circle(), stamp_ns=STAMP_ON_ARRIVAL))
    leader.receive_reference(reference(circle()))
    jump_ns = 0

    def send(command: Command, left_ns: int | None = None) -> None:
        assert jump_ns or body.accept(command, body.now_ns) in ("", "expired")
        controller.commit(command, left_ns)
        sent.append(encode(command))

    for k in range(samples):
        before(k)
        jump_ns, seen = jumped_ns(k), body.tick()
        state = replace(seen, stamp_ns=seen.stamp_ns + jump_ns)
        local_ns = body.now_ns + int(rng.integers(0, 3 * MS))
        if 60 <= k < 75:
            if k == 60:
                controller.stand_by()
            if (theirs := answer(leader, state, local_ns)) is not None:
                controller.overhear(theirs)
        elif k == 75:
            controller.lead(9)
        if k == 40:
            controller.retune(problem, 1)
        if k == 90:
            controller.stop("asked for")
        if k == 110:
            controller.enable()
        if k == 115:
            controller.receive_reference(reference(eight(), stamp_ns=body.now_ns, epoch=2))
        if 120 <= k < 126:  # lost
            if (ramp := controller.tick(local_ns)) is not None:
                send(ramp)
            continue
        command = controller.receive_state(state, local_ns)
        if command is None:
            continue
        command = controller.in_time(command, left_ns := local_ns + (90 * MS if k in (30, 50, 51) else MS))
        if command is not None:
            if controller.standing_by:
                controller.commit(command, left_ns)
            else:
                send(command, left_ns)
        controller.prepare()
        for _ in range(int(pieces.integers(0, 5))):
            controller.second_opinion()
    last = controller.standstill(body.now_ns)
    assert last is not None
    send(last)
    return sent


def answer(leader: Controller, state: State, local_ns: int) -> Command | None:
    """Return the leader's command for a state."""
    if (command := leader.receive_state(state, local_ns)) is not None:
        leader.commit(command)
        leader.prepare()
    return command
