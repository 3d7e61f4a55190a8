# SPDX-License-Identifier: Apache-2.0
"""
Controller process: waits for a state, sends its command, and prepares the next sample in the slack.

One thread receives states and does all of the control, so that only
`Controller.receive_state` and one `put` lie between a state and its command. In the
slack it forms second opinions, piece by piece, until the next state is there. The
other threads only hand things over: references through an inbox that is emptied in
the slack, requests and the check for silence through a lock that is held for
microseconds.

All threads share the interpreter's lock with the control thread, so none may compute
for long. References are laid out by the thread that receives them. A change of
parameters builds no expressions, and is tried just after a sample has ended. A switch
interval below the interpreter's 5 ms was measured and does not help: a sample then
loses the lock as often as it takes it, and preparations take twice as long.
"""

from __future__ import annotations

import gc
import logging
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Condition, Event, Lock, Thread
from typing import Any

from rti_mpc.contract.latch import Latch
from rti_mpc.contract.message import Command, Notice, Severity, State
from rti_mpc.control.controller import Controller
from rti_mpc.errors import ConfigError
from rti_mpc.journal.book import Book
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.way_to_rest import StopLaw
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import RING_MESSAGES, WOKEN, Bus, BusSettings, Subscriber
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc_service.announce import announce
from rti_mpc_service.compiling import work_shown
from rti_mpc_service.config.build import build_controller, build_rti
from rti_mpc_service.config.fit import check_period, check_stop
from rti_mpc_service.config.schema import Config
from rti_mpc_service.controller.journal import JournalPublisher
from rti_mpc_service.controller.kept_case import KeptCase
from rti_mpc_service.controller.leadership import LEADER, LISTEN_BEFORE_START_S, STANDBY, Candidate, hear_others
from rti_mpc_service.controller.orders import Orders
from rti_mpc_service.controller.params import Params
from rti_mpc_service.controller.references import References
from rti_mpc_service.controller.rehearsal import Rehearsal
from rti_mpc_service.controller.slack import Slack
from rti_mpc_service.description import check_length, controller_info, fitting
from rti_mpc_service.host import realtime
from rti_mpc_service.latch_file import LatchFile
from rti_mpc_service.operator_stop import OperatorStop
from rti_mpc_service.origin import Origin, model_hash, origin_files
from rti_mpc_service.warm_up import warm_up

TICK_PERIOD_S = 0.01  # period of the check for silence
MAX_RAMP_S = 0.6  # how long a controller that is being stopped may take to bring the robot to rest

log = logging.getLogger(LEADER)


