# SPDX-License-Identifier: Apache-2.0
"""Conformance tests by the command that users run, of robots and guards in their own processes: ours pass, broken ones fail where they should."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.session import BusSettings
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.command import command
from tests.guarded import write_robot
from tests.movers import toml
from tests.processes.system import PATIENCE_S, ROOT, command_line, environment, heard, listening, rti_mpc, until

CLI = "from rti_mpc_service.cli import main; main()"
# A robot of a user's own with the adapter, at rest in one place: what it is told is seen by the inputs that it reports.
ADAPTED = """
import sys
from rti_mpc.adapter import RobotAdapter
from rti_mpc.wire.bus import BusSettings
from rti_mpc_service.config.config import load
from pathlib import Path
config = load(Path(sys.argv[1]))
bounds = config.ocp.bounds
with RobotAdapter(
    config.robot, dt_s=config.ocp.dt_s, inputs=bounds.inputs, increments=bounds.increments, bus=BusSettings(listen=(sys.argv[3],))
) as robot:
    for tick, _ in enumerate(robot.every(0.005)):
        if tick % 10 == 0:
            robot.send([0.0] * 5)
        robot.act()
"""
BROKEN_ROBOTS = {
    "plays expired rows for ever": (
        """
from dataclasses import replace
import numpy as np
from rti_mpc.wire.actuator import Actuator
accept = Actuator.accept
longer = lambda command: replace(command, valid_until_ns=2**62, u=np.vstack([command.u, np.tile(command.u[-1], (900, 1))]))
Actuator.accept = lambda self, command, arrival_ns: accept(self, longer(command), arrival_ns)
""",
        {"expiry", "way", "late"},
    ),
    "steps without an approach after a gap": (
        """
import rti_mpc.contract.schedule
rti_mpc.contract.schedule.approach = lambda u, *_, **__: u
""",
        {"slew"},
    ),
    "obeys an old epoch": (
        """
from rti_mpc.wire.source import Source, Verdict
judge = Source._judge
Source._judge = lambda self, epoch, seq, now_ns: Verdict.NEW if epoch != self.epoch else judge(self, epoch, seq, now_ns)
""",
        {"epochs"},
    ),
}
BROKEN_GUARDS = {
    "passes a plan on without an approach": (
        """
from rti_mpc.contract.belief import Belief
add = Belief.add
Belief.add = lambda self, command, *times, **_: (add(self, command, *times, approached=False), command.u)[1]
""",
        {"slew"},
    ),
    "obeys an old epoch": (
        """
from rti_mpc.contract.guard import Guard
object_to = Guard._objection
def _objection(self, command, now_ns, until_ns):
    if command.epoch < self._leader[0]:
        self._leader = 0, -1
    return object_to(self, command, now_ns, until_ns)
Guard._objection = _objection
""",
        {"epochs"},
    ),
    "plays a way to rest without its gain": (
        """
from rti_mpc.contract.way import Way
Way.corrected = lambda self, *_: self
""",
        {"gain"},
    ),
    "forgets a stop": (
        """
