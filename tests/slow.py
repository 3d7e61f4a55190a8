# SPDX-License-Identifier: Apache-2.0
"""Parameters of a test of which `make test` takes some and `make test-slow` the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_but(values: Iterable[Any], *fast: Any) -> list[Any]:
    """Return the values of a parameter, or the tuples of several, marked slow but for a few of them: those show what is meant, the rest how far."""
    found = list(values)
    assert all(value in found for value in fast), fast
    several = (value if isinstance(value, tuple) else (value,) for value in found)
    return [pytest.param(*each, marks=() if value in fast else pytest.mark.slow) for value, each in zip(found, several, strict=True)]
