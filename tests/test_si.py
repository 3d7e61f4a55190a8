# SPDX-License-Identifier: Apache-2.0
"""Units read from their text."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rti_mpc.errors import OcpError
from rti_mpc.si import BASE, DERIVED, MEANT, misspelt, ones, read
from rti_mpc.signals import Signal

SIZES = {
    "m": 1.0,
    "km": 1e3,
    "mm": 1e-3,
    "µm": 1e-6,
    "km/h": 1 / 3.6,
    "m/s^2": 1.0,
    "m s⁻²": 1.0,
    "1/m": 1.0,
    "1/mm": 1e3,
    "cm**2": 1e-4,
    "deg/s": math.pi / 180,
    "rpm": math.pi / 30,
    "rev/min": math.pi / 30,
    "mN": 1e-3,
    "kN m": 1e3,
    "N·mm": 1e-3,
    "s m/rad^2": 1.0,
    "1000 m": 1e3,
    "1e-3 rad": 1e-3,
    "N.m": 1.0,
    "kNs": 1e3,
    "Nms/rad": 1.0,
    "mph": 0.44704,
    "kn": 1852 / 3600,
    "nmi": 1852.0,
    "kWh": 3.6e6,
    "mAh": 3.6,
    "mT": 1e-3,
    "kΩ": 1e3,
    "nm": 1e-9,
    "g": 1e-3,
    "%": 0.01,
    "1": 1.0,
    "": 1.0,
}


@pytest.mark.parametrize("text", SIZES)
def test_size_of_a_unit_is_how_many_si_units_it_is(text: str) -> None:
    assert read(text).size == pytest.approx(SIZES[text], rel=1e-15)


@pytest.mark.parametrize("text", ["m", "rad", "m/s", "rad/s", "m/s^2", "N", "Nm", "s m/rad^2", "1", "1/m"])
def test_an_si_unit_has_size_one_to_the_last_bit(text: str) -> None:
    """So that nothing is rounded for a robot in SI units."""
    assert read(text).size == 1.0


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ("km", "mm", True),
        ("km/h", "m/s", True),
        ("rpm", "rad/s", True),
        ("deg", "rad", True),
        ("N m", "Nm", True),
        ("kn", "m/s", True),
        ("V/A", "ohm", True),
        ("V s/A", "H", True),
        ("A/V", "S", True),
        ("F", "A s/V", True),
        ("T m^2", "Wb", True),
        ("Wb", "V s", True),
        ("Nms", "J s", True),
        ("Ns", "N s", True),
        ("Wh", "J", True),
        ("Ah", "A s", True),
        ("rpm", "Hz", False),
        ("min", "m", False),
        ("m", "m^2", False),
        ("rad", "1", False),
    ],
)
def test_units_of_one_quantity_have_one_dimension(one: str, other: str, alike: bool) -> None:
    assert (read(one).dimension == read(other).dimension) is alike


@pytest.mark.parametrize(
    "text", ["counts", "N/(m/s)", "m//s", "m/", "mkg", "0 m", "1e999 m", "1e90 1e90 m", "m^99", "10m", "_", "furlong/s", "deg C", "kt", "mt", "cin"]
)
def test_a_text_that_is_no_known_unit_is_one_of_its_own(text: str) -> None:
    assert read(text) == (1.0, ((text, 1),))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rad/sec", "s instead of sec"),
        ("deg/Sec^2", "s instead of Sec"),
        ("kmh", "km/h instead of kmh"),
        ("KPH", "km/h instead of KPH"),
        ("Km", "km instead of Km"),
        ("KG", "kg instead of KG"),
        ("degs/sec", "deg instead of degs, s instead of sec"),
        ("RPM", "rpm instead of RPM"),
        ("kt", "kn or Gg instead of kt"),
        ("NM", "Nm or nmi instead of NM"),
        ("Mpa", "mPa or MPa instead of Mpa"),
        ("mt", "t instead of mt"),
        ("cin", "in^3 instead of cin"),
    ],
)
def test_a_known_unit_in_another_spelling_is_refused_with_the_right_one(text: str, said: str) -> None:
    with pytest.raises(OcpError) as error:
        Signal("v", text)
    assert str(error.value) == f"unit of the signal 'v' must have {said}, got {text!r}"


@pytest.mark.parametrize("text", ["", "1", "widgets", "counts", "counts/sec", "steps per second", "px", "dB", "ct", "M", "v", "mPas", "m/(V s)"])
def test_a_text_that_no_other_spelling_makes_a_known_unit_is_taken_as_it_is(text: str) -> None:
    assert Signal("v", text).unit == text
    assert read(text).size == 1.0


def test_every_known_unit_is_taken_and_so_is_every_unit_that_a_refusal_names() -> None:
    named = [unit for units in MEANT.values() for unit in units.split(" or ")]
    for text in (*BASE, *DERIVED, *SIZES, *named):
        assert Signal("v", text).unit == text
        assert not misspelt(text)
    assert all(read(unit).dimension != ((unit, 1),) or unit in BASE for unit in named)


def test_every_unit_of_the_table_is_made_of_base_units() -> None:
    for symbol in DERIVED:
        assert {base for base, _ in read(symbol).dimension} <= set(BASE), symbol


@pytest.mark.parametrize(("text", "si"), [("km", "m"), ("rpm", "rad s^-1"), ("mN", "kg m s^-2"), ("%", "1"), ("counts", "counts")])
def test_si_unit_of_a_unit_is_told(text: str, si: str) -> None:
    assert read(text).in_si == si
    assert read(si) == (1.0, read(text).dimension)


def test_one_si_unit_is_told_in_the_unit_of_each_signal() -> None:
    np.testing.assert_allclose(ones([Signal("x", "km"), Signal("psi", "deg"), Signal("n", "1")]), [1e-3, 180 / math.pi, 1.0], rtol=1e-15)
    assert ones([]).shape == (0,)