from rti_mpc.contract.guard import Guard
Guard.latch = lambda self, reason, local_ns: None
""",
        {"stop"},
    ),
}


@contextmanager
def running(folder: Path, config: Path, *program: str) -> Iterator[str]:
    """Run a robot or a guard, of which the endpoint is returned."""
    endpoint = free_endpoint()
    with (folder / "judged.log").open("ab") as log:
        line = [sys.executable, "-c", *program, str(config), "-l", endpoint]
        process = subprocess.Popen(line, cwd=ROOT, env=environment(folder / "state"), stdout=log, stderr=subprocess.STDOUT)
    try:
        until(lambda: listening(process.pid), "it listens")
        yield endpoint
        assert process.poll() is None, (folder / "judged.log").read_text()
    finally:
        process.kill()
        process.wait()


def judged(folder: Path, what: str, config: Path, *meeting: object) -> dict[str, dict[str, Any]]:
    """Rows by name, as written to a file; the exit status and the table agree with them."""
    path = folder / "found.json"
    done = rti_mpc("conformance", config, what, *meeting, "--moves-the-robot", "--json", path, timeout_s=300.0)
    rows = {row["name"]: row for row in json.loads(path.read_text())}
    assert done.returncode == int(any(row["verdict"] not in ("yes", "host") for row in rows.values())), done.stdout + done.stderr
    for name, row in rows.items():
        assert (row["verdict"] == "NO") == ("mend" in row) == (f"{name}: right is: {row['promise']}; mend: " in done.stdout)
    return rows


def fails_in(rows: dict[str, dict[str, Any]], expected: set[str]) -> None:
    """Check which promises are broken; a host that was busy may excuse what it could explain, and no more."""
    by_verdict = {verdict: {name for name, row in rows.items() if row["verdict"] == verdict} for verdict in ("yes", "host", "NO")}
    assert set().union(*by_verdict.values()) == set(rows), rows
    assert by_verdict["NO"] <= expected <= by_verdict["NO"] | by_verdict["host"], rows


@pytest.mark.slow
def test_simulated_robot_keeps_every_promise_at_four_times_real_speed(tmp_path: Path) -> None:
    """Judged in its own time."""
    with running(tmp_path, SHIPPED, "import sys; sys.argv.insert(1, 'sim'); sys.argv += ['--speed', '4']; " + CLI) as endpoint:
        fails_in(judged(tmp_path, "robot", SHIPPED, "-e", endpoint), set())


@pytest.mark.slow
def test_robot_with_the_adapter_keeps_every_promise(tmp_path: Path) -> None:
    with running(tmp_path, SHIPPED, ADAPTED) as endpoint:
        fails_in(judged(tmp_path, "robot", SHIPPED, "-e", endpoint), set())


@pytest.mark.slow
@pytest.mark.parametrize("what", BROKEN_ROBOTS)
def test_broken_robot_fails_where_it_should_and_only_there(tmp_path: Path, what: str) -> None:
    change, expected = BROKEN_ROBOTS[what]
    with running(tmp_path, SHIPPED, change + ADAPTED) as endpoint:
        fails_in(judged(tmp_path, "robot", SHIPPED, "-e", endpoint), expected)


@pytest.mark.slow
def test_interrupted_test_leaves_even_a_robot_at_rest_that_plays_for_ever(tmp_path: Path) -> None:
    change, _ = BROKEN_ROBOTS["plays expired rows for ever"]
    with running(tmp_path, SHIPPED, change + ADAPTED) as endpoint, Bus.join(BusSettings(connect=(endpoint,)), load(SHIPPED).keys()) as bus:
        states = bus.subscriber(bus.keys.state)
        arguments = command_line("conformance", SHIPPED, "robot", "-e", endpoint, "--moves-the-robot")
        process = subprocess.Popen(arguments, cwd=ROOT, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            heard(states, State, lambda state: bool(np.abs(state.u).max() > 0.3))
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
        assert (process.returncode, said) == (1, "rti-mpc: stopped before everything was judged\n")
        seq = heard(states, State, lambda _: True).seq
        assert not heard(states, State, lambda state: state.seq > seq).u.any()


@pytest.mark.slow
def test_arm_that_falls_without_its_controller_keeps_every_promise(tmp_path: Path) -> None:
    config = write_robot(tmp_path / "robot.toml", text=toml("arm"))
    with running(tmp_path, config, "import sys; sys.argv.insert(1, 'sim'); " + CLI) as endpoint:  # a faster one would be held by a faster host
        fails_in(judged(tmp_path, "robot", config, "-e", endpoint), set())


@pytest.mark.slow
def test_guard_keeps_every_promise_on_a_bus_with_tls(tmp_path: Path) -> None:
    """By a certificate of the test's own."""
    pytest.importorskip("cryptography", reason="the extra certs is not installed: conformance with TLS was NOT tried")
    from tests.processes.secured import Secured

    with Secured(tmp_path) as bus:
        (judge := tmp_path / "judge").mkdir()
        for file in ("authority.pem", "conformance.pem", "conformance.key", "conformance.json5"):
            shutil.copy(bus.tls / file, judge)
        bus.start("guard")
        fails_in(judged(tmp_path, "guard", bus.config, "--tls", judge), set())


@pytest.mark.slow
@pytest.mark.parametrize("what", BROKEN_GUARDS)
def test_broken_guard_fails_where_it_should_and_only_there(tmp_path: Path, what: str) -> None:
    change, expected = BROKEN_GUARDS[what]
    config = write_robot(tmp_path / "robot.toml")
    with running(tmp_path, config, change + CLI, "guard") as endpoint:
        fails_in(judged(tmp_path, "guard", config, "-e", endpoint), expected)


@pytest.mark.parametrize(
    ("what", "role"), [("robot", "controller"), ("robot", "standby.17"), ("robot", "guard"), ("guard", "controller"), ("guard", "robot")]
)
def test_nothing_is_judged_beside_who_commands_or_is_commanded(tmp_path: Path, what: str, role: str) -> None:
    config = write_robot(tmp_path / "robot.toml")
    endpoint = free_endpoint()
    with Bus.join(BusSettings(listen=(endpoint,), connect=()), load(config).keys()) as bus:
        commands = [bus.subscriber(key) for key in (bus.keys.command, bus.keys.actuation, bus.keys.state)]
        bus.alive(role)
        done = command("conformance", config, what, "-e", endpoint, "--moves-the-robot")
        assert not any(subscriber.drain() for subscriber in commands)
    said = f"rti-mpc: pioneer has a live {role.partition('.')[0]}: a {what} is judged without, stop it first\n"
    assert (done.returncode, done.stdout, done.stderr) == (1, "", said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "conformance must be followed by robot or guard, got neither\n"),
        (("arm",), "conformance must be followed by robot or guard, got arm\n"),
        (("guard", "--moves-the-robot"), "guard.enabled must be true for a robot to have a guard, got false\n"),
        (("robot",), "conformance moves the robot, by metres and without a view of it: clear its way, and give --moves-the-robot\n"),
    ],
)
def test_what_cannot_be_judged_is_refused_in_one_line(words: tuple[str, ...], said: str) -> None:
    done = command("conformance", *words)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"rti-mpc: {said}")
