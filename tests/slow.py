# SPDX-License-Identifier: Apache-2.0
"""Parameters of a test of which `make test` takes some and `make test-slow` the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_but(values: Iterable[Any], *fast: Any) -> list[Any]:
    """Return values as parameters, marked slow but for a few, which must be among them: these show that the statement holds, the rest where else."""
    found = list(values)
    assert all(value in found for value in fast), fast
    return [value if value in fast else pytest.param(value, marks=pytest.mark.slow) for value in found]
