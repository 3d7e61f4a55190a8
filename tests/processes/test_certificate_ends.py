# SPDX-License-Identifier: Apache-2.0
"""Warning of every process that its certificate ends soon, by real processes with certificates of one day."""

from __future__ import annotations

from pathlib import Path

import pytest

from rti_mpc.contract.message import Event
from tests.processes.system import heard, until

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from tests.processes.test_secured import Secured

pytestmark = pytest.mark.slow

ROLES = {"sim": ("robot", "robot"), "guard": ("guard", "guard"), "run": ("controller", "controller"), "reference": ("planner", "reference")}


def test_every_process_says_at_its_start_that_its_certificate_ends_within_thirty_days(tmp_path: Path) -> None:
    system = Secured(tmp_path)
    try:
        system.start("router")
        until(lambda: "routing" in system.said("router"), "the router routes")
        viewer = system.join("viewer")
        events = {source: viewer.subscriber(viewer.keys.event(source), capacity=64) for _, source in ROLES.values()}
        system.start(*ROLES)
        for role, source in ROLES.values():
            event = heard(events[source], Event, lambda event: event.code == "certificate_ends")
            assert event.text.startswith(f"{system.tls / role}.pem ends in 1.0 days")
        for command, role in {"router": "router", **{command: role for command, (role, _) in ROLES.items()}}.items():
            said = f"{system.tls / role}.pem ends in 1.0 days"
            until(lambda said=said, command=command: said in system.said(command), f"{command} says that its certificate ends")
            assert system.said(command).count(said) == 1
    finally:
        system.close()
