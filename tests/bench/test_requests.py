# SPDX-License-Identifier: Apache-2.0
"""
Load by requests: parameters changed and read, failures injected, malformed requests and long references, each twenty times per second.

Real processes, 200 samples per second in real time, in rounds of blocks in random
order. All of it is answered by threads of the controller's own process, which
share one interpreter lock with the thread that controls. Two blocks without
requests differ because of the machine. Run it with a priority below the
controller's, or the robot measures what else the machine does: `chrt -f 15`.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Telemetry
from rti_mpc_service.host import machine
from tests.bench.asker import KINDS, Asker
from tests.bench.driven import Driven, driven, quantiles

pytestmark = pytest.mark.benchmark

DT_S = 0.005
SHORT = "CI" in os.environ
ROUNDS = 2 if SHORT else 5
BLOCK_SAMPLES = 400
COLD_SAMPLES = 600  # first samples, left out: the robot drives to its path
LOSS_TOLERANCE_SHARE = 0.01  # of the samples: the machine may cost one block more samples than another
REFERENCE_ROWS = 6000
REALTIME = "priority = 20\n[debug]\ninject = true"
BLOCKS = ("alone", "alone again", *KINDS)


def block(robot: Driven, asker: Asker, name: str) -> list[Telemetry]:
    """Samples of a block, with requests or without."""
    if name not in KINDS:
        return robot.samples(BLOCK_SAMPLES)
    with asker.asking([name]):
        return robot.samples(BLOCK_SAMPLES)


def lost(blocks: list[list[Telemetry]]) -> int:
    """How many samples were skipped, or were over their budget and not sent."""
    return sum(one[-1].skipped + one[-1].fallbacks - one[0].skipped - one[0].fallbacks for one in blocks)


def test_no_request_costs_samples(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    blocks: dict[str, list[list[Telemetry]]] = {name: [] for name in BLOCKS}
    with driven(tmp_path, DT_S, duration_s=3600.0, realtime=REALTIME) as robot:
        asker = Asker(robot, REFERENCE_ROWS)
        robot.samples(COLD_SAMPLES)
        for _ in range(ROUNDS):
            for name in rng.permutation(BLOCKS).tolist():
                blocks[name].append(block(robot, asker, name))
        for name in ("controller", "robot", "reference"):
            assert robot.children.end(name) == 0
        log, said = robot.log(), (tmp_path / "controller.log").read_text()
    granted = next(line for line in said.splitlines() if "real time: " in line)
    answered_us = dict(zip(log.seq.tolist(), log.latency_us.tolist(), strict=True))
    with capsys.disabled():
        print(f"\n{machine.machine_info()}\n{ROUNDS} rounds of {len(BLOCKS)} blocks of {BLOCK_SAMPLES} samples, {granted}\n{dict(asker.answers)}")
        print("state sent to command received, at the robot; preparation")
        for name, each in blocks.items():
            times = np.array([[(answered_us[sample.state_seq], sample.prepare_us) for sample in one] for one in each])
            print(f"  {name:14} {quantiles(times[..., 0])}; {quantiles(times[..., 1])}; {lost(each)} samples lost")
    if not SHORT:
        for name in KINDS:
            assert lost(blocks[name]) <= lost(blocks["alone"] + blocks["alone again"]) + LOSS_TOLERANCE_SHARE * ROUNDS * BLOCK_SAMPLES, name
