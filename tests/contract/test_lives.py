# SPDX-License-Identifier: Apache-2.0
"""Lives of the robot: which one is believed, by the epochs of its states alone."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from rti_mpc.contract.lives import Heard, Lives

MS = 1_000_000
STALE_S, SETTLING_S = 0.25, 0.5
OURS, BEGINS, OTHER = Heard.OURS, Heard.BEGINS, Heard.OTHER


class Scene:
    """Two decisions could differ: what is heard is written as (epoch, ms) pairs."""

    def __init__(self, rate: float = 1.0) -> None:
        self.lives = Lives(STALE_S, SETTLING_S)
        self.rate = rate
        self.now_ms = 0.0
        self.told: list[str] = []

    def hear(self, epoch: int, after_ms: float = 100.0) -> Heard:
        self.now_ms += after_ms
        heard = self.lives.judge(epoch, round(self.now_ms * MS), self.rate)
        if self.lives.notice is not None:
            self.told.append(self.lives.notice.text)
        return heard


@pytest.fixture
def scene() -> Scene:
    """A robot of epoch 7 has lived for half a second."""
    scene = Scene()
    assert [scene.hear(7) for _ in range(5)] == [BEGINS, OURS, OURS, OURS, OURS]
    assert not scene.told
    return scene


@pytest.mark.parametrize("epoch", [8, 6, 2**63])
def test_second_epoch_within_the_stale_time_is_a_second_robot_and_is_told_once_by_both_names(scene: Scene, epoch: int) -> None:
    assert scene.hear(epoch, 50) is OTHER
    assert scene.lives.disputed
    for _ in range(3):
        assert (scene.hear(7, 50), scene.hear(epoch, 50)) == (OURS, OTHER)
    assert scene.lives.disputed
    (text,) = scene.told
    assert "7" in text
    assert str(epoch) in text
    assert "stop one of them" in text
    assert "0.5 s" in text


def test_life_before_goes_on_once_it_alone_was_heard_for_long_enough_for_anything_to_settle(scene: Scene) -> None:
    scene.hear(9, 50)
    assert [(scene.hear(7), scene.lives.disputed) for _ in range(6)] == [(OURS, True)] * 5 + [(OURS, False)]
    assert scene.hear(9) is OTHER
    assert len(scene.told) == 2, "another time is told again"


def test_second_robot_that_stays_alone_is_believed_after_the_same_time(scene: Scene) -> None:
    assert [scene.hear(8) for _ in range(7)] == [OTHER] * 6 + [BEGINS]
    assert not scene.lives.disputed
    assert scene.hear(8) is OURS


@pytest.mark.parametrize("epoch", [8, 6])
def test_robot_that_was_silent_is_restarted_and_nobody_is_warned(scene: Scene, epoch: int) -> None:
    assert [scene.hear(epoch, 1000 if i == 0 else 100) for i in range(4)] == [OTHER] * 3 + [BEGINS]
    assert not scene.told


def test_forged_state_in_a_silence_of_the_robot_displaces_nothing(scene: Scene) -> None:
    assert scene.hear(9, 400) is OTHER
    assert scene.lives.rival == 9
    assert not scene.lives.disputed
    assert scene.hear(7, 300) is OURS
    assert (scene.lives.rival, scene.told) == (None, [])


def test_robot_heard_again_right_after_a_second_one_is_two_robots_too(scene: Scene) -> None:
    assert scene.hear(9, 400) is OTHER
    assert scene.hear(7, 100) is OURS
    assert scene.lives.disputed


def test_two_new_ones_after_a_silence_are_two_robots_and_neither_is_believed(scene: Scene) -> None:
    scene.hear(8, 1000)
    assert [scene.hear(epoch) for _ in range(20) for epoch in (9, 8)] == [OTHER] * 40
    assert scene.lives.disputed
    assert len(scene.told) == 1
    assert [scene.hear(9) for _ in range(8)][-1] is OURS


@pytest.mark.parametrize("alive", [True, False])
def test_flood_of_ever_new_epochs_moves_nobody_and_takes_no_memory(scene: Scene, alive: bool) -> None:
    rng = np.random.default_rng(1)
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    for i in range(2000):
        assert scene.hear(int(rng.integers(2**62)), 1) is OTHER
        if alive and i % 100 == 0:
            assert scene.hear(7, 0) is OURS
        assert scene.lives.disputed
        scene.told.clear()
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 4096
    assert [(scene.hear(7), scene.lives.disputed) for _ in range(8)][-1] == (OURS, False)


@pytest.mark.parametrize("rate", [0.01, 0.5, 4.0, 100.0])
def test_times_are_the_robots(rate: float) -> None:
    scene = Scene(rate)
    for _ in range(5):
        scene.hear(7, 100 / rate)
    scene.hear(8, 50 / rate)
    assert [(scene.hear(7, 100 / rate), scene.lives.disputed) for _ in range(6)] == [(OURS, True)] * 5 + [(OURS, False)]
