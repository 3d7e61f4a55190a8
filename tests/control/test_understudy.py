# SPDX-License-Identifier: Apache-2.0
"""Rehearsals of a controller: whatever happens to it, commands and all that they depend on are the same bit for bit with them and without."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Mapping
from enum import Enum
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc.contract.message import Command
from rti_mpc.control.call import Call
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.kept import Kept
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.cdr import encode
from tests.control.test_call import life, made
from tests.loop import MS, reference, robot
from tests.problems import pioneer

NOT_STATE = {"_understudy", "_kept"}  # attributes of a controller and its planner in which rehearsals are made


COMPARED_CALLS = 7  # state is compared after every so many calls, and after each one that is unusual
USUAL_CALLS = {"commit", "in_time", "overhear", "prepare", "receive_state", "second_opinion", "tick"}


@pytest.fixture(scope="module")
def calls() -> list[Call]:
    """Calls of a controller that lives through all that can happen."""
    return life(made())[0]


def bits(value: Any, seen: dict[int, tuple[int, Any]]) -> Iterator[Any]:
    """Yield all that an object holds: numbers bit for bit, and objects in the order in which they are met."""
    if isinstance(value, float):
        yield value.hex()
    elif value is None or isinstance(value, int | str | bytes | Enum):
        yield value
    elif id(value) in seen:
        yield "again", seen[id(value)][0]
    else:
        seen[id(value)] = len(seen), value  # kept, so that no other object gets its number
        if isinstance(value, np.ndarray):
            yield value.shape, value.tobytes()
        elif isinstance(value, memoryview):
            yield value.tobytes()
        elif isinstance(value, Mapping):
            yield from (part for key, item in value.items() for part in (str(key), *bits(item, seen)))
        elif isinstance(value, list | tuple | deque | set | frozenset):
            yield from (part for item in value for part in bits(item, seen))
        elif isinstance(value, ca.Function | Kept) or callable(value):
            yield type(value).__name__
        else:
            yield type(value).__name__
            slots = {name: getattr(value, name) for name in getattr(type(value), "__slots__", ())}
            yield from bits({name: item for name, item in ({**slots, **getattr(value, "__dict__", {})}).items() if name not in NOT_STATE}, seen)


def state_of(held: object) -> list[Any]:
    return list(bits(held, {}))


def test_commands_and_all_they_depend_on_are_the_same_bit_for_bit_with_rehearsals_before_every_call(calls: list[Call]) -> None:
    """Late samples, a loss, a standby that takes over, a stop, other weights and references, and what OSQP thinks of each plan."""
    plain, rehearsed = made(), made()
    outcomes: Counter[bool] = Counter()
    local_ns = 0
    for k, call in enumerate(calls):
        if call.name == "receive_state":
            local_ns = call.args[1]
        outcomes[rehearsed.rehearse(local_ns) is not None] += 1
        one, other = call.repeat(plain), call.repeat(rehearsed)
        if isinstance(one, Command):
            assert encode(one) == encode(other)
        else:
            assert one == other
        if k % COMPARED_CALLS == 0 or call.name not in USUAL_CALLS:
            assert state_of(plain) == state_of(rehearsed), call.name
    assert min(outcomes.values()) > 20, "rehearsed, and without a prepared sample to rehearse"


def test_state_of_a_controller_tells_of_one_bit(calls: list[Call]) -> None:
    one, other = made(), made()
    for call in calls[:40]:
        call.repeat(one)
        call.repeat(other)
    assert state_of(one) == state_of(other)
    one._rti.guess.sample["x"][3, 1] += 1e-16
    one._sent._schedule._plans[-1].u[-1, 0] += 1e-15
    differences = [a for a, b in zip(state_of(one), state_of(other), strict=True) if a != b]
    assert len(differences) >= 1


def followed() -> tuple[Controller, Any]:
    """A controller that has answered a few states, and the robot."""
    controller = Controller(Rti(pioneer(N=6, N_u=4), compile=False), Timing(0.02), compile=False)
    controller.receive_reference(reference(eight()))
    body = robot(eight())
    for _ in range(5):
        if (command := controller.receive_state(body.tick(), body.now_ns)) is not None:
            body.accept(command, body.now_ns)
            controller.commit(command, body.now_ns)
            controller.prepare()
    return controller, body


def test_rehearsal_makes_a_command_of_the_same_size_from_the_last_state() -> None:
    controller, body = followed()
    rehearsed = controller.rehearse(body.now_ns + 99 * MS)
    command = controller.receive_state(body.tick(), body.now_ns)
    assert rehearsed is not None and command is not None
    assert len(encode(rehearsed)) == len(encode(command))
    assert (rehearsed.seq, rehearsed.stamp_ns, rehearsed.state_seq) == (command.seq, command.stamp_ns, command.state_seq - 1)
    assert np.isfinite(rehearsed.u).all()


def test_nothing_is_rehearsed_before_a_sample_is_prepared_nor_while_another_controller_leads() -> None:
    fresh = made()
    assert fresh.rehearse(0) is None
    controller, body = followed()
    controller.stand_by()
    assert controller.rehearse(body.now_ns) is None


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_qp_solver_is_left_alone(solver: str) -> None:
    """It starts from its last iterate, which a rehearsal would change."""
    rti = Rti(pioneer(N=6, N_u=4), solver=solver, compile=False)
    rti.prepare(rti.y_ref.copy())
    before = state_of(rti)
    with Kept(rti.rehearsed):
        rti.rehearse(rti.x_nominal + 0.1)
    assert state_of(rti) == before
