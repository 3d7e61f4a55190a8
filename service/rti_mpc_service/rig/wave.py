# SPDX-License-Identifier: Apache-2.0
"""Reference for any model: a sine wave in every output, starting at the outputs of a state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.rti.ocp import Ocp

WAVE_PERIOD_S = 40.0


def wave(ocp: Ocp, x: Array, rng: np.random.Generator) -> Callable[[NDArray[np.int64]], Array]:
    """Return a reference that starts at state `x`, shape ``(nx,)``: a function of sample indices, shape ``(M,)``, to rows, shape ``(M, ny)``."""
    model = ocp.model
    phases = rng.uniform(-np.pi, np.pi, model.ny)
    start = np.array([x[[state.name for state in model.states].index(y.name)] if y in model.states else 0.0 for y in model.outputs])
    return lambda k: np.asarray(start + np.sin(2 * np.pi / WAVE_PERIOD_S * ocp.dt * k[:, None] + phases) - np.sin(phases))
