# SPDX-License-Identifier: Apache-2.0
"""The race car of `examples/race.py` laps three tracks: faster than at constant speed on the centre line, never off the track."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from rti_mpc.reference.tracks import TRACKS, track
from rti_mpc.rti.rti import Rti

EXAMPLE = Path(__file__).parents[2] / "examples" / "race.py"

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def race() -> Iterator[ModuleType]:
    spec = importlib.util.spec_from_file_location("race", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["race"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["race"]


@pytest.fixture(scope="module")
def controllers(race: ModuleType) -> tuple[Rti, Rti]:
    return race.racing(), race.tracking()


@pytest.mark.parametrize("name", TRACKS)
def test_race_car_laps_a_track_faster_than_at_the_best_constant_speed_and_never_leaves_it(
    race: ModuleType, controllers: tuple[Rti, Rti], name: str
) -> None:
    following, centre = controllers
    path = track(name).limited(race.LIMITS)
    lap = race.follow(following, path)
    speed, constant = race.fastest_constant(centre, path)
    print(f"\n{name}: {lap.time_s:.2f} s, {constant.time_s:.2f} s at {speed:.2f} m/s; {lap.edge_m:.3f} m from an edge, {lap.lateral:.2f} m/s^2")
    assert lap.unusable == 0
    assert constant.lateral <= 1.01 * race.LATERAL  # it is measured between samples of the controller, too
    assert lap.lateral <= 1.01 * race.LATERAL
    assert lap.edge_m > race.HALF_CAR_M - 0.01  # m, of the true centre of the car; its model has more grip
    assert lap.time_s < 0.8 * constant.time_s


def test_car_that_may_not_cut_corners_takes_as_long_as_the_profile_of_the_centre_line(race: ModuleType) -> None:
    path = track("chicane").limited(race.SpeedLimits(7.0, race.LATERAL, 4.0, 5.0))
    following = race.racing()
    following.retune({"Q": race.np.diag([5.0, 20.0, 1.0, 0.0])})  # contour, lag, pace, no drift
    lap = race.follow(following, path)
    assert lap.time_s == pytest.approx(path.time_s, rel=0.03)
    assert lap.contour_m < 0.15  # m
