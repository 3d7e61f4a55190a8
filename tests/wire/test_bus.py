# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest
import zenoh

from rti_mpc.contract.message import Command, End, Event, Reference, Severity, State
from rti_mpc.wire import bus as bus_module
from rti_mpc.wire.bus import RING_MESSAGES, WOKEN, Bus, BusSettings, Received, Subscriber
from rti_mpc.wire.cdr import decode, encoding
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.keys import Key, Keys
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES
from rti_mpc.wire.streams import MAX_RING_BYTES
from rti_mpc.wire.zenoh_session import ZenohSession
from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from tests.in_time import MS, PATIENT, WAIT_BEFORE_CLOSE, WAIT_BEFORE_DROP, explained, in_time
from tests.wire.fake_session import FakeSession

ROOT = Path(__file__).parents[2]
KEYS = Keys(robot="test")
FAST = ("transport/link/tx/lease:600",)  # ms, as in peer.py
STATE = State(1, 1, 0, np.arange(5.0))
EVENT = Event(1, 1, 0, "robot", Severity.INFO, "code", "text")
REFERENCE = Reference(1, 1, 0, 10**8, End.HOLD, np.arange(6.0).reshape(2, 3), np.zeros((2, 0)))
TIMEOUT_S = 60
T = TypeVar("T")


def eventually(look: Callable[[], T | None], timeout_s: float = TIMEOUT_S) -> T:
    """First value that is neither None nor False."""
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        if (value := look()) is not None and value is not False:
            return value
        time.sleep(0.002)
    raise AssertionError(f"nothing happened within {timeout_s} s")


def received(subscriber: Subscriber) -> Received:
    return eventually(subscriber.try_recv)


def stranger(endpoint: str) -> zenoh.Session:
    """Session of a program that is not ours."""
    config = zenoh.Config()
    settings = {
        "mode": '"client"',
        "connect/endpoints": f'["{endpoint}"]',
        "scouting/multicast/enabled": "false",
        WAIT_BEFORE_DROP: f"{10**6 * TIMEOUT_S}",
        WAIT_BEFORE_CLOSE: f"{10**6 * TIMEOUT_S}",
    }
    for name, value in settings.items():
        config.insert_json5(name, value)
    return zenoh.open(config)


@pytest.fixture
def endpoint() -> str:
    return free_endpoint()


@pytest.fixture
def join(endpoint: str) -> Iterator[Callable[..., Bus]]:
    """Joins the bus, as the robot that listens or as anybody else."""
    with ExitStack() as stack:

        def join(*, robot: bool = False, **settings: Any) -> Bus:
            settings = {"listen": (endpoint,) if robot else (), "connect": (endpoint,), "cfg": PATIENT, **settings}
            return stack.enter_context(Bus.join(BusSettings(**settings), KEYS))

        yield join


