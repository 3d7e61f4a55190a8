# SPDX-License-Identifier: Apache-2.0
"""Adapters of a robot and of a planner, on a clock and a bus that tests move."""

from __future__ import annotations

import io
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from queue import SimpleQueue
from threading import Event as Stop
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rti_mpc.adapter import PlannerAdapter, RobotAdapter, robot
from rti_mpc.contract.message import STAMP_ON_ARRIVAL, Command, End, Event, Reference, State
from rti_mpc.errors import ConfigError, RtiMpcError
from rti_mpc.wire import connection
from rti_mpc.wire.bus import Bus, Received
from rti_mpc.wire.cdr import decode, encode, encoding
from rti_mpc.wire.info import Label, labels
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES, REFERENCE_HEAD_BYTES, most_rows
from rti_mpc_service.conformance.answer import answer
from tests.wire.fake_session import FakeSession

MS = 1_000_000
TIMEOUT_S = 60.0
KEYS = Keys(robot="car")
LIMITS: dict[str, Any] = {"dt_s": 0.1, "inputs": {"v_c": [-1.0, 1.0], "kappa": [-0.5, 0.5]}, "increments": {"v_c": [-0.2, 0.2]}}


class Session(FakeSession):
    """Session that hands over what the test has sent."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting: list[Received] = []

    def subscriber(self, key: Any, capacity: int, *, history: bool, wakes: bool = False) -> Any:
        return Waiting(self, str(key))


class Waiting:
    """Subscriber to what the test has sent."""

    def __init__(self, session: Session, key: str) -> None:
        self._session, self._key = session, key

    def drain(self) -> list[Received]:
        waiting = [received for received in self._session.waiting if received.key == self._key]
        self._session.waiting = [received for received in self._session.waiting if received.key != self._key]
        return waiting

    def undeclare(self) -> None:
        pass


class Scene:
    """A robot that is adapted, and its clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **limits: Any) -> None:
        self.now_ns = 10**12
        self.session, self.stop = Session(), Stop()
        monkeypatch.setattr(Bus, "join", lambda settings, keys, **_: Bus(self.session, keys))
        clock = SimpleNamespace(monotonic_ns=lambda: self.now_ns, time_ns=time.time_ns, sleep=self.sleep)
        monkeypatch.setattr(robot, "time", clock)
        self.robot = RobotAdapter("car", stop=self.stop, **(LIMITS | limits))
        self.seq = 0

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(1e9 * duration_s)

    def state(self) -> State:
        return decode(State, self.session.put[KEYS.state])

    def command(self, u: list[list[float]], **change: Any) -> None:
        """Answer the last state with rows of 0.1 s, valid for 250 ms."""
        self.seq += 1
        command = answer(self.state(), np.array(u), epoch=7, seq=self.seq, period_ns=100 * MS, valid_ns=250 * MS)
        self.session.waiting.append(Received(encode(replace(command, **change)), encoding(Command), KEYS.command))

    def acts(self, after_ms: int) -> list[float]:
        self.now_ns += after_ms * MS
        return [round(float(u), 6) for u in self.robot.act()]


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    scene = Scene(monkeypatch)
    scene.robot.send(np.zeros(4))
    return scene


def test_rows_act_from_their_time_on_and_the_state_says_which_and_whose(scene: Scene) -> None:
    scene.command([[0.2, 0.1], [0.4, 0.2], [0.6, 0.3]])
    assert [scene.acts(10), scene.acts(80), scene.acts(10)] == [[0.2, 0.1], [0.2, 0.1], [0.4, 0.2]]
    scene.robot.send([1.0, 2.0, 3.0, 4.0])
    state = scene.state()
    assert (state.seq, state.stamp_ns, state.x.tolist(), state.u.tolist()) == (2, scene.now_ns, [1.0, 2.0, 3.0, 4.0], [0.4, 0.2])
    assert (state.command_epoch, state.command_seq) == (7, 1)


def test_state_that_took_its_time_says_what_acted_when_it_was_measured(scene: Scene) -> None:
    scene.command([[0.2, 0.1], [0.4, 0.2], [0.6, 0.3]])
    assert [scene.acts(10), scene.acts(100)] == [[0.2, 0.1], [0.4, 0.2]]
    scene.robot.send(np.zeros(4), age_s=0.02)
    assert scene.state().stamp_ns == scene.now_ns - 20 * MS
    assert scene.state().u.tolist() == [0.2, 0.1]


