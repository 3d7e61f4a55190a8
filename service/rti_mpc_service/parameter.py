# SPDX-License-Identifier: Apache-2.0
"""Values of parameters on the bus: JSON has no infinities, so null stands for a bound that is absent on its side."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

BOUND_KEYS = ("ocp.bounds.inputs", "ocp.bounds.increments", "ocp.bounds.second_differences", "ocp.bounds.states")
ABSENT = (-math.inf, math.inf)  # as lower and upper bound


def to_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values, by key, with null for each bound that is absent."""
    return {key: _pair(key, value, [(absent, None) for absent in ABSENT]) for key, value in values.items()}


def from_json(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values, by key, with the infinity of its side for each bound that is null."""
    return {key: _pair(key, value, [(None, absent) for absent in ABSENT]) for key, value in values.items()}


def _pair(key: str, value: Any, replaced: list[tuple[Any, Any]]) -> Any:
    """Replace in a pair of bounds; anything else is returned as it is."""
    if key.rpartition(".")[0] not in BOUND_KEYS or not isinstance(value, list | tuple) or len(value) != len(replaced):
        return value
    return type(value)(new if bound == old else bound for bound, (old, new) in zip(value, replaced, strict=True))
