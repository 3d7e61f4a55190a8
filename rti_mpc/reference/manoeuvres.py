# SPDX-License-Identifier: Apache-2.0
"""Manoeuvres of the robots that ship: their outputs over time, from times in s, shape ``(M,)``, to rows, shape ``(M, ny)``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import ConfigError
from rti_mpc.reference.outputs import OutputReference
from rti_mpc.signals import Signal

Rows = Callable[[Array], Array]

BAY_APPROACH_M, BAY_TURN_M, BAY_DEPTH_M = 14.0, 20.0, 6.0  # ahead; then backwards along a quarter turn, and into the bay
BAY_TIMES_S = (20.0, 24.0, 70.0)  # when it has come to a stop, when it begins to reverse, and when it is in the bay
DURATION_S = 60.0
WIDENING_S = 4.0  # of the eight that is flown
TURNING_RAD_S = 0.5  # of the yaw in flight
GRAVITY = 9.81  # m/s^2
STEP_S = 1e-3  # by which the acceleration of a flight is found
UPRIGHT_S = 5.0  # before the cart moves to and fro, its pole upright


def eight(length_m: float, width_m: float, lap_s: float) -> Rows:
    """Build an eight about the origin, with its tangent as heading."""
    half, rate = 0.5 * np.array([length_m, width_m]), 2 * np.pi / lap_s * np.array([1.0, 2.0])

    def rows(t: Array) -> Array:
        position, velocity = half * np.sin(rate * t[:, None]), half * rate * np.cos(rate * t[:, None])
        return np.column_stack([position, np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))])

    return rows


def turning_eight(t: Array) -> Array:
    """Drive an eight while turning: ``x, y, psi``."""
    return np.column_stack([eight(3.0, 2.0, 30.0)(t)[:, :2], 0.3 * t])


def boat_eight(t: Array) -> Array:
    """Sail an eight: ``x, y``."""
    return eight(20.0, 10.0, 75.0)(t)[:, :2]


def flown_eight(t: Array) -> Array:
    """Fly an eight that rises and falls, its nose ahead, and that widens at the start: ``x, y, z, psi``."""
    x, y, _ = eight(4.0, 2.0, 8.0)(t).T * smooth(t / WIDENING_S)
    return np.column_stack([x, y, 1.0 + 0.3 * np.sin(2 * np.pi / 16.0 * t), 0.0 * t])


def turning_flight(t: Array) -> Array:
    """Fly the same eight while turning, as the thrust must point for it: ``x, y, z`` and the quaternion ``q_w, q_x, q_y, q_z``."""
    from scipy.spatial.transform import Rotation  # which takes as long to load as all else that a source of references needs

    before, at, after = (flown_eight(t + by)[:, :3] for by in (-STEP_S, 0.0, STEP_S))
    up = (after - 2 * at + before) / STEP_S**2 + np.array([0.0, 0.0, GRAVITY])
    yaw = TURNING_RAD_S * t
    nose = np.column_stack([np.cos(yaw), np.sin(yaw), 0.0 * t])
    axes = np.stack([np.cross(side := np.cross(up, nose), up), side, up], axis=-1)
    vector_first = Rotation.from_matrix(axes / np.linalg.norm(axes, axis=1, keepdims=True)).as_quat()
    return np.column_stack([at, vector_first[:, 3], vector_first[:, :3]])


def tip_circle(t: Array) -> Array:
    """Draw a circle with the tip of an arm: ``x, z``."""
    angle = 2 * np.pi / 4.0 * t
    return np.column_stack([0.6 + 0.2 * np.cos(angle), 0.2 + 0.2 * np.sin(angle)])


def swing_up(t: Array) -> Array:
    """Swing a pole up, then move its cart to and fro: ``x, theta, v, omega``."""
    rate, since = 2 * np.pi / 8.0, np.maximum(0.0, t - UPRIGHT_S)
    return np.column_stack([0.4 * (1.0 - np.cos(rate * since)), 0.0 * t, 0.4 * rate * np.sin(rate * since), 0.0 * t])


def bay(t: Array) -> Array:
    """Drive ahead, then back a trailer into a bay beside the road: ``x, y, psi``, of the trailer."""
    stop_s, reverse_s, end_s = BAY_TIMES_S
    ahead = BAY_APPROACH_M * smooth(t / stop_s)
    s = np.linspace(0.0, BAY_TURN_M + BAY_DEPTH_M, 2001)
    psi = 0.5 * np.pi * smooth(s / BAY_TURN_M)
    backwards = -np.column_stack([np.cos(psi), np.sin(psi)])
    steps = 0.5 * (backwards[1:] + backwards[:-1]) * np.diff(s)[:, None]
    at = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
    done = s[-1] * smooth((t - reverse_s) / (end_s - reverse_s))
    x, y, heading = (np.interp(done, s, column) for column in (*at.T, psi))
    return np.column_stack([ahead + x, y, heading])


def swung_chain(t: Array) -> Array:
    """Move the end of a chain away from a wall and back, its middle as calm as it can be: ``x, y, z`` of the end, the velocity of the middle."""
    aside, still = 0.15 * (1.0 - np.cos(2 * np.pi / 10.0 * t)), 0.0 * t
    return np.column_stack([1.0 + still, aside, still, still, still, still])


def smooth(share: Array) -> Array:
    """Return a share of a way, 0 to 1, that begins and ends at rest."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share**2 * (3.0 - 2.0 * share))


POSE, POSITION = ("x", "y", "psi"), ("x", "y")
MANOEUVRES: dict[str, tuple[tuple[str, ...], Rows]] = {  # names of the outputs, in the order of the columns
    "car_eight": (POSE, eight(8.0, 4.0, 16.0)),
    "race_eight": (POSE, eight(8.0, 4.0, 11.0)),
    "turning_eight": (POSE, turning_eight),
    "bay": (POSE, bay),
    "boat_eight": (POSITION, boat_eight),
    "flown_eight": ((*POSITION, "z", "psi"), flown_eight),
    "turning_flight": ((*POSITION, "z", "q_w", "q_x", "q_y", "q_z"), turning_flight),
    "tip_circle": (("x_tip", "z_tip"), tip_circle),
    "swing_up": (("x", "theta", "v", "omega"), swing_up),
    "swung_chain": (("x_3", "y_3", "z_3", "vx_2", "vy_2", "vz_2"), swung_chain),
}


def manoeuvre(name: str, outputs: Sequence[Signal]) -> OutputReference:
    """
    Return a manoeuvre as a reference of a model's outputs.

    Raises:
        ConfigError: It is of other outputs.
    """
    columns, rows = MANOEUVRES[name]
    if name not in fitting(outputs):
        named = ", ".join(output.name for output in outputs)
        raise ConfigError(f"the scenario {name} is of the outputs {', '.join(columns)}, it must be of those of the model, {named}")
    order = [columns.index(output.name) for output in outputs]
    return OutputReference(name, lambda y0, t: np.ascontiguousarray(rows(t)[:, order]), DURATION_S)


def fitting(outputs: Sequence[Signal]) -> list[str]:
    """Return the manoeuvres that are of these outputs, in whatever order."""
    names = sorted(output.name for output in outputs)
    return [name for name, (columns, _) in MANOEUVRES.items() if sorted(columns) == names]