@pytest.fixture
def start(endpoint: str) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts another process, see `peer.py`."""
    with ExitStack() as stack:

        def start(what: str, *args: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, str(Path(__file__).with_name("peer.py")), what, endpoint, *args]
            process = stack.enter_context(subprocess.Popen(command, env={**os.environ, "PYTHONPATH": str(ROOT)}))
            stack.callback(process.kill)
            return process

        yield start


def echoed(bus: Bus, seq: int) -> bool:
    """Whether a state is answered by the command of its number."""
    states, commands = bus.publisher(KEYS.state), bus.subscriber(KEYS.command)

    def answered() -> bool:
        states.put(State(1, seq, 0, np.ones(5)))
        answer = commands.try_recv()
        return answer is not None and decode(Command, answer.payload).state_seq == seq

    return eventually(answered)


def test_processes_exchange_messages_when_the_robot_starts_first(join: Any, start: Any) -> None:
    robot = join(robot=True)
    start("echo")
    assert echoed(robot, 7)


def test_processes_exchange_messages_when_the_robot_starts_last_and_restarts(join: Any, start: Any) -> None:
    start("echo")
    time.sleep(0.5)  # long enough to have tried in vain
    with join(robot=True) as robot:
        assert echoed(robot, 1)
    with join(robot=True) as robot:
        assert echoed(robot, 2)


def test_those_who_met_through_the_robot_stay_linked_without_it(join: Any) -> None:
    controller, viewer = join(), join()
    commands, seen = controller.publisher(KEYS.command), viewer.subscriber(KEYS.command)

    def passes() -> bool:
        commands.put(EVENT)
        return seen.try_recv() is not None

    assert not passes()
    with join(robot=True):
        assert eventually(passes)
    seen.drain()
    assert eventually(passes)
    controller.close()
    with join(robot=True):
        commands = join().publisher(KEYS.command)
        assert eventually(passes)


def test_a_cached_reference_reaches_a_late_joiner_in_another_process(join: Any, start: Any) -> None:
    start("plan")
    robot = join(robot=True)
    assert decode(Reference, received(robot.subscriber(KEYS.reference)).payload).y[1, 2] == 5.0
    late = join()
    sample = received(late.subscriber(KEYS.reference))
    assert np.array_equal(decode(Reference, sample.payload).y, REFERENCE.y)
    assert sample.encoding == encoding(Reference)


def test_a_cached_message_that_the_link_has_dropped_arrives_all_the_same(join: Any) -> None:
    """As large ones are on a busy host: DROP waits for nobody."""
    dropping = f"downsampling:[{{messages:['put'],flows:['egress'],rules:[{{key_expr:'{KEYS.reference}',freq:0.001}}]}}]"
    robot, planner = join(robot=True), join(cfg=(*FAST, dropping))
    references = robot.subscriber(KEYS.reference, capacity=8)
    publisher = planner.publisher(KEYS.reference)
    for seq in (1, 2, 3):  # all but the first that passes come too soon for the link
        publisher.put(replace(REFERENCE, seq=seq))
        assert eventually(lambda seq=seq: [decode(Reference, r.payload).seq for r in references.drain()] == [seq])


def test_a_cached_message_put_before_anybody_was_there_arrives_once(join: Any) -> None:
    planner, controller = join(), join()
    references = controller.subscriber(KEYS.reference, capacity=8)
    planner.publisher(KEYS.reference).put(REFERENCE)
    join(robot=True)
    received(references)
    late = join().subscriber(KEYS.reference, capacity=8)
    received(late)
    assert references.drain() == late.drain() == []


def test_late_joiners_get_the_last_event_and_info_of_every_role(join: Any) -> None:
    robot, other = join(robot=True), join()
    for role, bus in {"robot": robot, "reference": other}.items():
        events = bus.publisher(KEYS.event(role))
        events.put(EVENT)
        events.put(Event(1, 2, 0, role, Severity.INFO, "last", ""))
        bus.publish_json(KEYS.info(role), {"role": role})
        bus.publish_json(KEYS.info(role), {"role": role, "dt_s": 0.1})
    late = join()
    events, infos = late.subscriber(KEYS.events, capacity=8), late.subscriber(KEYS.infos, capacity=8)
    got = [received(events), received(events)]
    assert {decode(Event, sample.payload).source for sample in got} == {"robot", "reference"}
    assert {decode(Event, sample.payload).code for sample in got} == {"last"}
    assert {received(infos).payload, received(infos).payload} == {b'{"role": "%s", "dt_s": 0.1}' % role for role in (b"robot", b"reference")}


def test_nothing_grows_when_a_role_is_taken_again_and_again(join: Any) -> None:
    """A late joiner gets one last event, not one for every time; and the bus holds one publisher and one token per role."""
    robot = join(robot=True)
    for epoch in range(1, 6):
        for role in ("controller", "standby"):
            token = robot.alive(role)
            robot.publisher(KEYS.event(role)).put(replace(EVENT, epoch=epoch, source=role))
            robot.publish_json(KEYS.info(role), {"role": role})
            robot.withdraw(KEYS.info(role))
            token.undeclare()
    events = join().subscriber(KEYS.events, capacity=16)
    got = [decode(Event, received(events).payload) for _ in range(2)]
    assert {(event.epoch, event.source) for event in got} == {(5, "controller"), (5, "standby")}
    assert events.drain() == []
    assert (len(robot._publishers), len(robot._tokens), len(robot._declared)) == (2, 2, 0)


def test_late_joiners_do_not_get_what_was_withdrawn(join: Any) -> None:
    robot = join(robot=True)
    for role in ("controller", "standby"):
        robot.publish_json(KEYS.info(role), {"role": role})
    robot.withdraw(KEYS.info("controller"))
    infos = join().subscriber(KEYS.infos, capacity=8)
    assert received(infos).payload == b'{"role": "standby"}'
    robot.publish_json(KEYS.info("standby"), {"role": "last"})
    assert received(infos).payload == b'{"role": "last"}'


def test_own_messages_do_not_come_back(join: Any) -> None:
    robot, other = join(robot=True), join()
    own = [robot.subscriber(KEYS.state), robot.subscriber(KEYS.events)]
    seen = other.subscriber(KEYS.events)
    robot.publisher(KEYS.state).put(STATE)
    robot.publisher(KEYS.event("robot")).put(EVENT)
    own.append(robot.subscriber(KEYS.events))
    received(seen)
    assert [subscriber.try_recv() for subscriber in own] == [None, None, None]


def test_a_receiver_that_waits_is_woken_without_a_message_and_nobody_else_is(join: Any) -> None:
    robot, other = join(robot=True), join()
    states, another, elsewhere = robot.subscriber(KEYS.state, wakes=True), robot.subscriber(KEYS.state), other.subscriber(KEYS.state)
    woken: list[Received | None] = []
    waits = threading.Thread(target=lambda: woken.append(states.recv()))
    waits.start()
    states.wake()
    waits.join(TIMEOUT_S)
    assert woken == [WOKEN]
    assert woken[0] is WOKEN
    sender = other.publisher(KEYS.state)
    eventually(lambda: sender.heard)
    sender.put(STATE)
    assert decode(State, received(another).payload).seq == STATE.seq
    assert elsewhere.try_recv() is None


def test_a_wake_is_over_for_who_looks_for_messages_and_displaces_none(join: Any) -> None:
    robot, other = join(robot=True), join()
    states = robot.subscriber(KEYS.state, capacity=RING_MESSAGES, wakes=True)
    sender = other.publisher(KEYS.state)
    eventually(lambda: sender.heard)
    sender.put(STATE)
    first = states.recv()
    states.wake()
    assert states.try_recv() is None
    states.wake()
    sender.put(STATE)
    assert states.recv() is WOKEN
    assert states.recv() == first
    states.undeclare()
    states.wake()


def test_a_ring_keeps_the_newest(join: Any) -> None:
    robot, other = join(robot=True), join()
    one, three, end = robot.subscriber(KEYS.state), robot.subscriber(KEYS.state, capacity=3), robot.subscriber(KEYS.command)
    states = other.publisher(KEYS.state)
    ends = other.publisher(KEYS.command)
    eventually(lambda: states.heard and ends.heard)
    for seq in range(10):
        states.put(State(1, seq, 0, np.zeros(1)))
    ends.put(EVENT)
    received(end)
    assert [decode(State, sample.payload).seq for sample in one.drain()] == [9]
    assert [decode(State, sample.payload).seq for sample in three.drain()] == [7, 8, 9]


def test_a_ring_holds_fewer_of_what_may_be_long(join: Any) -> None:
    """A ring is limited in bytes as well: 1024 of the longest references would be 8 GiB."""
    robot, other = join(robot=True), join()
    references = robot.subscriber(KEYS.reference, capacity=RING_MESSAGES)
    marks = robot.subscriber(KEYS.event("planner"))  # of the same priority: what was sent before has come before
    planner, marker = other.publisher(KEYS.reference), other.publisher(KEYS.event("planner"))
    most = MAX_RING_BYTES // MAX_PAYLOAD_BYTES[Reference]
    for seq in range(1, 2 * most):
        planner.put(replace(REFERENCE, seq=seq))
        marker.put(replace(EVENT, seq=seq))
        eventually(lambda seq=seq: any(decode(Event, sample.payload).seq == seq for sample in marks.drain()))
    got = [decode(Reference, sample.payload).seq for sample in references.drain()]
    assert len(got) == most
    assert got[-1] == 2 * most - 1


def test_an_unread_subscriber_stops_nobody_and_put_never_waits(join: Any, host: Host) -> None:
    robot, other = join(robot=True), join(cfg=FAST)
    unread, commands = robot.subscriber(KEYS.telemetry), robot.subscriber(KEYS.command)
    flood, marks = other.publisher(KEYS.telemetry), other.publisher(KEYS.command)
    eventually(lambda: flood.heard and marks.heard)
    load = Event(1, 1, 0, "controller", Severity.INFO, "load", 2000 * "x")
    worst = (0, 0)
    for _ in range(3000):
        since_ns = time.monotonic_ns()
        flood.put(load)
        worst = max(worst, (time.monotonic_ns() - since_ns, since_ns))
    marks.put(EVENT)
    received(commands)
    received(unread)
    in_time(host, "a put", worst[0] / MS, 1000.0, worst[1])


def test_a_hung_viewer_does_not_cut_the_robot_from_the_controller(join: Any, start: Any, host: Host) -> None:
    robot = join(robot=True, cfg=FAST)
    changes: list[tuple[str, bool]] = []
    robot.watch_alive(lambda role, present: changes.append((role, present)))
    viewers = [start("watch") for _ in range(2)]
    eventually(lambda: changes.count(("viewer", True)) >= 1)
    start("echo")
    assert echoed(robot, 1)
    for viewer in viewers:
        viewer.send_signal(signal.SIGSTOP)
    states, commands = robot.publisher(KEYS.state), robot.subscriber(KEYS.command)
    until_s, heard_ns, gap = time.monotonic() + 3.0, time.monotonic_ns(), (0, 0)  # five leases
    while time.monotonic() < until_s or ("viewer", False) not in changes:
        assert time.monotonic() < until_s + TIMEOUT_S
        states.put(STATE)
        time.sleep(0.01)  # the pace of the robot
        now_ns = time.monotonic_ns()
        gap = max(gap, (now_ns - heard_ns, heard_ns))
        heard_ns = now_ns if commands.try_recv() is not None else heard_ns
    in_time(host, "the longest silence", gap[0] / MS, 600.0, gap[1])
    if ("controller", False) in changes:  # a lease of 0.6 s
        assert explained(host, "the controller was given up", 200.0, heard_ns - 4000 * MS, heard_ns)


def test_close_unblocks_whoever_waits(join: Any) -> None:
    bus = join(robot=True)
    subscribers = [bus.subscriber(KEYS.state), bus.subscriber(KEYS.events)]
    results: list[Received | None] = []
    threads = [threading.Thread(target=lambda s=subscriber: results.append(s.recv())) for subscriber in subscribers]
    for thread in threads:
        thread.start()
    bus.close()
    for thread in threads:
        thread.join(TIMEOUT_S)
    assert results == [None, None]
    assert subscribers[0].try_recv() is None
    assert subscribers[0].recv() is None


def test_close_waits_for_the_threads_that_answer_and_watch(join: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that came back from Zenoh while the interpreter ends would abort the process."""
    monkeypatch.setattr("rti_mpc.wire.zenoh_session.CLOSE_TIMEOUT_S", TIMEOUT_S)  # a busy host takes its time
    robot, before, asked, answered = join(robot=True), set(threading.enumerate()), threading.Event(), threading.Event()

    def answer(_: dict[str, Any]) -> dict[str, Any]:
        asked.set()
        time.sleep(0.1)
        answered.set()
        return {}

    robot.serve(KEYS.request, answer)
    robot.watch_alive(lambda *_: None)
    own = set(threading.enumerate()) - before
    other = join()

    def ask() -> None:
        with suppress(TimeoutError):  # the answer comes while its sender leaves
            other.request(KEYS.request, {}, 1.0)

    asking = threading.Thread(target=ask)
    asking.start()
    assert asked.wait(TIMEOUT_S)
    robot.close()
    assert answered.is_set()
    assert len(own) >= 2
    assert not any(thread.is_alive() for thread in own)
    asking.join(TIMEOUT_S)


