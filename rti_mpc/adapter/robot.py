# SPDX-License-Identifier: Apache-2.0
"""
Adapter of a robot: its states to the bus, and from there the inputs to apply.

The robot's clock is the monotonic clock of this process. Commands are played as
`rti_mpc.contract.schedule` says: each row from its time on, approached inside the slew
limits from what was really applied before; without a valid command the inputs go to rest.
What acts is reported in each state, so that the controller plans from there.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from threading import Event
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

import rti_mpc
from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.approach import Increments
from rti_mpc.contract.message import Command, Notice, Severity, State
from rti_mpc.contract.schedule import unfit
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.rotation import TURNS, Rotations
from rti_mpc.wire.actuator import STALE_NS, Actuator
from rti_mpc.wire.announcer import Announcer
from rti_mpc.wire.bus import RING_MESSAGES, Bus, BusSettings, new_epoch
from rti_mpc.wire.info import Info, Label, labels
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.received import Received
from rti_mpc.wire.session import RENDEZVOUS_ENDPOINT

ROLE, CONTROLLER = "robot", "controller"
NO_LIMIT = (-np.inf, np.inf)


class RobotAdapter:
    """
    One life of a robot on the bus; leaves it at the end of a ``with`` block. For one thread.

    Attributes:
        inputs: Names of the inputs, in the order of `act`.
    """

    def __init__(
        self,
        robot: str,
        *,
        dt_s: float,
        inputs: Mapping[str, tuple[float, float]],
        increments: Mapping[str, tuple[float, float]],
        u_rest: Mapping[str, float] | None = None,
        angles: Sequence[bool | str] = (),
        quaternions: Sequence[Sequence[int]] = (),
        guarded: bool = False,
        prefix: str = "rti_mpc",
        bus: BusSettings | None = None,
        stop: Event | None = None,
    ) -> None:
        """
        Join the bus, with the inputs at rest. Call it in the main thread, unless `stop` is given.

        Args:
            robot: Name of the robot, as in its TOML file.
            dt_s: Period of the controller, ``ocp.dt_s`` of that file.
            inputs: Bounds of each input, ``ocp.bounds.inputs`` of that file, in the order of the model: commands of a controller whose model has
                the same inputs in another order are refused.
            increments: Slew limits over `dt_s`, ``ocp.bounds.increments``; an input that is left out has none.
            u_rest: Inputs at rest that are not 0.
            angles: Which states are angles, in the order of the model, in rad or by their unit, rad or deg, for a robot that needs feedback to
                stay at rest: then the states that are sent correct its way to rest. Left out: the rows of the way act as they are.
            quaternions: Places of w, x, y and z of each attitude among them.
            guarded: Whether a guard runs: then only what it passes on is taken.
            prefix: What all keys begin with.
            bus: How to join; None: a peer that listens on the usual endpoint, where the others look for the robot.
            stop: Ends `every` when set; None: SIGINT and SIGTERM do.

        Raises:
            ConfigError: A name or a number does not fit, or the endpoint is taken.
        """
        rest = u_rest or {}
        check_limits(dt_s, inputs, increments, rest)
        rotations = known_rotations(angles, quaternions)
        self.inputs = tuple(inputs)
        lbu, ubu = np.array([inputs[name] for name in self.inputs], dtype=np.float64).T
        lbdu, ubdu = np.array([increments.get(name, NO_LIMIT) for name in self.inputs], dtype=np.float64).T
        dt_ns, nu, epoch = round(1e9 * dt_s), len(inputs), new_epoch()
        self._epoch, self._seq = epoch, 0
        self._stop = stop or stop_on_signals()
        self._actuator = Actuator(
            np.array([rest.get(name, 0.0) for name in self.inputs]),
            np.minimum(-lbdu, ubdu) / dt_s,
            epoch,
            bounds=(lbu, ubu),
            increments=Increments(lbdu, ubdu, dt_ns),
            rotations=rotations,
        )
        self._nx = rotations.size  # 0: no state corrects anything
        self._measured_ns = 0  # time of the last state that does
        self._played_ns = time.monotonic_ns()
        settings = bus or BusSettings(listen=(RENDEZVOUS_ENDPOINT,))
        keys = Keys(prefix, robot)
        self._robot = robot
        self._bus = Bus.join(settings, keys, stop=self._stop, say=self._say)
        self._states = self._bus.publisher(keys.state)
        self._announcer = Announcer(self._bus, ROLE, epoch)
        self._misordered = False  # whether the controller's model has these inputs in another order
        self._infos = self._bus.subscriber(keys.info(CONTROLLER), capacity=RING_MESSAGES)
        self._intake = self._bus.intake(Command, 1e-9 * STALE_NS, {"u": nu}, unfit=self._objection)
        self._commands = self._bus.subscriber(keys.actuation if guarded else keys.command, capacity=RING_MESSAGES)
        self._bus.expect("command", lambda: self._intake.source.epoch is not None)
        about = {"role": ROLE, "version": rti_mpc.__version__, "epoch": epoch, "speed": 1.0, "reports_inputs": True, "approaches": True}
        self._bus.publish_json(keys.info(ROLE), {**about, **labels(inputs=[Label(name) for name in self.inputs])})
        self._bus.alive(ROLE)
        self._bus.watch_connection(self._warn)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leave the bus: from then on `send` does nothing, and `act` leads the inputs to rest."""
        self._bus.close()

    def every(self, period_s: float) -> Iterator[int]:
        """
        Yield the robot's time, in ns, once per period, until the process is stopped and `act` has returned the inputs at rest.

        The period is that in which the inputs are renewed: a fraction of `dt_s`, for a command acts from its time on, and comes soon
        after its state. A period that was missed is skipped. Once stopped, no command is taken and the inputs ramp to rest.

        Raises:
            ConfigError: The period is none.
            OcpError: It is no number.
        """
        if not 1e-4 <= given.number("period_s", period_s) <= 10.0:
            raise ConfigError(f"period_s must be from 0.0001 to 10 s, got {period_s}")
        period_ns = round(1e9 * period_s)
        due_ns = time.monotonic_ns()
        while not (self._stop.is_set() and self._actuator.at_rest):
            if self._stop.is_set():
                self._actuator.switch_off()
            yield due_ns
            now_ns = time.monotonic_ns()
            due_ns += max(1, -((due_ns - now_ns) // period_ns)) * period_ns
            time.sleep(max(0.0, 1e-9 * (due_ns - now_ns)))

    def send(self, x: ArrayLike, age_s: float = 0.0) -> None:
        """
        Send a state, with the inputs that acted when it was measured.

        Args:
            x: State in the order of the model, shape ``(nx,)``; angles may wrap.
            age_s: How long ago it was measured, at most `dt_s`; less than 0 counts as 0.

        Raises:
            ConfigError: It is no list, or has not as many numbers as `angles`; or its age is none.
            OcpError: What must be numbers is none.
        """
        now_ns, state = time.monotonic_ns(), np.array(given.numbers("x", x), ndmin=1)
        if not math.isfinite(given.number("age_s", age_s)):
            raise ConfigError(f"age_s must be finite, got {age_s}")
        stamp_ns = now_ns - max(0, round(1e9 * age_s))
        if self._nx and state.shape != (self._nx,):
            raise ConfigError(f"x must have as many components as angles, {self._nx}, got shape {state.shape}")
        if state.ndim != 1 or not state.size:
            raise ConfigError(f"x must be a list of the model's states, got shape {state.shape}")
        u, source = self._actuator.acting(stamp_ns)
        if self._nx and np.isfinite(state).all():
            self._actuator.measure(state, stamp_ns, now_ns)
            self._measured_ns = now_ns
        self._seq += 1
        self._states.put(State(self._epoch, self._seq, stamp_ns, state, u.copy(), *source))

    def act(self) -> Array:
        """Return the inputs to apply now, shape ``(nu,)``."""
        now_ns = time.monotonic_ns()
        for received in self._infos.drain():
            self._compare(received)
        for received in self._commands.drain():
            command = self._intake.accept(received, now_ns)
            if command is not None and (reason := self._actuator.accept(command, now_ns)):
                text = f"command {command.seq} of epoch {command.epoch} was refused: {reason.replace('_', ' ')}"
                self._announcer.say(Notice(Severity.WARNING, f"command_{reason}", text), now_ns)
        if self._nx and now_ns - self._measured_ns > STALE_NS:
            self._actuator.measure(None, now_ns)
        starved = self._actuator.counters.starved
        for _ in self._actuator.play(self._played_ns, now_ns + 1):
            pass
        self._played_ns = now_ns + 1
        if self._actuator.counters.starved > starved:
            ran_out = Notice(Severity.ERROR, "command_ran_out", "no valid command is left: the robot goes to rest by itself")
            self._announcer.say(ran_out, now_ns)
        for notice in self._intake.notices(now_ns):
            self._announcer.say(notice, now_ns)
        return self._actuator.u.copy()

    def _objection(self, command: Command) -> str:
        """Return why a command is not for this robot, as a code; empty if it is."""
        return "misordered" if self._misordered else unfit(command, len(self.inputs), self._epoch)

    def _compare(self, received: Received) -> None:
        """Take no commands of a controller whose model has the same inputs in another order: each would act as another."""
        with suppress(MessageError):
            theirs = tuple(label.name for label in Info.from_received(received).inputs)
            before, self._misordered = self._misordered, theirs != self.inputs and sorted(theirs) == sorted(self.inputs)
            if self._misordered and not before:
                told = f"inputs must be in the order of the model, {', '.join(theirs)}, got {', '.join(self.inputs)}"
                self._warn(Notice(Severity.ERROR, "inputs_misordered", f"{told}: no command is taken"))

    def _warn(self, notice: Notice) -> None:
        """Announce and print what does not come from the control loop; in any thread."""
        self._announcer.say(notice, time.monotonic_ns())
        self._say(notice.text, notice.severity)

    def _say(self, line: str, severity: Severity = Severity.WARNING) -> None:
        """Print a line with its level, as the logs of the other processes have it; what the bus waits for is a warning there, too."""
        print(f"{severity.name:<7} {self._robot}: {line}", file=sys.stderr)


def check_limits(
    dt_s: float,
    inputs: Mapping[str, tuple[float, float]],
    increments: Mapping[str, tuple[float, float]],
    u_rest: Mapping[str, float],
) -> None:
    """
    Check the limits of a robot.

    Raises:
        ConfigError: A name is none of an input, or a number does not fit.
        OcpError: What must be numbers is none.
        ShapeError: A pair of bounds is none.
    """
    if not 0.0 < given.number("dt_s", dt_s) <= 10.0:
        raise ConfigError(f"dt_s must be above 0 and at most 10 s, got {dt_s}")
    shapes: dict[str, tuple[Mapping[str, Any], tuple[int, ...]]] = {
        "inputs": (inputs, (2,)),
        "increments": (increments, (2,)),
        "u_rest": (u_rest, ()),
    }
    for what, (values, shape) in shapes.items():
        if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
            raise ConfigError(f"{what} must have numbers by the names of inputs, got {given.quoted(values)}")
        for name, value in values.items():
            given.array(f"{what}.{name}", value, shape)
    if not inputs:
        raise ConfigError("inputs must name at least one input, got none")
    for what, table in (("increments", increments), ("u_rest", u_rest)):
        if unknown := [name for name in table if name not in inputs]:
            raise ConfigError(f"{what}.{unknown[0]} must be one of the inputs {', '.join(inputs)}")
    for name, (lower, upper) in inputs.items():
        if not lower <= (rest := u_rest.get(name, 0.0)) <= upper:
            raise ConfigError(f"inputs.{name} must hold the input at rest, {rest:g}, got {[lower, upper]}")
    for name, (lower, upper) in increments.items():
        if not lower < 0.0 < upper:
            raise ConfigError(f"increments.{name} must go from below 0 to above 0, got {[lower, upper]}")


def known_rotations(angles: Sequence[bool | str], quaternions: Sequence[Sequence[int]]) -> Rotations:
    """
    Return the rotations among the states of a robot.

    Raises:
        ConfigError: One is not among its states.
    """
    if not all(isinstance(angle, bool | np.bool_) or angle in TURNS for angle in angles):
        raise ConfigError(f"angles must say of each state whether it is an angle, such as [False, True] or [False, 'deg'], got {list(angles)}")
    plain = [i for i, angle in enumerate(angles) if not angle]
    for places in quaternions:
        if len(places) != 4 or len(set(places)) < 4 or not all(place in plain for place in places):
            raise ConfigError(f"quaternions must be places of w, x, y, z among the states, of none that is an angle, got {list(places)}")
    turns = {i: TURNS[angle if isinstance(angle, str) else "rad"] for i, angle in enumerate(angles) if angle}
    return Rotations(len(angles), tuple(turns), tuple((w, x, y, z) for w, x, y, z in quaternions), tuple(turns.values()))
