# SPDX-License-Identifier: Apache-2.0
"""A robot among discs: the paper's robot in lockstep, its clearance measured on the plant every centisecond."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.integrator import integrator
from rti_mpc.obstacle import with_obstacles
from rti_mpc.ocp import Ocp
from rti_mpc.pioneer_3dx import pioneer_3dx
from rti_mpc.rti import Rti

INF = np.inf
SPEED = 0.25  # m/s, of the reference along the x axis to 4 m
N, DT = 20, 0.1


class Drive:
    """One drive along the axis, with discs (x, y, radius) that move by (vx, vy)."""

    def __init__(self, discs: list[tuple[float, float, float]], moving: list[tuple[float, float]], formulation: str, duration_s: float) -> None:
        model, clearance = with_obstacles(pioneer_3dx(), discs)
        ocp = Ocp(
            model,
            N=N,
            dt=DT,
            Q=[1, 1, 0],
            R=[1, 1],
            delta=28,
            lambda_=0.8,
            lbu=[-0.5, -0.745],
            ubu=[0.5, 0.745],
            lbdu=[-0.25, -0.4],
            ubdu=[0.25, 0.4],
            lbx=[-INF, -INF, -INF, -0.5, -0.745],
            ubx=[INF, INF, INF, 0.5, 0.745],
            h_expr=clearance,
            lh=0.0,
        )
        plant, p = integrator(pioneer_3dx(), "rk4", 2), np.array(pioneer_3dx().p_nominal)
        rti = Rti(ocp, formulation=formulation)
        self.x: Array = np.array([0.0, 0.02, 0.0, 0.0, 0.0])
        self.worst_m = INF
        rti.reset(self.x, np.zeros(2))
        for k in range(round(duration_s / DT)):
            t = DT * np.arange(k, k + N + 1)
            y_ref = np.stack([np.minimum(SPEED * t, 4.0), 0 * t, 0 * t], axis=-1)[1:]
            parts = [np.stack([x + vx * t, y + vy * t, r + 0 * t], axis=-1) for (x, y, r), (vx, vy) in zip(discs, moving, strict=True)]
            rti.prepare(y_ref, np.hstack([np.tile(p, (N + 1, 1)), *parts]), shift=k > 0)
            assert rti.feedback(self.x).usable
            for i in range(1, 11):
                self.x = np.array(plant(self.x, rti.u[0], p, DT / 10)).ravel()
                now = t[0] + i * DT / 10
                for (x, y, r), (vx, vy) in zip(discs, moving, strict=True):
                    self.worst_m = min(self.worst_m, float(np.hypot(self.x[0] - x - vx * now, self.x[1] - y - vy * now) - r))


@pytest.mark.parametrize("formulation", ["simultaneous", "sequential"])
def test_robot_passes_three_discs_one_of_them_moving_and_never_enters_one_by_more_than_a_millimetre(formulation: str) -> None:
    drive = Drive([(1.0, 0.05, 0.3), (2.0, -0.1, 0.3), (3.0, 1.0, 0.3)], [(0, 0), (0, 0), (0, -0.07)], formulation, duration_s=20.0)
    assert drive.worst_m > -1e-3
    np.testing.assert_allclose(drive.x[:2], [4.0, 0.0], rtol=0, atol=1e-3)  # and is where it was to go


def test_robot_stops_where_all_paths_are_blocked() -> None:
    drive = Drive([(1.5, -0.6, 0.35), (1.5, 0.0, 0.35), (1.5, 0.6, 0.35)], [(0, 0)] * 3, "simultaneous", duration_s=20.0)
    assert drive.worst_m > -1e-3
    assert np.abs(drive.x[3:]).max() < 1e-3  # m/s, rad/s: it stands
    assert drive.x[0] < 1.5
