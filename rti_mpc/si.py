# SPDX-License-Identifier: Apache-2.0
"""
Units of signals as multiples of SI units, read from their text: km, deg/s, rpm, N m, 1/s^2, 10 mm.

Where nothing bounds a signal, a distance that is tried is one of its SI unit, so that the
same robot in other units is treated alike. A unit that is not known, or none, counts as one
of its own: of size 1, and of a dimension that no other unit has. Signals refuse
another spelling of a known unit, such as kmh, which would count as one of its own as well.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np

from rti_mpc.array import Array

BASE = ("m", "kg", "s", "A", "K", "mol", "rad")  # an angle has a dimension here: a rate of turn is no frequency
PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "d": 0.1, "k": 1e3, "M": 1e6, "G": 1e9}
DERIVED = {
    "g": (1e-3, "kg"),
    "t": (1e3, "kg"),
    "in": (0.0254, "m"),
    "ft": (0.3048, "m"),
    "mi": (1609.344, "m"),
    "nmi": (1852.0, "m"),
    "mph": (0.44704, "m s^-1"),
    "kn": (1852 / 3600, "m s^-1"),
    "l": (1e-3, "m^3"),
    "L": (1e-3, "m^3"),
    "min": (60.0, "s"),
    "h": (3600.0, "s"),
    "Hz": (1.0, "s^-1"),
    "deg": (math.pi / 180, "rad"),
    "°": (math.pi / 180, "rad"),
    "rev": (2 * math.pi, "rad"),
    "rpm": (2 * math.pi / 60, "rad s^-1"),
    "N": (1.0, "kg m s^-2"),
    "Nm": (1.0, "kg m^2 s^-2"),
    "Ns": (1.0, "kg m s^-1"),
    "Nms": (1.0, "kg m^2 s^-1"),
    "J": (1.0, "kg m^2 s^-2"),
    "W": (1.0, "kg m^2 s^-3"),
    "Pa": (1.0, "kg m^-1 s^-2"),
    "bar": (1e5, "kg m^-1 s^-2"),
    "Wh": (3600.0, "kg m^2 s^-2"),
    "Ah": (3600.0, "A s"),
    "V": (1.0, "kg m^2 s^-3 A^-1"),
    "F": (1.0, "kg^-1 m^-2 s^4 A^2"),
    "H": (1.0, "kg m^2 s^-2 A^-2"),
    "S": (1.0, "kg^-1 m^-2 s^3 A^2"),
    "T": (1.0, "kg s^-2 A^-1"),
    "Wb": (1.0, "kg m^2 s^-2 A^-1"),
    "ohm": (1.0, "kg m^2 s^-3 A^-2"),
    "Ω": (1.0, "kg m^2 s^-3 A^-2"),
    "°C": (1.0, "K"),
    "degC": (1.0, "K"),
    "%": (0.01, ""),
}  # size of each unit in SI units, and these; not the coulomb, since C is a degree, as in deg C
WITHOUT_PREFIX = {"kg", "t", "in", "ft", "mi", "nmi", "mph", "kn", "min", "h", "rev", "°C", "degC", "%"}  # kt is not taken for a kilotonne
MEANT = {
    "meter": "m",
    "metre": "m",
    "inch": "in",
    "inches": "in",
    "cin": "in^3",
    "foot": "ft",
    "feet": "ft",
    "mile": "mi",
    "cm": "cm",
    "nm": "Nm or nmi",
    "gm": "g",
    "gram": "g",
    "tonne": "t",
    "mt": "t",
    "liter": "l",
    "litre": "l",
    "sec": "s",
    "second": "s",
    "msec": "ms",
    "usec": "us",
    "minute": "min",
    "hr": "h",
    "hour": "h",
    "min": "min",
    "rev": "rev",
    "rad": "rad",
    "deg": "deg",
    "radian": "rad",
    "degree": "deg",
    "percent": "%",
    "celsius": "degC",
    "kelvin": "K",
    "newton": "N",
    "volt": "V",
    "amp": "A",
    "watt": "W",
    "mps": "m/s",
    "kmh": "km/h",
    "kmph": "km/h",
    "kph": "km/h",
    "kt": "kn or Gg",
    "knot": "kn",
    "dps": "deg/s",
    "rps": "rev/s",
}  # unit that another spelling stands for, which is in lower case here and without the s of a plural
ANY_CASE = [
    *BASE,
    *DERIVED,
    *(prefix + symbol for symbol in (*BASE, *DERIVED) if symbol not in WITHOUT_PREFIX for prefix in "numkM"),
]  # in which capitals are looked past
LEAST = 1e-100  # size of a unit that is believed; also the inverse of the largest
MAX_POWER = 9
SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻·⋅", "0123456789-**")

FACTOR = re.compile(
    r"\s*(?P<by>/|\.|\*(?!\*)|)\s*(?:(?P<number>\d+(?:\.\d*)?(?:e[-+]?\d+)?)(?![^\W\d_])|(?P<symbol>[^\W\d_]+|°[^\W\d_]?|%)(?:\^|\*\*)?(?P<power>-?\d{1,2}(?!\d))?)\s*"
)


class Unit(NamedTuple):
    """
    A unit.

    Attributes:
        size: How many SI units it is.
        dimension: Base units, each with its power, in alphabetical order; empty for a number, an unknown unit for itself.
    """

    size: float
    dimension: tuple[tuple[str, int], ...]

    @property
    def in_si(self) -> str:
        """The SI unit of this dimension, as text; ``"1"`` of a number."""
        return " ".join(base if power == 1 else f"{base}^{power}" for base, power in self.dimension) or "1"


class HasUnit(Protocol):
    """A signal, or its label on the bus."""

    @property
    def unit(self) -> str:
        """Its unit."""


def read(text: str) -> Unit:
    """Return the unit that a text means. A slash divides by the factor behind it alone; powers follow ``^``, ``**`` or nothing."""
    size, powers, unknown = 1.0, Counter[str](), Unit(1.0, ((text, 1),))
    if (factors := _factors(text)) is None:
        return unknown
    for factor in factors:
        if (part := _part(factor)) is None:
            return unknown
        sign = -1 if factor["by"] == "/" else 1
        size *= part.size**sign
        powers.update({base: sign * power for base, power in part.dimension})
    if not LEAST <= size <= 1.0 / LEAST:
        return unknown
    return Unit(size, tuple(sorted((base, power) for base, power in powers.items() if power)))


def misspelt(text: str) -> dict[str, str]:
    """Return what to write instead of each unknown symbol of a text; empty if that would not make all of it known, or nothing is unknown."""
    symbols = [factor["symbol"] for factor in _factors(text) or () if factor["symbol"]]
    instead = {symbol: _meant(symbol) for symbol in symbols if _symbol(symbol) is None}
    return instead if all(instead.values()) else {}


def ones(signals: Iterable[HasUnit]) -> Array:
    """Return how many units of each signal one SI unit is, shape ``(n,)``."""
    return np.array([1.0 / read(signal.unit).size for signal in signals])


def _factors(text: str) -> list[re.Match[str]] | None:
    """Return the factors of a text; None if it is not made of factors."""
    found: list[re.Match[str]] = []
    at, written = 0, text.strip().translate(SUPERSCRIPTS)
    while at < len(written):
        if (factor := FACTOR.match(written, at)) is None:
            return None
        found.append(factor)
        at = factor.end()
    return found


def _meant(symbol: str) -> str:
    """Return the known units that an unknown symbol may stand for; empty if there is none."""
    if len(symbol) == 1:
        return ""
    lower = symbol.lower()
    alike = [known for known in dict.fromkeys(ANY_CASE) if len(known) > 1 and known.lower() == lower]
    return MEANT.get(lower) or MEANT.get(lower.removesuffix("s")) or " or ".join(alike)


def _part(factor: re.Match[str]) -> Unit | None:
    """Return the unit of one factor of a text; None if it is not known."""
    if factor["number"]:
        number = float(factor["number"])
        return Unit(number, ()) if LEAST <= number <= 1.0 / LEAST else None
    power = int(factor["power"] or 1)
    if abs(power) > MAX_POWER or (unit := _symbol(factor["symbol"])) is None:
        return None
    return Unit(unit.size**power, tuple((base, power * of) for base, of in unit.dimension))


def _symbol(symbol: str) -> Unit | None:
    """Return the unit of a symbol, perhaps with a prefix; None if it is not known."""
    if symbol in BASE:
        return Unit(1.0, ((symbol, 1),))
    if symbol in DERIVED:
        size, of = DERIVED[symbol]
        return Unit(size, read(of).dimension)
    prefix, rest = symbol[:1], symbol[1:]
    if prefix not in PREFIXES or not (rest in DERIVED or rest in BASE) or rest in WITHOUT_PREFIX:
        return None
    of_rest = _symbol(rest)
    return of_rest and Unit(PREFIXES[prefix] * of_rest.size, of_rest.dimension)
