# SPDX-License-Identifier: Apache-2.0
r"""
Path following for any robot with a position in the plane: progress along the path is a state, and how fast it grows is for the optimiser to choose.

    model = path_following(dynamic_bicycle())
    ocp = Ocp(model, Q=[...], h_expr=..., lh=0.0, ...)

Model predictive contouring control [Faulwasser2016]_ [Lam2010]_ [Liniger2015]_: a point moves along the path,

.. math::

    \dot\theta = v, \qquad \dot v = (v_c - v) / \tau ,

and the robot at :math:`(x, y)` is told from the point :math:`p(\theta)`, with the unit tangent :math:`t` and the normal `n` to the left, by

.. math::

    e_c = n^T ((x, y) - p), \quad e_l = t^T ((x, y) - p), \quad e_v = v - v_{ref}(\theta) ,

the outputs contour, lag and pace, whose references are zero. A large weight on the lag makes the point the projection of the robot. A small one on
the contour leaves the robot free to cut corners as far as the edges of the track, :math:`-w_{right} \le e_c \le w_{left}`, which are constraints.

The path enters through stage parameters: control points of a cubic B-spline, widths and speeds at knots around the robot, see
`rti_mpc.reference.path.Path.window`. The dynamics do not contain them, so that a robot or a simulator integrates the progress without a path.
"""

from __future__ import annotations

from dataclasses import replace

import casadi as ca

from rti_mpc import given
from rti_mpc.errors import OcpError
from rti_mpc.model.model import Model
from rti_mpc.signals import KNOTS_BEHIND, Signal, path_place, place, plane

KNOTS = 24
LAG_S = 0.1  # time constant of the point's speed behind its command
NOMINAL_STEP_M, NOMINAL_WIDTH_M, NOMINAL_SPEED_M_S = 0.5, 1.0, 1.0
KNOT_PARTS = {"x": "m", "y": "m", "right": "m", "left": "m", "speed": "m/s"}  # a knot's parameters, as `Path.window` has them


def path_following(model: Model, knots: int = KNOTS, lag_s: float = LAG_S) -> Model:
    """
    Let a robot follow a path.

    Args:
        model: Robot, two of whose states are its position, by role.
        knots: Of the path around the robot, one more than reached within a horizon, and those behind it.
        lag_s: Time constant of the point's speed behind its command, in s.

    Returns:
        The model with

        - states ``progress``, in m along the path, and ``pace``, its rate of change, in m/s;
        - input ``pace_c``, which commands the pace;
        - outputs ``contour`` (m to the left of the path), ``lag`` (m ahead of the point) and ``pace_error`` (m/s above the speed profile),
          in place of the robot's own;
        - constraints, after its own: ``left`` and ``right``, the distances to the edges in m, and, if a state is its heading,
          ``lateral_acceleration`` in m/s^2;
        - parameters ``path_start`` and ``path_step``, in m, and ``path_i_x`` to ``path_i_speed`` of each knot. Nominal is a straight line along
          the x axis.

    Raises:
        OcpError: The model has no position, or an argument is out of range.
    """
    given.instance("model", model, Model)
    knots = given.whole("knots", knots, KNOTS_BEHIND + 3)
    if not 0.0 < given.number("lag_s", lag_s) < float("inf"):
        raise OcpError(f"lag_s must be a positive number of seconds, got {lag_s}")
    of_states = plane(model.states)
    if model.f_expl_expr is None:
        raise OcpError(f"model {model.name}: a model that follows a path must be in continuous time, got one in discrete time")
    if of_states is None:
        raise OcpError(f"model {model.name}: two states must be a position, with role x and role y, got {[s.name for s in model.states]}")
    progress, pace, pace_c = ca.SX.sym("progress"), ca.SX.sym("pace"), ca.SX.sym("pace_c")
    start, step, knot = ca.SX.sym("path_start"), ca.SX.sym("path_step"), ca.SX.sym("path", len(KNOT_PARTS), knots)
    position = model.x[list(of_states), 0]
    velocity = model.f_expl_expr[list(of_states), 0]
    point, tangent, (right, left, speed) = spline(progress, start, step, knot)
    away = position - point
    contour = tangent[0] * away[1] - tangent[1] * away[0]
    constraints = [(Signal("left", "m"), left - contour), (Signal("right", "m"), right + contour)]
    if (heading := place(model.states, "heading")) is not None:
        ahead = velocity[0] * ca.cos(model.x[heading]) + velocity[1] * ca.sin(model.x[heading])
        constraints.append((Signal("lateral_acceleration", "m/s^2"), ahead * model.f_expl_expr[heading]))
    return replace(
        model,
        x=ca.vertcat(model.x, progress, pace),
        u=ca.vertcat(model.u, pace_c),
        p=ca.vertcat(model.p, start, step, ca.vec(knot)),
        f_expl_expr=ca.vertcat(model.f_expl_expr, pace, (pace_c - pace) / lag_s),
        y_expr=ca.vertcat(contour, ca.dot(tangent, away), pace - speed),
        h_expr=ca.vertcat(model.h_expr, *(expression for _, expression in constraints)),
        states=(*model.states, Signal("progress", "m", role="progress"), Signal("pace", "m/s")),
        inputs=(*model.inputs, Signal("pace_c", "m/s", commands="pace")),
        outputs=(Signal("contour", "m"), Signal("lag", "m"), Signal("pace_error", "m/s")),
        constraints=(*model.constraints, *(signal for signal, _ in constraints)),
        parameters=(
            *model.parameters,
            Signal("path_start", "m", role="path_start"),
            Signal("path_step", "m"),
            *(Signal(f"path_{i}_{part}", unit, role="path_x" if part == "x" else "") for i in range(knots) for part, unit in KNOT_PARTS.items()),
        ),
        p_nominal=(*model.p_nominal, *nominal_window(knots)),
        u_rest=(*model.u_rest, 0.0),
        stop_expr=None if model.stop_expr is None else ca.vertcat(model.stop_expr, 0),
        x_nominal=(*model.x_nominal, 0.0, 0.0) if model.x_nominal else (),
    )


