# SPDX-License-Identifier: Apache-2.0
"""What the library asks of its arrays."""

from __future__ import annotations

import numpy as np
import pytest

from rti_mpc.array import FEW, bounded

LIMIT = 1e9


@pytest.mark.parametrize("size", [1, FEW, FEW + 1])
@pytest.mark.parametrize("value", [0.0, 0.4 * LIMIT, LIMIT, -LIMIT, np.nextafter(LIMIT, np.inf), -np.nextafter(LIMIT, np.inf), 1e300, np.nan, np.inf])
def test_numbers_are_bounded_exactly_up_to_the_limit_wherever_they_stand(value: float, size: int) -> None:
    for place in (0, size - 1):
        vector = np.full(size, 1.0)
        vector[place] = value
        assert bounded(vector, LIMIT) == (abs(value) <= LIMIT)


def test_no_numbers_are_bounded_and_overflow_is_no_warning() -> None:
    assert bounded(np.zeros(0), LIMIT)
    with np.errstate(all="raise"):
        assert not bounded(np.array([np.nan, 1e300, np.inf]), LIMIT)
