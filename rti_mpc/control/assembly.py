# SPDX-License-Identifier: Apache-2.0
"""Assembly of a controller: its parts, built once, which whatever acts on several of them shares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.limits import Limits
from rti_mpc.control.blockage import Blockage
from rti_mpc.control.delay import DelayEstimator
from rti_mpc.control.envelope import INPUT_BOUNDS, Envelope
from rti_mpc.control.grid import Grid, Timing
from rti_mpc.control.issued import Issued
from rti_mpc.control.ladder import Ladder
from rti_mpc.control.mode import ModeMachine
from rti_mpc.control.observer import Observer
from rti_mpc.control.prediction import Prediction
from rti_mpc.control.report import Reports
from rti_mpc.control.sent import Sent
from rti_mpc.control.state_stream import StateStream
from rti_mpc.control.stopping import Stopping
from rti_mpc.control.track import Track
from rti_mpc.control.tuning import Tuning
from rti_mpc.model.model import depends_on
from rti_mpc.rti.rti import Rti
from rti_mpc.rti.way_to_rest import StopLaw


@dataclass(frozen=True, eq=False)
class Assembly:
    """
    Parts of one controller.

    Attributes:
        rti: The real-time iteration.
        stale_ns: Age from which a state is not used, robot time.
        valid_ns: How long a command is valid, robot time.
        modes: What the controller is doing, and what it has to say.
        ladder: Samples without a plan of their own.
        envelope: Limits of the inputs.
        tuning: Weights and bounds that act.
        grid: Times at which commands act.
        states: States of the robot.
        understudy: Judge of states in rehearsals, in place of `states`.
        track: Reference.
        sent: Inputs that act before the plan.
        reports: What the robot says of them.
        prediction: Prediction of the state in which the plan begins.
        ways: Ways to rest; None where the inputs ramp to rest.
        issued: Commands.
        delay: Estimator of the delay; None where it is configured.
        blockage: Judge of plans that stop short of the reference.
        robot: Parameters of the robot, each of shape ``(np,)``, wherever it is predicted; those of the reference are written into them.
    """

    rti: Rti
    stale_ns: int
    valid_ns: int
    modes: ModeMachine
    ladder: Ladder
    envelope: Envelope
    tuning: Tuning
    grid: Grid
    states: StateStream
    understudy: StateStream
    track: Track
    sent: Sent
    reports: Reports
    prediction: Prediction
    ways: Stopping | None
    issued: Issued
    delay: DelayEstimator | None
    blockage: Blockage
    robot: tuple[Array, ...]


def assemble(
    rti: Rti, timing: Timing, *, epoch: int, config_hash: int, observer: Observer | None, stop_law: StopLaw | None, compile: bool
) -> Assembly:
    """Build the parts of a `Controller`, whose arguments these are."""
    ocp, model = rti.ocp, rti.ocp.model
    u_rest: Array = np.array(model.u_rest)
    stale_ns, valid_ns = round(1e9 * timing.stale_s), round(1e9 * timing.valid_s)
    envelope, grid = Envelope(ocp, compile=compile), Grid(ocp.dt, timing)
    lbu, ubu, lbdu, ubdu = (ocp.widest(name) for name in INPUT_BOUNDS)
    limits = Limits(u_rest, lbu, ubu, lbdu, ubdu, ocp.dt, 1e-9 * grid.most_ns)
    settling_s = limits.settling_s + (0.0 if stop_law is None else stop_law.rows * stop_law.period_s)
    sent = Sent(u_rest, lbdu, ubdu, grid.dt_ns, (lbu, ubu), model.rotations("states"))
    prediction = Prediction(model, sent, compile=compile)
    delay = None
    if timing.delay_s is None:
        measured = list(range(model.nx)) if observer is None else observer.measured
        delay = DelayEstimator(model, grid.dt_ns, grid.most_ns, scale=rti.scale_x, measured=measured, compile=compile)
    states = StateStream(model, stale_ns, grid.dt_ns, settling_s, observer, as_measured=delay is not None)
    if observer is not None:
        observer.take_scales(rti.scale_x)
    given_np = model.np_ - len(states.d)
    predicting = tuple(of.p[:given_np] for of in (prediction, observer, delay) if of is not None)
    return Assembly(
        rti=rti,
        stale_ns=stale_ns,
        valid_ns=valid_ns,
        modes=ModeMachine(),
        ladder=Ladder(),
        envelope=envelope,
        tuning=Tuning(rti, envelope),
        grid=grid,
        states=states,
        understudy=StateStream(model, stale_ns, grid.dt_ns, settling_s),
        track=Track(model, ocp.N, grid.dt_ns, compile=compile),
        sent=sent,
        reports=Reports(sent, envelope.limits, grid.dt_ns),
        prediction=prediction,
        ways=None if stop_law is None else Stopping(ocp, stop_law, envelope.limits, prediction, valid_ns, compile=compile),
        issued=Issued(epoch, config_hash, grid.dt_ns),
        delay=delay,
        blockage=Blockage(rti, compile=compile),
        robot=predicting if depends_on(model.rate_expr, model.p[:given_np]) else (),
    )
