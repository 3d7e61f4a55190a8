# SPDX-License-Identifier: Apache-2.0
"""Guard and robot on ways to rest that commands carry: a mass driven by a force, which coasts at zero input, judged by its standstill."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rti_mpc.array import Array
from rti_mpc.contract.approach import SLEW_WINDOW_PERIODS, Increments
from rti_mpc.contract.guard import Guard
from rti_mpc.contract.limits import Limits
from rti_mpc.contract.message import Command, State
from rti_mpc.rotation import Rotations
from rti_mpc.wire.actuator import Actuator
from rti_mpc_service.conformance.answer import answer

MS = 1_000_000
LOCAL_NS = 10**15  # local time when the robot's clock is 0
DT = 100 * MS
BOUND, STEP = np.array([1.0]), np.array([0.5])  # acceleration in m/s^2, its increment over 100 ms
LIMITS = Limits(np.zeros(1), -BOUND, BOUND, -STEP, STEP, dt_s=0.1, rotations=Rotations(2))
BRAKES = [-0.5, -1.0, -1.0, -1.0, -1.0, -0.5, 0.0]  # from 0.5 m/s to 0
GAIN = np.array([[0.0, 2.0]])  # 1/s, of the speed alone


class Mass:
    """
    A mass, its guard and a controller.

    Attributes:
        x: Position in m and speed in m/s.
        guarded: Whether a guard is between controller and robot.
        plays_ways: Whether the robot itself plays ways to rest, or rows alone.
    """

    def __init__(self, *, guarded: bool = True, plays_ways: bool = True, measures: bool = True, push: float = 1.0, fall: float = 0.0) -> None:
        self.reports = True  # which inputs act
        self.guarded, self.plays_ways, self.measures = guarded, plays_ways, measures
        self.push, self.fall = push, fall  # what an input is worth, and how fast it falls over, in 1/s^2
        self.x = np.zeros(2)
        self.guard = Guard(LIMITS, epoch=10)
        self.actuator = Actuator(np.zeros(1), LIMITS.slew, 7, 0, (-BOUND, BOUND), Increments(-STEP, STEP, DT), LIMITS.rotations)
        self.now_ns = self.seq = self.sent = self.paused_ns = 0
        self.linked = True  # between guard and robot
        self.heard = True  # by the guard
        self.published: list[Command] = []
        self.refused = ""
        self.acted: list[float] = []  # every 10 ms
        self.wait(1000)

    @property
    def local_ns(self) -> int:
        return LOCAL_NS + self.now_ns + self.paused_ns

    def pause(self, ms: int) -> None:
        """Let it stand still with its clock, as a simulation that is held up, while the guard goes on."""
        for _ in range(ms // 10):
            self.paused_ns += 10 * MS
            self.tell(self.guard.tick(self.local_ns))

    def wait(self, ms: int) -> None:
        """Let it live in steps of 10 ms; states come every 20 ms."""
        for _ in range(ms // 10):
            for until_ns, u in self.actuator.play(self.now_ns, self.now_ns + 10 * MS):
                h = 1e-9 * (until_ns - self.now_ns)
                a = self.push * u[0] + self.fall * self.x[0]
                self.x += [h * self.x[1] + 0.5 * h * h * a, h * a]
                self.now_ns = until_ns
            self.acted.append(float(self.actuator.u[0]))
            if self.now_ns % (20 * MS) == 0:
                self.sent += 1
                self.state = State(
                    7, self.sent, self.now_ns, self.x.copy(), self.actuator.u.copy() if self.reports else np.zeros(0), *self.actuator.source
                )
                if self.measures:
                    self.actuator.measure(self.x, self.now_ns)
                if self.heard:
                    self.guard.receive_state(self.state, self.local_ns)
            if self.guarded:
                self.tell(self.guard.tick(self.local_ns))

    def tell(self, told: Command | None) -> None:
        if told is None or not self.linked:
            return
        self.published.append(told)
        if not self.plays_ways:
            told = replace(told, rest_period_ns=0, u_rest=np.zeros((0, 0)), x_rest=np.zeros((0, 0)), K=np.zeros((0, 0)))
        assert self.actuator.accept(told, self.now_ns) == ""

    def command(self, u: Array | None = None, **change: Any) -> Command:
        """Rows, coasting unless told otherwise, for 250 ms from the last state on, and the brakes after them."""
        self.seq += 1
        rows = np.zeros((3, 1)) if u is None else u
        healthy = answer(self.state, rows, epoch=100, seq=self.seq, period_ns=DT, valid_ns=250 * MS)
        return replace(healthy, **{"rest_period_ns": DT, "u_rest": np.array(BRAKES)[:, None], **change})

    def send(self, **change: Any) -> bool:
        """Command, through the guard if there is one; return whether the robot got it."""
        command: Command | None = self.command(**change)
        if self.guarded:
            self.guard.notices.clear()
            command = self.guard.receive_command(command, self.local_ns)  # type: ignore[arg-type]
            self.refused = " ".join(notice.text for notice in self.guard.notices if notice.code.startswith("command_"))
        self.tell(command)
        return command is not None

    def drive(self, periods: int = 5, **change: Any) -> Mass:
        """Coast at 0.5 m/s; the controller dies after its last command."""
        self.x[1] = 0.5
        for _ in range(periods):
            assert self.send(**change), self.refused
            self.wait(100)
        return self

    def fed_back(self) -> dict[str, Any]:
        """Speeds along the brakes, and the gain."""
        speeds = 0.5 + 0.1 * np.concatenate([[0.0], np.cumsum(BRAKES)[:-1]])
        return {"x_rest": np.column_stack([np.zeros(7), speeds]), "K": GAIN}


def inside(acted: list[float]) -> bool:
    """Whether inputs of every 10 ms keep to the slew limits within three quarters of a period."""
    span = round(1e2 * SLEW_WINDOW_PERIODS * 0.1)
    return all(np.ptp(acted[i : i + span + 1]) <= STEP[0] + 1e-9 for i in range(len(acted)))


WHO = [(True, True), (True, False), (False, True)]
WHO_NAMES = ["guard and robot", "guard alone", "robot alone"]


@pytest.mark.parametrize(("guarded", "plays_ways"), WHO, ids=WHO_NAMES)
def test_robot_whose_inputs_coast_stands_after_the_last_command(guarded: bool, plays_ways: bool) -> None:
    mass = Mass(guarded=guarded, plays_ways=plays_ways).drive()
    mass.wait(3000)
    assert abs(mass.x[1]) < 1e-9
    assert inside(mass.acted)
    assert [u for i, u in enumerate(mass.acted) if i and u != mass.acted[i - 1]] == [-0.5, -1.0, -0.5, 0.0]
    assert mass.guard.at_rest(mass.local_ns)
    assert mass.actuator.at_rest == (not guarded)


def test_command_without_a_way_to_rest_leaves_such_a_robot_coasting() -> None:
    """Its inputs rest at zero, where it coasts: the reason for ways to rest."""
    mass = Mass().drive(u_rest=np.zeros((0, 0)))
    mass.wait(3000)
    assert mass.x[1] == pytest.approx(0.5)


@pytest.mark.parametrize("after_ms", [100, 200, 300, 400, 430, 600])
def test_robot_goes_on_its_way_to_rest_when_its_guard_dies_on_it(after_ms: int) -> None:
    """Each piece that the guard tells carries what is left of the way."""
    mass = Mass().drive()
    mass.wait(after_ms)
    mass.linked = False
    mass.wait(3000)
    assert abs(mass.x[1]) < 1e-9
    assert inside(mass.acted)
    assert mass.actuator.at_rest


@pytest.mark.parametrize("period_ms", [10, 37, 50, 130, 300])
def test_guard_tells_a_way_of_any_period_in_step_with_the_robot(period_ms: int) -> None:
    rows = np.clip(np.linspace(0.0, -0.5, 30), -0.001 * 5 * period_ms, 0.0)[:, None]
    rows = np.vstack([np.maximum(rows, -0.005 * period_ms * np.arange(30)[:, None]), rows[::-1]])
    alone, through = Mass(guarded=False), Mass(plays_ways=False)
    for mass in (alone, through):
        mass.drive(rest_period_ns=period_ms * MS, u_rest=rows)
        mass.wait(300 + 70 * period_ms)
        assert inside(mass.acted)
        mass.x[1] -= 0.5 + 1e-3 * period_ms * rows.sum()  # what the rows do
    assert abs(alone.x[1]) < 1e-9
    assert abs(through.x[1]) <= 0.02 * 0.5, "rows begin up to a step of 10 ms late"


@pytest.mark.parametrize(("guarded", "plays_ways"), WHO, ids=WHO_NAMES)
def test_feedback_brings_a_robot_to_rest_whose_inputs_do_less_than_believed(guarded: bool, plays_ways: bool) -> None:
    def speed(**fed_back: Any) -> float:
        mass = Mass(guarded=guarded, plays_ways=plays_ways, push=0.8).drive(**fed_back)
        mass.wait(5000)
        assert inside(mass.acted)
        return abs(float(mass.x[1]))

    assert speed() == pytest.approx(0.1)
    assert speed(**Mass().fed_back()) < 1e-3


@pytest.mark.parametrize(("guarded", "plays_ways"), WHO, ids=WHO_NAMES)
def test_feedback_holds_what_would_fall_over(guarded: bool, plays_ways: bool) -> None:
    fed_back = {"u_rest": np.zeros((3, 1)), "x_rest": np.zeros((3, 2)), "K": np.array([[5.0, 3.0]])}
    mass = Mass(guarded=guarded, plays_ways=plays_ways, fall=2.0)
    mass.x[:] = 0.01, 0.0
    assert mass.send(**fed_back)
    mass.wait(6000)
    assert np.abs(mass.x).max() < 1e-3
    assert inside(mass.acted)
    dropped = Mass(guarded=guarded, plays_ways=plays_ways, fall=2.0)
    dropped.x[:] = 0.01, 0.0
    assert dropped.send(u_rest=np.zeros((3, 1)))
    dropped.wait(6000)
    assert abs(dropped.x[0]) > 1.0


@pytest.mark.parametrize("after_ms", range(0, 1200, 100))
def test_guard_keeps_the_way_to_rest_when_the_robots_clock_has_waited(after_ms: int) -> None:
    """What the robot reports is then from before all that the guard still knows to act."""
    mass = Mass(push=0.9)
    mass.drive(**mass.fed_back())
    for _ in range(3):
        mass.wait(after_ms)
        mass.pause(500)
        mass.wait(300)
    mass.wait(3000)
    assert len(mass.published[-1].K), "it still feeds back"
    assert abs(mass.x[1]) < 1e-3


def test_robot_holds_itself_when_its_guard_dies_and_the_guard_holds_a_robot_that_measures_nothing() -> None:
    fed_back = {"u_rest": np.zeros((3, 1)), "x_rest": np.zeros((3, 2)), "K": np.array([[5.0, 3.0]])}
    for change in ({"linked": False}, {"measures": False}):
        mass = Mass(fall=2.0)
        mass.x[:] = 0.01, 0.0
        assert mass.send(**fed_back)
        mass.wait(700)
        for name, value in change.items():
            setattr(mass, name, value)
        mass.wait(6000)
        assert np.abs(mass.x).max() < 1e-3, change


def test_robot_that_would_fall_over_holds_itself_while_its_guard_hears_no_state() -> None:
    """As where every state comes with a NaN: rows that nobody corrects would take the place of the robot's own feedback."""
    mass = Mass(fall=2.0)
    gain = np.array([[4.0, 3.0]])
    mass.drive(2, **{**mass.fed_back(), "x_rest": np.zeros((7, 2)), "u_rest": np.zeros((7, 1)), "K": gain, "u": np.zeros((5, 1))})
    mass.x[:] = 0.02, 0.0
    mass.heard = False
    mass.wait(6000)
    assert np.abs(mass.x).max() < 1e-2


