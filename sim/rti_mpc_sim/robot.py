# SPDX-License-Identifier: Apache-2.0
"""
Simulated robot as a process: the lockstep robot with a clock, on the bus.

It measures and sends states on an absolute grid of robot time, and integrates over
exactly the intervals in which each received row acts. If the process itself is held
up for a whole period, the robot's clock waits with it, so that a busy machine is not
taken for a fault of the controller. When the robot is stopped, its inputs go their way to
rest, and the last state that it sends is the one in which it stands; if it still coasts, it says so.
"""

from __future__ import annotations

import gc
import logging
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np

import rti_mpc
from rti_mpc.array import Array
from rti_mpc.contract.message import Command, Notice, Severity
from rti_mpc.contract.schedule import unfit
from rti_mpc.model.model import Model
from rti_mpc.signals import quantity
from rti_mpc.wire.actuator import STALE_NS, Counters
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import RING_MESSAGES, Bus, BusSettings, Subscriber, new_epoch
from rti_mpc.wire.info import labels
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_sim.clock import MAX_SLEEP_S, Clock
from rti_mpc_sim.lockstep import Lockstep
from rti_mpc_sim.log import Log
from rti_mpc_sim.settings import RobotSettings

ROLE = "robot"
STANDSTILL_CHANGE_S = 1e-6  # nothing moves any more if no state changes by more in a period than in operation in this time
STANDSTILL_SHARE = 1e-3  # of the rates in operation: the robot stands if no state changes faster
MAX_COAST_NS = 10_000_000_000  # robot time with the inputs at rest after which it is decided whether the robot stands
COAST_SHARE = 0.05  # of its robot time that this takes in real time: many states at once would be dropped as congestion
MAX_WAY_NS = 120_000_000_000  # robot time that the inputs may take to come to rest
LISTEN_BEFORE_START_S = 0.5  # how long a starting robot listens for another one of its name
PRESENCE_LEASE_S = 2.0  # time after which the presence of a process that was killed or hangs has ended

logger = logging.getLogger(ROLE)


@dataclass(frozen=True)
class RobotSummary:
    """
    Summary of one life of the robot.

    Attributes:
        states: States sent.
        held_up_s: Wall time for which the robot's clock waited for this process.
        counters: What became of commands.
    """

    states: int
    held_up_s: float
    counters: Counters


def main(
    settings: RobotSettings,
    bus_settings: BusSettings,
    keys: Keys,
    *,
    speed: float = 1.0,
    log: Path | None = None,
    duration_s: float | None = None,
    guarded: bool = False,
    info: dict[str, Any] | None = None,
    stop: Event | None = None,
) -> RobotSummary:
    """
    Play the robot until it is stopped.

    Args:
        settings: Plant, actuators and sensors.
        bus_settings: How to join the bus; the robot listens on the rendezvous endpoint.
        keys: Where its streams are.
        speed: Seconds of robot time per second.
        log: CSV file to write, see `rti_mpc_sim.log`.
        duration_s: Robot time after which it stops by itself.
        guarded: Whether it takes `actuation`, a guard's, and no `command`.
        info: Further entries of its description.
        stop: Stops the robot when set; SIGINT and SIGTERM if there is none.

    Raises:
        ConfigError: A setting is out of range, an endpoint is taken.
    """
    stop = stop or stop_on_signals()
    with Bus.join(bus_settings, keys, stop=stop, say=logger.warning) as bus:
        wait_for_another(bus, stop)
        robot = Robot(settings, bus, keys.actuation if guarded else keys.command, speed, log)
        life = {"role": ROLE, "epoch": robot.body.epoch, "speed": speed, "state_period_s": settings.state_period_s}
        life |= {"reports_inputs": settings.reports_inputs, "approaches": settings.increments is not None}
        bus.publish_json(keys.info(ROLE), {**model_info(settings.model), **(info or {}), **life})
        bus.alive(ROLE)
        bus.watch_connection(robot.warn)
        logger.info("epoch %d of %s, model %s, at %g times real speed", robot.body.epoch, keys.robot, settings.model.name, speed)
        gc.collect()
        gc.freeze()
        robot.run(stop, None if duration_s is None else round(1e9 * duration_s))
        return robot.finish()


