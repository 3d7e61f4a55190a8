# SPDX-License-Identifier: Apache-2.0
"""Guard while a stop is latched: it passes ways to rest, and rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rti_mpc.array import Array
from tests.contract.scene import BOUND, FULL, LIMITS, MS, Scene
from tests.slow import slow_but

REASON = "asked for by ada@lab"
WAY = np.array([max(0.0, 0.25 - 0.25 * k) * np.array([1.0, 0.6]) for k in range(20)])  # of a controller that is stopped at FULL


def test_latched_guard_passes_the_way_to_rest_and_then_rest(scene: Scene) -> None:
    scene.drive(1000)
    scene.guard.latch(REASON, scene.local_ns)
    passed = scene.send(WAY)
    assert passed is not None
    np.testing.assert_array_equal(passed.u, WAY)
    scene.wait(300)
    assert not scene.actuator.u.any()
    for _ in range(10):
        assert scene.send(np.zeros(2)) is not None
        scene.wait(100)
    assert "command_stopped" not in scene.said()


@pytest.mark.parametrize(
    "rows",
    [
        np.tile(FULL, (20, 1)),  # goes on
        np.vstack([WAY[:1], WAY[:-1]])[:4] + 0.01,  # does not arrive
        np.vstack([WAY[:2], np.tile([0.05, 0.0], (10, 1)), WAY[-1:]]),  # moves again
        np.vstack([0.8 * WAY[:1], -0.1 * WAY[:1], WAY[2:]]),  # goes beyond rest
        np.vstack([FULL * np.array([1.0, 1.1]), WAY]),  # turns faster first
    ],
    ids=["goes on", "does not arrive", "moves again", "goes beyond rest", "turns faster"],
)
def test_latched_guard_passes_nothing_but_ways_to_rest_and_brakes_in_time_if_none_comes(scene: Scene, rows: Array) -> None:
    scene.drive(1000)
    scene.said()
    scene.guard.latch(REASON, scene.local_ns)
    assert scene.send(rows) is None
    assert scene.said() == ["stop", "command_stopped"]
    for _ in range(5):
        scene.send(rows)
        scene.wait(100)
    assert not scene.actuator.u.any(), "the last plan before has ended, and the guard has braked"
    assert scene.actuator.counters.starved == 0
    assert scene.send(rows) is None


def test_controller_that_ramps_down_anew_with_every_command_does_not_drive_on_against_a_latched_guard(scene: Scene) -> None:
    """Each of its plans leads to rest, but only the first row of each would act."""
    scene.drive(1000)
    scene.guard.latch(REASON, scene.local_ns)
    stubborn = np.vstack([FULL, FULL - [0.25, 0.3], WAY[1:]])
    assert scene.send(stubborn) is not None, "nearer to rest in every row"
    for _ in range(20):
        scene.wait(100)
        scene.send(stubborn)
    assert not scene.actuator.u.any()
    times, inputs = scene.trace()
    moving = times[np.abs(inputs).max(axis=1) > 0.0]
    assert moving.max() - 2000 <= 1e3 * LIMITS.settling_s + 200 + 30, "once it should stand, the guard brakes; it looks every 10 ms"


@pytest.mark.parametrize("seed", slow_but(range(4), 0, 1))
def test_nothing_moves_a_robot_away_from_rest_while_a_stop_is_latched_whatever_is_commanded(seed: int) -> None:
    """Ways to rest, late and early ones, and random plans."""
    rng = np.random.default_rng(seed)
    scene = Scene().ready()
    passed = 0
    for _ in range(25):
        scene.drive(600, rng.uniform(-BOUND, BOUND))
        scene.wait(int(rng.integers(0, 8)) * 10)
        scene.guard.latch(REASON, scene.local_ns)
        scene.inputs.clear()
        for _ in range(15):
            factors = rng.choice([rng.uniform(0.5, 1.0), 1.1, -0.2]) * np.append(np.linspace(1.0, 0.0, int(rng.integers(2, 6))), np.zeros(4))
            rows = np.outer(factors, scene.actuator.u) + (rng.uniform(-0.02, 0.02, 2) if rng.random() < 0.3 else 0.0)
            passed += scene.send(np.clip(rows, -BOUND, BOUND), stamp_ns=scene.now_ns - int(rng.integers(-3, 9)) * 10 * MS) is not None
            scene.wait(int(rng.integers(1, 11)) * 10)
        scene.wait(600)
        way = np.abs(scene.inputs)
        assert (np.diff(way, axis=0) <= 1e-6).all(), "the rounding that the guard allows"
        assert not scene.actuator.u.any()
        scene.guard.enable()
        scene.wait(-scene.now_ns // MS % 100)
    assert passed > 10


def test_controller_that_knows_of_no_stop_does_not_drive_a_robot_whose_guard_was_restarted_latched(scene: Scene) -> None:
    scene.power_up()
    scene.guard.latch(REASON, scene.local_ns)
    scene.ready()
    for _ in range(10):
        assert scene.send(FULL * 0.5) is None
        scene.wait(100)
    assert not scene.actuator.u.any()
    scene.guard.enable()
    assert scene.send(FULL * 0.5) is not None
    assert scene.said()[-2:] == ["enable", "guard_passing"]


def test_latch_before_the_first_state_and_across_another_life_of_the_robot_holds() -> None:
    scene = Scene()
    scene.guard.latch(REASON, scene.local_ns)
    scene.ready()
    assert scene.send(FULL * 0.5) is None
    assert scene.send(np.zeros(2)) is not None
    scene.restart()
    assert scene.send(FULL * 0.5) is None
    assert scene.send(np.zeros(2)) is not None


def test_guard_that_starts_latched_passes_rest_alone_from_the_time_on_that_commands_pass() -> None:
    """Whatever is commanded by then of a way to rest has had its time, and no clock of the robot was known when it was latched."""
    scene = Scene()
    scene.guard.latch(REASON, scene.local_ns)
    scene.ready().heard = False
    scene.wait(100)
    assert scene.state is not None
    scene.guard.receive_state(replace(scene.state, u=0.5 * FULL, command_epoch=scene.leader, command_seq=1), scene.local_ns)
    assert scene.send(0.5 * WAY) is None
    assert scene.send(np.zeros(2)) is not None