def test_feedback_takes_no_plan_from_the_robot_that_is_about_to_begin() -> None:
    mass = Mass(plays_ways=False, push=0.8).drive(**Mass().fed_back())
    mass.wait(300)
    told = len(mass.published)
    begins_ns = mass.state.stamp_ns + 80 * MS
    assert mass.send(stamp_ns=begins_ns, valid_until_ns=begins_ns + 250 * MS, u=np.array([[-0.8], [-0.7], [-0.6]]))
    mass.wait(60)
    assert len(mass.published) == told + 1
    mass.wait(40)
    assert mass.actuator.source == (mass.published[-1].epoch, mass.published[-1].seq)
    assert mass.acted[-1] == -0.8


def test_guard_takes_back_what_a_state_has_added_once_it_is_too_old() -> None:
    mass = Mass().drive(**Mass().fed_back())
    mass.wait(3000)
    mass.guard.receive_state(replace(mass.state, seq=mass.sent + 1, stamp_ns=mass.now_ns + MS, x=np.array([0.0, 0.1])), mass.local_ns + MS)
    told = mass.guard.tick(mass.local_ns + 2 * MS)
    assert told is not None
    np.testing.assert_allclose(told.u[-1], [-0.2])
    told = mass.guard.tick(mass.local_ns + 300 * MS)
    assert told is not None
    assert not told.u[-1].any()