def test_one_session_speaks_for_two_robots(join: Any, endpoint: str) -> None:
    """Each is found, queried and left as if it had a separate process."""
    keys = Keys(robot="first"), Keys(robot="second")
    with ZenohSession(BusSettings(listen=(endpoint,), connect=(endpoint,), cfg=FAST)) as session:
        robots = [Bus(session, mine) for mine in keys]
        with (
            Bus.join(BusSettings(connect=(endpoint,), cfg=FAST), keys[0]) as first,
            Bus.join(BusSettings(connect=(endpoint,), cfg=FAST), keys[1]) as second,
        ):
            controllers = first, second
            for number, (robot, mine) in enumerate(zip(robots, keys, strict=True)):
                robot.alive("robot")
                robot.publish_json(mine.info("robot"), {"role": "robot", "number": number})
                robot.serve(mine.stop, lambda request, number=number: {"ok": True, "by": number})
            states = [controller.subscriber(controller.keys.state) for controller in controllers]
            publishers = [robot.publisher(robot.keys.state) for robot in robots]
            for number, (controller, publisher, subscriber) in enumerate(zip(controllers, publishers, states, strict=True)):
                assert controller.is_alive("robot", TIMEOUT_S)
                assert json.loads(received(controller.subscriber(controller.keys.infos)).payload)["number"] == number
                assert controller.request(controller.keys.stop, {}, TIMEOUT_S) == {"ok": True, "by": number}
                eventually(lambda publisher=publisher: publisher.heard)
                publisher.put(replace(STATE, epoch=1 + number))
                assert decode(State, received(subscriber).payload).epoch == 1 + number
            assert [subscriber.try_recv() for subscriber in states] == [None, None], "neither hears of the other's robot"

            commands = robots[0].subscriber(keys[0].command)
            waiting = threading.Thread(target=commands.recv)
            waiting.start()
            robots[0].close()
            waiting.join(TIMEOUT_S)
            assert not waiting.is_alive(), "who waits for the robot that is left is told so"
            publishers[0].put(STATE)
            eventually(lambda: not first.is_alive("robot", 0.05))
            assert second.is_alive("robot", TIMEOUT_S)
            publishers[1].put(replace(STATE, epoch=2, seq=2))
            assert decode(State, received(states[1]).payload).seq == 2
            assert states[0].try_recv() is None


