# SPDX-License-Identifier: Apache-2.0
"""References on their way to a controller: which thread does what."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rti_mpc.controller import Controller, Timing
from rti_mpc.message import State
from rti_mpc.rti import Rti
from rti_mpc.track import Track
from rti_mpc.trajectory import circle
from rti_mpc.wire.bus import Received
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.intake import Intake
from service.references import References
from tests.loop import reference
from tests.problems import pioneer


def test_controlling_thread_does_nothing_for_each_row_of_a_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = Controller(Rti(pioneer(N=5), compile=False), Timing(), compile=False)
    bus: Any = SimpleNamespace(intake=Intake, keys=SimpleNamespace(anchored="anchored"), publisher=lambda *_, **__: None)
    references = References(bus, controller, ny=3)
    message = reference(circle())
    waiting = iter([Received(encode(message), encoding(type(message)), "reference"), None])
    subscriber: Any = SimpleNamespace(recv=lambda: next(waiting))
    references.from_planner(subscriber)

    def refuse(*_: Any) -> None:
        raise AssertionError("laid out by the thread that controls")

    monkeypatch.setattr(Track, "lay_out", refuse)
    controller.receive_state(State(1, 1, 0, np.zeros(5)), 0)
    references.hand_over(leading=True)
    assert controller.receive_state(State(1, 2, 100_000_000, np.zeros(5)), 100_000_000) is not None