# What is refused.


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"u_rest": np.array([[-0.5], [-1.1], [0.0]])}, "inputs to rest reach from [-1.1] to [0.0]"),
        ({"u_rest": np.array([[-0.5], [-1.0], [0.0]])}, "rows to rest change by up to [1.0]"),
        ({"u_rest": np.array([[-0.6], [-0.5], [0.0]])}, "rows from the plan to its way to rest change by up to [0.6]"),
        ({"rest_period_ns": DT // 2}, "rows to rest change by up to [0.5]"),
        ({"u_rest": np.zeros((7, 2))}, "wrong shape"),
        ({"x_rest": np.zeros((7, 3)), "K": np.zeros((1, 3))}, "wrong shape"),
        ({"u_rest": np.full((7, 1), np.nan)}, "not finite"),
    ],
)
def test_way_to_rest_is_judged_as_the_plan_is(change: dict[str, Any], why: str) -> None:
    mass = Mass()
    assert mass.send()
    mass.wait(100)
    assert not mass.send(**change)
    assert why in mass.refused


def test_way_to_rest_that_needs_feedback_passes_only_where_the_states_are_known() -> None:
    mass = Mass()
    mass.guard = Guard(replace(LIMITS, rotations=Rotations()), epoch=10)
    mass.wait(1000)
    assert not mass.send(**mass.fed_back())
    assert "its way to rest feeds 2 states back, of 0 that are known" in mass.refused
    assert mass.send()