def wait_for_another(bus: Bus, stop: Event) -> None:
    """Wait until no other robot of this name is present, for one lease at most: a killed robot vanishes within it, a living one stays."""
    if not bus.is_alive(ROLE, LISTEN_BEFORE_START_S):
        return
    logger.warning("another robot is present as %s: waiting for at most %g s until it is gone", bus.keys.robot, PRESENCE_LEASE_S)
    deadline_s = time.monotonic() + PRESENCE_LEASE_S
    while not stop.is_set() and time.monotonic() < deadline_s:
        if not bus.is_alive(ROLE, MAX_SLEEP_S):
            logger.info("the other robot is gone")
            return
        stop.wait(MAX_SLEEP_S)
    logger.warning("two robots use the name %s: stop one of them, or give it another name", bus.keys.robot)


def model_info(model: Model) -> dict[str, Any]:
    """Return the description of the robot's model for ``info``."""
    return {
        "version": rti_mpc.__version__,
        "model": model.name,
        "quaternions": model.quaternions,
        **labels(model.counterparts(), states=model.states, inputs=model.inputs, outputs=model.outputs),
        "parameters": {s.name: value for s, value in zip(model.parameters, model.p_nominal, strict=True)},
    }


def standing(model: Model, rate: Array, rates: Array) -> str:
    """Say whether a robot stands, by how fast its states change, now and in operation, shape ``(nx,)``, per s; if not, which of them does most."""
    fastest = int(np.argmax(np.abs(rate) / rates))
    if abs(rate[fastest]) < STANDSTILL_SHARE * rates[fastest]:
        return "stands"
    state = model.states[fastest]
    return f"coasts with its inputs at rest: {state.name} changes by {quantity(rate[fastest], state.unit)} per s"


