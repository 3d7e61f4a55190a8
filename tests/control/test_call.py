# SPDX-License-Identifier: Apache-2.0
"""Reported calls of a controller: repeated on a second controller, they give the same commands, bit for bit."""

from __future__ import annotations

import ast
import copy
import inspect
from dataclasses import replace
from typing import Any

import numpy as np

from rti_mpc.contract.status import Mode
from rti_mpc.control.call import Call
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.reference.trajectory import circle
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.cdr import encode
from tests.life import live_through
from tests.loop import reference, robot
from tests.problems import pioneer

REPORTED_CALLS = {
    *("commit", "enable", "in_time", "lead", "overhear", "prepare", "receive_reference"),
    *("receive_state", "retune", "rewarm", "second_opinion", "stand_by", "standstill", "stop", "tick"),
}
READING_CALLS = {  # change nothing that a command depends on
    *("at_rest", "blocked", "continues", "followed", "heard", "lay_out", "mode", "notices", "rehearse", "robot_now_ns", "robot_rate"),
    *("say", "scales", "standing_by", "slack_s", "telemetry", "wanted"),
}


def made() -> Controller:
    return Controller(Rti(pioneer(N=6, N_u=4), compile=False), Timing(), second_opinion=1, compile=False)


def test_every_public_method_of_a_controller_is_reported_or_only_reads() -> None:
    public = {name: member for name, member in vars(Controller).items() if not name.startswith("_")}
    assert {name for name, member in public.items() if hasattr(member, "__wrapped__")} == REPORTED_CALLS
    assert set(public) == REPORTED_CALLS | READING_CALLS


def test_no_call_that_is_told_makes_another_one() -> None:
    """Otherwise it would happen twice, when both calls are repeated."""
    calls = [node.func for node in ast.walk(ast.parse(inspect.getsource(Controller))) if isinstance(node, ast.Call)]
    own = {func.attr for func in calls if isinstance(func, ast.Attribute) and isinstance(func.value, ast.Name) and func.value.id == "self"}
    assert own
    assert not own & REPORTED_CALLS


def life(controller: Controller) -> tuple[list[Call], list[bytes]]:
    """Let a controller live through all that can happen; return its calls, with the arguments as they were, and its commands as sent."""
    calls: list[Call] = []
    controller.on_call = lambda call: calls.append(copy.deepcopy(call, {id(problem): problem}))
    problem = replace(pioneer(N=6, N_u=4), R=np.array([0.3, 0.2]))
    sent = live_through(controller, made(), problem)
    assert controller.ladder.shifted == 2, "of three that were late; no plan was left for the third"
    return calls, sent


def test_controller_that_is_told_the_same_calls_sends_the_same_commands_bit_for_bit() -> None:
    """Late samples, a loss, a standby that takes over, a stop, other weights and references: all is in the calls."""
    calls, sent = life(made())
    assert {call.name for call in calls} >= {"lead", "overhear", "retune", "second_opinion", "stand_by", "standstill", "stop", "tick"}
    again, repeated = made(), []
    proposal: Any = None
    for call in calls:
        if call.name == "commit":
            assert encode(proposal) == encode(call.args[0])
            if not again.standing_by:
                repeated.append(encode(proposal))
            call = call._replace(args=(proposal, *call.args[1:]))
        result = call.repeat(again)
        if call.name in ("receive_state", "in_time", "tick", "standstill"):
            proposal = result
    assert repeated == sent
    assert len(sent) > 100
    assert again.mode is not Mode.IDLE


def test_proposal_that_is_not_committed_was_never_sent() -> None:
    """Sequence numbers have no gap, and the next plan starts from what was sent."""
    one, other, body = made(), made(), robot(circle())
    for controller in (one, other):
        controller.receive_reference(reference(circle()))
    commands = []
    for k in range(30):
        state = body.tick()
        both = [controller.receive_state(state, body.now_ns) for controller in (one, other)]
        if k == 20:
            assert both[0] is not None
            assert one._issued.last is not both[0]
            np.testing.assert_array_equal(one._sent.at(body.now_ns)[0], commands[-1].u[1])  # what was sent before plays on
            assert one.receive_state(replace(state, seq=state.seq), body.now_ns) is None, "and once is enough for a state"
        for controller, command in zip((one, other), both, strict=True):
            if command is not None:
                if k != 20 or controller is other:
                    controller.commit(command)
                controller.prepare()
        if both[0] is not None and k != 20:
            commands.append(both[0])
            body.accept(both[0])
    assert [command.seq for command in commands] == list(range(1, len(commands) + 1))
