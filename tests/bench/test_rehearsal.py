# SPDX-License-Identifier: Apache-2.0
"""
What rehearsals are worth.

In one process: decode, feedback and encode right after the sample before, after a pause,
after a pause with a rehearsal at its end, and after one whose thread stays awake from the
rehearsal on; in random order on one controller. With
real processes: from a state sent to its command received, of a controller that rehearses
and one that does not, each with a robot of its own, in turn.
"""

from __future__ import annotations

import gc
import os
import random
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.received import Received
from rti_mpc_service.controller.rehearsal import LEAD_S
from rti_mpc_service.host import machine
from tests.bench.driven import quantiles
from tests.bench.paced import pace, two
from tests.bench.test_sample import COLD_SAMPLES, follower, recorded

pytestmark = pytest.mark.benchmark

SHORT = "CI" in os.environ
PAUSES = ("hot", "cold", "rehearsed", "awake")
MAX_SAMPLES = {10: 150, 50: 300, 100: 300}  # by rate in Hz
SAMPLES = {10: 150, 50: 600, 100: 1200}
WAKING_S = 0.15e-3  # of the lead, before a rehearsal begins
MAX_OF_COLD = 0.9  # feedback after a rehearsal, beside one without: 0.45 to 0.65 on a quiet host, 0.75 to 0.79 under a load of 20


def feedback_us(rate: int, payloads: list[tuple[bytes, int]]) -> dict[str, np.ndarray]:
    """CPU time from payload to payload, by what came before; rehearsals themselves as well."""
    controller, intake = follower(), Intake(State, 0.25, {"x": 5, "u": 2})
    took: dict[str, list[int]] = defaultdict(list)
    chance = random.Random(1)
    gc.collect()
    gc.disable()
    try:
        for k, (payload, now_ns) in enumerate(payloads[: COLD_SAMPLES + MAX_SAMPLES[rate]]):
            before = chance.choice(PAUSES) if k >= COLD_SAMPLES else "hot"
            if before == "cold":
                time.sleep(1 / rate)
            elif before != "hot":
                time.sleep(1 / rate - LEAD_S + WAKING_S)
                began_s, began_ns = time.monotonic(), time.thread_time_ns()
                intake.rehearse()
                if (rehearsed := controller.rehearse(now_ns)) is not None:
                    encode(rehearsed)
                took["rehearsal"].append(time.thread_time_ns() - began_ns)
                if before == "rehearsed":
                    time.sleep(max(0.0, LEAD_S - WAKING_S - (time.monotonic() - began_s)))
                while time.monotonic() < began_s + LEAD_S - WAKING_S:
                    pass
            received = Received(payload, encoding(State), "state")
            began_ns = time.thread_time_ns()
            (state,) = intake.newest_of_each((received,), controller.continues)
            if (command := controller.receive_state(state, now_ns)) is None:
                continue
            encode(command)
            if k >= COLD_SAMPLES:
                took[before].append(time.thread_time_ns() - began_ns)
            controller.commit(command, now_ns)
            controller.prepare()
    finally:
        gc.enable()
    return {name: 1e-3 * np.array(values) for name, values in took.items()}


def test_feedback_after_a_pause_takes_less_time_with_a_rehearsal_than_without(capsys: pytest.CaptureFixture[str]) -> None:
    payloads = recorded()
    for rate in MAX_SAMPLES:
        took = feedback_us(rate, payloads)
        with capsys.disabled():
            print(f"\n{machine.machine_info()}\nfeedback at {rate} Hz, CPU time")
            for name in (*PAUSES, "rehearsal"):
                print(f"  {name:10} {quantiles(took[name])}, {np.median(took[name]) / np.median(took['hot']):.2f} of hot")
        assert SHORT or np.median(took["rehearsed"]) < MAX_OF_COLD * np.median(took["cold"])


@pytest.mark.parametrize("rate", [10, 50, 100])
def test_command_is_no_later_with_rehearsals(rate: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with two(tmp_path, 1 / rate) as robots:
        numbers = list(pace(robots, 1 / rate, 60 if SHORT else SAMPLES[rate]))[30:]
    with capsys.disabled():
        print(f"\n{machine.machine_info()}\n{rate} Hz")
        for name, robot in zip(("rehearsed", "not rehearsed"), robots, strict=True):
            print(f"  state to command, {name:14} {quantiles(robot.latency_us(numbers))}, feedback {quantiles(robot.feedback_us(numbers))}")