def test_inputs_come_to_rest_inside_the_slew_limits_where_no_command_is_valid(scene: Scene) -> None:
    scene.command([[0.2, 0.1], [0.4, 0.2], [0.6, 0.3]])
    speeds = [scene.acts(10)[0] for _ in range(100)]
    assert max(speeds) == 0.6
    assert speeds[-1] == 0.0
    assert np.diff(speeds[25:]).min() >= -0.02 - 1e-9, "0.2 over 100 ms"
    scene.robot.send(np.zeros(4))
    assert (scene.state().command_epoch, scene.state().command_seq) == (0, 0)


def test_plan_that_begins_elsewhere_is_approached_inside_the_slew_limits(scene: Scene) -> None:
    scene.command([[1.0, 0.0]] * 5, valid_until_ns=scene.now_ns + 500 * MS)
    speeds = np.array([scene.acts(10)[0] for _ in range(48)])
    assert max(np.ptp(speeds[k : k + 8]) for k in range(40)) <= 0.2 + 1e-9, "over three quarters of a period"
    assert speeds[-1] >= 0.6


def test_what_is_for_another_life_or_out_of_bounds_is_refused_or_clipped(scene: Scene) -> None:
    scene.command([[0.2, 0.1]], state_epoch=1)
    assert scene.acts(10) == [0.0, 0.0]
    scene.command([[0.1, 9.0]])
    assert scene.acts(10) == [0.1, 0.5]


def test_loop_goes_on_after_ctrl_c_until_the_inputs_rest(scene: Scene) -> None:
    scene.command([[0.2, 0.1], [0.4, 0.2], [0.6, 0.3]])
    played = []
    for tick, _ in enumerate(scene.robot.every(0.01)):
        played.append(scene.robot.act()[0])
        if tick == 15:
            scene.stop.set()
    assert played[15] == pytest.approx(0.4)
    assert played[-1] == 0.0
    assert np.diff(played[16:]).min() >= -0.02 - 1e-9


def test_periods_lie_on_a_grid_and_missed_ones_are_skipped(scene: Scene) -> None:
    times = []
    for due_ns in scene.robot.every(0.01):
        times.append(due_ns)
        assert scene.now_ns >= due_ns
        scene.now_ns += (35 if len(times) == 3 else 4) * MS
        if len(times) == 6:
            scene.stop.set()
        scene.robot.act()
    assert (np.diff(times) // MS).tolist() == [10, 10, 40, 10, 10]


def test_robot_without_an_increment_has_no_slew_limit_and_one_at_rest_elsewhere_begins_there(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, u_rest={"kappa": 0.1})
    assert scene.acts(0) == [0.0, 0.1]


def way(**change: Any) -> dict[str, Any]:
    """A way to rest from the end of a plan of 0.1 s on, with a gain for two states."""
    K = np.array([[0.5, 0.0], [0.0, 0.2]])
    return {"rest_period_ns": 100 * MS, "u_rest": np.zeros((3, 2)), "x_rest": np.zeros((3, 2)), "K": K} | change


def test_way_to_rest_with_a_gain_is_corrected_by_what_the_robot_measures_angles_modulo_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, angles=[False, True])
    scene.robot.send([0.0, 0.0])
    scene.command([[0.1, 0.1]], valid_until_ns=scene.now_ns + 100 * MS, **way())
    assert [scene.acts(50), scene.acts(150)] == [[0.1, 0.1], [0.0, 0.0]]
    scene.robot.send([-0.2, 0.5 + 4 * np.pi])
    assert scene.acts(10) == [0.1, -0.1]
    scene.robot.send([-0.1, -0.5], age_s=0.05)
    assert scene.acts(10) == [0.05, 0.1]
    scene.robot.send([np.nan, 0.0])
    assert scene.acts(10) == [0.05, 0.1], "the controller refuses such a state, and nothing is corrected by it"
    assert scene.acts(300) == [0.0, 0.0], "the last state is too old"