SETTLED_MS = 1e3 * LIMITS.settling_s  # after a command without a way to rest: 300 ms, and the ramp of 200 ms
WAY_MS = 100 * len(BRAKES) - 200  # by which the way lasts longer than the ramp


def passes_ms(mass: Mass) -> int:
    """Time until a command passes, each answering the last state."""
    for waited_ms in range(0, 5000, 20):
        if mass.send():
            return waited_ms
        mass.wait(20)
    raise AssertionError(mass.refused)


@pytest.mark.parametrize("reports", [True, False])
def test_guard_that_starts_waits_for_the_end_of_a_way_to_rest_of_which_the_robot_says_nothing(reports: bool) -> None:
    """The robot is still on the way of a command that an earlier guard has passed; if it reports its inputs, the guard knows where on it."""
    mass = Mass().drive()
    mass.reports, mass.guard = reports, Guard(LIMITS, epoch=20)
    mass.wait(40)  # two states
    assert SETTLED_MS + WAY_MS * (not reports) - 60 <= passes_ms(mass) <= SETTLED_MS + WAY_MS * (not reports)


def test_commands_wait_after_two_robots_for_as_long_as_a_way_to_rest_moves_one_of_them() -> None:
    mass = Mass().drive()
    for _ in range(3):
        mass.guard.receive_state(replace(mass.state, epoch=8, seq=mass.sent), mass.local_ns)
        mass.wait(20)
    assert not mass.send()
    assert "two" in mass.refused
    assert SETTLED_MS + WAY_MS - 60 <= passes_ms(mass) <= SETTLED_MS + WAY_MS + 20


