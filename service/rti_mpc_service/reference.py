# SPDX-License-Identifier: Apache-2.0
"""
Reference source as a process: one scenario, anchored to the robot's clock.

It waits for a state, publishes the whole reference from that state's stamp on, and
publishes it again whenever the robot restarts. Processes that join late get the
last reference while the source lives. A second robot of the same name, or a forged
state, gets no reference while the first robot lives. A second source for the same robot
does not start beside the first.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from threading import Event

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.lives import Heard, Lives
from rti_mpc.contract.message import Notice, Reference, Severity, State
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import RING_MESSAGES, Bus, BusSettings, Subscriber, new_epoch
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.rival import Rival
from rti_mpc_service.announce import announce
from rti_mpc_service.scenario import Scenario

ROLE = "reference"
LOOK_PERIOD_S = 0.02  # period of reading states: waking at every state would take processor time from the controller
RESTART_CHECK_NS = 500_000_000  # period of checking whether the robot was restarted
LISTEN_BEFORE_START_S = 0.5  # how long a starting source listens for another one
STALE_S = 1.0  # silence of the robot, and time for which only another one is heard, before the reference is anchored to that one

logger = logging.getLogger(ROLE)


def main(
    scenario: Scenario, bus_settings: BusSettings, keys: Keys, *, parameters: Callable[[Array], Array] | None = None, stop: Event | None = None
) -> int:
    """
    Publish a reference until stopped.

    Args:
        scenario: What to follow, see `rti_mpc_service.scenario.find_scenario`.
        bus_settings: How to join the bus.
        keys: Where its streams are.
        parameters: Stage parameters at times since the start, in s: of shape ``(M,)`` to ``(M, np)``; the model's nominal ones if left out.
        stop: Event that stops the source; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 0 when stopped, 1 when another source is present.
    """
    stop = stop or stop_on_signals()
    with Bus.join(bus_settings, keys, stop=stop, say=logger.warning) as bus:
        if has_source(bus):
            return 1
        source = ReferenceSource(bus, scenario, parameters)
        bus.alive(ROLE)
        logger.info("%s for %s", scenario.title, keys.robot)
        if scenario.note:
            logger.warning("%s", scenario.note)
        while not stop.wait(LOOK_PERIOD_S):
            source.publish_if_restarted()
    return 0


def has_source(bus: Bus) -> bool:
    """Whether another source publishes references for the robot; a line says so if one does."""
    present = bus.is_alive(ROLE, LISTEN_BEFORE_START_S)
    if present:
        print(f"rti-mpc: {bus.keys.robot} already has a source of references: stop it first", file=sys.stderr)
    return present


class ReferenceSource:
    """
    Publishes the reference for every new life of the robot.

    Attributes:
        anchored: How often the reference was anchored to a life of the robot.
    """

    def __init__(self, bus: Bus, scenario: Scenario, parameters: Callable[[Array], Array] | None) -> None:
        self.anchored = 0
        self._scenario, self._parameters = scenario, parameters
        self._epoch = new_epoch()
        self._publisher = bus.publisher(bus.keys.reference)
        self._announcer = Announcer(bus, ROLE, self._epoch)
        self._rival = Rival(bus, self._epoch)
        self._bus = bus
        self._states: Subscriber | None = None
        self._look_again_ns = 0
        self._stamp_ns = 0  # of the last state; 0 before the first one
        self._intake = bus.intake(State, STALE_S, {"x": scenario.nx})
        self._lives = Lives(STALE_S, STALE_S)
        bus.expect("state", lambda: self.anchored)
        bus.watch_connection(self._warn)

    def publish_if_restarted(self) -> None:
        """
        Publish the reference if a robot has started since the last look.

        An occasional state is enough to tell, more where there may be more than one
        robot. A permanent subscription would wake this process at every state, when
        robot and controller need the processor.
        """
        now_ns = time.monotonic_ns()
        if (notice := self._rival.notice()) is not None:
            announce(logger, self._announcer, notice, self._stamp_ns)
        if self._states is None:
            if now_ns < self._look_again_ns:
                return
            self._states = self._bus.subscriber(self._bus.keys.state, capacity=RING_MESSAGES)
        state = None
        for state in self._intake.newest_of_each(self._states.drain()):
            if self._lives.judge(state.epoch, now_ns) is Heard.BEGINS:
                self._anchor(state)
        if state is not None:
            self._stamp_ns = state.stamp_ns
            if self._lives.rival is None:
                self._states = None
                self._look_again_ns = now_ns + RESTART_CHECK_NS
        for notice in self._intake.notices(now_ns):
            self._announcer.say(notice, self._stamp_ns)

    def _warn(self, notice: Notice) -> None:
        """Announce and log what does not come from the robot; in any thread."""
        announce(logger, self._announcer, notice, self._stamp_ns)

    def _anchor(self, state: State) -> None:
        """Publish the reference that starts at a state."""
        self.anchored += 1
        scenario, stamp_ns = self._scenario, state.stamp_ns
        y = scenario.y(state.x)
        t: Array = np.float64(scenario.period_s) * np.arange(len(y))
        p = np.empty((len(y), 0)) if self._parameters is None else self._parameters(t)
        self._publisher.put(Reference(self._epoch, self.anchored, stamp_ns, round(1e9 * scenario.period_s), scenario.end, y, p))
        text = f"{scenario.name} for {scenario.duration_s:.1f} s from {1e-9 * stamp_ns:.3f} s of the robot on"
        self._announcer.say(Notice(Severity.INFO, "reference_published", text), stamp_ns)
        logger.info("%s", text)