def main(config: Config, bus_settings: BusSettings, *, standby: bool = False, state: Path | None = None, stop: Event | None = None) -> int:
    """
    Control one robot until stopped.

    Args:
        config: The robot's configuration.
        bus_settings: How to join the bus.
        standby: Whether to stand by while another controller leads.
        state: Folder in which an operator's stop is stored; None: the folder of the user or of the service.
        stop: Event that stops the controller; None: SIGINT and SIGTERM do.

    Returns:
        Exit status: 0 when stopped, 1 when another controller is present or an unforeseen error ended this one.

    Raises:
        ConfigError: A stop would not bring the robot to rest, a command not last until the next, or the leader has another configuration than its
            standby.
    """
    check_period(config)
    with work_shown("finding how the robot comes to rest", log.info):
        stop_law = check_stop(config)
    stop = stop or stop_on_signals()
    rti = build_rti(config, log.info)
    check_length(rti.ocp)
    warm_up(rti)
    controller = build_controller(config, rti, stop_law)
    book = Book(controller)
    if (notice := unguarded(config, stop_law)) is not None:
        controller.say(notice)
    lock = Condition()
    params = Params(config, controller, rti, lock)

    def obey(latch: Latch) -> None:
        with lock:
            if latch.stopped:
                controller.stop(latch.reason)
            else:
                controller.enable()

    origin = Origin(origin_files(config, rti.ocp.model), lambda: leadership.epoch)  # asks git, which must not be real-time
    # After compiling, and before any thread is started, so that all threads inherit the settings.
    outcomes = realtime.attempt(**config.realtime.model_dump(exclude={"rehearse"}))
    with Bus.join(bus_settings, config.keys(), stop=stop, say=log.warning) as bus:
        bus.expect("state", lambda: controller.heard)
        operator_stop = OperatorStop(LatchFile(bus.keys, state), obey, controller.say)
        operator_stop.listen(bus)
        others = hear_others(bus, stop)
        model = model_hash(rti.ocp.model)
        if standby and (misfit := others.misfit(config.config_hash, model)):
            raise ConfigError(misfit)
        if not standby and bus.is_alive(LEADER, LISTEN_BEFORE_START_S):
            print(
                f"rti-mpc: {config.robot} already has a controller: stop it first, run this one with --standby, or give this robot another name",
                file=sys.stderr,
            )
            return 1
        ocp = rti.ocp
        leadership = Candidate(
            bus, controller, others, config_hash=config.config_hash, model_hash=model, dt_s=ocp.dt, nu=ocp.model.nu, standby=standby
        )
        daemon = Daemon(config, controller, bus, leadership, params, lock, rti, outcomes, operator_stop, book)
        operator_stop.serve(bus, lambda: leadership.role, daemon.publish_info)
        bus.serve(bus.keys.request, daemon.orders.answer)
        bus.serve(bus.keys.origin, origin.answer)
        log.info("epoch %d controls %s every %g s" if leadership.leading else "%d stands by %s, every %g s", leadership.epoch, config.robot, ocp.dt)
        if outcomes:
            level = logging.INFO if all(outcome.granted for outcome in outcomes) else logging.WARNING
            log.log(level, "real time: %s", "; ".join(map(str, outcomes)))
        return daemon.run(stop)


def unguarded(config: Config, stop_law: StopLaw | None) -> Notice | None:
    """Return a notice of what a lost controller leaves, None for a robot that then stays at rest or has a guard."""
    if stop_law is None or stop_law.holds or config.guard.enabled:
        return None
    left = "unless the robot itself feeds its states back it does not stay at rest"
    return Notice(Severity.INFO, "unguarded", f"no guard: if this controller is lost, {left}: {stop_law.alone}")