def test_close_is_bounded_while_a_peer_hangs(join: Any, start: Any, host: Host) -> None:
    bus = join(robot=True, cfg=FAST)
    viewer = start("watch")
    eventually(lambda: bus.is_alive("viewer"))
    viewer.send_signal(signal.SIGSTOP)
    flood = bus.publisher(KEYS.telemetry)
    for _ in range(2000):
        flood.put(Event(1, 1, 0, "controller", Severity.INFO, "load", 6000 * "x"))
    since_ns = time.monotonic_ns()
    bus.close()
    in_time(host, "the end", (time.monotonic_ns() - since_ns) / MS, 1000.0, since_ns)


def test_after_close_put_does_nothing(join: Any) -> None:
    bus = join(robot=True)
    publishers = [bus.publisher(KEYS.state), bus.publisher(KEYS.reference)]
    bus.close()
    bus.close()
    publishers[0].put(STATE)
    publishers[1].put(REFERENCE)


def test_the_last_message_before_close_arrives(join: Any, start: Any) -> None:
    states = join(robot=True).subscriber(KEYS.state)
    assert start("farewell").wait(TIMEOUT_S) == 0
    assert decode(State, received(states).payload).seq == 1


def test_a_process_that_forgets_to_close_exits(start: Any) -> None:
    assert start("careless").wait(TIMEOUT_S) == 0


