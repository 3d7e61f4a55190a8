# SPDX-License-Identifier: Apache-2.0
"""Description of a controller whose weights are too long to be read: it goes without them, and says so."""

from __future__ import annotations

import json
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.rti.rti import Rti
from rti_mpc.wire.bus import BusSettings
from rti_mpc.wire.document import MAX_DOCUMENT_BYTES, read
from rti_mpc.wire.info import Info, Leader, latches
from rti_mpc.wire.received import Received
from rti_mpc_service import description
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.controller import daemon
from rti_mpc_service.description import check_length, controller_info, fitting
from rti_mpc_service.shipped import SHIPPED
from tests.problems import pioneer
from tests.wire.fake_session import FakeSession

LONG = 1000  # stages, the most that are allowed


def test_weights_of_each_of_many_stages_are_left_out_and_that_is_said(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    factors = ", ".join(f"{name} = {[1.0 + 1 / (k + 3) for k in range(LONG)]}" for name in ("x", "y", "psi"))
    stages = f"[ocp.stages]\ndelta = {{ {factors} }}\n"
    path.write_text(SHIPPED.read_text().replace("N = 20 ", f"N = {LONG} ") + stages)
    ocp = build_ocp(load(path))
    whole = {"role": "controller", **controller_info(ocp, 0)}
    assert len(json.dumps(whole)) > MAX_DOCUMENT_BYTES
    short, said = fitting(whole)
    info = Info.from_json(read(json.dumps(short).encode()))
    assert info.weights is None
    assert [label.name for label in info.inputs] == ["u_c", "omega_c"]
    assert f"may have {MAX_DOCUMENT_BYTES}: it is without the weights of each stage" in said
    assert check_length(ocp).startswith("the description on info has ")


def test_weights_that_fit_are_described() -> None:
    ocp = build_ocp(load(SHIPPED))
    assert check_length(ocp) == ""
    assert fitting(controller_info(ocp, 0)) == (controller_info(ocp, 0), "")


def test_scales_of_inputs_are_told_where_the_solvers_remember_inputs_as_further_states() -> None:
    rti = Rti(pioneer(N=7, lbddu=[-0.1, -np.inf]), compile=False)
    info = Info.from_json({"role": "controller", **controller_info(rti.ocp, 0, (rti.scale_x, rti.scale_u))})
    assert rti.problem.model.nx > rti.ocp.model.nx
    assert info.scale_u == (0.5, 0.745)  # half the ranges
    assert info.scale_x == tuple(rti.scale[:5])


def test_signals_too_long_for_a_description_are_refused_at_the_door(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(description, "MAX_DOCUMENT_BYTES", 5000)
    with pytest.raises(ConfigError, match=r"must have at most 904 bytes, for viewers and standbys to read it, got .*: have fewer states"):
        check_length(build_ocp(load(SHIPPED)))


def test_controller_with_too_many_weights_is_still_read_by_standbys_and_says_what_viewers_miss(
    session: FakeSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, stopped = load(SHIPPED), Event()
    stopped.set()
    monkeypatch.setattr(daemon, "check_length", lambda _: None)
    size = len(json.dumps(controller_info(build_ocp(config), 0)))
    monkeypatch.setattr(description, "MAX_DOCUMENT_BYTES", size)  # what a running controller adds makes it longer
    assert daemon.main(config, BusSettings(), state=tmp_path, stop=stopped) == 0
    key = config.keys().info("controller")
    received = Received(session.put[key], "application/json", key)
    assert Info.from_received(received).weights is None
    assert len(latches(received)) == 1
    assert Info.from_received(received).scale_u == (0.5, 0.745)  # half the ranges
    leader = Leader.from_received(received, 2**63)
    assert leader is not None
    assert leader.parameters == {"version": 0, "changes": {}}
