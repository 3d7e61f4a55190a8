# SPDX-License-Identifier: Apache-2.0
"""Event with which `run` says at its start what a lost controller leaves of a robot without a guard."""

from __future__ import annotations

import re
from pathlib import Path
from threading import Event

import pytest

from rti_mpc.contract.message import Severity
from rti_mpc.wire.bus import BusSettings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_stop
from rti_mpc_service.controller import daemon
from rti_mpc_service.shipped import SHIPPED
from tests.movers import toml
from tests.wire.fake_session import FakeSession


def test_only_a_robot_that_does_not_hold_and_has_no_guard_is_told_what_a_lost_controller_leaves(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(toml("car"))
    config = load(path)
    law = check_stop(config)
    assert daemon.unguarded(config, law) is None, "it has a guard"
    config = config.model_copy(update={"guard": config.guard.model_copy(update={"enabled": False})})
    notice = daemon.unguarded(config, law)
    assert notice is not None
    assert (notice.severity, notice.code) == (Severity.INFO, "unguarded")
    assert re.match(r"no guard: if this controller is lost, .*: [\d.]+ s after a stop \w+ changes by up to [\d.]+ (m|rad) per second$", notice.text)
    assert daemon.unguarded(load(SHIPPED), check_stop(load(SHIPPED))) is None, "inputs that ramp to rest stop it"


@pytest.mark.slow  # compiles the car
def test_run_says_it_at_its_start(session: FakeSession, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, stopped = tmp_path / "robot.toml", Event()
    path.write_text(toml("car").replace("enabled = true", "enabled = false"))
    config = load(path)
    stopped.set()
    with caplog.at_level("INFO"):
        daemon.main(config, BusSettings(), state=tmp_path, stop=stopped)
    assert [line for line in caplog.messages if "no guard: if this controller is lost" in line]