def test_large_references_pass(join: Any) -> None:
    robot, other = join(robot=True), join()
    references = robot.subscriber(KEYS.reference)
    large = Reference(1, 1, 0, 10**7, End.STOP, np.random.default_rng(1).normal(size=(100_000, 3)), np.zeros((100_000, 0)))
    other.publisher(KEYS.reference).put(large)
    assert np.array_equal(decode(Reference, received(references).payload).y, large.y)


def test_what_is_longer_than_its_key_takes_is_withheld_and_what_no_key_takes_never_comes(join: Any, endpoint: str) -> None:
    robot = join(robot=True)
    keys = (KEYS.state, KEYS.command, KEYS.info("robot"))
    subscribers = [robot.subscriber(key, capacity=4) for key in keys]
    with stranger(endpoint) as session:
        for key, subscriber in zip(keys, subscribers, strict=True):
            with session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK) as publisher:
                eventually(lambda publisher=publisher: publisher.matching_status.matching)
                for size in (1 << 24, key.stream.max_bytes + 1, key.stream.max_bytes):
                    publisher.put(bytes(size))
            got = [received(subscriber), received(subscriber)]
            assert [(sample.size, len(sample.payload)) for sample in got] == [(key.stream.max_bytes + 1, 0), 2 * (key.stream.max_bytes,)]