class Daemon:
    """
    One life of a controller on the bus.

    Attributes:
        orders: Answers requests.
    """

    def __init__(
        self,
        config: Config,
        controller: Controller,
        bus: Bus,
        leadership: Candidate,
        params: Params,
        lock: Condition,
        rti: Rti,
        outcomes: Sequence[realtime.RealtimeOutcome],
        operator_stop: OperatorStop,
        book: Book,
    ) -> None:
        keys, model = bus.keys, rti.ocp.model
        self._config = config
        self._formulation = rti.formulation
        self._model_hash = model_hash(rti.ocp.model)
        self._controller = controller
        self._bus = bus
        self._leadership = leadership
        self._params = params
        self.orders = Orders(controller, rti, params, lock, operator_stop, lambda: leadership.leading, self.publish_info, book.ask)
        self._operator_stop = operator_stop
        self._lock = lock
        self._telling = Lock()
        self._told = 0  # descriptions published
        self._said = ""  # of the length of the last one
        self._ending = False
        self._crashed = Event()
        self._announcer: Announcer | None = None
        self._commands = bus.publisher(keys.command)
        self._telemetries = {role: bus.publisher(key) for role, key in ((LEADER, keys.telemetry), (STANDBY, keys.standby_telemetry))}
        book.epoch = leadership.epoch
        self._journal = JournalPublisher(bus, controller, book)
        self._case = KeptCase(rti, book)
        self._states_in = bus.intake(State, config.stale_s, {"x": model.nx, "u": model.nu})
        bus.watch_connection(controller.say)
        self._references = References(bus, controller, model.ny)
        self._prepare_us = 0.0
        self._slack = Slack()
        states = bus.subscriber(keys.state, capacity=RING_MESSAGES, wakes=True)
        self._rehearsal = Rehearsal(states.wake) if config.realtime.rehearse else None
        self._granted = {outcome.what: outcome.text for outcome in outcomes} | {"rehearsal": self._rehearsal.text if self._rehearsal else "off"}
        self._ticked_ns = 0
        self._threads = [
            Thread(target=self._guarded, args=(act, subscriber), name=act.__name__, daemon=True)
            for act, subscriber in (
                (self._control, states),
                (self._references.from_planner, bus.subscriber(keys.reference, capacity=RING_MESSAGES)),
                (self._references.from_leader, bus.subscriber(keys.anchored, capacity=RING_MESSAGES)),
            )
        ]
        if self._rehearsal is not None:
            self._threads.append(Thread(target=self._rehearsal.keep_time, name="rehearsal", daemon=True))

    def run(self, stop: Event) -> int:
        """Control until stopped; then bring the robot to rest and send rest as the last command, unless another controller takes over."""
        with self._lock:
            self._journal.start()
        gc.collect()
        gc.freeze()
        gc.disable()
        self._tick()
        for thread in self._threads:
            thread.start()
        self._guarded(self._watch, stop)
        with self._lock:
            relieved = self._ending = self._leadership.relieved
            self._guarded(self._controller.stop, "the controller is being stopped")
        deadline_s = time.monotonic() + MAX_RAMP_S
        while not (relieved or self._crashed.is_set() or self._controller.at_rest) and time.monotonic() < deadline_s:
            time.sleep(TICK_PERIOD_S)
        with self._lock:
            self._ending = True
            if not relieved:
                self._guarded(self._stand)
        for end in (self._journal.close, self._announce, self._operator_stop.close):
            self._guarded(end)
        log.info("stopped")
        return int(self._crashed.is_set())

    def _watch(self, stop: Event) -> None:
        """Tick until stopped, or until another loop has ended by an error."""
        while not stop.wait(TICK_PERIOD_S) and not self._crashed.is_set():
            self._tick()

    def _stand(self) -> None:
        """Send the last command: whatever happened before, it makes the robot come to rest and stay there."""
        if (command := self._controller.standstill(time.monotonic_ns())) is not None:
            self._commands.put(command)
            self._controller.commit(command)

    def _control(self, subscriber: Subscriber) -> None:
        """Answer states as they arrive: the control loop."""
        received = subscriber.recv()
        while received is not None:
            if received is WOKEN:
                if (received := subscriber.try_recv()) is None:
                    self._rehearse()
                    received = subscriber.recv()
                continue
            arrival_ns = time.monotonic_ns()
            for state in self._states_in.newest_of_each((received, *subscriber.drain()), self._controller.continues):
                self._sample(state, arrival_ns)
            self._announce()
            received = self._slack.fill(self._judge_piece, subscriber.try_recv)
            if received is None:
                self._photograph()
                received = subscriber.recv()

    def _sample(self, state: State, arrival_ns: int) -> None:
        """Answer one state: command, preparation of the next sample, telemetry."""
        controller = self._controller
        with self._lock:
            if self._ending:
                return
            if controller.continues(state):  # not for a repeated or outdated state
                self._leadership.receive_state(state, arrival_ns)
            command = proposal = controller.receive_state(state, arrival_ns)
            acted_ns = time.monotonic_ns()
            if proposal is not None:
                command = controller.in_time(proposal, acted_ns)
                if command is not None:
                    self._send(command, acted_ns)
                sent_ns = time.monotonic_ns()
                self._case.note(proposal, command, sent_ns)
                controller.prepare()
                prepared_ns = time.monotonic_ns()
                self._lock.notify_all()
            self._references.hand_over(self._leadership.leading)
        if command is not None:
            slack_s = controller.slack_s(prepared_ns)
            telemetry = controller.telemetry(
                prepare_us=self._prepare_us,
                feedback_us=1e-3 * (acted_ns - arrival_ns),
                latency_us=1e-3 * (sent_ns - arrival_ns),
                slack_s=slack_s,
                second_us=1e6 * self._slack.taken_s,
            )
            self._telemetries[self._leadership.role].put(telemetry)
            self._prepare_us = 1e-3 * (prepared_ns - sent_ns)
            left_s = slack_s / controller.robot_rate
            if (notice := self._slack.begin(left_s, judged=telemetry.second_seq > 0)) is not None:
                controller.say(notice)
            if self._rehearsal is not None and (notice := self._rehearsal.begin(left_s)) is not None:
                controller.say(notice)

    def _judge_piece(self) -> bool:
        """Let OSQP do a piece of its second opinion about the last plan, and return whether nothing is left to be done."""
        with self._lock:
            return self._ending or self._controller.second_opinion()

    def _photograph(self) -> None:
        """Take a snapshot for the journal if one is due, and as long as no state is."""
        controller, now_ns = self._controller, time.monotonic_ns()
        slack_s = controller.slack_s(now_ns) / controller.robot_rate if controller.grid.running else math.inf
        if self._journal.due(now_ns, slack_s):
            with self._lock:
                self._journal.photograph(now_ns)

    def _rehearse(self) -> None:
        """Go the way from a state to its command once more, so that the state that is due finds it in the caches; nothing else comes of it."""
        with self._lock:
            if self._rehearsal is None or self._ending or not self._rehearsal.timely:
                return
            self._states_in.rehearse()
            if (command := self._controller.rehearse(time.monotonic_ns())) is not None:
                encode(command)

    def _send(self, command: Command, left_ns: int | None = None) -> None:
        """Send a command if this controller leads, and record it."""
        if self._leadership.sends(command):
            self._commands.put(command)
        self._controller.commit(command, left_ns)

    def _guarded(self, act: Callable[..., object], *given: Any) -> None:
        """Run a loop or a step of the end; an error leads to a standstill and exit status 1, so that a supervisor restarts the controller."""
        try:
            act(*given)
        except Exception as error:
            if self._bus.closed:
                return  # by another thread, at the end of the process: the error does not matter
            log.exception("stopping after an unexpected error")
            self._controller.say(Notice(Severity.ERROR, "crashed", f"stopping after an unexpected error: {type(error).__name__}: {error}"))
            self._crashed.set()

    def _tick(self) -> None:
        """Check for silence of the robot or the leader, and announce what has happened; needed when no states come."""
        now_ns = time.monotonic_ns()
        held_up = now_ns - self._ticked_ns > 3e9 * TICK_PERIOD_S  # then received states may still wait to be processed
        self._ticked_ns = now_ns
        with self._lock:
            self._leadership.listen(now_ns)
            command = None if held_up else self._controller.tick(now_ns)
            if command is not None:
                self._send(command)
            if not self._controller.grid.running and self._journal.due(now_ns, math.inf):
                self._journal.photograph(now_ns)
        if self._leadership.declare():
            self._introduce()
        if (leader := self._leadership.leader()) is not None:
            self.orders.adopt(leader)
        self._announce()

    def _introduce(self) -> None:
        """Publish description and events under the present role from now on."""
        role = self._leadership.role
        self.publish_info()
        self._bus.withdraw(self._bus.keys.info(STANDBY if role == LEADER else LEADER))
        self._announcer = Announcer(self._bus, role, self._leadership.epoch)

    def publish_info(self) -> None:
        """Publish the description of this controller on ``info``."""
        with self._telling:
            role, config = self._leadership.role, self._config
            self._told += 1
            life = {"role": role, "epoch": self._leadership.epoch, "seq": self._told}
            about = {**life, "config_hash": config.config_hash, "model_hash": self._model_hash, "stale_s": config.stale_s}
            known = controller_info(self._params.ocp, self._controller.np_, self._controller.scales)
            model = {**known, "formulation": self._formulation, "realtime": self._granted}
            description, said = fitting({**model, **about, **self.orders.orders_info()})
            self._bus.publish_json(self._bus.keys.info(role), description)
            if said not in ("", self._said):
                self._controller.say(Notice(Severity.WARNING, "description_too_long", said))
            self._said = said

    def _announce(self) -> None:
        """Publish and log mode changes and faults."""
        announcer, now_ns = self._announcer, time.monotonic_ns()
        if announcer is None or announcer.role != self._leadership.role:
            return  # the next tick introduces the new role
        for notice in self._controller.notices():
            announce(log, announcer, notice, self._controller.robot_now_ns(now_ns))
        for intake in (self._states_in, self._references.planners, self._references.leaders, self._leadership.commands_in):
            for refusal in intake.notices(now_ns):
                announce(log, announcer, refusal, self._controller.robot_now_ns(now_ns))
