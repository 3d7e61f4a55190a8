# SPDX-License-Identifier: Apache-2.0
"""JSON that scripts read."""

from __future__ import annotations

import json
import math

import numpy as np

from rti_mpc_service.json_text import json_text


def test_numbers_that_are_none_are_null_wherever_they_are() -> None:
    value = {"a": math.nan, "b": (1.5, math.inf, {"c": [-np.float64("inf"), np.float64(2.0)]}), "d": "nan", "e": None, "f": True, "g": 3}
    assert json.loads(json_text(value)) == {"a": None, "b": [1.5, None, {"c": [None, 2.0]}], "d": "nan", "e": None, "f": True, "g": 3}
    assert "NaN" not in json_text(value)
    assert "Infinity" not in json_text(value)
