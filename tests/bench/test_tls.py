# SPDX-License-Identifier: Apache-2.0
"""
Cost of security: from a state sent to its command received, between peers, through a router, and through a router with TLS and its list.

Real processes, 100 samples per second in real time. Each round has one block of each
bus, in random order, with processes of its own. Times are compared within a round.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rti_mpc_service.host import machine
from rti_mpc_service.rig import robot_log
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.bench.driven import INFO, sampled
from tests.processes.system import until

pytest.importorskip("cryptography", reason="the extra certs is not installed: the cost of TLS was NOT measured")

from tests.processes.secured import Secured

pytestmark = pytest.mark.benchmark

DT_S = 0.01
SHORT = "CI" in os.environ
ROUNDS = 1 if SHORT else 6
COLD_SAMPLES, BLOCK_SAMPLES = 200, 200 if SHORT else 500  # the first are left out: the robot drives to its path
TLS = "router, TLS, list"
BUSES = ("peers", "router", TLS)
LOSS_TOLERANCE_SHARE = 0.01  # of the samples: the machine may cost one block more samples than another


def block(folder: Path, bus: str, tls: Path) -> np.ndarray:
    """Return the latencies of the samples of a block, us; NaN where a state was not answered."""
    folder.mkdir()
    toml, endpoint = sampled(folder, DT_S), free_endpoint()
    client = ("-m", "client", "-e", endpoint)
    router, robot, others = {
        "peers": ((), ("-l", endpoint), ("-e", endpoint)),
        "router": (("-l", endpoint), client, client),
        TLS: 3 * (("--tls", tls),),
    }[bus]
    log = folder / "robot.csv"
    with Children(folder) as children:
        if router:
            children.start("router", "rti_mpc_service.cli", "router", toml, *router)
        children.start("robot", "rti_mpc_service.cli", "sim", toml, *robot, "--log", log)
        children.start("reference", "rti_mpc_service.cli", "reference", toml, *others, "--duration", 120)
        children.start("controller", "rti_mpc_service.cli", "run", toml, *others)

        def answered() -> int:
            """Number of states since the first that was answered."""
            latency_us = robot_log.read(log, INFO).latency_us if log.exists() else np.empty(0)
            return int(np.isfinite(latency_us).cumsum().astype(bool).sum())

        until(lambda: answered() >= COLD_SAMPLES + BLOCK_SAMPLES, "a block of samples", pause_s=1.0, patience_s=120.0)
        for name in ("controller", "robot", "reference"):
            children.end(name)
    latency_us = robot_log.read(log, INFO).latency_us
    first = int(np.flatnonzero(np.isfinite(latency_us))[0]) + COLD_SAMPLES
    return latency_us[first : first + BLOCK_SAMPLES]


def test_tls_and_list_cost_a_command_little_and_no_sample(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng, tls = np.random.default_rng(1), Secured(tmp_path).tls
    blocks: dict[str, list[np.ndarray]] = {bus: [] for bus in BUSES}
    for k in range(ROUNDS):
        for bus in rng.permutation(BUSES).tolist():
            blocks[bus].append(block(tmp_path / f"{k}-{BUSES.index(bus)}", bus, tls))
    rows = {bus: np.array([(*np.nanpercentile(one, [50, 99]), np.sum(~(one < 1e6 * DT_S))) for one in each]) for bus, each in blocks.items()}
    with capsys.disabled():
        print(f"\n{machine.machine_info()}\nstate sent to command received, at the robot; medians over {ROUNDS} rounds of {BLOCK_SAMPLES} samples")
        for bus, each in rows.items():
            p50, p99, late = np.median(each, axis=0)
            print(f"  {bus:18} p50 {p50:6.0f}  p99 {p99:6.0f} us, {late:.0f} samples not answered within the period")
        p50, p99 = np.median(rows[TLS][:, :2] / rows["router"][:, :2], axis=0)
        print(f"  with TLS and list p50 is {p50:.2f} and p99 {p99:.2f} of that through a router in the same round")
    if not SHORT:
        assert np.median(rows[TLS][:, 2] - rows["router"][:, 2]) <= LOSS_TOLERANCE_SHARE * BLOCK_SAMPLES
