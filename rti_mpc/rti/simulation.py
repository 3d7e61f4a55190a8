# SPDX-License-Identifier: Apache-2.0
"""
Simulation of a closed loop: a real-time iteration and a plant, one sample after the other, without a clock and without a bus.

    run = simulate(Rti(ocp), ocp.phi(), lambda t: np.column_stack([t, 0 * t]), samples=200)
    print(run.summary())
    plot(run).savefig("run.png")
    print(compare({"R = 1": run, "R = 0.1": other}))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from rti_mpc import given
from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.model.integrator import integrator
from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti

PLANT_SUBSTEPS = 10  # RK4 steps per stage of a plant that is given as a model
SETTLED_SHARE = 0.5  # of a run, after which errors count as those of the settled loop

Plant = Callable[[Array, Array, Array], ArrayLike]  # (x, u, p) -> x after one stage; as `Ocp.phi` returns it
Rows = Callable[[Array], ArrayLike] | ArrayLike


@dataclass(frozen=True, eq=False)
class Simulation:
    """
    One closed loop, as arrays: a row for each sample.

    Attributes:
        ocp: Problem that was solved.
        t: Times of the samples, shape ``(M + 1,)``, in s; the last one is the end.
        x: States of the plant, shape ``(M + 1, nx)``.
        u: Inputs that acted from each sample on, shape ``(M, nu)``.
        y: Outputs of the plant, shape ``(M + 1, ny)``.
        y_ref: Reference at the same times, shape ``(M + 1, ny)``, its angles in the turn of the outputs.
        status: Outcome of each sample.
        u0: Input that acted before the first sample, shape ``(nu,)``.
    """

    ocp: Ocp
    t: Array
    x: Array
    u: Array
    y: Array
    y_ref: Array
    status: tuple[QpStatus, ...]
    u0: Array

    @property
    def error(self) -> Array:
        """Outputs less reference, shape ``(M + 1, ny)``, in the unit of each output."""
        return np.asarray(self.y - self.y_ref)

    @property
    def cost(self) -> float:
        """Closed-loop cost: that of the OCP, each sample's output after it, its increment and its input weighted as in the first stage."""
        e, du = self._residual()[1:], np.diff(self.u, axis=0, prepend=self.u0[None])
        ocp = self.ocp
        off = self.u - np.array(ca.Function("u_ref", [ocp.model.p], [ocp.u_ref])(ocp.model.p_nominal)).ravel()
        of_inputs = np.einsum("ki,ij,kj->", du, ocp.R_at(0), du) + np.einsum("ki,i,ki->", off, np.atleast_2d(ocp.R_u)[0], off)
        return float(np.einsum("ki,ij,kj->", e, ocp.Q_at(0), e) + of_inputs)

    def _residual(self) -> Array:
        """Return what the cost weighs of outputs and reference, shape ``(M + 1, ny)``."""
        y, y_ref = (ca.SX.sym(name, self.ocp.model.ny) for name in ("y", "y_ref"))
        residual = ca.Function("residual", [y, y_ref], [ca.densify(self.ocp.model.residual(y, y_ref))]).map(len(self.t))
        return np.array(residual(self.y.T, self.y_ref.T)).T.reshape(self.y.shape)

    def summary(self) -> dict[str, float]:
        """Return closed-loop cost, largest error of each output in the second half, largest excess of a bound on states, and unusable samples."""
        settled = np.abs(self.error[int(SETTLED_SHARE * len(self.t)) :]).max(axis=0)
        excess = np.maximum(self.x[1:] - self.ocp.widest("ubx"), self.ocp.widest("lbx") - self.x[1:])
        return {
            "cost": self.cost,
            **{f"{signal.name} off by [{signal.unit}]": float(value) for signal, value in zip(self.ocp.model.outputs, settled, strict=True)},
            "beyond bounds": float(np.max(excess, initial=0.0)),
            "unusable": sum(not status.usable for status in self.status),
        }


