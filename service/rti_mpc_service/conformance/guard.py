# SPDX-License-Identifier: Apache-2.0
"""
Conformance of a guard: this process is the robot and the controller on both sides of it.

The robot's actuators approach nothing by themselves: what the guard publishes is what
acts. Times are those of the robot. A command that must not pass is marked by its
configuration hash, which a guard passes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.approach import magnitudes
from rti_mpc.contract.limits import MAX_VALID_NS
from rti_mpc.contract.message import Command
from rti_mpc.wire.cdr import encode
from rti_mpc_service.conformance.finding import Case, Finding, Unseen
from rti_mpc_service.conformance.level import shown
from rti_mpc_service.conformance.stand import MS, VALID_NS, Stand, Steering
from rti_mpc_service.conformance.wrong import refused, wrong

MARK = 77  # configuration hash of a command that is followed through the guard
PATIENCE_S = 20.0  # for a guard to let healthy commands pass: one that has just started waits until what an earlier guard passed has ended
BRAKING_MS = 300.0  # from the last command's state to the first step to rest
LATE_MS = 60.0  # that the end of the ramp may be late: steps of 10 ms, and two messages on their way
STANDS_MS = 1000.0  # for which the robot is seen to stand
REFUSAL_MS = 50.0  # in which a command would have passed
HELD_UP_MS = 150.0  # that a host may hold up what follows a healthy command; after 250 ms of silence numbers may begin anywhere
SLEW_ROUNDING = 1e-5  # that a guard may forgive, relative to the largest value of an input
STOP_TIMEOUT_S = 5.0  # for the answer to a stop
LEADER = 1 << 20  # between epochs of two controllers


def ready(stand: Stand) -> None:
    """
    Begin a life of the robot, and drive it to its high inputs.

    Raises:
        Unseen: The guard lets no healthy command pass.
    """
    stand.new_robot()
    drive(stand)


def drive(stand: Stand, level: Array | None = None) -> None:
    """
    Bring the inputs to a level, the high one if none is given, by healthy commands.

    Raises:
        Unseen: The guard does not let them pass.
    """
    target = stand.levels.high if level is None else level
    pilot, deadline_s = stand.towards(target), time.monotonic() + PATIENCE_S
    while not stand.levels.at(stand.actuator.u, target):
        if time.monotonic() > deadline_s:
            raise Unseen(f"healthy commands to {shown(target)} did not pass: the inputs are {shown(stand.actuator.u)}")
        stand.run(stand.period_ns / MS, pilot)
    stand.run(2 * stand.period_ns / MS, pilot)


def passes(stand: Stand) -> Finding:
    """Judge how healthy commands pass."""
    try:
        ready(stand)
    except Unseen as reason:
        return Finding(False, str(reason))
    sent: dict[int, Command] = {}

    def pilot(_: object) -> Command:
        command = stand.command(stand.levels.towards(stand.actuator.u, stand.levels.high), config_hash=MARK)
        return sent.setdefault(command.state_seq, command)

    stand.run(10 * stand.period_ns / MS, pilot)
    stand.run(REFUSAL_MS)
    passed = {told.state_seq: told for _, told in stand.heard if told.config_hash == MARK}
    for seq, told in passed.items():
        command = sent[seq]
        if encode(replace(told, epoch=command.epoch, seq=command.seq)) != encode(command):
            return Finding(False, "a healthy command passed, but not as it was: its rows, times or the state that it answers were changed")
    lost = len(sent) - len(passed)
    if lost:
        return Finding(False, f"of {len(sent)} healthy commands {lost} did not pass within {REFUSAL_MS:g} ms", stand.period_ns / MS)
    return Finding(True, f"{len(sent)} of {len(sent)} healthy commands passed, word by word")


def expiry(stand: Stand) -> Finding:
    """Judge the inputs once no command comes."""
    ready(stand)
    fault_ns = stand.state.stamp_ns  # of the last state that was answered
    allowed_ms = VALID_NS / MS + 1e3 * stand.limits.ramp_s + LATE_MS
    stand.run(allowed_ms + STANDS_MS)
    times, inputs = stand.acting(fault_ns)
    levels = stand.levels
    moves = [t for t, u in zip(times, inputs, strict=True) if not levels.at(u, levels.high)]
    rest = np.array([levels.at(u, levels.rest) for u in inputs])
    if not moves or not rest[-1]:
        return Finding(False, f"{1e-3 * (allowed_ms + STANDS_MS):.2f} s after the last answered state the inputs still were {shown(inputs[-1])}")
    rested_ms = times[np.flatnonzero(~rest)[-1] + 1]
    if moves[0] > BRAKING_MS or rested_ms > allowed_ms:
        late_ms = max(moves[0] - BRAKING_MS, rested_ms - allowed_ms)
        text = f"braking began after {moves[0]:.0f} ms and ended after {rested_ms:.0f} ms, {BRAKING_MS:.0f} and {allowed_ms:.0f} ms are right"
        return Finding(False, text, late_ms)
    return Finding(True, f"braking began {moves[0]:.0f} ms after the last answered state, and the inputs were at rest after {rested_ms:.0f} ms")


def validity(stand: Stand) -> Finding:
    """Judge a command that says that it is valid for ever."""
    ready(stand)
    before = len(stand.heard)
    stand.run(4 * stand.period_ns / MS, stand.towards(stand.levels.high, valid_until_ns=2**62 - 1))
    stand.run(VALID_NS / MS + 1e3 * stand.limits.ramp_s + STANDS_MS)
    most_ns = MAX_VALID_NS + round(1e9 * stand.limits.delay_s)
    for _, told in stand.heard[before:]:
        if told.u.any() and (lasts_ns := told.valid_until_ns - told.state_stamp_ns) > most_ns:
            return Finding(
                False, f"a command passed that is valid for {1e-9 * lasts_ns:.3g} s, at most {1e-9 * most_ns:.2f} s after its state are right"
            )
    return Finding(True, f"it passed with a validity of at most {1e-9 * most_ns:.2f} s after its state")


def way(stand: Stand) -> Finding:
    """Judge a way to rest that first holds the inputs, which no ramp does."""
    ready(stand)
    levels, period_ms = stand.levels, stand.period_ns / MS
    rows = levels.way(levels.high, held := 5 + round(200.0 / period_ms))
    pilot = stand.towards(levels.high, u_rest=rows, rest_period_ns=stand.period_ns)
    stand.run(3 * period_ms, pilot)
    answered_ns = stand.state.stamp_ns
    stand.run(VALID_NS / MS + len(rows) * period_ms + STANDS_MS)
    times, inputs = stand.acting(answered_ns)
    until_ms = VALID_NS / MS + (held - 2) * period_ms
    if (away := next((u for t, u in zip(times, inputs, strict=True) if t < until_ms and not levels.at(u, levels.high)), None)) is not None:
        return Finding(False, f"its way to rest should hold {shown(levels.high)} for {until_ms:.0f} ms after the state, got {shown(away)}", period_ms)
    if not levels.at(inputs[-1], levels.rest):
        return Finding(False, f"the inputs did not come to its last row, {shown(levels.rest)}, but to {shown(inputs[-1])}", period_ms)
    return Finding(True, "its rows acted after the plan's end")


def gain(stand: Stand) -> Finding:
    """Judge a way to rest whose rows alone are the ramp, and which by its gain and the robot's states first holds the inputs."""
    ready(stand)
    levels, period_ms, nx = stand.levels, stand.period_ns / MS, stand.limits.rotations.size
    held, away = 8 + round(300.0 / period_ms), levels.high - levels.rest
    ramp = np.linspace(1.0, 0.0, len(levels.way(levels.high, 0)) + 1)[1:]  # as shares of the way up from rest
    alone, wanted = np.concatenate([ramp, np.zeros(held)]), np.concatenate([np.ones(held), ramp])
    rows, x, K = levels.rest + np.outer(alone, away), np.zeros((len(alone), nx)), np.zeros((len(away), nx))
    x[:, 0], K[:, 0] = wanted - alone, away  # the robot's states are zeros, so K x is added to the rows
    pilot = stand.towards(levels.high, u_rest=rows, x_rest=x, K=K, rest_period_ns=stand.period_ns)
    stand.run(3 * period_ms, pilot)
    answered_ns = stand.state.stamp_ns
    stand.run(VALID_NS / MS + len(rows) * period_ms + STANDS_MS)
    times, inputs = stand.acting(answered_ns)
    from_ms, until_ms = VALID_NS / MS + (len(ramp) + 4) * period_ms, VALID_NS / MS + (held - 2) * period_ms
    judged = [u for t, u in zip(times, inputs, strict=True) if from_ms <= t < until_ms]
    if (other := next((u for u in judged if not levels.at(u, levels.high)), None)) is not None:
        text = f"its way to rest with its gain holds {shown(levels.high)} from {from_ms:.0f} to {until_ms:.0f} ms after the state, got {shown(other)}"
        return Finding(False, text, period_ms)
    if not levels.at(inputs[-1], levels.rest):
        return Finding(False, f"the inputs did not come to its last row, {shown(levels.rest)}, but to {shown(inputs[-1])}", period_ms)
    return Finding(True, "its gain went on with its rows")


