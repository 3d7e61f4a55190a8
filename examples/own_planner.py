# SPDX-License-Identifier: Apache-2.0
"""
Follow a walker whose way nobody knows: a planner of one's own sends a short reference twice a second, from what it sees; in lockstep.

    python examples/own_planner.py [own_planner.png]

On the bus the planner is a process of its own, and sends the same rows with `rti_mpc.adapter.PlannerAdapter`: see docs/adapter.md.
"""

import sys

import numpy as np

from rti_mpc import Controller, End, Reference, Timing
from rti_mpc_service.config.build import build_rti, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import robot_file
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.settings import RobotSettings

DURATION_S, REPLANNED_S = 60.0, 0.5
AHEAD_S, ROW_S = 4.0, 0.1  # how far a reference reaches, longer than the horizon, and the time between its rows
BEHIND_S = 1.0  # the robot is where the walker was


def walker(t: np.ndarray) -> np.ndarray:
    """Return where the walker is, shape ``(M, 2)``, in m; the planner does not know this."""
    return np.column_stack([0.25 * t, 1.0 * np.sin(0.2 * t)])


class Planner:
    """Remembers where the walker was seen, and believes that it goes on as in the last half second."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, np.ndarray]] = []
        self.sent = 0

    def see(self, t: float) -> None:
        """Note where the walker is."""
        self.seen.append((t, walker(np.array([t]))[0]))

    def plan(self, t: float, stamp_ns: int) -> Reference:
        """Return rows x, y, psi from now on: the walker's way of a second ago, and straight on where it is not known yet."""
        times, places = np.array([at for at, _ in self.seen]), np.array([place for _, place in self.seen])
        velocity = (places[-1] - places[-6]) / (times[-1] - times[-6])
        wanted = t + ROW_S * np.arange(round(AHEAD_S / ROW_S)) - BEHIND_S
        known = np.column_stack([np.interp(wanted, times, column) for column in places.T])
        rows = known + np.maximum(wanted - times[-1], 0.0)[:, None] * velocity
        along = np.gradient(rows, ROW_S, axis=0)
        self.sent += 1
        y = np.column_stack([rows, np.unwrap(np.arctan2(along[:, 1], along[:, 0]))])
        return Reference(1, self.sent, stamp_ns, round(1e9 * ROW_S), End.STOP, y, np.zeros((len(y), 0)))


def draw(driven: np.ndarray, file: str) -> None:
    """Draw both ways."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(8.4, 2.6), layout="constrained")
    axes = page.subplots()
    axes.plot(*walker(driven[:, 0]).T, linewidth=4.0, alpha=0.4, label="walker")
    axes.plot(*driven[:, 1:3].T, label="robot, a second behind")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="A reference every half second, from what was seen so far", aspect="equal", ylim=(-1.3, 2.3))
    axes.legend(loc="upper right", ncols=2)
    page.savefig(file, dpi=90)


config = load(robot_file("pioneer_3dx"))
settings = robot_settings(config)
controller, robot, planner = Controller(build_rti(config), Timing()), Lockstep(RobotSettings(**settings)), Planner()
driven = []
while robot.now_ns < 1e9 * DURATION_S:
    state = robot.tick()
    t = 1e-9 * robot.now_ns
    planner.see(t)
    driven.append((t, *robot.x[:2]))
    if t >= BEHIND_S and round(t / ROW_S) % round(REPLANNED_S / ROW_S) == 0:
        controller.receive_reference(planner.plan(t, robot.now_ns))
    command = controller.receive_state(state, robot.now_ns)
    if command is not None:
        robot.accept(command, robot.now_ns)
        controller.commit(command)
        controller.prepare()
run = np.array(driven)
off = np.hypot(*(run[:, 1:3] - walker(run[:, 0] - BEHIND_S)).T)
most = 1e3 * off[run[:, 0] > 0.5 * DURATION_S].max()
print(f"{most:.1f} mm off the walker's way at most, after {0.5 * DURATION_S:.0f} s and {planner.sent} references")
if len(sys.argv) > 1:
    draw(run, sys.argv[1])
