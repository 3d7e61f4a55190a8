# SPDX-License-Identifier: Apache-2.0
"""
Operator's stop among real processes: the restarts that it survives, and the processes that confirm it.

That it outlives a controller which is killed is among the tests of `tests.processes.test_system`, which has one.
"""

from __future__ import annotations

import csv
import json
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
import zenoh

from rti_mpc.contract.message import Command
from rti_mpc.contract.status import Mode
from rti_mpc_service.host.hold_up import Host
from tests.guarded import write_robot
from tests.in_time import MS, in_time
from tests.processes.record import FAST_STATES, moves, rests
from tests.processes.system import ANSWERED, KEYS, PATIENCE_S, System, heard, rti_mpc, until

pytestmark = pytest.mark.slow

REQUESTS_PER_S = 300
ANSWER_MS = 2000.0  # for which the command `stop` waits for an answer


class Operated(System):
    """A system, and its operator on the same host."""

    def says(self, word: str, *options: object) -> CompletedProcess[str]:
        return rti_mpc(word, self.config, "-e", self.endpoint, "--state", self.folder / "state", *options)

    def stands(self, samples: int = 20) -> None:
        """Wait for this number of states; from now on every input is at rest."""
        first = self.state(lambda _: True)
        last = self.state(lambda state: state.seq >= first.seq + samples)
        with (self.folder / "robot.csv").open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if None not in row.values() and first.seq <= int(row["seq"]) <= last.seq]
        assert not np.array([[float(row["u_c"]), float(row["omega_c"])] for row in rows]).any()

    def commanded_to_stand(self) -> None:
        heard(self.bus.subscriber(KEYS.command), Command, lambda command: command.mode is Mode.STOPPED and not command.u.any())
        self.stands()


@pytest.fixture
def system(tmp_path: Path) -> Iterator[Operated]:
    with Operated(tmp_path) as system:
        yield system


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Operated]:
    with Operated(tmp_path, write_robot(tmp_path / "robot.toml", FAST_STATES)) as system:
        yield system


def test_stop_said_to_nobody_is_noted_and_outlives_every_restart_until_it_is_released(system: Operated) -> None:
    system.start("robot", "reference")
    done = system.says("stop", "--timeout", 0.3)
    assert (done.returncode, done.stdout) == (1, "")
    assert "the controller has not confirmed stop within 0.3 s; nobody has; processes started later read" in done.stderr
    for _ in range(2):
        system.start("controller")
        system.commanded_to_stand()
        assert system.interrupt("controller") == 0
    assert system.says("enable", "--timeout", 0.3).returncode == 1
    system.start("controller")
    system.tracking()
    system.state(moves)


@contextmanager
def flood(endpoint: str) -> Iterator[list[float]]:
    """Ask a controller for its parameters `REQUESTS_PER_S` times per second, and wait for no answer; the times at which it was asked, s."""
    config = zenoh.Config()
    for key, value in (("mode", '"peer"'), ("connect/endpoints", json.dumps([endpoint])), ("scouting/multicast/enabled", "false")):
        config.insert_json5(key, value)
    over, asked = threading.Event(), []

    def ask() -> None:
        start_s = time.monotonic()
        while not over.is_set():
            session.get(KEYS.request, lambda _: None, payload=b'{"request": "params", "get": true}', timeout=1.0)
            asked.append(time.monotonic())
            over.wait(max(0.0, start_s + len(asked) / REQUESTS_PER_S - time.monotonic()))

    with zenoh.open(config) as session:
        thread = threading.Thread(target=ask)
        thread.start()
        try:
            until(lambda: len(asked) > REQUESTS_PER_S, "a second of requests")
            yield asked
        finally:
            over.set()
            thread.join()


def test_stop_is_answered_beside_300_requests_a_second(system: Operated, host: Host) -> None:
    system.start("robot", "controller", "reference")
    system.tracking()
    with flood(system.endpoint) as asked:
        took_ms = []
        for word in ("stop", "enable") * 5:  # of which three of five stops were lost where they waited with the others
            start_ns, before = time.monotonic_ns(), len(asked)
            answer = next(system.bus.answers(KEYS.stop, {"request": word}, PATIENCE_S))
            took_ms.append((time.monotonic_ns() - start_ns) / MS)
            in_time(host, f"the answer to {word}", took_ms[-1], ANSWER_MS, start_ns)
            assert answer["ok"] is True
            until(lambda: len(asked) > before + REQUESTS_PER_S // 5, "more requests")  # noqa: B023
        print(f"\n{len(asked)} requests; stop and enable were answered within {max(took_ms):.0f} ms, median {np.median(took_ms):.1f}")
    system.tracking()


def test_stop_outlives_all_processes_of_a_guarded_robot_and_the_guard_tells_a_controller_of_another_host(guarded: Operated) -> None:
    system, state = guarded, guarded.folder / "state"
    system.start("robot", "guard", "controller", "reference")
    system.tracking()
    system.state(moves)
    done = system.says("stop", *ANSWERED)
    assert (done.returncode, json.loads(done.stdout)["role"]) == (0, "guard"), done.stderr
    system.state(rests)

    for role in ("controller", "guard", "robot", "reference"):
        system.kill(role)
    system.start("robot", "guard", "reference")
    until(lambda: "guard" in system.lives, "a guard")
    kept = state.rename(system.folder / "kept")  # the controller of another host knows of nothing
    system.start("controller")
    system.commanded_to_stand()
    assert "stopped since" in system.said("guard")
    assert "stopped since" not in system.said("controller")

    system.kill("guard")
    shutil.rmtree(kept)
    shutil.rmtree(state)
    system.start("guard")  # and now the guard hears it of the controller
    until(lambda: (state / "rti_mpc%2Fpioneer.json").exists(), "it is stored again")
    system.commanded_to_stand()

    system.kill("controller")
    done = system.says("enable", *ANSWERED)  # the guard alone is there, and acts
    assert (done.returncode, json.loads(done.stdout)["role"]) == (0, "guard"), done.stderr
    system.start("controller")
    system.tracking()
    system.state(moves)

    system.kill("guard")
    done = system.says("stop", "--timeout", 5.0)  # longer than the host may hold the controller up
    assert done.returncode == 1
    assert "the guard has not confirmed stop within 5 s; controller has" in done.stderr