def stands(stand: Stand) -> Finding:
    """Judge what the guard says while the robot stands and nothing is commanded."""
    ready(stand)
    stand.run(VALID_NS / MS + 1e3 * stand.limits.ramp_s + STANDS_MS)
    at_ns, told = stand.heard[-1]
    silent_ms = (stand.now_ns - at_ns) / MS
    if silent_ms > 500.0:
        return Finding(False, f"the guard has been silent for {silent_ms:.0f} ms, at most 500 ms are right", silent_ms - 500.0)
    valid_ms, most_ms = (told.valid_until_ns - at_ns) / MS, MAX_VALID_NS / MS
    if (told.u != stand.limits.u_rest).any() or valid_ms > most_ms:
        return Finding(False, f"it said {shown(told.u[-1])} for {valid_ms:.0f} ms, rest for at most {most_ms:.0f} ms is right")
    return Finding(True, "commands to stand were repeated, each with a short validity")


def slew(stand: Stand) -> Finding:
    """Judge the inputs after plans that begin far from them, as those of a controller do that knows nothing of a gap or of lost commands."""
    ready(stand)
    levels = stand.levels
    stand.run(VALID_NS / MS + 1e3 * stand.limits.ramp_s + STANDS_MS)
    before = len(stand.inputs) - 1
    for level in (levels.high, levels.low):
        deadline_s = time.monotonic() + PATIENCE_S
        while not levels.at(stand.actuator.u, level):
            if time.monotonic() > deadline_s:
                raise Unseen(f"commands that begin at {shown(level)} at once did not bring the inputs there, but to {shown(stand.actuator.u)}")
            stand.run(stand.period_ns / MS, at_once(stand, level))
    limits = stand.limits
    allowed = levels.step + SLEW_ROUNDING * magnitudes(limits.lbu, limits.ubu, limits.lbdu, limits.ubdu)
    most = float((np.abs(np.diff(stand.inputs[before:], axis=0)) / allowed).max())
    text = f"the inputs changed at once by {100 * most:.0f} % of what the slew limits allow in a period"
    return Finding(most <= 1.0, text, 0.5 * stand.period_ns / MS if most <= 2.0 else 0.0)  # no guard knows that a message is still on its way


