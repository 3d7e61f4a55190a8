# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="module")
def one_problem(shared_problems: None) -> None:
    """Every recorded controller of a configuration and every one that is built again have one problem."""
