# SPDX-License-Identifier: Apache-2.0
"""Sensor: noise, delay and dropout are reproduced by their seed."""

from __future__ import annotations

import numpy as np

from rti_mpc.array import Array
from rti_mpc.rotation import Rotations
from rti_mpc_sim.sensor import Sensor

STD = np.array([0.01, 0.0])


def measured(sensor: Sensor, n: int = 2000) -> tuple[list[int], Array]:
    states = []
    for i in range(n):
        sensor.measure(np.array([1.0, 4.0]), i)
        while (state := sensor.take(i)) is not None:
            states.append(state)
    return [state.seq for state in states], np.array([state.x for state in states])


def test_seeded_noise_and_dropout_repeat() -> None:
    first, second, other = (measured(Sensor(1, STD, Rotations(2), dropout=0.1, seed=seed)) for seed in (3, 3, 4))
    assert first[0] == second[0]
    np.testing.assert_array_equal(first[1], second[1])
    assert first[0] != other[0]


def test_noise_has_the_standard_deviation_asked_for() -> None:
    _, x = measured(Sensor(1, STD, Rotations(2)))
    np.testing.assert_allclose(x.std(axis=0), STD, rtol=0.06)
    np.testing.assert_allclose(x.mean(axis=0), [1.0, 4.0], atol=1e-3)


def test_lost_states_leave_gaps_in_the_sequence() -> None:
    seqs, _ = measured(Sensor(1, STD, Rotations(2), dropout=0.25))
    assert 0.7 < len(seqs) / 2000 < 0.8
    assert seqs[-1] > 1990


def test_angles_wrap_and_other_states_do_not() -> None:
    sensor = Sensor(1, np.zeros(4), Rotations(4, (1, 2, 3)))
    sensor.measure(np.array([4.0, 4.0, np.pi, -np.pi]), 0)
    state = sensor.take(0)
    assert state is not None
    np.testing.assert_allclose(state.x, [4.0, 4.0 - 2 * np.pi, np.pi, np.pi])


def test_delayed_state_keeps_the_stamp_of_its_measurement() -> None:
    sensor = Sensor(1, STD, Rotations(2), delay_ns=30)
    sensor.measure(np.zeros(2), 100)
    assert sensor.due_ns == 130
    assert sensor.take(129) is None
    state = sensor.take(130)
    assert state is not None
    assert state.stamp_ns == 100
    assert sensor.take(1000) is None