def test_way_to_rest_is_passed_on_whole_and_inside_the_bounds() -> None:
    mass = Mass()
    rows = np.array([[-0.5], [-1.0], [-1.0 - 1e-7], [-0.5]])
    assert mass.send(u_rest=rows, x_rest=np.ones((4, 2)), K=GAIN)
    passed = mass.published[-1]
    np.testing.assert_array_equal(passed.u_rest, np.clip(rows, -1.0, 1.0))
    np.testing.assert_array_equal(passed.x_rest, np.ones((4, 2)))
    np.testing.assert_array_equal(passed.K, GAIN)
    assert passed.rest_period_ns == DT


# An operator's stop.


def test_latched_guard_passes_ways_that_come_to_rest_in_time_and_then_rest() -> None:
    mass = Mass().drive()
    mass.guard.latch("asked for", mass.local_ns)
    rows = np.array([[0.0], *([u] for u in BRAKES), *([[0.0]] * 20)])
    for k in range(25):
        assert mass.send(u=rows[k : k + 3], u_rest=rows[k + 3 :] if k + 3 < len(rows) else np.zeros((1, 1))), (k, mass.refused)
        mass.wait(100)
    assert abs(mass.x[1]) < 1e-9
    assert mass.guard.passing


def test_controller_that_drives_on_is_braked_by_the_guard_while_a_stop_is_latched() -> None:
    """Each of its commands has a way to rest, which begins later every time."""
    mass = Mass().drive()
    mass.guard.latch("asked for", mass.local_ns)
    passed = []
    for _ in range(40):
        passed.append(mass.send())
        mass.wait(100)
    assert not any(passed[4:]), "each is valid for 300 ms at most"
    assert abs(mass.x[1]) < 1e-9
    assert "only ways to rest pass" in mass.refused


@pytest.mark.parametrize("u", [0.1, -0.1, 1.0])
def test_nothing_pushes_a_robot_that_stands_while_a_stop_is_latched(u: float) -> None:
    mass = Mass().drive()
    mass.guard.latch("asked for", mass.local_ns)
    mass.wait(3000)
    assert not mass.send(u=np.full((3, 1), u), u_rest=np.full((3, 1), u)), "held, but not where it stands"
    assert not mass.send(u=np.full((3, 1), u), u_rest=np.zeros((3, 1))), "not held"
    assert mass.send(u=np.zeros((3, 1)), u_rest=np.zeros((3, 1)))
    mass.wait(1000)
    assert not mass.actuator.u.any()


def test_stopped_guard_does_not_wait_for_a_silent_robot_that_plays_its_way_by_itself() -> None:
    mass = Mass().drive()
    assert mass.send(**mass.fed_back()), mass.refused
    mass.guard.stop(mass.local_ns)
    mass.heard = False
    mass.wait(round(1e3 * LIMITS.stale_s) + 20)
    assert mass.guard.at_rest(mass.local_ns)
    mass.wait(2000)
    assert abs(mass.x[1]) < 1e-3


def test_guard_that_is_stopped_brings_the_robot_to_rest_by_the_way_it_knows() -> None:
    mass = Mass().drive()
    mass.guard.stop(mass.local_ns)
    while not mass.guard.at_rest(mass.local_ns):
        mass.wait(10)
    mass.wait(200)
    mass.linked = False
    mass.wait(1000)
    assert abs(mass.x[1]) < 0.02 * 0.5, "its next tick may be 10 ms later"
    assert inside(mass.acted)
