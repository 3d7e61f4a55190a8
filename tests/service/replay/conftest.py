# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from rti_mpc.rti.ocp import Ocp
from rti_mpc_service.config import build
from rti_mpc_service.config.schema import Config

build_ocp = build.build_ocp
problems: dict[str, Ocp] = {}  # by configuration


@pytest.fixture(autouse=True)
def shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give controllers of equal configurations one problem, whose expressions are then built once; that of a user's own model is built each time."""

    def of(config: Config) -> Ocp:
        if ":" in config.model.name:
            return build_ocp(config)
        text = repr(config)
        if text not in problems:
            problems[text] = build_ocp(config)
        return problems[text]

    monkeypatch.setattr(build, "build_ocp", of)