def test_angles_in_degrees_are_corrected_modulo_360_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, angles=[False, "deg"])
    scene.robot.send([0.0, 0.0])
    scene.command([[0.1, 0.1]], valid_until_ns=scene.now_ns + 100 * MS, **way())
    assert [scene.acts(50), scene.acts(150)] == [[0.1, 0.1], [0.0, 0.0]]
    scene.robot.send([0.0, 0.5 - 720.0])
    assert scene.acts(10) == pytest.approx([0.0, -0.1])


def test_robot_that_drifts_is_kept_where_it_rests_once_its_controller_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mass that something pushes, driven by its acceleration: only with its states does it stay, within what the gain leaves."""
    found = {}
    for angles in ((), (False, False)):
        scene = Scene(monkeypatch, inputs={"a": [-1.0, 1.0]}, increments={}, angles=angles)
        x, v = 0.0, 0.0
        scene.robot.send([x, v])
        rest = way(u_rest=np.zeros((3, 1)), K=np.array([[1.0, 2.0]]))
        scene.command([[0.0]], valid_until_ns=scene.now_ns + 100 * MS, **rest)
        for _ in range(1000):
            (a,) = scene.acts(10)
            x, v = x + 0.01 * v, v + 0.01 * (a + 0.05)
            scene.robot.send([x, v])
        found[angles] = abs(x)
    assert found[()] > 2.0  # m, after 10 s
    assert found[False, False] < 0.06


def test_state_of_another_size_than_its_angles_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, angles=[False, True])
    with pytest.raises(ConfigError, match=r"^x must have as many components as angles, 2, got shape \(3,\)$"):
        scene.robot.send([0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("limits", "refusal"),
    [
        ({"dt_s": 0.0}, "dt_s must be above 0 and at most 10 s, got 0.0"),
        ({"inputs": {}}, "inputs must name at least one input, got none"),
        ({"increments": {"v": [-1, 1]}}, "increments.v must be one of the inputs v_c, kappa"),
        ({"u_rest": {"v": 1}}, "u_rest.v must be one of the inputs v_c, kappa"),
        ({"u_rest": {"v_c": 2.0}}, "inputs.v_c must hold the input at rest, 2, got [-1.0, 1.0]"),
        ({"angles": ["psi"]}, "angles must say of each state whether it is an angle, such as [False, True] or [False, 'deg'], got ['psi']"),
        (
            {"quaternions": [[0, 1, 2]]},
            "quaternions must be places of w, x, y, z among the states, of none that is an angle, got [0, 1, 2]",
        ),
        ({"increments": {"v_c": [0.1, 0.2]}}, "increments.v_c must go from below 0 to above 0, got [0.1, 0.2]"),
        ({"dt_s": "0.05"}, "dt_s must be real numbers, got '0.05'"),
        ({"inputs": [[-1, 1]]}, "inputs must have numbers by the names of inputs, got [[-1, 1]]"),
        ({"inputs": {1: [-1, 1]}}, "inputs must have numbers by the names of inputs, got {1: [-1, 1]}"),
        ({"inputs": {"v_c": 1.0}}, "inputs.v_c must be an array of shape (2,), got float64 of shape ()"),
        ({"inputs": {"v_c": [-1, "a"]}}, "inputs.v_c must be real numbers, got [-1, 'a']"),
        ({"increments": None}, "increments must have numbers by the names of inputs, got None"),
        ({"increments": {"v_c": [-0.1]}}, "increments.v_c must be an array of shape (2,), got float64 of shape (1,)"),
        ({"u_rest": {"v_c": "0"}}, "u_rest.v_c must be real numbers, got '0'"),
    ],
)
def test_limits_that_do_not_fit_are_refused_in_one_line(limits: dict[str, Any], refusal: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RtiMpcError) as refused:
        Scene(monkeypatch, **limits)
    assert str(refused.value) == refusal


def test_planner_sends_references_and_refuses_what_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    monkeypatch.setattr(Bus, "join", lambda settings, keys, **_: Bus(session, keys))
    with PlannerAdapter("car") as planner:
        planner.send([[0.0, 1.0], [2.0, 3.0]], 0.05, end=End.STOP)
        reference = decode(Reference, session.put[KEYS.reference])
        assert (reference.seq, reference.stamp_ns, reference.period_ns, reference.end) == (1, STAMP_ON_ARRIVAL, 50 * MS, End.STOP)
        assert (reference.y.tolist(), reference.p.shape) == ([[0.0, 1.0], [2.0, 3.0]], (2, 0))
        for y, period_s, p in (
            (3.0, 0.1, None),
            ([1.0, 2.0], 0.1, None),
            ([[np.nan]], 0.1, None),
            ([[1.0]], 0.0, None),
            ([[1.0]], 0.1, [[1.0], [2.0]]),
        ):
            with pytest.raises(ConfigError, match="must be"):
                planner.send(y, period_s, p=p)


@pytest.mark.parametrize("name", ["my robot", "", "a/b", None])
def test_name_that_no_robots_file_may_have_is_refused_before_the_bus_is_joined(name: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bus, "join", None)
    for adapt in (PlannerAdapter, lambda name: RobotAdapter(name, stop=Stop(), **LIMITS)):
        with pytest.raises(ConfigError, match="robot must be a word of letters, digits"):
            adapt(name)


def test_planner_beside_another_source_is_told_so_in_a_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    session = Session()
    monkeypatch.setattr(Bus, "join", lambda settings, keys, **_: Bus(session, keys))
    with PlannerAdapter("car") as planner:
        planner.send([[0.0], [1.0]], 0.05)
        assert capsys.readouterr().err == ""
        other = Reference(1, 1, 0, 50 * MS, End.HOLD, np.zeros((2, 1)), np.zeros((2, 0)))
        session.waiting.append(Received(encode(other), encoding(Reference), KEYS.reference))
        for _ in range(2):
            planner.send([[0.0], [1.0]], 0.05)
    said = "another source publishes references for car: its controller follows this one, not that one, while this one publishes; stop one of the two"
    assert capsys.readouterr().err == f"WARNING car: {said}\n"


class Lines(io.StringIO):
    """Standard error, line by line as it is printed."""

    def __init__(self) -> None:
        super().__init__()
        self.printed: SimpleQueue[str] = SimpleQueue()

    def write(self, text: str) -> int:
        if text.strip():
            self.printed.put(text)
        return len(text)


ADAPTERS: dict[str, Callable[[], RobotAdapter | PlannerAdapter]] = {
    "robot": lambda: RobotAdapter("car", stop=Stop(), **LIMITS),
    "planner": lambda: PlannerAdapter("car"),
}


@pytest.mark.parametrize("name", ADAPTERS)
def test_line_of_an_adapter_says_whether_it_is_a_fault_or_news(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loss and return of the links looked alike."""
    session, lines = FakeSession(), Lines()
    session.links, session.connects_to = 1, "tcp/127.0.0.1:7447"
    monkeypatch.setattr(Bus, "join", lambda settings, keys, **_: Bus(session, keys))
    monkeypatch.setattr(connection, "LOOK_INTERVAL_S", 0.001)
    monkeypatch.setattr(sys, "stderr", lines)
    with ADAPTERS[name]():
        session.links = 0
        assert lines.printed.get(timeout=TIMEOUT_S).startswith("ERROR   car: all links to other processes are lost")
        session.links = 1
        assert lines.printed.get(timeout=TIMEOUT_S).startswith("INFO    car: linked to others again")


