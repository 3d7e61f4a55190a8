# SPDX-License-Identifier: Apache-2.0
"""Angles and quaternions, of which several numbers are the same rotation."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.rotation import Rotations, whole_turns
from rti_mpc.signals import Signal

BODY = Rotations(6, (1,), ((2, 3, 4, 5),))  # a length, an angle, a quaternion


def vectors(seed: int, count: int = 200) -> Array:
    """A length, an angle within three turns and an attitude each, shape ``(count, 6)``."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(count, 6)) * [1.0, 6.0, 1.0, 1.0, 1.0, 1.0]
    x[:, 2:] /= np.linalg.norm(x[:, 2:], axis=1, keepdims=True)
    return np.asarray(x)


def rewritten(x: Array, seed: int) -> Array:
    """The same rotations with other whole turns and other signs."""
    rng = np.random.default_rng(seed)
    other = x.copy()
    other[:, 1] += 2 * np.pi * rng.integers(-3, 4, len(x))
    other[:, 2:] *= rng.choice([-1.0, 1.0], (len(x), 1))
    return other


@pytest.mark.parametrize("angle", [0.0, 3.0, -3.2, 7.0, 1e5, -1e8])
def test_whole_turns_leave_half_a_turn_at_most(angle: float) -> None:
    assert whole_turns(angle) / (2 * np.pi) == pytest.approx(round(angle / (2 * np.pi)))
    assert abs(angle - whole_turns(angle)) <= np.pi


@pytest.mark.parametrize("angle", [np.nan, np.inf, 1e300])
def test_there_are_no_whole_turns_in_what_is_no_angle(angle: float) -> None:
    assert whole_turns(angle) == 0.0


def test_rotations_are_found_among_components_by_name_where_all_of_a_quaternion_is_there() -> None:
    components = [Signal("r", "m"), Signal("psi", "rad", angle=True), *(Signal(name, "1") for name in "wxyz")]
    assert Rotations.of(components, ["wxyz", "abcd"]) == BODY
    assert Rotations.of(components[:-1], ["wxyz"]) == Rotations(5, (1,))


def test_difference_does_not_depend_on_how_rotations_are_written() -> None:
    a, b = vectors(1), vectors(2)
    plain = BODY.difference(a, b)
    np.testing.assert_allclose(BODY.difference(rewritten(a, 3), b), plain, rtol=0, atol=1e-12)
    assert np.abs(plain[:, 1]).max() <= np.pi
    assert np.linalg.norm(plain[:, 2:], axis=1).max() <= np.sqrt(2.0) + 1e-12  # of two unit vectors no more than a right angle apart
    np.testing.assert_array_equal(plain[:, 0], a[:, 0] - b[:, 0])


def test_a_vector_is_brought_near_in_place_as_its_difference_says_from_any_kind_of_view() -> None:
    for a, b in zip(vectors(1, 20), vectors(2, 20), strict=True):
        near = a.copy()
        BODY.bring_near(near.data, b.tolist())
        np.testing.assert_allclose(near - b, BODY.difference(a, b), rtol=0, atol=1e-12)


def test_rows_are_unwrapped_whatever_the_sensor_wrote() -> None:
    t = np.linspace(0.0, 20.0, 400)
    still = np.zeros_like(t)
    rows = np.column_stack([still, 3 * t, np.cos(t / 2), still, still, np.sin(t / 2), t])
    written = np.hstack([rewritten(rows[:, :6], 4), rows[:, 6:]])
    written[0] = rows[0]
    BODY.unwrap(written)
    np.testing.assert_allclose(written, rows, rtol=0, atol=1e-12)


def test_sensors_write_angles_within_half_a_turn_and_attitudes_of_length_1_with_w_above_0() -> None:
    for x in 1.02 * vectors(5):
        measured = x.copy()
        BODY.wrap(measured)
        assert -np.pi < measured[1] <= np.pi
        assert measured[2] >= 0.0
        assert np.linalg.norm(measured[2:]) == pytest.approx(1.0, abs=1e-12)
        assert BODY.difference(measured, x)[:2] == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize(("q", "fits"), [([0.0, 0, 0, 0], False), ([1.0, 1, 1, 1], False), ([1.02, 0.02, 0, 0], True), ([-1.0, 0, 0, 0], True)])
def test_attitude_that_no_sensor_has_measured_is_told(q: list[float], fits: bool) -> None:
    said = BODY.misfit(np.array([0.0, 0.0, *q]))
    assert said == ("" if fits else f"a quaternion must have length 1, got {list(map(float, q))}")


def test_zero_is_left_as_it_is() -> None:
    zero = [0.0] * 6
    BODY.normalize(zero)
    assert zero == [0.0] * 6


def test_attitudes_are_completed_by_their_real_part_and_shortened_only_where_they_must_be() -> None:
    whole = BODY.completed(np.array([5.0, 9.0, -3.0, 0.6, 0.0, 0.0]))
    np.testing.assert_allclose(whole, [5.0, 9.0, -0.8, 0.6, 0.0, 0.0], rtol=0, atol=1e-15)
    np.testing.assert_allclose(BODY.completed(np.array([0.0, 0.0, 1.0, 3.0, 4.0, 0.0]))[2:], [0.0, 0.6, 0.8, 0.0], rtol=0, atol=1e-15)


def test_an_angle_in_degrees_is_the_same_after_360_of_them() -> None:
    joint = Rotations.of([Signal("q", "deg", angle=True), Signal("r", "rad", angle=True)])
    a, b = np.array([[170.0, 3.0]]), np.array([[-170.0, -3.0]])
    np.testing.assert_allclose(joint.difference(a, b), [[-20.0, 6.0 - 2 * np.pi]], rtol=0, atol=1e-12)
    near = a[0].copy()
    joint.bring_near(near, b[0])
    np.testing.assert_allclose(near, [-190.0, 3.0 - 2 * np.pi], rtol=0, atol=1e-12)
    measured = np.array([540.0 + 1.0, 0.0])
    joint.wrap(measured)
    assert measured[0] == pytest.approx(-179.0)
    rows = np.array([[179.0, 0.0], [-179.0, 0.0], [-177.0, 0.0]])
    joint.unwrap(rows)
    assert rows[:, 0].tolist() == [179.0, 181.0, 183.0]
