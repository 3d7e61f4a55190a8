# SPDX-License-Identifier: Apache-2.0
"""The array type of the library: float64, C-contiguous; shapes are in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
