# SPDX-License-Identifier: Apache-2.0
"""Wave in every output: it starts where the outputs are, and stays inside the bounds of the states that they are."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.si import read
from rti_mpc_service.rig.wave import wave
from tests.problems import INF
from tests.units import with_units


def two_links(**bounds: object) -> Ocp:
    """Two joints driven by speeds, whose outputs are the position of the tip and the first joint."""
    q, w = ca.SX.sym("q", 2), ca.SX.sym("w", 2)
    tip = ca.cos(q[0]) + ca.cos(q[0] + q[1]), ca.sin(q[0]) + ca.sin(q[0] + q[1])
    model = Model("arm", q, w, w, [*tip, q[0]], ("q_1", "q_2"), ("w_1", "w_2"), ("x", "y", "q_1"))
    return Ocp(model, N=5, dt=0.1, Q=[1, 1, 1], R=[1, 1], **bounds)  # type: ignore[arg-type]


def test_wave_starts_at_outputs_that_are_no_state() -> None:
    x = np.array([0.5, 1.0])
    rows = wave(two_links(), x, np.random.default_rng(1))(np.arange(400))
    assert rows[0] == pytest.approx([np.cos(0.5) + np.cos(1.5), np.sin(0.5) + np.sin(1.5), 0.5])
    assert np.ptp(rows, axis=0) == pytest.approx(2.0, rel=1e-3)  # of a crest between two samples


def test_wave_is_the_same_in_any_units() -> None:
    """It moved an output by two of its units, whatever these were, and kept away from bounds that were nearer than that."""
    units, rows = {"q_1": "deg", "x": "km", "y": "mm"}, []
    for texts in ({}, units):
        arm = two_links().model
        vectors = {name: tuple(replace(s, unit="m" if s.name in "xy" else "rad") for s in getattr(arm, name)) for name in ("states", "outputs")}
        model = with_units(replace(arm, **vectors), texts)
        sizes = [np.array([read(signal.unit).size for signal in signals]) for signals in (model.states, model.outputs)]
        ocp = Ocp(model, N=5, dt=0.1, Q=[1, 1, 1], R=[1, 1], lbx=np.array([0.2, -INF]) / sizes[0], ubx=np.array([2.7, INF]) / sizes[0])
        rows.append(sizes[1] * wave(ocp, np.array([0.5, 1.0]) / sizes[0], np.random.default_rng(1))(np.arange(400)))
    np.testing.assert_allclose(rows[1], rows[0], rtol=0, atol=1e-12)


def test_wave_keeps_a_distance_from_bounds() -> None:
    x = np.array([0.5, 1.0])
    rows = wave(two_links(lbx=[0.2, -INF], ubx=[0.7, INF]), x, np.random.default_rng(1))(np.arange(400))
    assert rows[:, 2].min() >= 0.25
    assert rows[:, 2].max() == pytest.approx(0.65)
    assert np.ptp(rows[:, 0]) == pytest.approx(2.0, rel=1e-3), "a joint's bound is none of the tip's"
