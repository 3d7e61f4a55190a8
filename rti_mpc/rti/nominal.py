# SPDX-License-Identifier: Apache-2.0
r"""
Nominal state of a problem: where the model is finite and differentiable, so that solvers can start and scales be found there.

Many models of the field are singular at zero, a state they never see: slip angles
divide by the speed, outflows are roots of a level, reaction rates have
:math:`\exp(-E / RT)`. Of a model that gives no `x_nominal`, zero is tried first, brought
inside the bounds, then one SI unit of each, then states at random; what is found so says little of
where the robot operates, and is left to come to rest.

Where a model is regular and its plans explode all the same, it is stiff: a stage
is longer than an explicit integrator can follow. With the model's eigenvalues
:math:`\lambda` and the scheme's growth :math:`R(\lambda \, dt)` per stage, a motion that decays, and whose
:math:`|R| > 1`, is one that a plan would see grow.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import OcpError
from rti_mpc.model.model import IRK, MAX_STEPS
from rti_mpc.rti.ocp import Ocp
from rti_mpc.si import ones

RANDOM_STATES = 40  # states at random, from a hundredth to ten thousand SI units in size
SETTLING_STAGES = 1000  # from a state that was found to where the model takes it with its inputs at rest
GROWTH = {"euler": (1.0, 1.0), "rk4": (1 / 24, 1 / 6, 1 / 2, 1.0, 1.0)}  # R(z) of a scheme, highest power first
FAST_RATE_STAGES = 2.0  # |lambda| dt from which on a motion is faster than a stage can follow
EXPLODED_GROWTH = 10.0  # growth of an error over the horizon from which on a plan means nothing


def nominal_state(ocp: Ocp) -> Array:
    """
    Return the nominal state of a problem's model, given or found, shape ``(nx,)``.

    Raises:
        OcpError: The model is singular there, or wherever it was looked for.
    """
    model = ocp.model
    u_rest = np.clip(model.u_rest, ocp.widest("lbu"), ocp.widest("ubu"))
    values = model_and_derivatives(ocp)

    def regular(x: Array) -> bool:
        return bool(np.isfinite(np.array(values(x, u_rest, model.p_nominal))).all())

    rotations = model.rotations("states")
    if model.x_nominal:
        x = np.array(model.x_nominal)
        if wrong := rotations.misfit(x):
            raise OcpError(f"x_nominal must be a state of model {model.name}: {wrong}")
        if not regular(x):
            raise OcpError(f"x_nominal must be a state at which model {model.name} is finite and differentiable, got {named(ocp, x)}")
        return x
    zero = rotations.completed(np.clip(np.zeros(model.nx), ocp.widest("lbx"), ocp.widest("ubx")))
    if regular(zero):
        return zero
    rng, one = np.random.default_rng(1), ones(model.states)
    candidates = [one, *(one * size * rng.normal(size=model.nx) for size in np.geomspace(1e-2, 1e4, RANDOM_STATES))]
    for candidate in candidates:
        if regular(x := rotations.completed(np.clip(candidate, ocp.widest("lbx"), ocp.widest("ubx")))):
            settled = np.array(ocp.phi().mapaccum(SETTLING_STAGES)(x, u_rest, model.p_nominal))[:, -1]
            return settled if regular(settled) else np.asarray(x)
    told = f"model {model.name} must be finite and differentiable at a nominal state: give one, x_nominal"
    raise OcpError(f"{told}, got none, and none was found, as at {named(ocp, zero)}")


def named(ocp: Ocp, x: Array) -> str:
    """Write a state by names, with what is not finite there."""
    model = ocp.model
    rates = np.array(ca.Function("f", [model.x, model.u, model.p], [ca.densify(model.rate_expr)])(x, model.u_rest, model.p_nominal)).ravel()
    where = ", ".join(f"{signal.name} = {value:g}" for signal, value in zip(model.states, x, strict=True))
    wrong = [signal.name for signal, rate in zip(model.states, rates, strict=True) if not np.isfinite(rate)]
    return f"{where}, where " + (f"the rate of {', '.join(wrong)} is not finite" if wrong else "a derivative is not finite")


def model_and_derivatives(ocp: Ocp) -> ca.Function:
    """Build ``(x, u, p) -> values``: all that a problem needs of its model at a point, finite if and only if the model is regular there."""
    model = ocp.model
    values = ca.vertcat(model.rate_expr, model.y_expr, ocp.h_expr)
    derivatives = ca.jacobian(values, ca.vertcat(model.x, model.u))
    return ca.Function("regular", [model.x, model.u, model.p], [ca.veccat(values, derivatives.nz[:])])


def check_stiffness(ocp: Ocp, x: Array) -> None:
    """
    Refuse a problem whose stages are too long for its integrator around a state of shape ``(nx,)``.

    Raises:
        OcpError: What must decay would grow; the message has the state, its time constant and the longest stage.
    """
    model = ocp.model
    rates = ca.Function("rates", [model.x, model.u, model.p], [ca.densify(ca.jacobian(model.rate_expr, model.x))])
    eigenvalues, modes = np.linalg.eig(np.array(rates(x, np.clip(model.u_rest, ocp.widest("lbu"), ocp.widest("ubu")), model.p_nominal)))
    if model.dt is not None or ocp.method == IRK:
        return  # it follows any motion that decays
    growth, steps = GROWTH[ocp.method], model.sim_method_num_steps
    for eigenvalue, mode in sorted(zip(eigenvalues, modes.T, strict=True), key=lambda pair: -abs(pair[0])):
        z = eigenvalue * ocp.dt / steps
        if z.real >= 0.0 or abs(z) <= FAST_RATE_STAGES or ocp.N * steps * np.log(abs(np.polyval(growth, z))) <= np.log(EXPLODED_GROWTH):
            continue
        shares = np.geomspace(1.0, 1e-9, 20_000)
        longest = ocp.dt * next(share for share in shares if abs(np.polyval(growth, share * z)) <= 1.0)
        state = model.states[int(np.argmax(np.abs(mode)))].name
        needed = math.ceil(steps * ocp.dt / longest)
        divided = f"or sim_method_num_steps = {needed}, " if needed <= MAX_STEPS else ""
        raise OcpError(
            f"dt must be at most {longest:.3g} s for {ocp.method} and model {model.name}, which is stiff: {state} settles with a time constant of "
            f"{-1.0 / eigenvalue.real:.3g} s; take the implicit integrator, {IRK}, "
            f"{divided}or shorten dt, got dt = {ocp.dt:g} s"
        )
