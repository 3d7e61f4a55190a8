# SPDX-License-Identifier: Apache-2.0
"""`rti-mpc check` of the robots that ship."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from rti_mpc_service.check import check
from rti_mpc_service.shipped import ROBOTS

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_that_ships_is_accepted(name: str, tmp_path: Path) -> None:
    copied = tmp_path / ROBOTS[name].name  # the file of its signals goes beside it
    shutil.copy(ROBOTS[name], copied)
    assert check.main(copied) == 0
