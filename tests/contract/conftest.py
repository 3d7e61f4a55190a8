# SPDX-License-Identifier: Apache-2.0
"""One scene with a guard that lets commands pass, and whose robot refuses nothing that the guard tells it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.contract.scene import Scene


@pytest.fixture
def scene() -> Iterator[Scene]:
    scene = Scene().ready()
    yield scene
    assert not scene.refused