def test_whatever_peers_send_is_counted_and_the_next_message_passes(join: Any, endpoint: str) -> None:
    robot = join(robot=True)
    states, intake = robot.subscriber(KEYS.state, capacity=16), Intake(State, stale_s=1.0, widths={"x": 5})
    with stranger(endpoint) as session, session.declare_publisher(KEYS.state) as publisher:
        eventually(lambda: publisher.matching_status.matching)
        publisher.put(b"\x01\x02\x03")
        publisher.put(b"\x01\x02\x03", encoding=encoding(State))
        publisher.put(b"", encoding=encoding(State), attachment=b"\x00")
        publisher.put(b"\x00\x00\x00\x00", encoding=encoding(State))
        publisher.put(np.random.default_rng(5).bytes(10**6), encoding=encoding(State).replace("@2", "@1"))
        publisher.delete()
        samples = [received(states) for _ in range(6)]
        assert [intake.accept(sample, n) for n, sample in enumerate(samples)] == [None] * 6
    assert intake.refused == {"encoding": 2, "truncated": 1, "empty": 1, "big_endian": 1, "version": 1}
    ours = join().publisher(KEYS.state)
    eventually(lambda: ours.heard)
    ours.put(STATE)
    assert intake.accept(received(states), 7) is not None


def test_a_second_publisher_on_a_key_takes_nothing_over(join: Any) -> None:
    robot, first, second = join(robot=True), join(), join()
    states, intake = robot.subscriber(KEYS.state, capacity=64), Intake(State, stale_s=10.0)
    ours, theirs = first.publisher(KEYS.state), second.publisher(KEYS.state)
    eventually(lambda: ours.heard and theirs.heard)
    ours.put(State(9, 0, 0, np.zeros(5)))
    assert intake.accept(received(states), 0) is not None
    for seq in range(1, 11):
        ours.put(State(9, seq, 0, np.zeros(5)))
        theirs.put(State(8, 100 + seq, 0, np.ones(5)))
    samples = [received(states) for _ in range(20)]
    accepted = [message for sample in samples if (message := intake.accept(sample, 1)) is not None]
    assert [(message.epoch, message.seq) for message in accepted] == [(9, seq) for seq in range(1, 11)]
    assert [notice.code for notice in intake.notices(1)] == ["source_refused"]


def test_requests_are_answered_and_faults_of_handlers_reported(join: Any) -> None:
    robot, operator = join(robot=True), join()

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        return {"ok": True, "did": request["do"]} if request["do"] != "burn" else {"ok": True, "fire": object()}

    robot.serve(KEYS.request, handle)
    assert operator.request(KEYS.request, {"do": "stop"}, TIMEOUT_S) == {"ok": True, "did": "stop"}
    assert operator.request(KEYS.request, {}, TIMEOUT_S) == {"ok": False, "error": "'do'"}
    assert operator.request(KEYS.request, {"do": "burn"}, TIMEOUT_S)["ok"] is False
    assert operator.request(KEYS.request, {"do": "stop"}, TIMEOUT_S)["ok"] is True


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b"1", b"\xff", 30_000 * b"["])
def test_requests_that_are_not_json_objects_are_answered(join: Any, endpoint: str, payload: bytes) -> None:
    robot = join(robot=True)
    robot.serve(KEYS.request, lambda request: {"ok": True})
    with stranger(endpoint) as session:
        (reply,) = session.get(KEYS.request, payload=payload, timeout=TIMEOUT_S)
        assert reply.ok.payload.to_string() == '{"ok": false, "error": "message must be a JSON object"}'


