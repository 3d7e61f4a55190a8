# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from rti_mpc.rti.ocp import Ocp
from rti_mpc.wire import bus as bus_module
from rti_mpc_service.config import build
from rti_mpc_service.config.schema import Config
from tests.wire.fake_session import FakeSession

build_ocp = build.build_ocp
problems: dict[str, Ocp] = {}  # by configuration


@pytest.fixture(scope="module")  # recordings that a module shares have these problems, too
def shared_problems() -> Iterator[None]:
    """Give controllers of equal configurations one problem, whose expressions are then built once; that of a user's own model is built each time."""

    def of(config: Config) -> Ocp:
        if ":" in config.model.name:
            return build_ocp(config)
        text = repr(config)
        if text not in problems:
            problems[text] = build_ocp(config)
        return problems[text]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "build_ocp", of)
        yield


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeSession]:
    """The session of any bus that a process joins."""
    session = FakeSession()
    monkeypatch.setattr(bus_module, "ZenohSession", lambda *_, **__: session)
    yield session
    gc.enable()  # which a controller disables
    gc.unfreeze()