def with_drift(model: Model) -> Model:
    r"""
    Let a model that follows a path also tell how fast its robot moves across the path.

    A robot that is slower than the speed profile is pulled ahead. Turning aside then costs progress, which lag and pace tell in second order only, by
    :math:`\cos`: a Gauss-Newton step does not see it, and turns too far, this way in one step and that way in the next. The drift, which has the
    :math:`\sin`, is what it sees. Where little else keeps the robot straight, as with a small weight on the contour, the steps do not converge
    without.

    Args:
        model: What `path_following` returns.

    Returns:
        The model with the output ``drift``, the robot's velocity to the left of the path's direction, in m/s, after its own outputs. Its reference
        is zero.

    Raises:
        OcpError: The model follows no path.
    """
    window, of_states, progress = window_place(given.instance("model", model, Model)), plane(model.states), place(model.states, "progress")
    if window is None or of_states is None or progress is None:
        raise OcpError(f"model {model.name} must be made by path_following to have a drift: it has no parameter whose role is path_start")
    first, knots = window
    knot = ca.reshape(model.p[first + 2 : first + 2 + len(KNOT_PARTS) * knots], len(KNOT_PARTS), knots)
    _, tangent, _ = spline(model.x[progress], model.p[first], model.p[first + 1], knot)
    velocity = model.f_expl_expr[list(of_states), 0]
    drift = tangent[0] * velocity[1] - tangent[1] * velocity[0]
    return replace(model, y_expr=ca.vertcat(model.y_expr, drift), outputs=(*model.outputs, Signal("drift", "m/s")))


def spline(s: ca.SX, start: ca.SX, step: ca.SX, knot: ca.SX) -> tuple[ca.SX, ca.SX, tuple[ca.SX, ca.SX, ca.SX]]:
    """
    Return point, unit tangent, and widths and speed of a path at arc length `s`, from its knots, shape ``(5, n)``; held beyond its knots.

    Each basis function is written for all arc lengths, which takes no branches: :math:`6 b(t) = (2 - |t|)_+^3 - 4 (1 - |t|)_+^3`.
    """
    n = knot.shape[1]
    t = ca.fmin(ca.fmax((s - start) / step, 1), n - 2)  # inside, where the basis functions add up to one
    away = t - ca.DM(range(n))
    outer, inner = ca.fmax(2 - ca.fabs(away), 0), ca.fmax(1 - ca.fabs(away), 0)
    basis = (outer**3 - 4 * inner**3) / 6
    slope = -ca.sign(away) * (outer**2 - 4 * inner**2) / 2
    along = knot[:2, :] @ slope / step
    widths_and_speed = knot[2:, :] @ inner
    return knot[:2, :] @ basis, along / ca.norm_2(along), (widths_and_speed[0], widths_and_speed[1], widths_and_speed[2])


def nominal_window(knots: int) -> list[float]:
    """Return the path's parameters on a straight line along the x axis, the first knot behind its origin."""
    start = -KNOTS_BEHIND * NOMINAL_STEP_M
    line = [(start + i * NOMINAL_STEP_M, 0.0, NOMINAL_WIDTH_M, NOMINAL_WIDTH_M, NOMINAL_SPEED_M_S) for i in range(knots)]
    return [start, NOMINAL_STEP_M, *(value for row in line for value in row)]


def window_place(model: Model) -> tuple[int, int] | None:
    """Return where the path's parameters begin among a model's, and how many knots they have; None if it follows no path."""
    return path_place(model.parameters)
