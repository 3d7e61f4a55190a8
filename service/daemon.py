# SPDX-License-Identifier: Apache-2.0
"""
The controller as a process: waits for the state, acts, prepares the next sample in the slack.

One thread waits for states and does all of the control, so that nothing stands
between a state and its command but `Controller.receive_state` and one `put`. The
others only hand things over: references through an inbox that is emptied in the
slack, requests and the watch for silence through a lock that is held for
microseconds.
"""

from __future__ import annotations

import gc
import logging
import sys
import time
from collections import deque
from math import isfinite
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

import rti_mpc
from rti_mpc.array import Array
from rti_mpc.controller import Controller, Timing
from rti_mpc.errors import MessageError
from rti_mpc.message import Command, Reference, Severity, State, Telemetry
from rti_mpc.obstacle import discs_of
from rti_mpc.ocp import Ocp
from rti_mpc.rti import Rti
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import Bus, BusSettings, Subscriber
from rti_mpc.wire.cdr import decode
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.interrupt import stop_on_signals
from service import injection, realtime
from service.config import Config

ROLE = "controller"
TICK_S = 0.01  # between two looks for silence
HEARING_S = 0.5  # for which a starting controller listens for another
RAMP_S = 0.6  # of a controller that is being stopped, to bring the robot to rest
PLANNER_STALE_S = 60.0  # silence of a planner after which one of a lower epoch may take over; a restarted one has a higher
WARM_UP = 20  # solves before the first command: the first real sample is not the first call

log = logging.getLogger(ROLE)