def at_once(stand: Stand, level: Array) -> Steering:
    """Return the pilot of a controller whose plans begin at a level, wherever the inputs are."""
    return lambda _: stand.command(level)


def epochs(stand: Stand) -> Finding:
    """Judge a takeover, the old controller beside the new one, and alone after it."""
    ready(stand)
    old, stand.leader = stand.leader, stand.leader + LEADER
    try:
        drive(stand, stand.levels.low)
    except Unseen as reason:
        return Finding(False, f"a controller of a higher epoch did not take over: {reason}")
    if (finding := refuses("epochs")(stand)).kept is not True:
        return finding
    new, stand.leader = stand.leader, old
    before = len(stand.heard)
    stand.run(STANDS_MS, stand.towards(stand.levels.high, config_hash=MARK))
    stand.leader = new
    if any(told.config_hash == MARK for _, told in stand.heard[before:]):
        return Finding(False, "the old controller's commands passed once the new one was silent, and it is fenced for good in this life of the robot")
    return Finding(True, "the higher epoch took over, and the lower one was refused, beside it and in its silence")


def refuses(name: str) -> Callable[[Stand], Finding]:
    """Return the judgement of the wrong commands of one case."""

    def judge(stand: Stand) -> Finding:
        ways = wrong(name)
        for way in ways:
            drive(stand)
            before = len(stand.heard)
            healthy = stand.command(stand.levels.towards(stand.actuator.u, stand.levels.high), config_hash=MARK)
            stand.send(way.make(healthy, stand.limits))
            stand.run(REFUSAL_MS)
            if any(told.config_hash == MARK for _, told in stand.heard[before:]):
                return Finding(False, f"a command {way.what} passed", HELD_UP_MS)
        try:
            drive(stand, stand.levels.low)
        except Unseen as reason:
            return Finding(False, f"after them {reason}")
        return Finding(True, refused(ways))

    return judge


def lives(stand: Stand) -> Finding:
    """Judge another life of the robot: it is at rest, and any controller may be the first."""
    ready(stand)
    old = stand.command(stand.levels.high, config_hash=MARK)
    stand.new_robot()
    stand.leader -= 5 * LEADER
    try:
        drive(stand)
    except Unseen as reason:
        return Finding(False, f"a controller of a lower epoch did not lead the robot that was restarted: {reason}")
    finally:
        stand.leader += 5 * LEADER
    stand.send(old)
    stand.run(REFUSAL_MS)
    if any(told.config_hash == MARK for _, told in stand.heard):
        return Finding(False, "a command for the life before passed")
    return Finding(True, "a controller of a lower epoch led the restarted robot, and no command for the life before passed")


