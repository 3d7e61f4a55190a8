# SPDX-License-Identifier: Apache-2.0
"""
Two controllers, one that rehearses and one that does not, each with a robot of its own.

The states of both are sent in turn by this process, earlier than expected if asked.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from rti_mpc.contract.message import Command, State, Telemetry
from rti_mpc.reference.trajectory import eight
from rti_mpc.wire.bus import RING_MESSAGES, Bus, BusSettings
from rti_mpc.wire.cdr import decode
from rti_mpc_service.config.config import load
from rti_mpc_service.rig.children import Children
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_sim.lockstep import Lockstep
from tests.bench.driven import sampled
from tests.loop import reference, robot
from tests.processes.system import until

LIVES_S = 120.0  # of the reference


class Paced:
    """
    A robot of a controller, which waits for nobody.

    Attributes:
        sent_ns: Local time at which a state was sent, by its sequence number.
        answered_ns: The same of the command that answers it.
        telemetry: Telemetry by the sequence number of the state.
    """

    def __init__(self, folder: Path, name: str, dt_s: float, *, rehearse: bool, children: Children, stack: ExitStack) -> None:
        folder.mkdir()
        self.toml = sampled(folder, dt_s, f"rehearse = {str(rehearse).lower()}")
        self.toml.write_text(self.toml.read_text().replace(f'robot = "{load(self.toml).robot}"', f'robot = "{name}"'))
        keys, endpoint = load(self.toml).keys(), free_endpoint()
        self.bus = stack.enter_context(Bus.join(BusSettings(listen=(endpoint,), connect=()), keys))
        self.body: Lockstep = robot(eight(), state_period_s=dt_s)
        self.sent_ns: dict[int, int] = {}
        self.answered_ns: dict[int, int] = {}
        self.telemetry: dict[int, Telemetry] = {}
        self.arrived: list[Command] = []
        self.states = self.bus.publisher(keys.state)
        self.references = self.bus.publisher(keys.reference)
        self.commands = self.bus.subscriber(keys.command, capacity=RING_MESSAGES)
        self.telemetries = self.bus.subscriber(keys.telemetry, capacity=RING_MESSAGES)
        threading.Thread(target=self.hear, daemon=True).start()
        children.start(name, "rti_mpc_service.cli", "run", self.toml, "-e", endpoint)
        until(lambda: self.states.heard, "the controller")
        self.references.put(reference(eight().lasting(LIVES_S), "consistent"))

    def hear(self) -> None:
        for received in iter(self.commands.recv, None):
            now_ns = time.monotonic_ns()
            command = decode(Command, received.payload)
            self.answered_ns[command.state_seq] = now_ns
            self.arrived.append(command)

    def send(self) -> State | None:
        """Send the state that is due; return it."""
        while self.arrived:
            self.body.accept(self.arrived.pop(0))
        for received in self.telemetries.drain():
            telemetry = decode(Telemetry, received.payload)
            self.telemetry[telemetry.state_seq] = telemetry
        if (state := self.body.tick()) is not None:
            self.sent_ns[state.seq] = time.monotonic_ns()
            self.states.put(state)
        return state

    def latency_us(self, numbers: list[int]) -> np.ndarray:
        return np.array([1e-3 * (self.answered_ns[seq] - self.sent_ns[seq]) for seq in numbers if seq in self.answered_ns])

    def feedback_us(self, numbers: list[int]) -> np.ndarray:
        return np.array([self.telemetry[seq].feedback_us for seq in numbers if seq in self.telemetry])


@contextmanager
def two(folder: Path, dt_s: float) -> Iterator[tuple[Paced, Paced]]:
    """Two robots, of a controller that rehearses and of one that does not."""
    with Children(folder) as children, ExitStack() as stack:
        yield (
            Paced(folder / "with", "rehearsed", dt_s, rehearse=True, children=children, stack=stack),
            Paced(folder / "without", "unrehearsed", dt_s, rehearse=False, children=children, stack=stack),
        )


def pace(robots: tuple[Paced, ...], dt_s: float, samples: int, early_s: np.ndarray | None = None) -> dict[int, float]:
    """
    Send states of the robots in turn.

    Args:
        robots: The robots.
        dt_s: Period.
        samples: Of each robot.
        early_s: How much earlier than expected each of them is sent, shape ``(samples,)``; in time if None.

    Returns:
        How much earlier, by the number of the state.
    """
    began_s = time.monotonic() + 0.1
    early: dict[int, float] = {}
    for k in range(samples):
        ahead_s = 0.0 if early_s is None else float(early_s[k])
        for i, one in enumerate(robots):
            left_s = began_s + (k + i / len(robots)) * dt_s - ahead_s - time.monotonic()
            time.sleep(max(0.0, left_s))
            if left_s < -0.5 * dt_s:  # held up itself: the robots' clock waits, as that of the simulated robot does
                began_s -= left_s
            if (state := one.send()) is not None:
                early[state.seq] = ahead_s
    time.sleep(0.2)
    for one in robots:
        one.send()
    return early