WRONG_REFERENCES: dict[str, tuple[dict[str, Any], str]] = {
    "rows of different lengths": ({"y": [[1.0], [1.0, 2.0]]}, "y must be real numbers"),
    "text": ({"y": [["a"]]}, "y must be real numbers, got [['a']]"),
    "no columns": ({"y": [[]]}, "y must be a table of finite numbers, as many rows as y has, got shape (1, 0)"),
    "numbers that are too large": ({"y": [[1e19]]}, "y must be finite and at most 1e+18, got 1e+19"),
    "a period of text": ({"period_s": "fast"}, "period_s must be real numbers, got 'fast'"),
    "a period that is infinite": ({"period_s": np.inf}, "period_s must be above 0 and at most 1e+09 s, got inf"),
    "a period that no stamp holds": ({"period_s": 1e300}, "period_s must be above 0 and at most 1e+09 s, got 1e+300"),
    "a period below a nanosecond": ({"period_s": 1e-12}, "period_ns must be from 1 to 3600000000000, got 0"),
    "a period of two hours": ({"period_s": 7200.0}, "period_ns must be from 1 to 3600000000000, got 7200000000000"),
    "a time beyond all clocks": ({"stamp_ns": 2**63}, "a reference must be one that receivers take: integers must fit into their fields"),
    "an end that is none": ({"end": 7}, "end must be one of [0, 1], got 7"),
    "more rows than a message holds": (
        {"y": np.zeros((349_523, 3))},
        "y must have at most 349522 rows of this length",
    ),
}


