# SPDX-License-Identifier: Apache-2.0
"""Replay of a journal: whatever a controller lives through, journal, snapshot and construction give every bit of its commands."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import Command, End, Journal, JournalKind, Reference
from rti_mpc.contract.status import Mode, QpStatus
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.control.observer import Disturbance, Observer, ObserverSettings
from rti_mpc.errors import JournalError
from rti_mpc.journal.book import Book
from rti_mpc.journal.replay import Replay, ReplayOutcome, difference, replay
from rti_mpc.journal.snapshot import ARRAY, PINNED, Camera, Snapshot
from rti_mpc.model.disturbance import with_disturbances
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.closed_loop.test_rest import MOTIONS, tracking
from tests.life import live_through
from tests.loop import MS, PIONEER, drive
from tests.movers import law_of, ocp_of
from tests.problems import PAPER, SLEW, pioneer

S = 1_000_000_000


@cache
def disturbed() -> Ocp:
    """One problem for all observers, whose expressions are then built once."""
    return Ocp(with_disturbances(pioneer(N=6, N_u=4).model, ["u_c"]), **(PAPER | SLEW | {"N": 6, "N_u": 4}))


@dataclass
class Kind:
    """One way to build a controller."""

    rti: dict[str, Any] = field(default_factory=dict)
    delay_s: float | None = 0.0
    observed: bool = False
    second_opinion: int = 1
    bounds: dict[str, Any] = field(default_factory=dict)

    def build(self) -> tuple[Controller, Rti]:
        problem, observer = pioneer(N=6, N_u=4, **self.bounds), None
        if self.observed:
            settings = ObserverSettings({"u_c": Disturbance(0.1, 0.3)}, ())
            observer = Observer(problem.model, settings, compile=False)
            problem = disturbed()
        rti = Rti(problem, compile=False, **self.rti)
        timing = Timing(delay_s=self.delay_s)
        return Controller(rti, timing, observer=observer, second_opinion=self.second_opinion, compile=False), rti


KINDS = {
    "riccati": Kind(),
    "osqp": Kind({"solver": "osqp"}, second_opinion=0),
    "sequential": Kind({"solver": "osqp", "formulation": "sequential"}, second_opinion=0),
    "daqp": Kind({"solver": "daqp"}),
    "hard": Kind({"formulation": "sequential"}, bounds={"lbx": [-np.inf] * 5, "ubx": [np.inf] * 5}),
    "delay": Kind(delay_s=None),
    "observer": Kind(observed=True),
}


@dataclass
class Life:
    """All that a controller has lived through."""

    messages: list[Journal]
    commands: list[bytes]


def live(kind: Kind, samples: int = 160, snapshots: tuple[int, ...] = (0, 35, 51, 65, 95, 123, 140)) -> Life:
    """Let a controller live through all that can happen: late samples, losses, a clock jump, standing by, a stop, other weights and references."""
    controller, rti = kind.build()
    book = Book(controller)
    problem = rti.ocp.retuned(R=np.array([0.3, 0.2]))
    leader, _ = kind.build()
    messages: list[Journal] = []
    book.photograph(0)

    def before(k: int) -> None:
        if k in snapshots:
            book.photograph(k * 100 * MS)
        messages.extend(book.messages(k * 100 * MS))

    commands = live_through(controller, leader, problem, samples=samples, before=before, jumped_ns=lambda k: 5 * S if k >= 145 else 0)
    book.photograph(samples * 100 * MS)
    messages += book.messages(samples * 100 * MS)
    assert not book.failure
    assert not book.dropped
    return Life(messages, commands)


def replayed(kind: Kind, messages: list[Journal], start_seq: int = 0, **override: Any) -> tuple[ReplayOutcome, Replay]:
    on = Replay(*kind.build())
    begun = False
    for _ in replay(on, messages, start_seq):
        if override and not begun:
            begun = True
            on.override(**override)
    return on.outcome, on


def contents(snapshot: Snapshot) -> Any:
    """All that a snapshot holds, arrays by their bytes, without which of them are one."""

    def of(node: Any) -> Any:
        if isinstance(node, tuple | list) and node and node[0] in (ARRAY, PINNED) and isinstance(node, tuple):
            return (snapshot.arrays if node[0] == ARRAY else snapshot.pinned)[node[1]].tobytes(), node[2]
        if isinstance(node, tuple | list):
            return [of(item) for item in node]
        if isinstance(node, dict):
            return {name: of(item) for name, item in node.items()}
        if isinstance(node, np.ndarray):
            return node.tobytes()
        return repr(node)

    return of(snapshot.tree)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "riccati")) for name in KINDS])
def test_journal_replays_with_no_differing_bit_from_every_snapshot(name: str) -> None:
    """And the last snapshot, too, is that of the recorded controller, in all its bits: no attribute is left out that depends on another one."""
    lived = live(KINDS[name])
    assert len(lived.commands) > 110
    starts = [message.seq for message in lived.messages if message.kind is JournalKind.SNAPSHOT]
    assert len(starts) == 9
    samples = []
    for start in starts[:-1]:
        outcome, on = replayed(KINDS[name], lived.messages, start)
        assert not outcome.differences, str(outcome.differences[0])
        assert not outcome.gaps
        samples.append(outcome.samples)
        assert contents(on._camera.take()) == contents(Snapshot.decode(lived.messages[-1].data))
    assert samples == sorted(samples, reverse=True)
    assert samples[0] >= len(lived.commands)
    assert samples[-1] < samples[0] - 100


def test_snapshot_that_would_change_the_pattern_of_a_matrix_is_refused() -> None:
    """Compiled code trusts the indices of a sparse matrix: with others it writes beyond its arrays."""
    camera = Camera(KINDS["osqp"].build()[0])
    snapshot = camera.take()
    camera.restore(snapshot)
    patterns = [i for i, array in enumerate(snapshot.pinned) if array.dtype.kind == "i"]
    assert len(patterns) > 3
    wrong: list[Any] = [snapshot.pinned[patterns[-1]] + 2_000_000_000, snapshot.pinned[patterns[-1]].astype(np.float64), 0, None]
    for other in wrong:
        with pytest.raises(JournalError, match="must be of a controller built like this one"):
            camera.restore(replace(snapshot, pinned=[other if i == patterns[-1] else array for i, array in enumerate(snapshot.pinned)]))


@cache
def observed_life() -> Life:
    """A short life with an observer, which has arrays of its own."""
    return live(KINDS["observer"], samples=60, snapshots=(0, 40))


@pytest.mark.parametrize("change", ["a column more", "an axis more"])
def test_snapshot_that_would_give_an_object_an_array_of_another_size_is_refused_by_name(change: str) -> None:
    """As one that somebody has made on purpose: a controller calls compiled code with them."""
    snapshot = Snapshot.decode(next(message for message in observed_life().messages if message.seq > 0 and message.kind is JournalKind.SNAPSHOT).data)
    controller = KINDS["observer"].build()[0]
    camera = Camera(controller)
    camera.restore(snapshot)
    refused = set()
    for i, array in enumerate(snapshot.arrays):
        shape = (*array.shape[:-1], array.shape[-1] + 1) if change == "a column more" else (*array.shape, 1)

        def grown(node: Any, i: int = i, shape: tuple[int, ...] = shape) -> Any:
            """The tree with this array, wherever it is reached, in its new shape."""
            if isinstance(node, tuple) and len(node) == 3 and node[:2] == (ARRAY, i):
                return ARRAY, i, shape
            return type(node)(map(grown, node)) if type(node) in (list, tuple) else node

        arrays = [np.resize(other, shape) if other is array else other for other in snapshot.arrays]
        with pytest.raises(JournalError, match=r"^\S+ of a snapshot must have the size that it has") as refusal:
            camera.restore(replace(snapshot, arrays=arrays, tree=grown(snapshot.tree)))
        refused.add(str(refusal.value).split()[0].rpartition(".")[2].strip("'"))
    assert refused > {"u", "before", "lbu", "zh", "_rows"}


@pytest.mark.parametrize("name", ["car", pytest.param("quadrotor", marks=pytest.mark.slow)])
def test_robot_with_a_way_to_rest_replays_from_every_snapshot(name: str) -> None:
    """A car follows its way on and on; a quadrotor feeds its states back to it."""

    def build() -> tuple[Controller, Rti]:
        rti = Rti(ocp_of(name), compile=False)
        return Controller(rti, Timing(), stop_law=law_of(name), second_opinion=1, compile=False), rti

    controller, _ = build()
    _, body = tracking(name)
    book, start = Book(controller), np.array(MOTIONS[name][0])
    messages: list[Journal] = []
    book.photograph(0)
    y = start + 0.05 * np.arange(400)[:, None] * np.array(MOTIONS[name][1])
    controller.receive_reference(Reference(1, 1, 0, 50 * MS, End.HOLD, y, np.zeros((len(y), 0))))
    for until_s in (0.5, 1.0, 1.2, 2.0):
        lost = until_s == 1.2
        drive(controller, body, until_s, sees=lambda state, lost=lost: None if lost else state)
        if until_s == 1.0:
            controller.stop("asked for")
        book.photograph(0)
        messages += book.messages(0)
    for start_seq in [message.seq for message in messages if message.kind is JournalKind.SNAPSHOT][:-1]:
        on = Replay(*build())
        for _ in replay(on, messages, start_seq):
            pass
        assert on.outcome.samples > 3
        assert not on.outcome.differences, str(on.outcome.differences[0])


def test_controller_whose_reference_moves_a_disc_replays_from_every_snapshot() -> None:
    """Rows of such a reference are longer than those of one without parameters, which a controller is built with."""

    def build() -> tuple[Controller, Rti]:
        model = with_obstacles(pioneer(N=6, N_u=4).model, [(3.0, 3.0, 0.2)])
        rti = Rti(Ocp(model, **(PAPER | SLEW | {"N": 6, "N_u": 4, "lh": 0.0})), compile=False)
        return Controller(rti, Timing(), compile=False), rti

    controller, rti = build()
    body, book, t = Lockstep(RobotSettings(PIONEER, np.zeros(5))), Book(controller), 0.1 * np.arange(60)
    rows, discs = np.stack([0.2 * t, 0 * t, 0 * t], axis=-1), np.tile(rti.ocp.model.p_nominal, (60, 1))
    discs[:, -3:-1] = np.stack([2.0 - 0.1 * t, 0 * t + 0.3], axis=-1)
    messages: list[Journal] = []
    for seq, p in enumerate((discs, np.zeros((60, 0)), discs), start=1):
        controller.receive_reference(Reference(1, seq, 0, 100 * MS, End.HOLD, rows, p))
        drive(controller, body, seq * 1.0)
        book.photograph(0)
        drive(controller, body, seq * 1.0 + 0.5)
        messages += book.messages(0)
    starts = [message.seq for message in messages if message.kind is JournalKind.SNAPSHOT]
    assert len(starts) == 3
    for start_seq in starts:
        on = Replay(*build())
        for _ in replay(on, messages, start_seq):
            pass
        assert on.outcome.samples > 3
        assert not on.outcome.differences, str(on.outcome.differences[0])


def test_weight_changed_by_a_billionth_is_found_at_its_first_sample_and_open_loop_goes_on() -> None:
    lived = live(KINDS["riccati"], samples=30, snapshots=(0, 12))
    first = replayed(KINDS["riccati"], lived.messages, R=np.array([1.0 + 1e-9, 1.0]))[0].differences[0]
    visible = replayed(KINDS["riccati"], lived.messages, R=np.array([1.05, 1.0]))[0].differences[0]
    assert first.seq == visible.seq, "plans before that are at their limits, with either weight"
    assert 0.0 < first.size < 1e-6
    assert first.field.startswith("u[")
    assert "was recorded as" in str(first)
    outcome, _ = replayed(KINDS["riccati"], lived.messages, R=np.array([50.0, 1.0]))
    assert outcome.samples == len(lived.commands)
    assert outcome.differing > 20
    assert outcome.size < 1.0, "each sample goes on from the recorded commands"


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**10], ids=["2^-20", "2^10"])
def test_difference_has_the_same_size_in_any_unit(unit: float) -> None:
    """Of inputs, and of a way to rest with its gain, whose unit is the input's over the state's."""
    x, u, K = np.full((3, 2), 0.3), np.full((3, 1), 0.1), np.full((1, 2), 2.0)

    def size(name: str, one: float) -> float:
        given = {"u": one * u, "u_rest": one * u, "x_rest": x, "K": one * K}
        recorded = Command(1, 1, 0, 1, 1, 0, 250 * MS, 0, Mode.TRACKING, QpStatus.SOLVED, 100 * MS, rest_period_ns=100 * MS, **given)
        scales = {"u": np.full(1, one), "u_rest": np.full(1, one), "x_rest": np.ones(2), "K": np.full((1, 2), one)}
        found = difference(recorded, replace(recorded, **{name: 1.25 * given[name]}), scales)
        assert found is not None
        return found.size

    for name in ("u", "u_rest", "x_rest", "K"):
        assert 0.0 < size(name, 1.0) == size(name, unit)
