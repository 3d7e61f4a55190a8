# SPDX-License-Identifier: Apache-2.0
"""The witness of a run names the processes that are missing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rti_mpc.wire.bus import Bus, Declared
from rti_mpc.wire.keys import Key, Keys
from rti_mpc_service.rig.witness import Witness
from tests.wire.fake_session import FakeSession


class Session(FakeSession):
    """One that tells of the roles that appear."""

    def watch(self, key: Key[Any], tell: Callable[[str, bool], None]) -> Declared:
        self.tell = tell
        return super().watch(key, tell)


def test_roles_that_are_not_present_and_a_controller_without_its_description_are_missing() -> None:
    session = Session()
    witness = Witness(Bus(session, Keys("tests", "pioneer")))
    assert witness.missing({"viewer", "controller", "robot"}) == ["controller", "robot", "viewer"]
    for role in ("controller", "viewer"):
        session.tell(role, True)
    assert witness.missing({"viewer", "controller", "robot"}) == ["controller", "robot"]
    session.tell("viewer", False)
    assert witness.missing({"viewer"}) == ["viewer"]
