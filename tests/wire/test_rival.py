# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np

from rti_mpc.contract.message import End, Reference
from rti_mpc.wire.bus import Bus, Received
from rti_mpc.wire.cdr import encode, encoding
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.rival import Rival
from tests.wire.fake_session import FakeSession

KEYS = Keys(robot="car")


class Session(FakeSession):
    """A session on which references of others arrive."""

    def __init__(self) -> None:
        super().__init__()
        self.waiting: list[Received] = []

    def subscriber(self, key: Any, capacity: int, *, history: bool, wakes: bool = False) -> Any:
        return self

    def drain(self) -> list[Received]:
        waiting, self.waiting = self.waiting, []
        return waiting

    def hear(self, epoch: int) -> None:
        reference = Reference(epoch, 1, 0, 10**8, End.HOLD, np.zeros((2, 3)), np.zeros((2, 0)))
        self.waiting.append(Received(encode(reference), encoding(Reference), KEYS.reference))


def test_source_is_told_once_that_another_one_publishes_and_which_is_followed() -> None:
    session = Session()
    rival = Rival(Bus(session, KEYS), 100)
    assert rival.notice() is None
    for epoch, followed in ((90, "this one, not that one, while this one publishes"), (110, "that one, not this one")):
        for _ in range(2):
            session.hear(epoch)
        notice = rival.notice()
        assert notice is not None
        assert notice.text == f"another source publishes references for car: its controller follows {followed}; stop one of the two"
        session.hear(epoch)
        assert rival.notice() is None


def test_two_others_that_take_turns_are_told_once_each() -> None:
    session = Session()
    rival, told = Rival(Bus(session, KEYS), 100), 0
    for _ in range(5):
        for epoch in (7, 9):
            session.hear(epoch)
            told += rival.notice() is not None
    assert told == 2


def test_bytes_that_are_no_reference_are_no_rival() -> None:
    session = Session()
    rival = Rival(Bus(session, KEYS), 100)
    session.waiting.append(Received(b"junk", encoding(Reference), KEYS.reference))
    assert rival.notice() is None
