# SPDX-License-Identifier: Apache-2.0
"""Reference for any model: a sine wave in every output, starting at the outputs of a state, inside the bounds of the states that outputs are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.rti.ocp import Ocp
from rti_mpc.si import ones

WAVE_PERIOD_S = 40.0
WAVE_SPAN = 2.0  # from its start that an output moves at most, in its SI unit, where no bound is nearer
BOUND_DISTANCE_SHARE = 0.1  # of what lies between the bounds, or within the span: the wave keeps this distance from a bound


def wave(ocp: Ocp, x: Array, rng: np.random.Generator) -> Callable[[NDArray[np.int64]], Array]:
    """Return a reference that starts at state `x`, shape ``(nx,)``: a function of sample indices, shape ``(M,)``, to rows, shape ``(M, ny)``."""
    model = ocp.model
    phases = rng.uniform(-np.pi, np.pi, model.ny)
    start = np.array(model.h()(x, model.p_nominal)).ravel()
    one, (low, high) = ones(model.outputs), inside(ocp, start)
    return lambda k: np.clip(start + one * np.sin(2 * np.pi / WAVE_PERIOD_S * ocp.dt * k[:, None] + phases) - one * np.sin(phases), low, high)


def inside(ocp: Ocp, start: Array) -> tuple[Array, Array]:
    """Return between which values a wave from `start` stays, all of shape ``(ny,)``; infinite where no bound is within its span."""
    states = [state.name for state in ocp.model.states]
    places = [states.index(name) if name else None for name in ocp.model.counterparts()["outputs"]]
    lower, upper = (
        np.array([none if j is None else bounds[j] for j in places]) for bounds, none in ((ocp.widest("lbx"), -np.inf), (ocp.widest("ubx"), np.inf))
    )
    span = WAVE_SPAN * ones(ocp.model.outputs)
    distance = BOUND_DISTANCE_SHARE * (np.minimum(upper, start + span) - np.maximum(lower, start - span))
    return np.where(lower > start - span, lower + distance, -np.inf), np.where(upper < start + span, upper - distance, np.inf)