def test_request_that_would_take_long_to_parse_is_refused_unread(join: Any, endpoint: str) -> None:
    robot = join(robot=True)
    robot.serve(KEYS.request, lambda request: {"ok": True})
    with stranger(endpoint) as session:
        for size, answer in ((32_768, '{"ok": true}'), (32_769, '{"ok": false, "error": "message must have at most 32768 bytes, got 32769"}')):
            (reply,) = session.get(KEYS.request, payload=b"{}".ljust(size), timeout=TIMEOUT_S)
            assert reply.ok.payload.to_string() == answer


def test_of_several_answers_a_refusal_counts(join: Any) -> None:
    robot, other, operator = join(robot=True), join(), join()
    robot.serve(KEYS.request, lambda request: {"ok": True})
    other.serve(KEYS.request, lambda request: {"ok": False, "error": "no"})
    eventually(lambda: operator.request(KEYS.request, {}, TIMEOUT_S) == {"ok": False, "error": "no"})


def test_who_has_no_answer_leaves_it_to_others(join: Any) -> None:
    robot, other = join(robot=True), join()
    robot.serve(KEYS.request, lambda request: None)
    other.serve(KEYS.request, lambda request: {"ok": True, "by": "other"})
    assert join().request(KEYS.request, {"request": "params"}, TIMEOUT_S) == {"ok": True, "by": "other"}


def test_a_request_waits_for_its_server_and_gives_up_in_time(join: Any, host: Host) -> None:
    robot, operator = join(robot=True), join()
    since_ns = time.monotonic_ns()
    with pytest.raises(TimeoutError, match="test/request must be served"):
        operator.request(KEYS.request, {}, 0.3)
    in_time(host, "giving up", (time.monotonic_ns() - since_ns) / MS, 1000.0, since_ns)
    threading.Timer(0.2, robot.serve, (KEYS.request, lambda request: {"ok": True})).start()
    assert operator.request(KEYS.request, {}, TIMEOUT_S) == {"ok": True}


def test_presence_is_seen_and_a_killed_process_is_missed(join: Any, start: Any) -> None:
    robot = join(robot=True)
    changes: list[tuple[str, bool]] = []
    robot.watch_alive(lambda role, present: changes.append((role, present)))
    assert not robot.is_alive("controller")
    controller = start("echo")
    eventually(lambda: ("controller", True) in changes)
    assert robot.is_alive("controller")
    assert join().is_alive("controller")
    controller.kill()
    eventually(lambda: ("controller", False) in changes)
    assert not robot.is_alive("controller")


class Settling(FakeSession):
    """A session that is linked to one more process at each look, and sees presence at the last."""

    def __init__(self, looks: int) -> None:
        super().__init__()
        self.links: int = 0
        self._looks = looks

    def present(self, key: Key[Any], timeout_s: float) -> bool:
        self.links = min(self.links + 1, self._looks)
        return self.links == self._looks


def test_look_for_another_process_goes_on_while_others_are_still_met() -> None:
    """On a busy host the first link may be there long before the one to the process that is looked for."""
    assert Bus(Settling(looks=4), KEYS).is_alive("reference", 0.0)


def test_look_for_another_process_ends_when_this_one_is_to_end() -> None:
    stop = threading.Event()
    stop.set()
    session = Settling(looks=1_000_000)
    assert not Bus(session, KEYS, stop=stop).is_alive("reference")
    assert session.links == 1, "looks"


def test_look_for_another_process_ends_though_others_come_and_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bus_module, "SETTLING_S", 0.3)
    assert not Bus(Settling(looks=1_000_000), KEYS).is_alive("reference", 0.0)
