# SPDX-License-Identifier: Apache-2.0
"""
Isolation of the controller from those who watch: a viewer that hangs, one that stops, one whose disk is full, and a recorder delay no sample.

Real processes, 100 samples per second in real time, in rounds of blocks in random
order. Each trouble begins with its block and is compared with the block of the
same round in which it is not there: nobody watches, or, for a viewer that goes on
without its recording, a viewer records. Two blocks without a viewer
differ because of the machine; no trouble may exceed this difference significantly.
"""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import Telemetry
from rti_mpc_service.host import machine
from tests.bench.driven import Driven, driven, quantiles
from tests.processes.system import until

pytest.importorskip("rerun")
pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="filling the disk of one process needs prlimit"),
]

DT_S = 0.01
SHORT = "CI" in os.environ
ROUNDS = 2 if SHORT else 10
BLOCK_SAMPLES = 400  # Zenoh closes the link of a hung peer in the second second, in the block
COLD_SAMPLES = 300  # first samples, left out: the robot drives to its path
REALTIME = "priority = 20"  # where it is granted, what else this machine does hides no delay
TROUBLES: dict[str, Callable[[int], object]] = {
    "watched": lambda pid: None,
    "hung": lambda pid: os.kill(pid, signal.SIGSTOP),
    "stopped": lambda pid: os.kill(pid, signal.SIGINT),
    "full disk": lambda pid: resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, 1)),
}
BLOCKS = ("alone", "alone again")
COMPARED = {"hung": "alone", "stopped": "alone", "full disk": "watched"}
RECORDED = "recorded"
RECORDS_B = 100_000  # size of a recording whose first chunks, with the attachments, are written


def block(robot: Driven, name: str) -> list[Telemetry]:
    """Samples from the beginning of a trouble on, of a time in which a recorder writes, or of one in which nobody watches."""
    if name == RECORDED:
        return recorded(robot)
    if name not in TROUBLES:
        return robot.samples(BLOCK_SAMPLES)
    recording = robot.folder / "run.rrd"
    recording.unlink(missing_ok=True)
    pid = robot.children.start("viewer", "rti_mpc_service.cli", "view", robot.toml, "-e", robot.endpoint, "--rerun-save", recording, nice=10)
    until(lambda: "viewer" in robot.lives and recording.exists() and recording.stat().st_size, "the viewer records")
    robot.listen()
    TROUBLES[name](pid)
    samples = robot.samples(BLOCK_SAMPLES)
    if name == "hung":
        os.kill(pid, signal.SIGCONT)
    robot.children.end("viewer")
    until(lambda: "viewer" not in robot.lives, "the viewer is gone")
    return samples


def recorded(robot: Driven) -> list[Telemetry]:
    """Samples while a recorder writes all streams and the journal."""
    recording = robot.folder / "run.mcap"
    recording.unlink(missing_ok=True)
    robot.children.start("recorder", "rti_mpc_service.cli", "record", robot.toml, "-e", robot.endpoint, "--out", recording, nice=10)
    until(lambda: "recorder" in robot.lives and recording.exists() and recording.stat().st_size > RECORDS_B, "it records")
    robot.listen()
    size = recording.stat().st_size
    samples = robot.samples(BLOCK_SAMPLES)
    assert recording.stat().st_size > size, "it has gone on"
    robot.children.end("recorder")
    until(lambda: "recorder" not in robot.lives, "the recorder is gone")
    return samples


def test_no_trouble_of_a_viewer_can_be_told_from_the_noise_of_the_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told_from_noise(tmp_path, capsys, (*BLOCKS, *TROUBLES), COMPARED)


def test_a_recorder_cannot_be_told_from_the_noise_of_the_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    told_from_noise(tmp_path, capsys, (*BLOCKS, RECORDED), {RECORDED: "alone"})


def told_from_noise(tmp_path: Path, capsys: pytest.CaptureFixture[str], names: tuple[str, ...], against: dict[str, str]) -> None:
    """Drive a robot in rounds of these blocks, print their times, and compare some with the block of the same round that each is set against."""
    rng = np.random.default_rng(1)
    blocks: dict[str, list[list[Telemetry]]] = {name: [] for name in names}
    with driven(tmp_path, DT_S, duration_s=3600.0, realtime=REALTIME) as robot:
        robot.samples(COLD_SAMPLES)
        for _ in range(ROUNDS):
            for name in rng.permutation(names).tolist():
                blocks[name].append(block(robot, name))
        for name in ("controller", "robot", "reference"):
            assert robot.children.end(name) == 0
        log, said = robot.log(), (tmp_path / "controller.log").read_text()
    granted = next(line for line in said.splitlines() if "real time: " in line)
    answered_us = dict(zip(log.seq.tolist(), log.latency_us.tolist(), strict=True))
    inside = {name: np.array([[sample.latency_us for sample in one] for one in blocks[name]]) for name in names}
    outside = {name: np.array([[answered_us[sample.state_seq] for sample in one] for one in blocks[name]]) for name in names}
    with capsys.disabled():
        print(f"\n{machine.machine_info()}\n{ROUNDS} rounds of {len(names)} blocks of {BLOCK_SAMPLES} samples, {granted}")
        for what, times in {"state in to command out": inside, "state sent to command received, at the robot": outside}.items():
            p99, spread = compared(times)
            print(f"{what}; two equal blocks differ in p99 by {spread:.1%}")
            for name in names:
                beside = against.get(name, "alone")
                print(f"  {name:12} {quantiles(times[name])}, p99 {ratio(p99, name, beside):.3f} of {beside} in the same round")
    if not SHORT:  # of two rounds there is no spread to compare with
        p99, spread = compared(inside)
        for name, beside in against.items():
            assert ratio(p99, name, beside) <= 1.0 + max(0.05, spread), name


def compared(times: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], float]:
    """Return p99 of each block, by round, and by how much those of two equal blocks differ, root mean square."""
    p99 = {name: np.nanpercentile(blocks, 99, axis=1) for name, blocks in times.items()}
    return p99, float(np.sqrt(np.mean(np.log(p99["alone again"] / p99["alone"]) ** 2)))


def ratio(p99: dict[str, np.ndarray], name: str, beside: str) -> float:
    """Return p99 against that of another block of the same round, median over the rounds."""
    return float(np.median(p99[name] / p99[beside]))
