# SPDX-License-Identifier: Apache-2.0
"""Stream of a recording that is not on the bus: what the recorder's host did meanwhile, a JSON object a chunk."""

from __future__ import annotations

from typing import Any

from rti_mpc.wire.streams import Qos, Stream

HOST: Stream[Any] = Stream(
    "host",
    None,
    ("recorder",),
    Qos(),
    "twice per second",
    "time in s, `waited_s`, for which a process of the recorder's host waited for a core since `from_ns`, of its monotonic clock",
)
