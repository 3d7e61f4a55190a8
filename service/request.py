# SPDX-License-Identifier: Apache-2.0
"""An operator's request to the controller of one robot: asked once, the answer printed."""

from __future__ import annotations

import json
import sys

from rti_mpc.wire.bus import Bus, BusSettings
from rti_mpc.wire.keys import Keys


def main(bus_settings: BusSettings, keys: Keys, request: str, timeout_s: float) -> int:
    """
    Ask, and print the acknowledgement.

    Args:
        bus_settings: How to join the bus.
        keys: Which robot.
        request: What is asked for, ``"stop"`` or ``"enable"``.
        timeout_s: How long to wait for an answer.

    Returns:
        Exit status: 0 if it was granted, 1 if it was refused or nobody answered.
    """
    with Bus(bus_settings, keys, timeout_s=timeout_s) as bus:
        try:
            answer = bus.request(keys.request, {"request": request}, timeout_s)
        except TimeoutError:
            print(f"rti-mpc: {keys.robot} has no controller that answers within {timeout_s} s: nothing was changed", file=sys.stderr)
            return 1
    print(json.dumps(answer))
    return 0 if answer.get("ok") is True else 1
