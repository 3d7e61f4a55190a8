# SPDX-License-Identifier: Apache-2.0
"""Requests of an operator to the processes of one robot; the answers are printed."""

from __future__ import annotations

import getpass
import json
import math
import os
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rti_mpc.contract.latch import Latch, read_latch
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.wire.bus import RETRY_INTERVAL_S, Bus, BusSettings
from rti_mpc.wire.keys import Keys
from rti_mpc_service.config import toml
from rti_mpc_service.config.assignments import assigned
from rti_mpc_service.latch_file import LatchFile
from rti_mpc_service.operator_stop import MAX_NAME_CHARACTERS, utc_now
from rti_mpc_service.parameter import from_json, to_json

REPEAT_AFTER_S = 0.7  # period at which a request is repeated: the acting process may hang, and another one take over
GUARD, LEADER = "guard", "controller"  # roles that can act on a stop


def main(bus_settings: BusSettings, keys: Keys, request: str, timeout_s: float, **details: Any) -> int:
    """
    Send a request, and print the answer.

    Args:
        bus_settings: How to join the bus.
        keys: The robot's keys.
        request: Name of the request, such as ``"params"``.
        timeout_s: How long to wait for an answer.
        details: Further entries of the request.

    Returns:
        Exit status: 0 if the request was granted, 1 if it was refused or nobody answered.
    """
    answer = ask(bus_settings, keys, {"request": request, **details}, timeout_s)
    if answer is not None:
        print(json.dumps(answer))
    return int(answer is None)


def ask(bus_settings: BusSettings, keys: Keys, request: dict[str, Any], timeout_s: float) -> dict[str, Any] | None:
    """Send a request and return its answer; if it is not granted, print the reason and return None."""
    with Bus.join(bus_settings, keys, timeout_s=timeout_s) as bus:
        try:
            answer = bus.request(keys.request, request, timeout_s)
        except TimeoutError:
            unchanged = "; nothing was changed" if "set" in request else ""
            answer = {"error": f"{keys.robot} has no controller that answers within {timeout_s:g} s{unreached(bus)}{unchanged}"}
    if answer.get("ok") is True:
        return answer
    print(f"rti-mpc: {answer.get('error', 'refused without a reason')}", file=sys.stderr)
    return None


def unreached(bus: Bus) -> str:
    """Return why nobody can answer, to be appended; empty if somebody is on the bus."""
    return f": {bus.unconnected}" if bus.unconnected else ""


def stop_or_enable(bus_settings: BusSettings, keys: Keys, what: str, timeout_s: float, *, guarded: bool, state: Path | None) -> int:
    """
    Stop or release a robot, and print the answer of the acting process: the guard if there is one, else the leading controller.

    Args:
        bus_settings: How to join the bus.
        keys: The robot's keys.
        what: ``"stop"`` or ``"enable"``.
        timeout_s: How long to wait for the answer of the acting process.
        guarded: Whether the robot takes its commands from a guard.
        state: Folder in which the request is stored if nobody answers; None: the user's.

    Returns:
        Exit status: 0 if the acting process has confirmed, else 1.

    Raises:
        ConfigError: The bus cannot be joined.
    """
    answers: dict[str, dict[str, Any]] = {}
    acting = GUARD if guarded else LEADER
    try:
        with Bus.join(bus_settings, keys, timeout_s=timeout_s) as bus:
            for answer in ask_repeatedly(bus, {"request": what, "by": operator()}, timeout_s):
                answers[str(answer.get("role", "somebody"))] = answer
                if answers.get(acting, {}).get("ok") is True:
                    break
            why = "" if answers else unreached(bus)
    except ConfigError as error:  # for example, there is no router
        raise ConfigError(f"{error}; nobody was asked to {what}; {note_for_later(LatchFile(keys, state), what)}") from error
    confirmed = [role for role, answer in answers.items() if answer.get("ok") is True]
    if acting in confirmed:
        print(json.dumps(answers[acting]))
        if fault := answers[acting].get("not_stored"):
            print(f"rti-mpc: the {acting} obeys, but will not know of it after a restart: {fault}", file=sys.stderr)
        return 0
    print(
        f"rti-mpc: {keys.robot}: the {acting} has not confirmed {what} within {timeout_s:g} s; {' and '.join(confirmed) or 'nobody'} has{why}",
        *(f"{role}: {answer['error']}" for role, answer in answers.items() if "error" in answer),
        *([] if answers else [note_for_later(LatchFile(keys, state), what)]),
        sep="; ",
        file=sys.stderr,
    )
    return 1


