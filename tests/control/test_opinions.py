# SPDX-License-Identifier: Apache-2.0
"""Second opinions of a controller, in lockstep with a robot."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np
import pytest

from rti_mpc.contract.message import Severity, State, Telemetry
from rti_mpc.contract.status import DISAGREEMENT, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.opinions import RELIABLE
from rti_mpc.errors import OcpError
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti import construction, linearization
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.cdr import encode
from rti_mpc_service.controller.slack import Slack
from tests.loop import MS, drive, reference, robot
from tests.problems import pioneer

GRADIENT_ERROR = ca.DM([1.0, -1.0, 1.0, 1.0, 1.0])  # the sign of y


def made(every: int = 1, epoch: int = 1, **options: Any) -> Controller:
    rti = Rti(pioneer(N=6, N_u=4), compile=False, **options)
    controller = Controller(rti, Timing(), epoch=epoch, second_opinion=every, compile=False)
    controller.receive_reference(reference(eight()))
    return controller


def told(controller: Controller) -> Telemetry:
    return controller.telemetry(prepare_us=0, feedback_us=0, latency_us=0, slack_s=0, second_us=1.0)


def judged(controller: Controller, samples: int) -> list[Telemetry]:
    """Drive, and return the telemetry of each sample."""
    body, found = robot(eight()), []
    for k in range(1, samples + 1):
        before = controller._issued.seq
        drive(controller, body, 0.1 * k)
        if controller._issued.seq > before:
            found.append(told(controller))
    return found


def test_telemetry_tells_of_the_plan_before() -> None:
    found = judged(made(), 12)
    assert found[0].second_seq == 0
    assert found[0].second_status is QpStatus.NONE
    assert np.isnan(found[0].second_difference)
    assert found[0].second_us == 0.0, "there was nothing to judge"
    for before, sample in pairwise(found):
        assert sample.second_seq == before.seq
        assert sample.second_status is QpStatus.SOLVED
        assert sample.second_difference < DISAGREEMENT
        assert sample.second_iterations >= 10
        assert sample.second_us == 1.0


@pytest.mark.parametrize("every", [0, 1, 3])
def test_every_so_many_plans_are_judged(every: int) -> None:
    seqs = [sample.second_seq for sample in judged(made(every), 16)]
    expected = sum(k % every == 0 for k in range(1, len(seqs))) if every else 0
    assert sum(seq > 0 for seq in seqs) == expected


def test_osqp_does_not_judge_its_own_plans() -> None:
    assert all(sample.second_seq == 0 for sample in judged(made(solver="osqp"), 4))


def test_a_standby_forms_no_opinion_until_it_leads() -> None:
    controller, body = made(), robot(eight())
    controller.stand_by()
    drive(controller, body, 1.0)
    assert told(controller).second_seq == 0
    controller.lead(2)
    drive(controller, body, 2.0)
    assert told(controller).second_seq > 0


def test_every_so_many_must_be_a_whole_number() -> None:
    with pytest.raises(OcpError, match="second_opinion"):
        made(-1)


def test_commands_are_the_same_bit_for_bit_with_second_opinions_and_without() -> None:
    runs = [drive(made(every), robot(eight(), noise_std=np.array([1e-3, 1e-3, 1e-3, 0.0, 0.0]), seed=1), 5.0) for every in (0, 1)]
    assert len(runs[0].commands) > 40
    assert [encode(command) for command in runs[0].commands] == [encode(command) for command in runs[1].commands]


def misled(build: Callable[..., Any]) -> Callable[..., Any]:
    """Let a function take a wrong gradient of the cost for the right one, whatever else is built from the problem."""
    right = linearization.gauss_newton

    def wrong(ocp: Ocp) -> tuple[ca.Function, ca.Sparsity]:
        node, pattern = right(ocp)
        symbols = [ca.SX.sym(f"a{i}", node.sparsity_in(i)) for i in range(node.n_in())]
        (out,) = node.call(symbols)
        nx = ocp.model.nx
        return ca.Function("node", symbols, [ca.vertcat(GRADIENT_ERROR * out[:nx], out[nx:])]), pattern

    def built(*args: Any, **kwargs: Any) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(linearization, "gauss_newton", wrong)
            patch.setattr(linearization, "_linearizations", WeakKeyDictionary())
            return build(*args, **kwargs)

    return built


@pytest.mark.parametrize("which", ["active set", "osqp"])
def test_a_wrong_gradient_in_either_solver_is_told_within_three_samples(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The certificate finds nothing wrong: it judges the plan by the same data. While all inputs are at bounds, nothing depends on the gradient."""
    body = robot(eight())
    drive(made(0), body, 3.0)
    monkeypatch.setattr(construction, "_constructions", WeakKeyDictionary())
    if which == "active set":
        for name in ("places", "certificate"):
            monkeypatch.setattr(construction, name, misled(getattr(construction, name)))
    else:
        for name, build in construction.FORMULATIONS.items():
            monkeypatch.setitem(construction.FORMULATIONS, name, misled(build))
    controller = made(epoch=2)
    while not (events := [notice for notice in controller.notices() if notice.code == "solvers_disagree"]):
        assert controller._issued.seq < 3
        drive(controller, body, 1e-9 * body.now_ns + 0.1)
    assert events[0].severity is Severity.WARNING
    assert told(controller).status is QpStatus.SOLVED


