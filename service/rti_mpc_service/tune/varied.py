# SPDX-License-Identifier: Apache-2.0
"""Keys of a robot's file that a study varies, each in a range, and configurations with other values of them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.fit import check_tree
from rti_mpc_service.config.refusal import explain
from rti_mpc_service.config.schema import Config

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

    from rti_mpc.model.model import Model

HORIZON, DELAY = "ocp.N", "timing.delay_s"
WEIGHTS = ("ocp.weights.delta", "ocp.weights.lambda", "ocp.bounds.soft_weight", "ocp.bounds.soft_weight_L2")
TABLES = ("ocp.weights.Q", "ocp.weights.R", "ocp.weights.R_u", "ocp.terminal.Q")  # of weights, by name
WEIGHT_DECADES = 2.0  # above and below today's weight
DELAY_PERIODS = 2.0  # from 0
DIGITS = 3  # significant digits of a value that is tried, so that the file holds what was driven


@dataclass(frozen=True)
class Varied:
    """
    One key and its range.

    Attributes:
        key: Dotted path in the file.
        low: Least value.
        high: Largest value.
        today: Value in the file.
    """

    key: str
    low: float
    high: float
    today: float

    @property
    def distribution(self) -> BaseDistribution:
        """Distribution of Optuna: whole numbers for the horizon, logarithmic for weights."""
        from optuna.distributions import FloatDistribution, IntDistribution

        if self.key == HORIZON:
            return IntDistribution(int(self.low), int(self.high))
        return FloatDistribution(self.low, self.high, log=self.key != DELAY)

    def rounded(self, value: float) -> float:
        """Return a proposed value with `DIGITS` significant digits, still inside the range."""
        return int(value) if self.key == HORIZON else min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high)


def find_varied(config: Config, model: Model, asked: Sequence[str]) -> tuple[Varied, ...]:
    """
    Return the keys to vary.

    Args:
        config: The robot's configuration.
        model: Its model.
        asked: Each ``KEY`` or ``KEY=LOW:HIGH``; none: `default_keys`.

    Raises:
        ConfigError: A key cannot be varied, or a range does not fit it.
    """
    found = tuple(parse(config, text) for text in asked or default_keys(config, model))
    if not found:
        raise ConfigError("--vary must name a key, since the file has no weight above 0 beside the one that all others are compared with")
    if twice := next((each.key for each in found if sum(each.key == other.key for other in found) > 1), ""):
        raise ConfigError(f"--vary must name each key once, got {twice} twice")
    return found


def default_keys(config: Config, model: Model) -> list[str]:
    """
    Return the weights above 0 whose ratios matter.

    A common factor of all weights changes nothing, and one that prefers x to y would be an
    artefact of the path. So the weights of the position stay, or of the first output.
    """
    weights = config.ocp.weights
    weighted = [output for output in model.outputs if weights.Q[output.name] > 0.0]
    position = [output.name for output in weighted if output.role in ("x", "y")]
    kept = position or [output.name for output in weighted[:1]]
    return [
        *(f"ocp.weights.Q.{output.name}" for output in weighted if output.name not in kept),
        *(f"ocp.weights.R.{name}" for name, weight in weights.R.items() if weight > 0.0),
    ]


def asked_for(text: str) -> tuple[str, tuple[float, float] | None]:
    """
    Return a key and its range, None if it has none, from ``KEY`` or ``KEY=LOW:HIGH``, as far as they can be judged without the robot's file.

    Raises:
        ConfigError: There is no such key, or the range is none.
    """
    key, given, span = text.partition("=")
    if key not in (HORIZON, DELAY, *WEIGHTS) and key.rpartition(".")[0] not in TABLES:
        known = ", ".join((*(f"{table}.NAME" for table in TABLES), *WEIGHTS, HORIZON, DELAY))
        raise ConfigError(f"--vary must name one of {known}, got {key!r}")
    if not given:
        return key, None
    low, high = limits(text, span)
    if key == HORIZON and not (low.is_integer() and high.is_integer()):
        raise ConfigError(f"--vary {HORIZON} must have a range of whole numbers, got {span!r}")
    if key != DELAY and low <= 0.0:
        raise ConfigError(f"--vary {key} must have a range above 0, got {span!r}")
    return key, (low, high)


def parse(config: Config, text: str) -> Varied:
    """Return one key with its range, from ``KEY`` or ``KEY=LOW:HIGH``."""
    key, span = asked_for(text)
    today = today_of(config, key)
    low, high = span or default_range(config, key, today)
    varied = Varied(key, low, high, today)
    for value in (low, high):
        with_values(config, {key: value})
    return varied


def limits(text: str, span: str) -> tuple[float, float]:
    """Return the limits that were asked for."""
    low, _, high = span.partition(":")
    try:
        pair = float(low), float(high)
    except ValueError:
        pair = math.nan, math.nan
    if not (pair[0] < pair[1] and all(map(math.isfinite, pair))):
        raise ConfigError(f"--vary must be KEY or KEY=LOW:HIGH, two numbers with LOW < HIGH, got {text!r}")
    return pair


def default_range(config: Config, key: str, today: float) -> tuple[float, float]:
    """Return the range of a key whose range was not asked for."""
    if key == HORIZON:
        return float(max(config.N_u if config.ocp.N_u else 1, int(today) // 2, 1)), 2.0 * today
    if key == DELAY:
        return 0.0, DELAY_PERIODS * config.ocp.dt_s
    if today <= 0.0:
        raise ConfigError(f"--vary {key} must have a range, {key}=LOW:HIGH, since it is 0 today")
    return today * 10.0**-WEIGHT_DECADES, today * 10.0**WEIGHT_DECADES


def today_of(config: Config, key: str) -> float:
    """
    Return the value of a key in a configuration.

    Raises:
        ConfigError: It is none, or no single number.
    """
    value: Any = config.model_dump(by_alias=True)
    for step in key.split("."):
        table, value = value, value.get(step) if isinstance(value, dict) else None
    if value is None and isinstance(table, dict) and key.rpartition(".")[0] in TABLES:
        raise ConfigError(f"--vary {key} must name one of {', '.join(table) or 'none: the file has no such table'}, got {step!r}")
    if isinstance(value, list | tuple) and len(value) == 1:
        (value,) = value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"--vary {key} must be one number in the robot's file, got {value!r}")
    return float(value)


def with_values(config: Config, values: Mapping[str, float]) -> Config:
    """
    Return a configuration with other values of some keys.

    Raises:
        ConfigError: A value does not fit, named as in the file.
    """
    document = config.model_dump(by_alias=True, exclude_unset=True)
    for key, value in values.items():
        *tables, name = key.split(".")
        place = document
        for table in tables:
            place = place.setdefault(table, {})
        place[name] = int(value) if key == HORIZON else value
    try:
        changed = Config.model_validate(document)
        check_tree(changed)
    except ValidationError as error:
        raise ConfigError(explain(error, Config, document)) from error
    return changed
