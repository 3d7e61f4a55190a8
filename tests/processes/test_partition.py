# SPDX-License-Identifier: Apache-2.0
"""
Network partition: robot with guard, leader and standby, each on a host of its own, as clients of a router between them.

Repeatedly a link is cut for 0.2 to 10 s: that of the leader, and every
fourth time the robot's, so that no controller leads. Commands to the robot are
recorded at the router, its motion by the robot itself, at speed 1.
"""

from __future__ import annotations

import csv
import os
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.status import Mode
from rti_mpc_service.config.build import build_signals, guard_limits
from rti_mpc_service.config.config import load
from rti_mpc_service.faults.measure import Incident, measure
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig import robot_log
from rti_mpc_service.shipped import SHIPPED
from tests.bench.driven import INFO
from tests.guarded import GUARDED, write_robot
from tests.in_time import MS, in_time
from tests.processes.network import MIDDLE, MIDDLE_ADDRESS, Network, missing
from tests.processes.overheard import Overheard
from tests.processes.record import FAST_STATES
from tests.processes.system import CONFIG, owner, until

pytestmark = pytest.mark.slow

CUTS = 4 if "CI" in os.environ else 20
SHORTEST_S, LONGEST_S = 0.2, 10.0
ROBOT, HOSTS = "robot", ("robot", "leader", "standby")
ENDPOINT = f"tcp/{MIDDLE_ADDRESS}:7447"
MEETING = ("-m", "client", "-e", ENDPOINT)
PROMISE_MS = 300.0  # from a cut to braking where nobody leads; without commands where somebody does
DT_NS = round(1e9 * CONFIG.ocp.dt_s)


@pytest.fixture
def network() -> Any:
    if reason := missing():
        pytest.skip(reason)
    with Network(*HOSTS) as network:
        yield network


class Partitioned:
    """The system on its hosts, and the messages recorded at the router."""

    def __init__(self, network: Network, folder: Path, guarded: bool) -> None:
        self.network, self.folder, self.guarded = network, folder, guarded
        self.config = write_robot(folder / "robot.toml", FAST_STATES, SHIPPED.read_text() + (GUARDED if guarded else "\n"))
        self.heard = Overheard(folder / "overheard.jsonl")
        self.heard.path.touch()
        self._start("router", MIDDLE, "router", "-l", ENDPOINT, meeting=())
        network.start("overheard", MIDDLE, "tests.processes.overheard", ENDPOINT, self.heard.path, folder=folder)
        self._start("robot", ROBOT, "sim", "--x0", "x=0.5", "--log", folder / "robot.csv")
        if guarded:
            self._start("guard", ROBOT, "guard")
        self._start("reference", MIDDLE, "reference", "--scenario", "eight", "--duration", 1200)
        self._start("leader", "leader", "run")
        until(lambda: "controls" in self.said("leader"), "a leader")
        self._start("standby", "standby", "run", "--standby")

    def _start(self, name: str, host: str, command: str, *arguments: object, meeting: tuple[object, ...] = MEETING) -> None:
        self.network.start(name, host, "rti_mpc_service.cli", command, self.config, *meeting, *arguments, folder=self.folder)

    def said(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def streams(self) -> dict[str, list[dict[str, Any]]]:
        return self.heard.listen().streams

    def driven(self, since_ns: int) -> bool:
        """Whether the robot moves by commands for states from an instant on, and another controller is ready to take over."""
        streams = self.streams()
        new = {state["seq"] for state in streams["state"][-400:] if state["at_ns"] > since_ns}
        told = streams["actuation" if self.guarded else "command"][-40:]
        follows = any(message["mode"] == Mode.TRACKING and message["state_seq"] in new for message in told)
        ready = any(message["mode"] == Mode.TRACKING and message["state_seq"] in new for message in streams["standby"][-40:])
        return follows and ready and abs(streams["state"][-1]["x"][3]) > 0.05

    def leads(self) -> str:
        """Host of the controller that has sent the last command."""
        number = self.streams()["command"][-1]["epoch"] % (1 << NUMBER_BITS)
        return next(host for host in HOSTS[1:] if owner(self.said(host)) == number)

    def robot_ns(self, at_ns: int) -> int:
        """Robot time at an instant of the monotonic clock, by the last state heard before."""
        state = next(state for state in reversed(self.streams()["state"]) if state["at_ns"] <= at_ns)
        return int(state["stamp_ns"] + at_ns - state["at_ns"])

    def suffer(self, host: str, duration_s: float) -> tuple[int, int, int]:
        """Cut a host off for a while, wait until the robot is driven again, and return the times of cut, restoration and recovery, monotonic."""
        cut_ns = time.monotonic_ns()
        self.network.cut(host)
        time.sleep(duration_s)  # the fault itself
        restored_ns = time.monotonic_ns()  # from here on the robot may be driven again
        self.network.restore(host)
        until(lambda: self.driven(restored_ns), f"all is well again after {duration_s:.1f} s without the {host}", pause_s=0.1)
        return cut_ns, restored_ns, time.monotonic_ns()

    def acted(self) -> list[int]:
        """Epochs of the controllers whose rows the robot took, in the order in which they came."""
        streams = self.streams()
        answers: dict[int, list[dict[str, Any]]] = {}
        for message in streams["command"]:
            answers.setdefault(message["state_seq"], []).append(message)
        if not self.guarded:
            rows = [row for row in rows_of(self.folder / "robot.csv") if row["command_seq"]]
            rows.sort(key=lambda row: int(row["stamp_ns"]) + 1e3 * float(row["latency_us"]))  # as they came
            taken = [(int(row["seq"]), int(row["command_seq"])) for row in rows]
            return [message["epoch"] for seq, number in taken for message in answers.get(seq, []) if message["seq"] == number]
        passed = [message for message in streams["actuation"] if message["mode"] != Mode.BRAKING]
        # A standby may have planned the same to the last bit: whose was heard first is whose passed. What a restored link brings later is neither's.
        equal = ([own for own in answers.get(told["state_seq"], []) if own["u"] == told["u"]] for told in passed)
        return [min(owns, key=lambda own: own["at_ns"])["epoch"] for owns in equal if owns]


def rows_of(path: Path) -> list[dict[str, str]]:

    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if None not in row.values()]