def main(config: Config, bus_settings: BusSettings, *, stop: Event | None = None) -> int:
    """
    Control one robot until stopped.

    Args:
        config: The robot.
        bus_settings: How to join the bus.
        stop: Stops the controller when set; SIGINT and SIGTERM if there is none.

    Returns:
        Exit status: 0 when stopped, 1 when another controller is there or an unforeseen error ended this one.
    """
    stop = stop or stop_on_signals()
    rti = config.build_rti()
    ocp = rti.ocp
    warm_up(rti)
    observer = config.build_observer()
    timing = Timing(config.delay_s, config.stale_s, config.timing.valid_s)
    Controller(rti, timing)  # compiles what is left to: a compiler must not be started in real time
    outcomes = realtime.attempt(**config.realtime.model_dump())  # before any thread is started, for all of them
    with Bus(bus_settings, config.keys(), stop=stop) as bus:
        heard = heard_epoch(bus, stop)
        if bus.is_alive(ROLE, HEARING_S):
            print(f"rti-mpc: {config.robot} already has a controller: stop it first, or give this robot another name", file=sys.stderr)
            return 1
        epoch = max(time.time_ns() // 1_000_000_000, heard + 1)
        controller = Controller(rti, timing, epoch=epoch, config_hash=config.config_hash, observer=observer)
        daemon = Daemon(controller, bus, epoch, rti, config.stale_s)
        bus.publish_json(
            bus.keys.info(ROLE),
            {
                **describe(ocp, controller.np_),
                "formulation": rti.formulation,
                "config_hash": config.config_hash,
                "epoch": epoch,
                "stale_s": config.stale_s,
                "realtime": {outcome.what: outcome.text for outcome in outcomes},
            },
        )
        bus.serve(bus.keys.request, daemon.answer)
        bus.alive(ROLE)
        log.info("epoch %d controls %s every %g s", epoch, config.robot, ocp.dt)
        if outcomes:
            level = logging.INFO if all(outcome.granted for outcome in outcomes) else logging.WARNING
            log.log(level, "real time: %s", "; ".join(map(str, outcomes)))
        return daemon.run(stop)


def warm_up(rti: Rti) -> None:
    """Solve a few samples at rest."""
    x0: Array = np.zeros(rti.ocp.model.nx)
    rti.reset(x0, rti.u_prev.copy())
    for _ in range(WARM_UP):
        rti.prepare(rti.y_ref.copy())
        rti.feedback(x0)


def heard_epoch(bus: Bus, stop: Event) -> int:
    """Return the highest epoch heard from a controller or a guard within `HEARING_S`, 0 if there is none."""
    subscribers = [bus.subscriber(key) for key in (bus.keys.command, bus.keys.actuation)]
    stop.wait(HEARING_S)
    highest = 0
    for received in (subscriber.try_recv() for subscriber in subscribers):
        if received is not None:
            try:
                highest = max(highest, decode(Command, received.payload).epoch)
            except MessageError:
                continue
    return highest


def describe(ocp: Ocp, np_: int) -> dict[str, Any]:
    """Describe a controller for ``info``: names, units, limits; null where there is none. Parameters from `np_` on are disturbances."""
    model = ocp.model
    vectors = {"states": model.states, "inputs": model.inputs, "outputs": model.outputs}
    vectors |= {"parameters": model.parameters[:np_], "disturbances": model.parameters[np_:]}
    limits = ("lbu", "ubu", "lbdu", "ubdu", "lbx", "ubx")
    return {
        "role": ROLE,
        "version": rti_mpc.__version__,
        "model": ocp.model.name,
        **{name: [{"name": s.name, "unit": s.unit, "angle": s.angle} for s in signals] for name, signals in vectors.items()},
        **{name: [value if isfinite(value) else None for value in getattr(ocp, name).tolist()] for name in limits},
        "p_nominal": list(model.p_nominal[:np_]),
        "obstacles": [{"at": at, "x": x, "y": y, "r": r} for at, x, y, r in discs_of(model)],
        "N": ocp.N,
        "N_u": ocp.N_u,
        "dt_s": ocp.dt,
        "integrator": ocp.method,
    }


class Daemon:
    """One life of the controller on the bus."""

    def __init__(self, controller: Controller, bus: Bus, epoch: int, rti: Rti, stale_s: float) -> None:
        keys, model = bus.keys, rti.ocp.model
        self._rti = rti
        self._controller = controller
        self._lock = Lock()
        self._ending = False
        self._crashed = Event()
        self._announcer = Announcer(bus, ROLE, epoch)
        self._commands = bus.publisher(keys.command, Command, realtime=True)
        self._telemetry = bus.publisher(keys.telemetry, Telemetry)
        self._anchored = bus.publisher(keys.anchored, Reference, cached=True)
        self._states_in = Intake(State, stale_s, {"x": model.nx})
        self._references_in = Intake(Reference, PLANNER_STALE_S, {"y": model.ny, "p": controller.np_})
        self._references: deque[Reference] = deque(maxlen=1)
        self._prepare_us = 0.0
        self._ticked_ns = 0
        self._threads = [
            Thread(target=self._guarded, args=(act, bus.subscriber(key, cached=cached)), name=act.__name__, daemon=True)
            for act, key, cached in ((self._control, keys.state, False), (self._listen, keys.reference, True))
        ]

    def run(self, stop: Event) -> int:
        """Control until stopped; then bring the robot to rest, and make rest the last command."""
        gc.collect()
        gc.freeze()
        gc.disable()
        for thread in self._threads:
            thread.start()
        while not stop.wait(TICK_S) and not self._crashed.is_set():
            self._tick()
        with self._lock:
            self._controller.stop("the controller is being stopped")
        deadline_s = time.monotonic() + RAMP_S
        while not self._crashed.is_set() and not self._controller.at_rest and time.monotonic() < deadline_s:
            time.sleep(TICK_S)
        with self._lock:
            self._ending = True
            # Whatever happened above, the last thing the robot hears is to come to rest, and stay there.
            if (command := self._controller.standstill(time.monotonic_ns())) is not None:
                self._commands.put(command)
        self._announce()
        log.info("stopped")
        return int(self._crashed.is_set())

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Grant a request of an operator."""
        what = request.get("request")
        with self._lock:
            if what == "stop":
                self._controller.stop("asked for by an operator")
            elif what == "enable":
                self._controller.enable()
            elif what == "inject":
                return injection.answer(self._rti, request)
            else:
                return {"ok": False, "error": f"request must be stop, enable or inject, got {what!r}"}
        return {"ok": True, "request": what}

    def _control(self, subscriber: Subscriber) -> None:
        """Act on states as they come: the loop that counts."""
        controller, intake = self._controller, self._states_in
        for received in iter(subscriber.recv, None):
            arrival_ns = time.monotonic_ns()
            state = intake.accept(received, arrival_ns)
            command = None
            if state is not None:
                with self._lock:
                    if self._ending:
                        return
                    command = controller.receive_state(state, arrival_ns)
                    acted_ns = time.monotonic_ns()
                    if command is not None:
                        command = controller.in_time(command, acted_ns)
                        if command is not None:
                            self._commands.put(command)
                        sent_ns = time.monotonic_ns()
                        controller.prepare()
                        prepared_ns = time.monotonic_ns()
                    while self._references:
                        if (anchored := controller.receive_reference(self._references.pop())) is not None:
                            self._anchored.put(anchored)
            if command is not None:
                self._telemetry.put(
                    controller.telemetry(
                        prepare_us=self._prepare_us,
                        feedback_us=1e-3 * (acted_ns - arrival_ns),
                        latency_us=1e-3 * (sent_ns - arrival_ns),
                        slack_s=controller.slack_s(prepared_ns),
                    )
                )
                self._prepare_us = 1e-3 * (prepared_ns - sent_ns)
            self._announce()

    def _listen(self, subscriber: Subscriber) -> None:
        """Take references in."""
        for received in iter(subscriber.recv, None):
            reference = self._references_in.accept(received, time.monotonic_ns())
            if reference is not None:
                self._references.append(reference)

    def _guarded(self, act: Any, subscriber: Subscriber) -> None:
        """Run a loop; what nobody foresaw ends in a standstill and a non-zero exit, for the supervisor to restart."""
        try:
            act(subscriber)
        except Exception:
            log.exception("stopping after an unforeseen error")
            self._crashed.set()

    def _tick(self) -> None:
        """Look for silence, and say what there is to say when no state does."""
        now_ns = time.monotonic_ns()
        held_up = now_ns - self._ticked_ns > 3e9 * TICK_S  # then states may have come that nobody has looked at yet
        self._ticked_ns = now_ns
        if not held_up:
            with self._lock:
                command = self._controller.tick(now_ns)
                if command is not None:
                    self._commands.put(command)
        self._announce()

    def _announce(self) -> None:
        """Publish and log mode changes and faults."""
        now_ns = time.monotonic_ns()
        while self._controller.notices:
            try:
                notice = self._controller.notices.popleft()
            except IndexError:
                return  # the other thread took it
            log.log(LEVELS[notice.severity], "%s", notice.text)
            self._announcer.say(notice.severity, notice.code, notice.text, self._controller.robot_now_ns(now_ns))
        for intake in (self._states_in, self._references_in):
            for refusal in intake.notices(now_ns):
                log.warning("%s", refusal.text)
                self._announcer.say(refusal.severity, refusal.code, refusal.text, self._controller.robot_now_ns(now_ns))


LEVELS = {Severity.INFO: logging.INFO, Severity.WARNING: logging.WARNING, Severity.ERROR: logging.ERROR}
