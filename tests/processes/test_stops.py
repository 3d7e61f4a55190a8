# SPDX-License-Identifier: Apache-2.0
"""
Stops of robots that their inputs at rest do not stop, among real processes, as the robot itself records them.

An operator stops it; its controller is killed behind its guard; then its guard is
killed. Each time it comes to rest and stays there, no farther away than `check` has printed.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.limits import MAX_VALID_NS
from rti_mpc.contract.message import State
from tests.movers import CURRENT, following, path_file, toml
from tests.processes.system import ANSWERED, System, rti_mpc, until

STILL = 1e-3  # m/s, rad/s
STANDING_S = 1.0  # robot time for which it then stands
ROUNDING = 1.01  # of what is printed: three digits
pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Driven:
    """
    How a robot of `tests.movers` is driven.

    Attributes:
        speed: Least speed of its outputs, in their unit / s, from which it is stopped.
        letter: What it does at rest, its inputs held.
        more: More of its configuration.
    """

    speed: float
    letter: str
    more: str = ""


ROBOTS = {
    "car": Driven(0.9, "b"),  # at 1 m/s
    "bicycle": Driven(0.9, "b"),
    "arm": Driven(0.5, "c"),
    "quadrotor": Driven(0.5, "c"),
    "floating": Driven(0.4, "b", CURRENT),  # in a current of 0.25 m/s
}


class Recorded(System):
    """A system whose robot records its outputs."""

    @property
    def names(self) -> list[str]:
        return [output.name for output in following(self.keys.robot).outputs]

    def moves(self, speed: float) -> None:
        """Wait until the robot moves at a speed."""
        last: list[tuple[int, Array]] = []
        states = [state.name for state in following(self.keys.robot).states]
        columns = [states.index(name) for name in self.names]

        def fast(state: State) -> bool:
            last.append((state.stamp_ns, state.x[columns]))
            (before_ns, before), (now_ns, now) = last[-2:] if len(last) > 1 else (last[0], last[0])
            return now_ns > before_ns and bool(np.linalg.norm(now - before) > speed * 1e-9 * (now_ns - before_ns))

        self.state(fast)

    def record(self, from_ns: int) -> tuple[Array, Array]:
        """Times since an instant, s, shape ``(n,)``, and outputs, shape ``(n, k)``."""
        with (self.folder / "robot.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if None not in row.values() and row["starved"]]
        data = np.array([[float(row[name]) for name in ("stamp_ns", *self.names)] for row in rows])
        data = data[data[:, 0] >= from_ns]
        return 1e-9 * (data[:, 0] - from_ns), data[:, 1:]

    def rests(self, from_ns: int, within_s: float) -> tuple[float, Array]:
        """Wait for rest that lasts for a while; return how long it took, and how far each output came from where it was."""

        def rested() -> tuple[float, Array] | None:
            t, y = self.record(from_ns)
            if len(t) < 2 or t[-1] < STANDING_S:
                return None
            speed = np.linalg.norm(np.diff(y, axis=0), axis=1) / np.diff(t)
            if not (speed[t[1:] > t[-1] - STANDING_S] < STILL).all():
                assert t[-1] < 3 * within_s + 10.0, f"it still moves at {speed[-1]} after {t[-1]} s"
                return None
            moving = np.flatnonzero(speed >= STILL)
            return float(t[moving[-1] + 1]) if moving.size else 0.0, np.abs(y - y[0]).max(axis=0)

        return until(rested, "it rests", pause_s=0.2)


@dataclass(frozen=True)
class Printed:
    """What `check` says of a stop: its class, how long it takes, s, and how far each state moves."""

    letter: str
    within_s: float
    moved: dict[str, float]


def printed(path: Path) -> Printed:
    done = rti_mpc("check", path, timeout_s=300.0)
    found = re.search(r"a stop: .*\((.)\); from .* within (\S+) s, which moves (.*) at most", done.stdout)
    assert found, done.stdout + done.stderr
    moved = {name: float(value) for name, value in re.findall(r"(\S+) by (\S+)", found[3])}
    return Printed(found[1], float(found[2]), moved)


@pytest.mark.parametrize("name", ROBOTS)
def test_robot_comes_to_rest_when_it_is_stopped_and_when_controller_or_guard_are_killed(name: str, tmp_path: Path) -> None:
    driven, path = ROBOTS[name], tmp_path / "robot.toml"
    path.write_text(toml(name, driven.more))
    promise = printed(path)
    assert promise.letter == driven.letter
    reference = ("reference", "--scenario", path_file(name, tmp_path))
    with Recorded(tmp_path, path, robot=("sim",), reference=reference) as system:

        def stops(what: str) -> None:
            from_ns = system.state(lambda _: True).stamp_ns
            took_s, moved = system.rests(from_ns, promise.within_s)
            print(f"\n{name}, {what}: below {STILL:g} /s after {took_s:.2f} s; moved {dict(zip(system.names, moved.round(3).tolist(), strict=True))}")
            t, y = system.record(from_ns)
            rate = np.abs(np.diff(y, axis=0) / np.diff(t)[:, None])[t[1:] < 0.5].max(axis=0)
            for output, way, before in zip(system.names, moved, rate, strict=True):  # a last plan goes on before the way begins
                assert way <= ROUNDING * promise.moved[output] + 1e-9 * MAX_VALID_NS * before

        system.start("robot", "guard", "controller", "reference")
        system.tracking()
        system.moves(driven.speed)
        operator = ("-e", system.endpoint, "--state", tmp_path / "state", *ANSWERED)
        assert rti_mpc("stop", path, *operator).returncode == 0
        stops("stopped")
        assert rti_mpc("enable", path, *operator).returncode == 0
        for role in ("controller", "guard"):
            system.tracking()
            system.moves(driven.speed)
            system.kill(role)
            stops(f"{role} killed")
            system.start(role)
        system.tracking()
        system.moves(driven.speed)