@pytest.mark.parametrize("guarded", [True, False], ids=["guarded", "unguarded"])
def test_links_that_are_cut_never_make_two_leaders_act_in_turn_and_the_robot_goes_on_by_itself(
    network: Network, tmp_path: Path, host: Host, guarded: bool
) -> None:
    rng = np.random.default_rng(1)
    system = Partitioned(network, tmp_path, guarded)
    until(lambda: system.driven(0), "the robot is driven", pause_s=0.1)
    cuts = []
    for k in range(CUTS):
        lost = ROBOT if k % 4 == 3 else system.leads()
        duration_s = float(np.exp(rng.uniform(np.log(SHORTEST_S), np.log(LONGEST_S))))
        cuts.append((lost, *system.suffer(lost, duration_s)))
    log = robot_log.read(tmp_path / "robot.csv", INFO)
    epochs = system.acted()
    assert epochs == sorted(epochs), "whoever was relieved acts no more"
    config = load(system.config)
    limits = guard_limits(config, build_signals(config))
    for lost, cut_ns, restored_ns, well_ns in cuts:
        incident = Incident(*map(system.robot_ns, (cut_ns, restored_ns, well_ns)))
        found = measure(log, log.x[:, :2], np.zeros(len(log.stamp_ns)), incident, limits)
        what = f"{lost} lost for {1e-9 * (restored_ns - cut_ns):.2f} s"
        print(f"\n{what}: braking {found.brake_s}, zero {found.zero_s}, well again {1e-9 * (well_ns - restored_ns):.2f} s after")
        assert found.step_share <= 1.0 + 1e-6, what
        assert found.stale == 0, what
        answered = log.stamp_ns[np.isfinite(log.latency_us)]
        if lost == ROBOT and restored_ns - cut_ns > 1000 * MS:
            assert found.brake_s is not None and found.zero_s is not None, what
            in_time(host, f"{what}: braking", 1e3 * found.brake_s, PROMISE_MS, cut_ns)
        elif lost != ROBOT:
            during = answered[(answered > incident.fault_ns - 2 * DT_NS) & (answered < incident.mend_ns)]
            gap_ms = 1e-6 * max(b - a for a, b in pairwise([*during.tolist(), incident.mend_ns]))
            in_time(host, f"{what}: without a leader", gap_ms, PROMISE_MS + 1e-6 * DT_NS, cut_ns)
    assert len(set(epochs)) > 1, "somebody has taken over"
