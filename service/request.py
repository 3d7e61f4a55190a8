# SPDX-License-Identifier: Apache-2.0
"""An operator's request to the controller of one robot: asked once, the answer printed."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Sequence
from typing import Any

from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys
from service import toml


def main(bus_settings: BusSettings, keys: Keys, request: str, timeout_s: float, **details: Any) -> int:
    """
    Ask, and print the acknowledgement.

    Args:
        bus_settings: How to join the bus.
        keys: Which robot.
        request: What is asked for, such as ``"stop"``.
        timeout_s: How long to wait for an answer.
        details: The rest of the request.

    Returns:
        Exit status: 0 if it was granted, 1 if it was refused or nobody answered.
    """
    answer = ask(bus_settings, keys, {"request": request, **details}, timeout_s)
    if answer is not None:
        print(json.dumps(answer))
    return int(answer is None)


def ask(bus_settings: BusSettings, keys: Keys, request: dict[str, Any], timeout_s: float) -> dict[str, Any] | None:
    """Return the answer if the request was granted; otherwise say why not, and return None."""
    with Bus(bus_settings, keys, timeout_s=timeout_s) as bus:
        try:
            answer = bus.request(keys.request, request, timeout_s)
        except TimeoutError:
            answer = {"error": f"{keys.robot} has no controller that answers within {timeout_s} s: nothing was changed"}
    if answer.get("ok") is True:
        return answer
    print(f"rti-mpc: {answer.get('error', 'refused without a reason')}", file=sys.stderr)
    return None


def params(bus_settings: BusSettings, keys: Keys, words: Sequence[str], timeout_s: float) -> int:
    """
    Print parameters as lines of TOML, or change them.

    Args:
        bus_settings: How to join the bus.
        keys: Which robot.
        words: ``get`` and keys, or what they begin with, all if there are none; or ``set`` and ``KEY=VALUE`` each.
        timeout_s: How long to wait for an answer.

    Returns:
        Exit status: 0 if it was granted, 1 if it was refused or nobody answered.

    Raises:
        ConfigError: The words are none of these.
    """
    action, *wanted = words
    if action == "set":
        return main(bus_settings, keys, "params", timeout_s, set=assigned(wanted))
    if action != "get":
        raise ConfigError(f"params must be followed by get or set, got {action}")
    answer = ask(bus_settings, keys, {"request": "params", "get": True}, timeout_s)
    if answer is None:
        return 1
    values = {key: value for key, value in answer["values"].items() if not wanted or any(f"{key}.".startswith(f"{want}.") for want in wanted)}
    if not values:
        print(f"rti-mpc: {' '.join(wanted)} must be among {', '.join(answer['values'])}", file=sys.stderr)
        return 1
    print(f"# version {answer['version']}{'' if answer['live'] else ', fixed: params.live is false'}")
    for key, value in values.items():
        print(f"{key} = {toml.text(value)}" if value is not None else f"# {key} is left to its default")
    return 0


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """
    Read ``KEY=VALUE`` as a line of TOML each.

    Raises:
        ConfigError: One is none.
    """
    values = {}
    for assignment in assignments:
        key, _, value = assignment.partition("=")
        try:
            values[key.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            raise ConfigError(f"params must be set by KEY=VALUE, the value as in the file, got {assignment}") from None
    return values