class Robot:
    """
    One life of the robot on the bus.

    Attributes:
        body: The robot itself.
        clock: Its clock.
    """

    def __init__(self, settings: RobotSettings, bus: Bus, key: Key[Command], speed: float, log: Path | None) -> None:
        # Milliseconds: a robot restarted within a second is another one.
        self.body = Lockstep(settings, epoch=new_epoch())
        self._model, self._rates = settings.model, settings.rates
        self._log = Log(log, settings.model)
        self._states = bus.publisher(bus.keys.state)
        self._announcer = Announcer(bus, ROLE, self.body.epoch)
        self._inbox: deque[tuple[Command, int]] = deque(maxlen=64)  # with the monotonic time of arrival
        nx, nu, epoch = settings.model.nx, settings.model.nu, self.body.epoch
        self._intake = bus.intake(Command, 1e-9 * STALE_NS / speed, {"u": nu}, unfit=lambda command: unfit(command, nu, epoch, nx))
        bus.expect("command", lambda: self._intake.source.epoch is not None)
        self._refused = 0  # by the intake, so far
        self._sent = 0
        self._held_up_ns = 0
        Thread(target=self._receive, args=(bus.subscriber(key, capacity=RING_MESSAGES),), daemon=True).start()
        self.clock = Clock(speed)

    def run(self, stop: Event, until_ns: int | None = None) -> None:
        """Run the robot until stopped, or until a robot time."""
        body = self.body
        self.clock.set_back(body.now_ns)  # the time that construction took does not count
        while not stop.is_set() and (until_ns is None or body.now_ns < until_ns):
            due_ns = body.due_ns
            self.clock.wait(due_ns - body.period_ns // 2, stop)  # just after a state, the controller needs the cores
            self._log.write(time.monotonic_ns())
            self.clock.wait(due_ns, stop)
            if self.clock.now_ns() - due_ns >= body.period_ns:
                self._hold(due_ns)
            self._live(due_ns)

    def warn(self, notice: Notice) -> None:
        """Announce and log what does not come from the robot's own loop; in any thread."""
        self._announcer.say(notice, self.body.now_ns)
        logger.log(notice.severity.level, "%s", notice.text)

    def finish(self) -> RobotSummary:
        """Go the way to rest and coast until the robot stands, ahead of the clock, and sum up."""
        body = self.body
        body.actuator.switch_off()
        x, moved_s, rate = body.x.copy(), np.inf, np.zeros_like(body.x)
        begun_ns = rested_ns = body.now_ns
        while body.now_ns < min(begun_ns + MAX_WAY_NS, rested_ns + MAX_COAST_NS) and not (body.actuator.at_rest and moved_s < STANDSTILL_CHANGE_S):
            x[:], before_ns = body.x, body.now_ns
            self._advance(body.due_ns)
            moved_s = (np.abs(body.x - x) / self._rates).max()
            rate[:] = (body.x - x) / (1e-9 * max(1, body.now_ns - before_ns))
            rested_ns = rested_ns if body.actuator.at_rest else body.now_ns
            self._send_due()
            time.sleep(1e-9 * COAST_SHARE * body.period_ns)
        how = standing(self._model, rate, self._rates)
        stands = how == "stands"
        self._announcer.say(Notice(Severity.INFO if stands else Severity.WARNING, "robot_stopped", f"the robot was stopped and {how}"), body.now_ns)
        logger.log(logging.INFO if stands else logging.WARNING, "stopped, and %s", how)
        self._log.close()
        return RobotSummary(self._sent, 1e-9 * self._held_up_ns, body.counters)

    def _receive(self, subscriber: Subscriber) -> None:
        """Queue every accepted command with its time of arrival; a thread of its own. Refused commands take no place in the queue."""
        for received in iter(subscriber.recv, None):
            arrival_ns = time.monotonic_ns()
            if (command := self._intake.accept(received, arrival_ns)) is not None:
                self._inbox.append((command, arrival_ns))

    def _hold(self, due_ns: int) -> None:
        """Set the clock back to a time that this process missed."""
        late_ns = self.clock.set_back(due_ns)
        self._held_up_ns += late_ns
        text = f"the simulation was held up for {1e-6 * late_ns:.1f} ms, {1e-6 * self._held_up_ns:.1f} ms in all: the robot's clock waited"
        self._announcer.say(Notice(Severity.WARNING, "simulation_held_up", text), due_ns)

    def _live(self, to_ns: int) -> None:
        """Advance to a time with the commands that arrived by then; measure and send states that are due."""
        while self._inbox and self.clock.at_ns(self._inbox[0][1]) <= to_ns:
            self._take(*self._inbox.popleft())
        for notice in self._intake.notices(time.monotonic_ns()):
            self._announcer.say(notice, to_ns)
        refused = self._intake.refused.total() + self._intake.source.dropped
        self.body.counters.refused += refused - self._refused
        self._refused = refused
        starved = self.body.counters.starved
        self._advance(to_ns)
        if self.body.counters.starved > starved:
            ran_out = Notice(Severity.ERROR, "command_ran_out", "no valid command is left: the robot goes to rest by itself")
            self._announcer.say(ran_out, to_ns)
        self._send_due()

    def _take(self, command: Command, monotonic_ns: int) -> None:
        """Hand a command to the actuators."""
        arrival_ns = max(self.body.now_ns, self.clock.at_ns(monotonic_ns))
        reason = self.body.accept(command, arrival_ns)
        if reason:
            text = f"command {command.seq} of epoch {command.epoch} was refused: {reason.replace('_', ' ')}"
            self._announcer.say(Notice(Severity.WARNING, f"command_{reason}", text), arrival_ns)
        else:
            self._log.answered(command.state_seq, command.seq, monotonic_ns)

    def _advance(self, to_ns: int) -> None:
        """Advance to a time, and measure a state if it is due."""
        body = self.body
        body.advance(to_ns)
        if (seq := body.measure()) is not None:
            self._log.measured(seq, body.now_ns, body.x, body.u, body.counters, time.monotonic_ns())

    def _send_due(self) -> None:
        """Send the states that are due."""
        while (state := self.body.sensor.take(self.body.now_ns)) is not None:
            self._log.sent(state.seq, time.monotonic_ns())
            self._states.put(state)
            self._sent += 1