def test_solvers_that_agree_again_are_told() -> None:
    controller, body = made(), robot(eight())
    drive(controller, body, 1.0)
    controller.notices()
    opinions = controller._opinions
    assert opinions is not None
    opinion = opinions._opinion
    right = opinion._u
    opinion._u = right + 1.0
    drive(controller, body, 2.0)
    assert [notice.code for notice in controller.notices()] == ["solvers_disagree"], "once"
    opinion._u = right
    drive(controller, body, 2.0 + 0.1 * (RELIABLE - 2))
    assert not controller.notices()
    drive(controller, body, 2.0 + 0.1 * (RELIABLE + 2))
    assert [notice.code for notice in controller.notices()] == ["solvers_agree"]


class Slow:
    """A controller whose clock advances by 30 ms with each piece of a second opinion; states come every 50 ms, one of two is due."""

    def __init__(self, every: int) -> None:
        self.controller, self.body = made(every), robot(eight(), state_period_s=0.05)
        self.now_ns = 0
        self.coming = self.body.tick()
        self.pieces: list[int] = []  # of each slack
        self.sent: list[bytes] = []

    def piece(self) -> bool:
        self.now_ns += 30 * MS
        self.pieces[-1] += 1
        return self.controller.second_opinion()

    def poll(self) -> State | None:
        return self.coming if self.now_ns >= self.body.now_ns else None

    def answer(self) -> None:
        """Answer the state that is there, or wait for it."""
        self.now_ns = max(self.now_ns, self.body.now_ns)
        if (command := self.controller.receive_state(self.coming, self.now_ns)) is not None:
            self.body.accept(command, self.body.now_ns)
            self.controller.commit(command)
            self.sent.append(encode(command))
            self.controller.prepare()
        self.coming = self.body.tick()
        self.pieces.append(0)


def test_a_state_that_comes_in_the_slack_is_answered_at_once() -> None:
    """After the piece that was begun, and as without second opinions; the rest is done after a state that is not due, never after one that is."""
    runs = [Slow(0), Slow(1)]
    cut = 0
    for run in runs:
        slack = Slack(lambda run=run: run.now_ns)
        for _ in range(24):
            run.answer()
            if slack.fill(run.piece, run.poll) is not None:
                cut += 1
                assert run.now_ns - run.body.now_ns < 30 * MS
    assert runs[0].sent == runs[1].sent
    assert len(runs[0].sent) > 8
    assert cut > 8
    assert set(runs[1].pieces) == {1, 2}
