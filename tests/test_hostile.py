# SPDX-License-Identifier: Apache-2.0
"""
Well-formed messages with absurd values: they raise no exception in any process, and have no effect once the robot has restarted.

NumPy's warnings are errors here. Messages that the receiver refuses are tested in `tests.wire`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Reference, State
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.bus import Received
from rti_mpc.wire.cdr import M, encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import MS, PIONEER, SLEW, drive, reference
from tests.problems import pioneer

NUMBERS = np.array([0.0, -0.0, 5e-324, -2e-308, 1e-18, 0.1, 1.0, -1.0, np.pi, 3.5, 1e3, 1e9, -1e9, 1.1e9, 1e12, 1e18, -1e18])
STAMPS = (0, 1, 10**8, 2**31, 2**53, 2**61, 2**62 - 1, -1, -(10**8), -(2**53), -(2**62) + 1)
INTEGERS = (0, 1, 2, 10**6, 10**6 + 1, 2**32, 2**52, 2**53, 2**63, 2**64 - 1)
PERIODS = (100_000, 10**6, 10**8, 10**8 + 1, 3_600_000_000_000)


BOUND = np.array([0.5, 0.745])


class Hostile:
    """Messages from a seed: each number sane or absurd, at random."""

    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def array(self, *shape: int) -> Array:
        rng = self._rng
        return np.where(rng.random(shape) < 0.3, rng.choice(NUMBERS, shape), rng.uniform(-0.5, 0.5, shape))

    def one_of(self, sane: int, absurd: tuple[int, ...]) -> int:
        return sane if self._rng.random() < 0.7 else int(absurd[self._rng.integers(len(absurd))])

    def state(self, stamp_ns: int, seq: int) -> State:
        return State(self.one_of(1, INTEGERS), self.one_of(seq, INTEGERS), self.one_of(stamp_ns, STAMPS), self.array(5))

    def reference(self, stamp_ns: int, seq: int) -> Reference:
        rows = self.one_of(50, (1, 2, 1000))
        stamp_ns = self.one_of(stamp_ns, (*STAMPS, STAMP_ON_ARRIVAL))
        p = self.array(rows, 4) if self._rng.random() < 0.3 else np.zeros((rows, 0))
        return Reference(1, seq, stamp_ns, self.one_of(10**8, PERIODS), End(self._rng.integers(2)), self.array(rows, 3), p)

    def command(self, stamp_ns: int, seq: int, state_epoch: int = 1) -> Command:
        stamps = [self.one_of(stamp_ns, STAMPS), self.one_of(stamp_ns, STAMPS), self.one_of(stamp_ns + 250 * MS, STAMPS)]
        epochs = self.one_of(5, INTEGERS), self.one_of(seq, INTEGERS), stamps[0], self.one_of(state_epoch, INTEGERS), self.one_of(seq, INTEGERS)
        u = self.array(self.one_of(20, (1, 2, 2000)), 2)
        return Command(*epochs, *stamps[1:], 7, Mode(self._rng.integers(7)), QpStatus.SOLVED, self.one_of(10**8, PERIODS), u)


def life(epoch: int) -> Lockstep:
    """A robot at the start of the circle."""
    return Lockstep(RobotSettings(PIONEER, np.array([*circle().pose0, 0.0, 0.0]), SLEW, lbu=-BOUND, ubu=BOUND), epoch)


def honest(stamp_ns: int, seq: int, state_epoch: int, epoch: int = 5) -> Command:
    """A command to stand."""
    u = np.zeros((20, 2))
    head = (epoch, seq, stamp_ns, state_epoch, seq, stamp_ns, stamp_ns + 250 * MS, 7)
    return Command(*head, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, u)


def let_in(intake: Intake[M], message: M) -> M | None:
    return intake.read(Received(encode(message), encoding(type(message)), ""))


@pytest.mark.parametrize(("seed", "delay_s"), [(1, 0.0), (2, None)])
def test_controller_answers_absurd_states_and_references_or_not_and_then_an_honest_robot_as_if_nothing_had_been(
    seed: int, delay_s: float | None
) -> None:
    controller, fresh = (Controller(Rti(pioneer(N=5), compile=False), Timing(delay_s), compile=False) for _ in range(2))
    hostile, states, references = Hostile(seed), Intake(State, 1.0, {"x": 5}), Intake(Reference, 1.0, {"y": 3, "p": controller.np_})
    answered = 0
    for k in range(-200, -10):
        local_ns = 100 * MS * k
        if k % 3 == 0 and (planned := let_in(references, hostile.reference(local_ns, k + 201))) is not None:
            controller.receive_reference(planned)
        if (state := let_in(states, hostile.state(local_ns, k + 201))) is None:
            continue
        command = controller.receive_state(state, local_ns)
        if command is not None:
            answered += 1
            sent = controller.in_time(command, local_ns + MS) or command
            encode(sent)
            assert (np.abs(sent.u) <= 0.75).all()
            controller.commit(sent, local_ns + MS)
            controller.prepare()
            encode(controller.telemetry(prepare_us=0.0, feedback_us=0.0, latency_us=0.0, slack_s=controller.slack_s(local_ns)))
        if (silent := controller.tick(local_ns + 20 * MS)) is not None:
            encode(silent)
            controller.commit(silent)
    assert answered > 10
    errors = []
    for one in (controller, fresh):
        body = life(2**54)
        for _ in range(30):  # longer than two robots are one too many
            one.receive_state(body.tick(), body.now_ns)
        one.receive_reference(reference(circle(), epoch=3, stamp_ns=body.now_ns))
        errors.append(drive(one, body, 9.0).error_mm(circle())[-10:])
    np.testing.assert_allclose(*errors, atol=5.0)  # mm: what is known of the clock and the delay of a robot is kept


def test_robot_plays_absurd_commands_or_not_and_then_an_honest_controllers() -> None:
    hostile, commands = Hostile(9), Intake(Command, 1.0, {"u": 2})
    body = life(1)
    taken = 0
    for k in range(300):
        body.tick()
        if (command := let_in(commands, hostile.command(body.now_ns, k))) is not None:
            taken += not body.accept(command)
        assert (np.abs(body.u) <= BOUND).all()
    assert taken > 3
    body.advance(body.now_ns + 300 * MS)  # of silence
    assert body.accept(honest(body.now_ns, 1, 1, epoch=2**53)) == "", "of a controller that has heard the others"


def test_guard_passes_nothing_outside_the_limits_of_absurd_commands_and_then_an_honest_controllers() -> None:
    limits = Limits(np.zeros(2), -BOUND, BOUND, -SLEW * 0.1, SLEW * 0.1, 0.1)
    guard, hostile, commands = Guard(limits, epoch=1 << 50), Hostile(5), Intake(Command, 1.0, {"u": 2})
    passed: list[Any] = []
    for k in range(1000):
        local_ns = 100 * MS * k
        guard.receive_state(State(1, k, local_ns, np.zeros(5)), local_ns)
        if (command := let_in(commands, hostile.command(local_ns, k))) is not None:
            passed.append(guard.receive_command(command, local_ns + MS))
        passed.append(guard.tick(local_ns + 2 * MS))
    for command in filter(None, passed):
        encode(command)
        assert (command.u >= limits.lbu).all()
        assert (command.u <= limits.ubu).all()
    assert guard.epoch < 2**54
    for k in range(1000, 1010):
        local_ns = 100 * MS * k
        guard.receive_state(State(2, k, local_ns, np.zeros(5)), local_ns)
        last = guard.receive_command(honest(local_ns, k, 2, guard.epoch), local_ns + MS)
    assert last is not None