def simulate(
    rti: Rti,
    plant: Plant | Model,
    reference: Rows,
    *,
    x0: ArrayLike | None = None,
    samples: int | None = None,
    parameters: Callable[[Array], ArrayLike] | None = None,
) -> Simulation:
    """
    Close the loop of a real-time iteration and a plant.

    Args:
        rti: What commands; it starts cold, with its inputs at rest.
        plant: What is commanded: ``(x, u, p)`` to the state one stage later, such as ``ocp.phi()``, or a model, which may differ from the
            controller's in its equations and its nominal parameters.
        reference: Outputs at times of shape ``(n,)``, in s from the start: a function to rows of shape ``(n, ny)``; or such rows one stage
            apart, the first at the start, the last one held.
        x0: Initial state, shape ``(nx,)``; the nominal one by default.
        samples: How many to simulate; as far as the rows go by default.
        parameters: Of the state of a sample, parameters of all its stages, shape ``(np,)``, such as the path around a robot that follows one; the
            nominal ones by default.

    Raises:
        OcpError: An argument is none, or the plant leaves where it is finite.
        ShapeError: A shape does not fit.
    """
    ocp = given.instance("rti", rti, Rti).ocp
    model, N, dt = ocp.model, ocp.N, ocp.dt
    rows = None if callable(reference) else given.numbers("reference", reference)
    if rows is not None:
        rows = given.array("reference", rows, (len(np.atleast_1d(rows)), model.ny))
        if len(rows) < (least := 2 if samples is None else 1):
            raise OcpError(
                f"reference must have at least {least} rows, the first at the start, or samples must be given for one row, got {len(rows)}"
            )
    if samples is None and rows is None:
        raise OcpError("samples must be given where the reference is a function, got None")
    samples = given.whole("samples", len(rows) - 1 if samples is None and rows is not None else samples, 1)
    if parameters is not None and not callable(parameters):
        raise OcpError(f"parameters must be a function of a state, got {given.quoted(parameters)}")
    step, p = next_state(plant, model, dt), np.tile(np.array(model.p_nominal), (samples + 1, 1))

    def at(k: Any) -> Array:
        """Return the reference at samples k, shape ``(n,)``."""
        if rows is not None:
            return np.asarray(rows[np.minimum(k, len(rows) - 1)])
        return given.array("what reference returns", reference(dt * np.asarray(k, dtype=np.float64)), (len(k), model.ny))  # type: ignore[operator]

    x: Array = np.empty((samples + 1, model.nx))
    u: Array = np.empty((samples, model.nu))
    x[0] = rti.x_nominal if x0 is None else given.array("x0", x0, (model.nx,))
    if not np.isfinite(x[0]).all():
        raise OcpError(f"x0 must be finite, got {x[0].tolist()}")
    u0: Array = np.array(model.u_rest)
    status = []
    rti.reset(x[0], u0)
    for k in range(samples):
        if parameters is not None:
            p[k:] = given.array("what parameters returns", parameters(x[k]), (model.np_,))
        rti.prepare(at(k + 1 + np.arange(N)), np.tile(p[k], (N + 1, 1)))
        status.append(rti.feedback(x[k]))
        u[k] = rti.u[0]
        x[k + 1] = given.array("what plant returns", step(x[k], u[k], p[k]), (model.nx,))
        if not np.isfinite(x[k + 1]).all():
            raise OcpError(f"plant must return finite states, got {x[k + 1].tolist()} after {dt * (k + 1):g} s")
    acting = np.vstack([u0[None], u])  # the input before each state
    y = np.array(model.outputs_at().map(samples + 1)(x.T, acting.T, p.T)).T.reshape(samples + 1, model.ny)
    y_ref = np.array(at(np.arange(samples + 1)), dtype=np.float64)
    y_ref = model.rotations("outputs").near(y_ref, y)
    return Simulation(ocp, np.asarray(dt * np.arange(samples + 1), dtype=np.float64), x, u, y, y_ref, tuple(status), u0)


def next_state(plant: Plant | Model, model: Model, dt: float) -> Plant:
    """Return a plant as a function, from one or from a model with its own nominal parameters."""
    if not isinstance(plant, Model):
        if not callable(plant):
            raise OcpError(f"plant must be a function of x, u and p, or a Model, got {given.quoted(plant)}")
        return plant
    if (plant.nx, plant.nu) != (model.nx, model.nu):
        raise OcpError(f"plant must have the {model.nx} states and {model.nu} inputs of the controller's model, got {plant.nx} and {plant.nu}")
    phi, own = integrator(plant, substeps=PLANT_SUBSTEPS if plant.dt is None else max(1, round(dt / plant.dt))), np.array(plant.p_nominal)
    return lambda x, u, _: phi(x, u, own, dt)


def compare(runs: Mapping[str, Simulation]) -> str:
    """
    Return a table of simulations: a line for each, with what `Simulation.summary` says of it.

    Raises:
        OcpError: There is none, or one is of another model.
    """
    if not isinstance(runs, Mapping) or not runs:
        raise OcpError(f"runs must be simulations by name, at least one, got {given.quoted(runs)}")
    summaries = {name: given.instance(f"the run {name}", run, Simulation).summary() for name, run in runs.items()}
    columns = list(next(iter(summaries.values())))
    if other := [name for name, summary in summaries.items() if list(summary) != columns]:
        raise OcpError(f"runs must have the same outputs to be compared, got others for {', '.join(other)}")
    lines = [["", *columns], *([str(name), *(f"{value:.4g}" for value in summary.values())] for name, summary in summaries.items())]
    widths = [max(len(line[i]) for line in lines) for i in range(len(columns) + 1)]
    return "\n".join("  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))]) for line in lines)
