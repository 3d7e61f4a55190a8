# SPDX-License-Identifier: Apache-2.0
"""
Cost of a sample through decode, `Controller` and encode: of a robot alone in its process, and of many robots in turn, which find cold caches.

All robots answer the same recorded states, so that each computes the same commands.
"""

from __future__ import annotations

import gc
import os
from time import perf_counter_ns

import numpy as np
import pytest

from rti_mpc.contract.message import State
from rti_mpc.control.controller import Controller
from rti_mpc.reference.trajectory import eight
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.cdr import decode, encode
from rti_mpc_service.host import machine
from tests.closed_loop.test_shipped import controller_for
from tests.loop import drive, reference, robot

SHORT = "CI" in os.environ  # to see that all of it runs: figures need a quiet machine, and `make bench`
ROBOTS = 5 if SHORT else 100
COLD_SAMPLES = 50  # first samples, left out: the robot drives to its path
SAMPLES = 60 if SHORT else 250
PARTS = ("decode", "receive_state", "encode", "commit", "prepare")
MAX_STEPS_PER_SAMPLE = 7.0  # a sample, in steps of the real-time iteration in a loop of its own: 8.6 before plain floats, 4.4 with them


def follower() -> Controller:
    """A controller of the shipped robot on the eight."""
    controller, _ = controller_for(eight(), "consistent")
    controller.receive_reference(reference(eight().lasting(140.0), "consistent"))
    return controller


def recorded() -> list[tuple[bytes, int]]:
    """Payloads of the states of one run, with their times."""
    body, payloads = robot(eight()), []

    def sees(state: State) -> State:
        payloads.append((encode(state), body.now_ns))
        return state

    drive(follower(), body, 0.1 * SAMPLES, sees=sees)
    return payloads


def sample(controller: Controller, payload: bytes, now_ns: int) -> tuple[int, ...]:
    """Answer one state as the controller's process does; return the times before, between and after the parts."""
    began = perf_counter_ns()
    state = decode(State, payload)
    decoded = perf_counter_ns()
    command = controller.receive_state(state, now_ns)
    answered = perf_counter_ns()
    if command is None:
        return (began,) * (len(PARTS) + 1)
    encode(command)
    encoded = perf_counter_ns()
    assert controller.in_time(command, now_ns) is command
    controller.commit(command, now_ns)
    committed = perf_counter_ns()
    controller.prepare()
    return began, decoded, answered, encoded, committed, perf_counter_ns()


def in_turn(robots: int, payloads: list[tuple[bytes, int]]) -> np.ndarray:
    """Medians of the parts, us, of robots that take turns at each sample."""
    controllers = [follower() for _ in range(robots)]
    gc.collect()
    gc.disable()
    try:
        times = [[sample(controller, *each) for controller in controllers] for each in payloads]
    finally:
        gc.enable()
    return 1e-3 * np.median(np.diff(times[COLD_SAMPLES:], axis=2), axis=(0, 1))


def step_us(rti: Rti, x: np.ndarray) -> float:
    """Median of a step in a loop of its own, us."""
    times = []
    for _ in range(1000):
        began = perf_counter_ns()
        rti.prepare(rti.y_ref.copy())
        rti.feedback(x)
        times.append(perf_counter_ns() - began)
    return 1e-3 * float(np.median(times))


@pytest.mark.benchmark
def test_sample_costs_a_few_steps_alone_and_with_many_robots_in_turn(capsys: pytest.CaptureFixture[str]) -> None:
    payloads = recorded()
    rows = {robots: in_turn(robots, payloads) for robots in (1, ROBOTS)}
    _, ocp = controller_for(eight(), "consistent")
    hot_us = step_us(Rti(ocp), np.zeros(ocp.model.nx))
    with capsys.disabled():
        print(f"\n{machine.machine_info()}\na sample of N = {ocp.N}, medians, us; a step in a loop of its own: {hot_us:.0f}")
        for robots, parts in rows.items():
            print(f"  {robots:3} in turn: {parts.sum():5.0f}, " + ", ".join(f"{name} {us:.1f}" for name, us in zip(PARTS, parts, strict=True)))
    assert SHORT or rows[1].sum() < MAX_STEPS_PER_SAMPLE * hot_us
