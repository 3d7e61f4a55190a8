# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--guard", metavar="COMMAND", help="the guard that tests/guard_conformance judges, run as COMMAND CONFIG.toml -e ENDPOINT; ours")
    parser.addoption("--soak-s", type=float, default=20.0, metavar="SECONDS", help="how long the soak test drives the robot (default: 20)")
