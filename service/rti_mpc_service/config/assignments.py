# SPDX-License-Identifier: Apache-2.0
"""Assignments ``KEY=VALUE`` as they are written on the command line."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rti_mpc.errors import ConfigError


def assigned(rule: str, assignments: Sequence[str]) -> dict[str, str]:
    """
    Return the text of each value by its key.

    Args:
        rule: What an assignment must be, in words, such as ``--x0 must be NAME=VALUE``.
        assignments: Each ``KEY=VALUE``.

    Raises:
        ConfigError: One has no key or no value, or two have the same key.
    """
    values: dict[str, str] = {}
    for assignment in assignments:
        key, _, value = (part.strip() for part in assignment.partition("="))
        if not key or not value:
            raise ConfigError(f"{rule}, got {assignment!r}")
        if key in values:
            raise ConfigError(f"{rule}, each key once, got {key} twice")
        values[key] = value
    return values


def assigned_numbers(rule: str, assignments: Sequence[str]) -> dict[str, float]:
    """
    Return the value of each key as a number, see `assigned`.

    Raises:
        ConfigError: One is none, or not finite.
    """
    numbers = {}
    for key, value in assigned(rule, assignments).items():
        try:
            numbers[key] = float(value)
        except ValueError:
            numbers[key] = math.nan
        if not math.isfinite(numbers[key]):
            raise ConfigError(f"{rule}, got {f'{key}={value}'!r}")
    return numbers
