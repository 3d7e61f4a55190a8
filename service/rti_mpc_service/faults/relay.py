# SPDX-License-Identifier: Apache-2.0
"""
Faulty link or sensor: a process between robot and controller that changes states on request, or drops commands.

The robot has one prefix, the receivers of the changed states another. Commands pass
back unchanged, except that after a jump of the clock their stamps are converted to
the robot's own time. `python -m rti_mpc_service.faults.relay ENDPOINT PREFIX_OF_ROBOT PREFIX ROBOT`.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from threading import Thread
from typing import Any

import numpy as np

from rti_mpc.contract.message import Command, State
from rti_mpc.wire.bus import RING_MESSAGES, Bus, Publisher, Subscriber
from rti_mpc.wire.cdr import M
from rti_mpc.wire.intake import Intake
from rti_mpc.wire.interrupt import stop_on_signals
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.session import BusSettings
from rti_mpc.wire.streams import ACTUATION, COMMAND, RELAY
from rti_mpc.wire.zenoh_session import ZenohSession

ROLE = "relay"
STALE_S = 0.25
STATE_DELAY_NS = 400_000_000
CLOCK_JUMP_NS = 5_000_000_000

Change = Callable[[State, "deque[State]"], Iterable[State]]
COMMAND_STAMPS = ("stamp_ns", "state_stamp_ns", "valid_until_ns")  # fields of a command that are times of the robot's clock


def frozen(state: State, held: deque[State]) -> Iterable[State]:
    """Return the first state after the fault's start again and again, with new sequence numbers."""
    held.append(state)
    return [replace(held[0], seq=state.seq)]


def late(state: State, held: deque[State]) -> Iterable[State]:
    """Delay every state by `STATE_DELAY_NS`."""
    held.append(state)
    while state.stamp_ns - held[0].stamp_ns >= STATE_DELAY_NS:
        yield held.popleft()


def reordered(state: State, held: deque[State]) -> Iterable[State]:
    """Swap every two states."""
    held.append(state)
    return [held.pop(), held.pop()] if len(held) == 2 else []


# The messages that are sent in place of one state, by the name of the fault.
STATE_CHANGES: dict[str, Change] = {
    "none": lambda state, _: [state],
    "frozen": frozen,
    "late": late,
    "duplicated": lambda state, _: [state, state, state],
    "microseconds": lambda state, _: [replace(state, stamp_ns=state.stamp_ns // 1000)],
    "twins": lambda state, _: [state, replace(state, epoch=state.epoch + 1)],
    "reordered": reordered,
    "nan": lambda state, _: [replace(state, x=np.where(np.arange(len(state.x)), state.x, np.nan))],
    "short": lambda state, _: [replace(state, x=state.x[:-1])],
}
COMMANDS_LOST = "commands_lost"  # name of the fault in which states pass and commands do not
CLOCK_JUMPS_NS = {"ahead": CLOCK_JUMP_NS, "behind": -CLOCK_JUMP_NS}


class Relay:
    """Passes states on, and commands back."""

    def __init__(self, robot: Bus, bus: Bus) -> None:
        """
        Start forwarding.

        Args:
            robot: Bus with the robot's prefix.
            bus: Bus with the prefix of the controller and the others.
        """
        self._offset_ns = 0
        self._losing = False  # whether commands are lost
        self._stamp_ns = 0  # stamp of the last state, as the robot sent it
        self._fault: tuple[str, int, deque[State]] = ("none", 0, deque())  # name, number of states it lasts for, states held back
        self._states = bus.publisher(bus.keys.state)
        self._follow(robot.subscriber(robot.keys.state, capacity=RING_MESSAGES), bus.intake(State, STALE_S), self._change)
        for stream in (COMMAND, ACTUATION):
            commands, publisher = bus.subscriber(bus.keys.of(stream), capacity=RING_MESSAGES), robot.publisher(robot.keys.of(stream))
            self._follow(commands, bus.intake(Command, STALE_S), partial(self._pass, publisher))

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer ``{"fault": NAME, "states": COUNT}`` by changing that many states, all if left out; the answer has the last stamp before."""
        name = request["fault"]
        if name in CLOCK_JUMPS_NS:
            self._offset_ns += CLOCK_JUMPS_NS[name]
            return {"ok": True, "stamp_ns": self._stamp_ns}
        if name not in STATE_CHANGES and name != COMMANDS_LOST:
            return {"ok": False, "error": f"fault must be one of {', '.join([*STATE_CHANGES, *CLOCK_JUMPS_NS, COMMANDS_LOST])}, got {name!r}"}
        self._losing = name == COMMANDS_LOST
        self._fault = ("none" if self._losing else name, request.get("states", 2**62), deque())
        return {"ok": True, "stamp_ns": self._stamp_ns}

    def _change(self, state: State) -> None:
        """Publish the messages that replace a state."""
        name, states, held = self._fault
        self._stamp_ns = state.stamp_ns
        for changed in STATE_CHANGES[name](state, held):
            self._states.put(replace(changed, stamp_ns=changed.stamp_ns + self._offset_ns))
        if name != "none" and self._fault[2] is held:
            self._fault = (name, states - 1, held) if states > 1 else ("none", 0, deque())

    def _pass(self, publisher: Publisher[Command], command: Command) -> None:
        """Pass a command back to the robot, unless commands are lost."""
        if self._losing:
            return
        publisher.put(replace(command, **{name: getattr(command, name) - self._offset_ns for name in COMMAND_STAMPS}))

    def _follow(self, subscriber: Subscriber, intake: Intake[M], act: Callable[[M], None]) -> None:
        def follow() -> None:
            for received in iter(subscriber.recv, None):
                if (message := intake.read(received)) is not None:
                    act(message)

        Thread(target=follow, daemon=True).start()


def main(settings: BusSettings, robot: Keys, keys: Keys) -> None:
    """Relay until stopped."""
    stop = stop_on_signals()
    with ZenohSession(settings, stop=stop) as session:
        bus = Bus(session, keys)
        relay = Relay(Bus(session, robot), bus)
        bus.serve(keys.of(RELAY), relay.answer)
        bus.alive(ROLE)
        stop.wait()


if __name__ == "__main__":
    _, endpoint, prefix_of_robot, prefix, name = sys.argv
    main(BusSettings(connect=(endpoint,)), Keys(prefix_of_robot, name), Keys(prefix, name))
