# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

from rti_mpc.wire import bus as bus_module
from tests.wire.fake_session import FakeSession


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeSession]:
    """The session of any bus that a process joins."""
    session = FakeSession()
    monkeypatch.setattr(bus_module, "ZenohSession", lambda *_, **__: session)
    yield session
    gc.enable()  # which a controller disables
    gc.unfreeze()
