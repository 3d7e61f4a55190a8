# SPDX-License-Identifier: Apache-2.0
"""Envelope of the inputs, the last check of every plan."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.control.envelope import Envelope
from tests.problems import pioneer
from tests.slow import slow_but

STEP = np.array([0.25, 0.4])
BOUND = np.array([0.5, 0.745])


@pytest.fixture(scope="module")
def envelope() -> Envelope:
    return Envelope(pioneer(N=8, N_u=6), compile=False)


def around(u: Array) -> tuple[Array, Array]:
    """Return the limits of the first two rows after an input that acts until then."""
    return np.tile(u - STEP, (2, 1)), np.tile(u + STEP, (2, 1))


def test_plan_that_is_inside_passes_unchanged_and_its_held_inputs_are_expanded(envelope: Envelope) -> None:
    plan = np.cumsum(np.full((6, 2), 0.05), axis=0)
    rows = envelope.fit(plan, around(np.zeros(2)))
    np.testing.assert_array_equal(rows, plan[[0, 1, 2, 3, 4, 5, 5, 5]])


@pytest.mark.parametrize("blocks", [[2, 1, 1, 1, 2, 1], [1, 1, 1, 2, 1, 2]])
def test_inputs_are_held_over_their_blocks(blocks: list[int]) -> None:
    envelope, plan = Envelope(pioneer(N=8, blocks=blocks), compile=False), np.cumsum(np.full((6, 2), 0.05), axis=0)
    np.testing.assert_array_equal(envelope.fit(plan, around(np.zeros(2))), np.repeat(plan, blocks, axis=0))


@pytest.mark.parametrize("plans", slow_but([400, 2000], 400))
@pytest.mark.parametrize("blocks", [[1, 1, 1, 1, 1, 3], [3, 1, 1, 1, 1, 1]])
def test_any_plan_comes_out_inside(blocks: list[int], plans: int) -> None:
    envelope, rng = Envelope(pioneer(N=8, blocks=blocks), compile=False), np.random.default_rng(1)
    for _ in range(plans):
        acting = rng.uniform(-BOUND, BOUND)
        plan = rng.choice([0.0, 1.0, 1e300]) * rng.standard_normal((6, 2))
        for rows in (
            envelope.fit(plan, around(acting)),
            envelope.refit(envelope.fit(plan, around(acting)), 3, around(acting)),
            envelope.ramp(around(acting)),
        ):
            assert rows.shape == (8, 2)
            assert np.all(np.abs(rows) <= BOUND)
            assert np.all(np.abs(np.diff(np.vstack([acting, rows]), axis=0)) <= (1 + 1e-14) * STEP)  # rounding
            assert np.all(np.abs(rows[1] - acting) <= (1 + 1e-14) * STEP)


def test_fresh_plan_obeys_the_bounds_of_its_stages_and_what_replaces_it_the_widest() -> None:
    ubu = np.column_stack([np.linspace(0.5, 0.1, 8), np.full(8, 0.7)])
    lbdu = np.column_stack([np.linspace(-0.25, -0.1, 8), np.full(8, -0.4)])
    envelope = Envelope(pioneer(N=8, ubu=ubu, lbdu=lbdu), compile=False)
    rows = envelope.fit(np.full((8, 2), 0.6), around(np.full(2, 0.4)))
    np.testing.assert_allclose(rows[:, 0], ubu[:, 0], rtol=0, atol=1e-15)
    falling = envelope.fit(np.linspace([0.5, 0.7], [-5.0, 0.7], 8), around(np.full(2, 0.5)))
    assert np.all(np.diff(falling[:, 0]) >= lbdu[1:, 0] - 1e-15)
    shifted = envelope.refit(np.full((8, 2), 0.5), 2, around(np.full(2, 0.4)))
    np.testing.assert_array_equal(shifted[:, 0], 0.5)
    envelope.take("ubu", ubu - 0.05)
    np.testing.assert_allclose(envelope.limits["ubu"], [0.45, 0.65], rtol=0, atol=1e-15)
    np.testing.assert_allclose(envelope.fit(np.full((8, 2), 0.6), around(np.full(2, 0.4)))[:, 0], ubu[:, 0] - 0.05, rtol=0, atol=1e-15)


def test_ramp_goes_to_rest_as_fast_as_it_may(envelope: Envelope) -> None:
    rows = envelope.ramp(around(np.array([0.5, -0.3])))
    np.testing.assert_allclose(rows[:, 0], [0.25, 0.25, 0, 0, 0, 0, 0, 0])  # the second row not before the first has surely arrived
    np.testing.assert_array_equal(rows[:, 1], 0.0)


def test_earlier_plan_is_shifted_and_its_last_row_repeated(envelope: Envelope) -> None:
    plan = np.cumsum(np.full((8, 2), 0.05), axis=0)
    np.testing.assert_array_equal(envelope.refit(plan, 2, around(plan[2])), plan[[2, 3, 4, 5, 6, 7, 7, 7]])


def test_limits_are_obeyed_as_they_are(envelope: Envelope) -> None:
    envelope = Envelope(pioneer(N=8), compile=False)
    envelope.limits["ubu"][:] = 0.1
    rows = envelope.fit(np.full((8, 2), 0.3), around(np.array([0.5, 0.0])))
    np.testing.assert_allclose(rows[:, 0], [0.25, 0.25, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])  # slew limits before bounds
    np.testing.assert_allclose(rows[:, 1], 0.1)