@pytest.mark.parametrize("what", WRONG_REFERENCES)
def test_reference_that_no_receiver_would_take_is_refused_where_it_is_sent(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    session, (wrong, told) = Session(), WRONG_REFERENCES[what]
    monkeypatch.setattr(Bus, "join", lambda settings, keys, **_: Bus(session, keys))
    with PlannerAdapter("car") as planner, pytest.raises(RtiMpcError) as refused:
        planner.send(**({"y": [[1.0]], "period_s": 0.1} | wrong))
    assert told in str(refused.value)
    assert KEYS.reference not in session.put


def test_longest_reference_that_may_be_sent_is_one_that_sessions_let_through(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session()
    monkeypatch.setattr(Bus, "join", lambda settings, keys, **_: Bus(session, keys))
    with PlannerAdapter("car") as planner:
        for ny, np_ in ((1, 0), (3, 0), (2, 5)):
            most = most_rows(ny, np_)
            planner.send(np.zeros((most, ny)), 0.1, p=np.zeros((most, np_)) if np_ else None)
            assert 0 <= MAX_PAYLOAD_BYTES[Reference] - len(session.put[KEYS.reference]) < 8 * (ny + np_) + REFERENCE_HEAD_BYTES


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda robot: robot.send([[0.0, 1.0]]), r"x must be a list of the model's states, got shape \(1, 2\)"),
        (lambda robot: robot.send([]), r"x must be a list of the model's states, got shape \(0,\)"),
        (lambda robot: robot.send("now"), "x must be real numbers, got 'now'"),
        (lambda robot: robot.send([0.0], age_s=np.nan), "age_s must be finite, got nan"),
        (lambda robot: next(robot.every(0.0)), "period_s must be from 0.0001 to 10 s, got 0.0"),
        (lambda robot: next(robot.every("fast")), "period_s must be real numbers, got 'fast'"),
    ],
)
def test_wrong_call_of_a_robot_is_refused_by_name(scene: Scene, call: Any, told: str) -> None:
    with pytest.raises(RtiMpcError, match=f"^{told}$"):
        call(scene.robot)


def test_state_of_one_number_may_be_that_number_and_one_measured_ahead_of_the_clock_is_of_now(scene: Scene) -> None:
    scene.robot.send(5.0, age_s=-0.001)
    assert (scene.state().x.tolist(), scene.state().stamp_ns) == ([5.0], scene.now_ns)


def test_commands_of_a_model_with_the_same_inputs_in_another_order_are_refused_and_the_order_is_told(
    scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    """As where a TOML file names them in another order than the model, and its table is handed on: speed and curvature would be swapped."""

    def described(*inputs: str) -> None:
        about = {"role": "controller", **labels(inputs=[Label(name) for name in inputs])}
        scene.session.waiting.append(Received(json.dumps(about).encode(), "application/json", KEYS.info("controller")))

    described("kappa", "v_c")
    scene.command([[0.1, 0.2]])
    assert scene.acts(10) == [0.0, 0.0]
    event = decode(Event, scene.session.put[KEYS.event("robot")])
    assert capsys.readouterr().err == "ERROR   car: inputs must be in the order of the model, kappa, v_c, got v_c, kappa: no command is taken\n"
    assert event.code in ("inputs_misordered", "command_misordered")
    for right in (("v_c", "kappa"), ("v", "omega")):
        described(*right)
        scene.robot.send(np.zeros(4))
        scene.command([[0.1, 0.2]])
        assert scene.acts(10)[0] > 0.0, "names of its own are the robot's own affair"
