# SPDX-License-Identifier: Apache-2.0
"""A robot among discs: the paper's robot in lockstep, its clearance measured on the plant every centisecond."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.message import End, Reference, Severity
from rti_mpc.control.controller import Controller, Timing
from rti_mpc.model.integrator import integrator
from rti_mpc.model.obstacle import with_obstacles
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import BUILT_IN_SOLVERS, Rti
from rti_mpc_service.config.build import build_ocp, build_rti, robot_settings, stage_parameters
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings
from tests.loop import drive
from tests.slow import slow_but

INF = np.inf
SPEED = 0.25  # m/s, of the reference along the x axis to 4 m
N, DT = 20, 0.1

pytestmark = pytest.mark.usefixtures("interpreted")


class Drive:
    """One drive along the axis, with discs (x, y, radius) that move by (vx, vy)."""

    def __init__(self, discs: list[tuple[float, float, float]], moving: list[tuple[float, float]], formulation: str, duration_s: float) -> None:
        model = with_obstacles(pioneer_3dx(), discs)
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


@pytest.mark.slow  # below it is the service that does
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_robot_passes_three_discs_one_of_them_moving_and_never_enters_one_by_more_than_a_millimetre(formulation: str) -> None:
    drive = Drive([(1.0, 0.05, 0.3), (2.0, -0.1, 0.3), (3.0, 1.0, 0.3)], [(0, 0), (0, 0), (0, -0.07)], formulation, duration_s=20.0)
    assert drive.worst_m > -1e-3
    np.testing.assert_allclose(drive.x[:2], [4.0, 0.0], rtol=0, atol=1e-3)  # and is where it was to go


@pytest.mark.slow  # below it is the service that does
def test_robot_stops_where_all_paths_are_blocked() -> None:
    drive = Drive([(1.5, -0.6, 0.35), (1.5, 0.0, 0.35), (1.5, 0.6, 0.35)], [(0, 0)] * 3, "simultaneous", duration_s=20.0)
    assert drive.worst_m > -1e-3
    assert np.abs(drive.x[3:]).max() < 1e-3  # m/s, rad/s: it stands
    assert drive.x[0] < 1.5


# The same through the service: discs in the robot's TOML, the controller's events.

SHIPPED = Path(__file__).parents[2] / "deploy" / "pioneer_3dx.toml"
PASSABLE = [("[1.0, 0.05]", 0.3, ""), ("[2.0, -0.1]", 0.3, ""), ("[3.0, 1.0]", 0.3, "velocity_m_s = [0.0, -0.07]")]
BLOCKED = [("[1.5, -0.6]", 0.35, ""), ("[1.5, 0.0]", 0.35, ""), ("[1.5, 0.6]", 0.35, "")]


def configured(path: Path, discs: list[tuple[str, float, str]]) -> Config:
    tables = [f"[[ocp.obstacles]]\ncentre_m = {centre}\nradius_m = {radius}\n{moving}\n" for centre, radius, moving in discs]
    path.write_text(SHIPPED.read_text().replace("psi = 0.05", "psi = 0.0") + "[sim]\nx0 = { y = 0.02 }\n" + "\n".join(tables))
    return load(path)


def along_the_axis(config: Config, seq: int = 1) -> Reference:
    """Reference along the axis to 4 m, and 20 s there."""
    t = DT * np.arange(500)
    y = np.stack([np.minimum(SPEED * t, 4.0), 0 * t, 0 * t], axis=-1)
    return Reference(1, seq, 0, round(1e9 * DT), End.HOLD, y, stage_parameters(config, t))


@pytest.mark.parametrize("solver", slow_but(BUILT_IN_SOLVERS, "riccati"))
def test_configured_discs_are_passed_and_nobody_is_told_that_the_way_is_blocked(solver: str, tmp_path: Path) -> None:
    config = configured(tmp_path / "robot.toml", PASSABLE)
    config = config.model_copy(update={"solver": config.solver.model_copy(update={"name": solver})})
    controller = Controller(build_rti(config), Timing())
    controller.receive_reference(along_the_axis(config))
    run = drive(controller, Lockstep(RobotSettings(**robot_settings(config))), 20.0)
    x, t = np.array(run.x), np.array(run.t_s)
    for (px, py), r, v in (((1.0, 0.05), 0.3, 0.0), ((2.0, -0.1), 0.3, 0.0), ((3.0, 1.0), 0.3, -0.07)):
        assert np.hypot(x[:, 0] - px, x[:, 1] - py - v * t).min() > r - 1e-3
    np.testing.assert_allclose(x[-1, :2], [4.0, 0.0], rtol=0, atol=2e-3)
    assert not [notice.code for notice in controller.notices() if notice.code in ("blocked", "free")]
    assert controller.ladder.fallbacks == 0


@pytest.mark.parametrize("noise_m", slow_but([0.0, 2e-3], 0.0))
def test_robot_whose_paths_are_all_blocked_says_so_once_and_once_that_it_is_free_again(noise_m: float, tmp_path: Path) -> None:
    config = configured(tmp_path / "robot.toml", BLOCKED)
    controller = Controller(build_rti(config), Timing())
    blocked = along_the_axis(config)
    controller.receive_reference(blocked)
    settings = RobotSettings(**robot_settings(config) | {"noise_std": [noise_m, noise_m, 0, 0, 0]})
    body = Lockstep(settings)
    drive(controller, body, 20.0)
    assert body.x[0] < 1.5
    assert noise_m > 0.0 or abs(body.x[3]) < 1e-3  # m/s: it stands, where noise lets it
    said = [(notice.severity, notice.code) for notice in controller.notices() if notice.code != "mode"]
    assert said == [(Severity.WARNING, "blocked")]
    gone = along_the_axis(config, seq=2)
    gone.p = np.tile(build_ocp(config).model.p_nominal, (len(gone.y), 1))
    gone.p[:, -5] = 9.0  # y of the second disc: a planner lets it go
    controller.receive_reference(gone)
    drive(controller, body, 45.0)
    np.testing.assert_allclose(body.x[:2], [4.0, 0.0], rtol=0, atol=2e-3 + 5 * noise_m)
    said += [(notice.severity, notice.code) for notice in controller.notices() if notice.code != "mode"]
    assert said == [(Severity.WARNING, "blocked"), (Severity.INFO, "free")]