def ask_repeatedly(bus: Bus, request: dict[str, Any], timeout_s: float) -> Iterator[dict[str, Any]]:
    """Yield the answers to a request that is repeated until the timeout; repetitions carry its latch, so that nobody acts on it twice."""
    deadline_s = time.monotonic() + timeout_s
    latch = Latch()
    while (left_s := deadline_s - time.monotonic()) > 0.0:
        again = {"latch": asdict(latch)} if latch.counter else {}
        for answer in bus.answers(bus.keys.stop, request | again, min(REPEAT_AFTER_S, left_s)):
            yield answer
            with suppress(MessageError):
                latch = max(latch, read_latch(answer.get("latch")))
        time.sleep(min(RETRY_INTERVAL_S, left_s))


def note_for_later(file: LatchFile, what: str) -> str:
    """Store a request that nobody has confirmed for processes that start later; return a text that says so."""
    latch, _ = file.read()
    changed = latch.change(stopped=what == "stop", reason=f"asked for by {operator()}", when=utc_now())
    try:
        if changed != latch or file.path is None:
            file.write(changed)
    except OSError as error:
        return f"it could not be stored for later either: {error.strerror}"
    return f"processes started later read {file.path}: {changed}"


def operator() -> str:
    """Return user and host, as the name of the operator."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):  # no name for this user
        name = str(os.getuid())
    return f"{name}@{socket.gethostname()}"[:MAX_NAME_CHARACTERS]


def params(bus_settings: BusSettings, keys: Keys, words: Sequence[str], timeout_s: float) -> int:
    """
    Print parameters as lines of TOML, or change them.

    Args:
        bus_settings: How to join the bus.
        keys: The robot's keys.
        words: ``get`` and keys or tables of keys, all keys if none are given; or ``set`` and at least one ``KEY=VALUE``.
        timeout_s: How long to wait for an answer.

    Returns:
        Exit status: 0 if the request was granted, 1 if it was refused or nobody answered.

    Raises:
        ConfigError: The words are not valid.
    """
    action, *wanted = words
    if action == "set" and not wanted:
        raise ConfigError("params set must be followed by KEY=VALUE, such as ocp.weights.Q.x=2.0, got nothing")
    if action == "set":
        return main(bus_settings, keys, "params", timeout_s, set=to_json(parse_assignments(wanted)))
    if action != "get":
        raise ConfigError(f"params must be followed by get or set, got {action}")
    answer = ask(bus_settings, keys, {"request": "params", "get": True}, timeout_s)
    if answer is None:
        return 1
    values = {
        key: value for key, value in from_json(answer["values"]).items() if not wanted or any(f"{key}.".startswith(f"{want}.") for want in wanted)
    }
    if not values:
        print(f"rti-mpc: {' '.join(wanted)} must be among {', '.join(answer['values'])}", file=sys.stderr)
        return 1
    print(f"# version {answer['version']}{'' if answer['live'] else ', fixed: params.live is false'}")
    for key, value in values.items():
        print(f"{key} = {toml.text(value)}" if value is not None else f"# {key} is left to its default")
    return 0


def parse_assignments(assignments: Sequence[str]) -> dict[str, Any]:
    """
    Parse assignments ``KEY=VALUE`` whose values are TOML.

    Raises:
        ConfigError: An assignment is not valid.
    """
    values = {}
    rule = "params must be set by KEY=VALUE, the value as in the file"
    for key, value in assigned(rule, assignments).items():
        try:
            values[key] = toml.read_value(value)
        except ConfigError:
            raise ConfigError(f"{rule}, got {f'{key}={value}'!r}{toml.advice(f'{key}={value}')}") from None
    for key, value in to_json(values).items():
        if not all(math.isfinite(number) for number in (value if isinstance(value, list) else [value]) if isinstance(number, float)):
            raise ConfigError(f"{key} must be finite, except for an absent bound, [-inf, upper] or [lower, inf], got {toml.text(values[key])}")
    return values
