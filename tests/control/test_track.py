# SPDX-License-Identifier: Apache-2.0
"""A reference on the controller's stages: interpolated, unwrapped, never extrapolated."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import End, Reference
from rti_mpc.control.track import Track
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from tests.problems import beacon

MS = 1_000_000
N = 5


def reference(y: Array, p: Array | None = None, stamp_ms: int = 0, period_ms: int = 20, end: End = End.HOLD) -> Reference:
    return Reference(1, 1, stamp_ms * MS, period_ms * MS, end, y, np.zeros((len(y), 0)) if p is None else p)


def turning(rows: int, wrapped: bool) -> Array:
    """A heading that goes from 2.5 through pi to 4, and positions equal to the time."""
    psi = np.linspace(2.5, 4.0, rows)
    y = np.column_stack([np.arange(rows), -np.arange(rows), psi])
    if wrapped:
        y[:, 2] = np.pi - np.remainder(np.pi - psi, 2 * np.pi)
    return y


def follow(track: Track, message: Reference, stamp_ns: int = 0) -> None:
    track.arriving = message, track.lay_out(message)
    track.anchor(stamp_ns)


def looked_up(y: Array, t_ms: float, **options: int) -> Array:
    track = Track(pioneer_3dx(), N, 100 * MS)
    follow(track, reference(y, **options))
    track.look_up(round(t_ms * MS))
    return track.y_ref.copy()


def test_nothing_is_followed_before_a_reference_and_after_it_is_cleared() -> None:
    track = Track(pioneer_3dx(), N, 100 * MS)
    assert not track.loaded
    assert track.ended(0) is None
    follow(track, reference(turning(3, wrapped=False)))
    assert track.loaded
    track.clear()
    assert not track.loaded


def test_rows_are_those_of_nodes_1_to_N() -> None:
    np.testing.assert_allclose(looked_up(turning(100, wrapped=False), t_ms=40)[:, 0], [7, 12, 17, 22, 27])


def test_time_between_rows_is_interpolated() -> None:
    np.testing.assert_allclose(looked_up(turning(100, wrapped=False), t_ms=45)[:, 0], [7.25, 12.25, 17.25, 22.25, 27.25])


def test_slow_reference_is_interpolated_too() -> None:
    np.testing.assert_allclose(looked_up(turning(10, wrapped=False), t_ms=0, period_ms=400)[:, 1], [-0.25, -0.5, -0.75, -1.0, -1.25])


@pytest.mark.parametrize(("t_ms", "row"), [(-5000, 0), (10_000, 9)])
def test_reference_is_held_before_its_first_and_after_its_last_row(t_ms: float, row: int) -> None:
    y = turning(10, wrapped=False)
    rows = looked_up(y, t_ms)
    np.testing.assert_allclose(rows[:, 0], np.full(N, row))
    np.testing.assert_allclose(np.ptp(rows, axis=0), 0.0)


def test_heading_that_wraps_is_the_same_as_one_that_does_not() -> None:
    for t_ms in (0, 333, 690):
        np.testing.assert_allclose(looked_up(turning(60, wrapped=True), t_ms), looked_up(turning(60, wrapped=False), t_ms), atol=1e-12)


def test_reference_ends_with_its_last_row_and_says_what_then() -> None:
    track = Track(pioneer_3dx(), N, 100 * MS)
    follow(track, reference(turning(11, wrapped=False), stamp_ms=1000, end=End.STOP))
    assert track.ended(1200 * MS) is None
    assert track.ended(1200 * MS + 1) is End.STOP


def test_parameters_are_looked_up_for_all_nodes_and_nominal_where_there_are_none() -> None:
    model = beacon().model
    track = Track(model, N, 100 * MS)
    y = np.zeros((20, 2))
    p = np.column_stack([np.arange(20.0), np.full(20, 3.0)])
    follow(track, reference(y, p, period_ms=100))
    track.look_up(250 * MS)
    np.testing.assert_allclose(track.p[:, 0], 2.5 + np.arange(6))
    follow(track, reference(y))
    track.look_up(250 * MS)
    np.testing.assert_allclose(track.p, np.tile(model.p_nominal, (6, 1)))


def test_single_row_is_a_point_to_go_to() -> None:
    np.testing.assert_allclose(looked_up(np.array([[1.0, 2.0, 0.3]]), 777), np.tile([1.0, 2.0, 0.3], (N, 1)))


def test_message_is_not_changed_and_may_change_later() -> None:
    y = turning(60, wrapped=True)
    before = y.copy()
    message = reference(y)
    track = Track(pioneer_3dx(), N, 100 * MS)
    follow(track, message)
    np.testing.assert_array_equal(message.y, before)
    track.look_up(0)
    first = track.y_ref.copy()
    y[:] = 9.0
    track.look_up(0)
    np.testing.assert_array_equal(track.y_ref, first)


def test_compiled_and_interpreted_rows_are_the_same_bit_for_bit() -> None:
    model, rng = beacon().model, np.random.default_rng(6)
    y, p = rng.normal(size=(40, model.ny)), rng.normal(size=(40, model.np_))
    tracks = [Track(model, N, 100 * MS, compile=compile) for compile in (False, True)]
    for parameters in (None, p):
        for track in tracks:
            follow(track, reference(y, parameters, stamp_ms=3))
        for t_ns in rng.integers(-200 * MS, 1000 * MS, size=50):
            for track in tracks:
                track.look_up(int(t_ns))
            assert all(track.y_ref.tobytes() + track.p.tobytes() == tracks[0].y_ref.tobytes() + tracks[0].p.tobytes() for track in tracks)


@pytest.mark.parametrize(
    ("y", "p", "said"),
    [
        (np.zeros((4, 3)), np.zeros((3, 7)), "as many rows of parameters as of outputs, got shapes (4, 3) and (3, 7)"),
        (np.zeros(3), np.zeros((1, 0)), "tables of outputs and of parameters, got shapes (3,) and (1, 0)"),
        (np.zeros((4, 3)), np.zeros(0), "tables of outputs and of parameters, got shapes (4, 3) and (0,)"),
    ],
)
def test_tables_that_do_not_fit_each_other_are_told(y: Array, p: Array, said: str) -> None:
    track = Track(pioneer_3dx(), N, 100 * MS, compile=False)
    assert said in track.misfit(Reference(1, 1, 0, 20 * MS, End.HOLD, y, p), 7)