def stop(stand: Stand) -> Finding:
    """Judge a stop: against a controller that did not hear of it, in silence, and against another one."""
    ready(stand)
    if not said(stand, "stop"):
        return Finding(False, f"no guard has confirmed a stop within {STOP_TIMEOUT_S:g} s")
    try:
        levels, stopped_ns = stand.levels, stand.now_ns
        by_ms = 1e3 * stand.limits.settling_s + LATE_MS
        stand.run(by_ms, stand.towards(levels.high))
        for pilot in (stand.towards(levels.high), lambda _: None, stand.towards(levels.high)):
            stand.run(STANDS_MS / 2, pilot)
            stand.leader += LEADER
        times, inputs = stand.acting(stopped_ns)
        late = [(t, u) for t, u in zip(times, inputs, strict=True) if t > by_ms and not levels.at(u, levels.rest)]
        if late:
            t, u = late[-1]
            text = f"{t:.0f} ms after the stop the inputs were {shown(u)}, rest after {by_ms:.0f} ms is right, whatever is commanded"
            return Finding(False, text, t - by_ms if t - by_ms < STANDS_MS / 2 else 0.0)
        if said_so := not_enabled(stand):
            return Finding(False, said_so)
    finally:
        said(stand, "enable")
    return Finding(True, f"the inputs were at rest {by_ms:.0f} ms after the stop, and stayed there until it was released, whatever was commanded")


def not_enabled(stand: Stand) -> str:
    """Release the robot, and return what is wrong then; empty if it can be driven."""
    if not said(stand, "enable"):
        return f"no guard has confirmed the release within {STOP_TIMEOUT_S:g} s"
    try:
        drive(stand)
    except Unseen as reason:
        return f"after the release {reason}"
    return ""


def said(stand: Stand, what: str) -> bool:
    """Ask for a stop or its release, and return whether a guard has confirmed it."""
    return any(answer.get("ok") is True for answer in stand.bus.answers(stand.bus.keys.stop, {"request": what, "by": "conformance"}, STOP_TIMEOUT_S))


def numbers(stand: Stand) -> Finding:
    """Judge the numbers of all that the guard has published."""
    drive(stand)
    told = [number[1:] for number in stand.numbers]
    if told != sorted(set(told)):
        at = next(i for i in range(1, len(told)) if told[i] <= told[i - 1])
        return Finding(False, f"epoch {told[at][0]}, number {told[at][1]} followed epoch {told[at - 1][0]}, number {told[at - 1][1]}")
    if told[-1][0] < stand.leader:
        return Finding(False, "its epoch is below that of a controller whose commands it passed")
    return Finding(True, f"{len(told)} commands were numbered upwards, in epochs not below a controller's")


REFUSE = "refuse such a command as a whole"
CASES = (
    Case("passes", "a healthy command passes at once and whole", "change nothing but epoch and number of what passes", passes),
    Case("expiry", "without commands braking begins at most 300 ms after the last state that was answered, inside the slew limits, for good",
         "send the ramp to rest before the last plan ends, in short commands", expiry),
    Case("validity", "nothing acts later than 300 ms after its state, and the configured delay, whatever a command says",
         "limit valid_until_ns of what passes", validity),
    Case("way", "a command's own way to rest acts from the end of its plan on", "pass u_rest on, and send what is left of it with each command", way),
    Case("gain", "the gain of a way to rest goes on with its rows, and states correct it", "send x_rest and K on with what is left of u_rest", gain),
    Case("stands", "while the robot stands, commands to stand are repeated, each with a short validity",
         "send a command to stand at least every 500 ms, as long as states come", stands),
    Case("slew", "a plan that begins far from the inputs that act, after a gap or a loss, is approached inside the slew limits",
         "compare the first row with the inputs that the robot really has, and limit it, or refuse the command", slew),
    Case("epochs", "a higher epoch takes over at once, and the lower one is fenced for good",
         "keep the highest epoch that had a command in order, and refuse lower ones in this life of the robot", epochs),
    Case("late", "a command that is stale, from the future or over does not pass", "compare the state that a command answers with the robot's clock",
         refuses("late")),
    Case("foreign", "a command for another life of the robot does not pass", REFUSE, refuses("foreign")),
    Case("repeated", "a command whose number is not above the last one of its epoch does not pass", REFUSE, refuses("repeated")),
    Case("malformed", "what is no command of this robot does not pass, and ends nothing", REFUSE, refuses("malformed")),
    Case("limits", "a command outside bounds or slew limits in any row does not pass", REFUSE, refuses("limits")),
    Case("lives", "with another life of the robot the guard starts anew", "forget leader and plan when states come in another epoch", lives),
    Case("stop", "an operator's stop lasts until it is released, whatever is commanded",
         "answer requests on the key stop, and pass only ways to rest until enable", stop),
    Case("numbers", "actuation is numbered upwards, in epochs no lower than a controller's",
         "take a higher epoch when a controller of a higher one is heard", numbers),
)  # fmt: skip
