# SPDX-License-Identifier: Apache-2.0
"""
The real-time iteration: one Newton-type step of the OCP per sample, in two phases.

Preparation needs no state: it shifts the guess, linearizes there and prepares the
solver, factorization included. Feedback embeds the initial state, solves and takes
the full step. Only feedback is on the path from sensor to actuator
[Diehl2005]_ [Gros2020]_. If that step is large, one linearization was not enough, and
feedback iterates a few times at most, the last times from extrapolated guesses, see
`rti_mpc.rti.acceleration`. With at most one iteration this is the plain scheme; with many, and a small tolerance, it is
sequential quadratic programming.

`ActiveSet` solves nearly every QP; a QP solver takes over when it fails. Softened bounds
rarely act, so the QP solver first solves the QP without them. A plan that keeps them
anyway also solves the whole QP. Otherwise the whole QP is solved, and is the one that is
prepared until its plan has left the softened bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

import numpy as np

from rti_mpc import given
from rti_mpc.array import Array, copy, memories
from rti_mpc.codegen import BUILDS, bind
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import OcpError
from rti_mpc.rti.acceleration import Acceleration
from rti_mpc.rti.active_set import ActiveSet
from rti_mpc.rti.construction import FORMULATIONS, construction
from rti_mpc.rti.linearization import scale_size
from rti_mpc.rti.ocp import ARGUMENTS, Ocp
from rti_mpc.rti.qp.osqp import Solver, SolverSettings
from rti_mpc.rti.qp.qp import Guess, Qp, Step, step_size
from rti_mpc.rti.qp.qpsolvers import ForeignSolver, check_name
from rti_mpc.rti.qp.transcription import INFINITY
from rti_mpc.rti.scale import scale
from rti_mpc.rti.second_difference import REMEMBERED, Remembering, as_solved, parts
from rti_mpc.rti.turns import Turns

BUILT_IN_SOLVERS = ("riccati", "osqp")  # any other solver is one of qpsolvers
MAX_SEQUENTIAL_N_U = 10  # control horizon up to which the sequential formulation is the faster one, see docs/engine.md
SOLVED, INACCURATE = QpStatus.SOLVED, QpStatus.INACCURATE  # read faster than a member of the enumeration
MAX_ITERATIONS = 3  # per sample
STEP_TOLERANCE = 0.015  # a larger step is followed by another iteration: closed-loop costs within 0.5 % of converged NMPC, see docs/engine.md
COST_WEIGHTS = ("delta", "lambda_", "z", "Z", "Q_e", "zh", "Zh", "R_u", "zddu", "Zddu")  # weights that are multiplied by the scale of the cost
TOUCHING_DISTANCE = 2e-3  # relative to the scale of a softened bound: a plan further away than this has left the bound


class Rti:
    """
    Real-time iteration on a fixed OCP.

    Between samples it remembers the guess, the previous input, and the starting points
    of its solvers; nothing else.

    Attributes:
        ocp: The problem.
        problem: The problem that the solvers solve: with the inputs sent last as further states, see `rti_mpc.rti.second_difference`, where second
            differences are bounded, else `ocp` itself. `scale` and `guess` belong to this one.
        formulation: ``"simultaneous"`` or ``"sequential"``.
        iterations: QPs per sample at most: 1 is the plain real-time iteration, many with a small tolerance are converged SQP.
        tolerance: Change of the inputs, relative to their scale, half their range: an iteration with a larger change is followed by another.
        taken: Iterations of the last feedback.
        x: States of the plan of the last feedback, shape ``(N + 1, nx)``; the next guess is made of them.
        u: Inputs of the plan, shape ``(N_u, nu)``. Row 0 is the command.
        u_prev: Input before the plan, shape ``(nu,)``, from which the first increment is counted.
        u_before: Input before that one, shape ``(nu,)``, on which the first second difference depends as well.
        y_ref: Reference rows of the current sample, shape ``(N, ny)``.
        p: Stage parameters of the current sample, shape ``(N + 1, np)``.
        x0: Initial state of the current sample, shape ``(nx,)``, its angles in the turn of the plan.
        scale: Scales of states, inputs and softened bounds inside the solvers, then the states' reach, see `rti_mpc.rti.scale`; shape
            ``(2 nx + nu + ng,)``.
        cost_scale: Factor of the cost inside the solvers.
        x_nominal: State around which the model is regular, given or found, shape ``(nx,)``; the plan begins there before the first `reset`.
        guess: Arrays of the guess at which the current sample is linearized, which the solvers read and write.
        active_set: The solver that is tried first; None if another one was asked for.
        solvers: The QP solvers, each with its QP: without softened bounds and, if there are any, with them.
        solver: The solver that solved the current sample, or that is prepared for it.
        status: Outcome of the last feedback.
        retuned: Changes of weights and bounds since the start.
        advance: Compiled call that shifts the plan by one stage into the guess.
        evaluate: Compiled call that computes the cost of the plan.

    Args:
        ocp: The problem.
        settings: Settings of OSQP, as the solver or as the one that takes over from `riccati`.
        formulation: ``"simultaneous"``, ``"sequential"``, or ``"auto"`` for the faster one.
        solver: ``"riccati"``, ``"osqp"``, or another one's name in qpsolvers.
        compile: Whether to compile the model.
        build: ``"native"`` to compile for this very processor, which is faster; see `rti_mpc.codegen.BUILDS`.

    Raises:
        OcpError: The formulation or the solver is unknown, the settings are not the solver's, a number of iterations or a tolerance makes no sense,
            the model is singular wherever it was looked at, or stiff.
    """

    solver: ActiveSet | Solver | ForeignSolver
    solvers: Sequence[Solver | ForeignSolver]

    def __init__(
        self,
        ocp: Ocp,
        settings: SolverSettings | None = None,
        *,
        formulation: str = "auto",
        solver: str = "riccati",
        iterations: int = MAX_ITERATIONS,
        tolerance: float = STEP_TOLERANCE,
        compile: bool = True,
        build: str = "portable",
    ) -> None:
        given.instance("ocp", ocp, Ocp)
        check_options(solver, settings, iterations, tolerance)
        given.one_of("build", build, BUILDS)
        self.ocp, self.problem = ocp, as_solved(ocp)
        own, model, N, N_u = ocp.model, self.problem.model, ocp.N, ocp.N_u
        self.formulation = formulation_of(ocp, formulation)
        built = construction(self.problem, self.formulation, structured=solver == "riccati", build=build if compile else None)
        self.iterations, self.tolerance, self.taken = iterations, tolerance, 0
        # A step leads from a guess to a plan; the next guess is that plan, shifted by one stage. The two never share memory.
        x_plan: Array = np.zeros((N + 1, model.nx))
        self.u: Array = np.zeros((N_u, model.nu))
        x, u = np.zeros_like(x_plan), np.zeros_like(self.u)
        self._pairs = memories(((x, x_plan), (u, self.u)))
        self.u_prev: Array = np.array(model.u_rest, dtype=np.float64)
        self.u_before = self.u_prev.copy()
        self.y_ref: Array = np.zeros((N, model.ny))
        p: Array = np.tile(np.array(model.p_nominal), (N + 1, 1))
        x0 = built.x_nominal.copy()
        # Inputs sent and marks of blocks come after the model's own states and parameters; the views that others read leave them out.
        self.x, self.p, self.x0 = x_plan[:, : own.nx], p[:, : own.np_], x0[: own.nx]
        self._bounded = list(ocp.soft_ddu)
        self._remembered: Array = x0[own.nx :].reshape(REMEMBERED, -1)
        if isinstance(self.problem, Remembering):
            p[:, own.np_ :] = self.problem.flags
        self.x_nominal = self.x0.copy()
        self.status = QpStatus.NONE
        self.retuned = 0
        self._pending = False  # whether a sample was prepared and has had no feedback
        self._settled = False  # whether a sample since the last start has ended with a small step
        self._violation: Array = np.zeros(2)  # of softened bounds, as it is and relative to their scales
        change: Array = np.zeros(1)
        self._change = change.data
        # OSQP knows no infinity but its own.
        self._weights = {name: np.clip(getattr(self.problem, name), -INFINITY, INFINITY) for name in ARGUMENTS}
        self._parts = parts(ocp, self._weights)
        self.scale: Array = np.ones(scale_size(self.problem))
        self.guess = Guess(
            sample={"x": x, "u": u, "u_prev": self.u_prev, "y_ref": self.y_ref, "p": p},
            weights=self._weights | {"scale": self.scale},
            x0=x0,
            plan=Step(x_plan, self.u, self._violation, change),
        )

        make = built.make
        self._acceleration = Acceleration(built.relaxation, self.guess, make)
        self.advance = bind(make(built.shift), {"x": x_plan, "u": self.u, "p": p}, {"x_next": x, "u_next": u})
        bounds = np.atleast_2d(self._weights["lbx"])[0], np.atleast_2d(self._weights["ubx"])[0]
        self._turns = Turns(self.problem, (make(built.output), make(built.steps), make(built.unsettled)), x, x0, self.y_ref, p, bounds)
        self._cost: Array = np.zeros(1)
        self.evaluate = bind(make(built.cost), self.guess.arguments | {"x": x_plan, "u": self.u}, {"cost": self._cost})
        qps = [Qp(transcription, self.guess, make) for transcription in built.transcriptions]
        self.active_set = None if built.structured is None else ActiveSet(*built.structured, self.guess, make)
        self._normalise(qps, built.normalised)
        if solver in BUILT_IN_SOLVERS:
            self.solvers = [Solver(qp, settings or SolverSettings()) for qp in qps]
        else:
            self.solvers = [ForeignSolver(qp, solver) for qp in qps]
        self.reset(self.x_nominal, np.array(model.u_rest))

    def __reduce_ex__(self, protocol: Any) -> str:
        """Refuse copies and pickles: compiled calls hold the memory of this object's arrays."""
        raise OcpError("an Rti must be made where it is used, Rti(ocp) in each process, and cannot be copied or pickled as its Ocp can")

    def _normalise(self, qps: Sequence[Qp], known: dict[str, Any]) -> None:
        """
        Compute the scales of the variables, and normalise the cost, so that one step size of ADMM and one tolerance fit every problem.

        Args:
            qps: The QPs, to be filled.
            known: The result by name, which the first `Rti` of the problem writes.
        """
        if not known:
            self._move(qps[0])
            self.scale[:] = scale(self.problem, self.guess.plan.x, self.u, self.y_ref, self.guess.sample["p"])
            motion = {name: array.copy() for name, array in self.guess.start.items()}
            known |= {"scale": self.scale.copy(), "cost_scale": 1.0 / step_size(qps[0]), "motion": motion}
        self.scale[:] = known["scale"]
        self.cost_scale: float = known["cost_scale"]
        for name, array in known["motion"].items():
            self.guess.sample[name][:] = array
        for name in COST_WEIGHTS:
            self._parts[name][0][...] *= self.cost_scale
        self.y_ref[:] = 0.0
        for qp in qps:
            qp.fill()

    def _move(self, qp: Qp) -> None:
        """Fill a QP along a motion, or at the nominal state if the motion leads out of where the model is regular, as below the bottom of a tank."""
        self._roll_out()
        qp.fill()
        if not qp.sound:
            self._stand()
            qp.fill()
        if not qp.sound:
            raise OcpError(
                f"model {self.ocp.model.name} must be finite and differentiable along a stage of {self.ocp.dt:g} s from its nominal state, "
                f"x_nominal, got {self.x_nominal.tolist()}"
            )

    @property
    def scale_x(self) -> Array:
        """Scales of the states, shape ``(nx,)``."""
        return self.scale[: self.ocp.model.nx]

    @property
    def scale_u(self) -> Array:
        """Scales of the inputs, shape ``(nu,)``."""
        return self.scale[self.problem.model.nx :][: self.ocp.model.nu]

    @property
    def scale_g(self) -> Array:
        """Scales of what has softened bounds in `problem`, shape ``(ng,)``."""
        return self.scale[self.problem.model.nx + self.problem.model.nu :][: self.problem.ng]

    @property
    def qp(self) -> Qp:
        """The QP of the current sample; filled if its solver is a QP solver."""
        return self._backup.qp if isinstance(self.solver, ActiveSet) else self.solver.qp

    def reset(self, x0: Array, u_prev: Array) -> None:
        """
        Start cold: the guess is one state and one input at all stages, and no solver starts from an earlier solution.

        Args:
            x0: State, shape ``(nx,)``.
            u_prev: Input that acts before the plan, and has acted for long, shape ``(nu,)``.

        Raises:
            OcpError: One of them is no array of real numbers.
            ShapeError: A shape does not fit.
        """
        x0 = given.array("x0", x0, self.x0.shape)
        self.u_prev[:] = self.u_before[:] = given.array("u_prev", u_prev, self.u_prev.shape)
        self.u[:] = np.clip(self.u_prev, self.ocp.lbu, self.ocp.ubu)
        self._stay_at(x0)
        self._pending = self._settled = False
        self._turns.forget()
        self._backup = self.solvers[0]
        self._loaded = False
        self.solver = self._backup
        for solver in self.solvers:
            solver.cold = True
        if self.active_set is not None:
            self.solver = self.active_set
            self.active_set.forget()

    def rewarm(self) -> None:
        """Let the workspaces of OSQP depend on nothing but arrays, see `Solver.rewarm`."""
        for solver in self.solvers:
            if isinstance(solver, Solver):
                solver.rewarm()

    def use_whole_qp(self) -> None:
        """Let the QP solver, if it is needed next, solve the QP with its softened bounds."""
        self._backup, self._loaded = self.solvers[-1], False

    def retune(self, values: Mapping[str, Array]) -> None:
        """
        Take other weights and bounds from the next `prepare` on; `ocp` keeps those it was built with.

        Args:
            values: Weights and bounds by the names in `WEIGHTS_AND_BOUNDS`, shapes as in `Ocp`. What is compiled in must stay, see
                `Ocp.check_compiled`.

        Raises:
            OcpError: A name is none of them, or a value is wrong by itself, as at construction, or changes what is compiled in. Nothing has
                changed then.
            ShapeError: A shape does not fit.
        """
        if not isinstance(values, Mapping):
            raise OcpError(f"values must be weights and bounds by name, got {given.quoted(values)}")
        known = {name: np.shape(getattr(self.ocp, given.one_of("the name of a weight or bound", name, self._parts))) for name in values}
        taken = {name: self.ocp.checked(name, given.array(name, value, known[name])) for name, value in values.items()}
        for name, value in taken.items():
            self.ocp.check_compiled(name, value)
        for name, value in taken.items():
            part, entries = self._parts[name]
            np.clip(value[..., entries], -INFINITY, INFINITY, out=part)
            if name in COST_WEIGHTS:
                part *= self.cost_scale
        for solver in self.solvers:
            solver.refill()
        self.retuned += 1

    def prepare(
        self, y_ref: Array, p: Array | None = None, *, shift: bool = True, u_prev: Array | None = None, u_before: Array | None = None
    ) -> None:
        """
        Shift the guess by one stage, linearize there and load the QP.

        Args:
            y_ref: Reference at nodes 1 to N, shape ``(N, ny)``; angles may wrap.
            p: Stage parameters at nodes 0 to N, shape ``(N + 1, np)``; None for those of the last sample.
            shift: Whether to shift to the next sample; False iterates on the same one.
            u_prev: Input that acts before the plan, shape ``(nu,)``, if it is not the first input of the last plan.
            u_before: Input that acts a stage before that one, shape ``(nu,)``, if it is not `u_prev` of the sample before.

        Raises:
            OcpError: One of them is no array of real numbers; nothing has changed then, as for a wrong shape.
            ShapeError: A shape does not fit.
        """
        y_ref = given.array("y_ref", y_ref, self.y_ref.shape)
        p = None if p is None else given.array("p", p, self.p.shape)
        u_prev = None if u_prev is None else given.array("u_prev", u_prev, self.u_prev.shape)
        u_before = None if u_before is None else given.array("u_before", u_before, self.u_before.shape)
        if p is not None:
            self.p[...] = p
        if self._pending:
            self.keep_guess()
        self.y_ref[...] = y_ref
        self._turns.take_reference()
        if u_before is not None:
            self.u_before[...] = u_before
        elif shift:
            self.u_before[...] = self.u_prev
        if u_prev is not None:
            self.u_prev[...] = u_prev
        elif shift:
            self.u_prev[...] = self.u[0]
        if self._bounded:
            self._remember()
        self._pending = True
        if not shift:
            self._relinearize()
            return
        self._loaded = False
        if self.active_set is not None:
            self.active_set.advance()
            self.active_set.gain()
        else:
            self.advance()
        if self.solver is not self.active_set:  # if the QP solver was needed last, it is prepared as well
            self._load()

    def _remember(self) -> None:
        """Embed the last two inputs before the plan; nothing depends on the one before them."""
        self._remembered[0], self._remembered[1:] = self.u_prev[self._bounded], self.u_before[self._bounded]

    def _stay_at(self, x: Array) -> None:
        """Let the states of the plan be those of a robot that stays in a state, shape ``(nx,)``, with the input before the plan."""
        self.x[:] = x
        if self._bounded:
            self.guess.plan.x[:, self.ocp.model.nx :] = np.tile(self.u_prev[self._bounded], REMEMBERED)

    def _relinearize(self) -> None:
        """Linearize at the plan itself, and prepare the solver."""
        copy(self._pairs)
        self._linearize()

    def _linearize(self) -> None:
        """Linearize at the guess as it is, and prepare the solver."""
        self._loaded = False
        if self.active_set is not None:
            self.active_set.linearize()
            self.active_set.gain()
        if self.solver is not self.active_set:
            self._load()

    def _load(self) -> None:
        """Prepare the QP solver at the guess."""
        self._backup.load()
        self._loaded = True

    def keep_guess(self) -> None:
        """Take the guess as the plan, because there is no better one."""
        for guess, plan in self._pairs:
            plan[:] = guess
        if self.active_set is not None:
            self.active_set.keep_guess()

    def _roll_out(self) -> None:
        """Make a guess in motion, with inputs half way to their upper bounds, and its outputs the reference: scales are computed there, undamped."""
        ubu = self.ocp.ubu
        self.u[:] = np.where(np.isfinite(ubu), 0.5 * (np.clip(ubu, -INFINITY, INFINITY) + self.u_prev), self.u_prev)
        self._stay_at(self.x_nominal)
        for _ in range(self.ocp.N):
            self.shift()
        self.u_prev[:] = self.u[0]
        self._meet_reference()

    def _stand(self) -> None:
        """Make a guess at the nominal state and the input at rest."""
        self.u_prev[:] = self.ocp.model.u_rest
        self.u[:] = np.clip(self.u_prev, self.ocp.lbu, self.ocp.ubu)
        self._stay_at(self.x_nominal)
        copy(self._pairs)
        self._meet_reference()

    def _meet_reference(self) -> None:
        """Let the reference be the outputs of the guess."""
        N = self.ocp.N
        held = self.u[self.ocp.held]
        self.y_ref[:] = np.array(self.ocp.model.outputs_at().map(N)(self.x[1:].T, held.T, self.p[1:].T)).T

    def shift(self) -> None:
        """Shift the plan by one stage: its first input becomes the previous one, its last is repeated, with the state that the model predicts."""
        if self._pending:
            self.keep_guess()
        self.u_before[...] = self.u_prev
        self.u_prev[...] = self.u[0]
        if self.active_set is None:
            self.advance()
        else:
            self.active_set.advance()
        self.keep_guess()

    def feedback(self, x0: Array) -> QpStatus:
        """
        Embed the initial state, solve the QP and take the full step; iterate while the step is large.

        If the status is not `usable`, the plan is the guess, and the next solve starts
        cold: no solve starts from a failed one.

        Args:
            x0: State at node 0, shape ``(nx,)``; angles may wrap, those of the plan continue the last plan's.

        Raises:
            OcpError: The sample has not been prepared, or `x0` is no array of real numbers.
            ShapeError: Its shape does not fit.
        """
        if not self._pending:
            raise OcpError("prepare must be called before each feedback, got feedback without a sample prepared")
        self.x0[...] = given.array("x0", x0, self.x0.shape)
        self._pending = False
        if self._turns.settle():
            self._linearize()
        if self.active_set is not None:
            self.active_set.begin(self.iterations)
        self.status = self.solve()
        self.taken = 1
        if self._change[0] > self.tolerance:
            self._iterate()
        if self.status is SOLVED and self.active_set is not None:
            self.status = self._certified(self.active_set)
        self._settled |= self._change[0] <= self.tolerance
        return self.status

    @property
    def rehearsed(self) -> Sequence[Array]:
        """The arrays that `rehearse` overwrites."""
        return self._turns.written if self.active_set is None else (*self._turns.written, *self.active_set.written)

    def rehearse(self, x0: Array) -> None:
        """
        Do what `feedback` does in most samples, so that the next one finds warm caches: make a plan by one roll-out, and certify it.

        The caller puts the arrays that are `rehearsed` back, with `rti_mpc.kept.Kept`: then nothing has changed. A QP solver is not rehearsed, since
        it starts from its last iterate.

        Args:
            x0: State at node 0, shape ``(nx,)``, of a sample that is prepared.
        """
        self.x0[...] = given.array("x0", x0, self.x0.shape)
        self._turns.rehearse()
        if self.active_set is not None:
            self.active_set.rehearse()

    def _certified(self, active_set: ActiveSet) -> QpStatus:
        """Certify the plan of the last QP; if that fails, the plan is the guess at which the QP was linearized."""
        if self.solver is not active_set:
            return INACCURATE  # a plan of the QP solver, to its tolerance
        status = active_set.certified()
        if not status.usable:
            self.keep_guess()
            if self.taken > 1:
                self._acceleration.restore()
            active_set.forget()
        return status

    def solve(self) -> QpStatus:
        """Solve the QP by the first solver that can, and make the plan; if none can, the plan is the guess."""
        active_set = self.active_set
        if active_set is not None and active_set.solve():
            self.solver = active_set
            return SOLVED
        status = self.solve_qp()
        if not status.usable:
            self.keep_guess()
        return status

    def _iterate(self) -> None:
        """Iterate while the step is large; an iteration that fails leaves the plan of the one before."""
        self._acceleration.begin()
        while self.status.usable and self.taken < self.iterations and self._change[0] > self.tolerance:
            if self._settled and self.active_set is not None and not self.active_set.goes_on:
                break  # the next sample continues; after a cold start, a plan that has not converged may be useless
            if isinstance(self.solver, ActiveSet):
                self.solver.sharpen()
            self._acceleration.advance()
            self._linearize()
            if not (status := self.solve()).usable:
                self._acceleration.restore()
                self.status = INACCURATE  # the plan comes from an earlier QP, which cannot be certified any more
                break
            self.status = status
            self.taken += 1

    def solve_qp(self) -> QpStatus:
        """Solve with the QP solver."""
        self.solver = self._backup
        if not (np.abs(self.x0) < INFINITY).all():  # false for NaN, too
            return QpStatus.FAILED
        violation = self._violation
        if not self._loaded:
            self._load()
        status = self._backup.solve()
        if status.usable and self._backup is not self.solvers[-1] and violation[0] > 0.0:
            self._backup = self.solver = self.solvers[-1]
            self._backup.load()
            status = self._backup.solve()
        if status.usable:
            self.evaluate()
            if not isfinite(self._cost[0]):  # numbers so large that they overflowed inside the solver
                self.solver.cold = True
                return QpStatus.FAILED
            if violation[1] < -TOUCHING_DISTANCE:
                self._backup = self.solvers[0]
        return status

    @property
    def cost(self) -> float:
        """The cost (4) of the plan, penalties on slacks included; read it before the next `prepare`, which overwrites its arguments."""
        self.evaluate()
        return float(self._cost[0]) / self.cost_scale

    @property
    def violation(self) -> float:
        """Largest amount by which the plan exceeds a softened bound, in the unit of that bound; 0 if it exceeds none."""
        return max(0.0, float(self._violation[0]))


def check_options(solver: str, settings: SolverSettings | None, iterations: int, tolerance: float) -> None:
    """
    Refuse options of an `Rti` that do not fit.

    Raises:
        OcpError: As `Rti`.
    """
    if solver not in BUILT_IN_SOLVERS:
        check_name(solver)
        if settings is not None:
            raise OcpError(f"settings are OSQP's, they must be left out for another solver, got {settings} for {solver!r}")
    if settings is not None:
        given.instance("settings", settings, SolverSettings)
    given.whole("iterations", iterations, 1)
    if not given.number("tolerance", tolerance) >= 0.0:
        raise OcpError(f"tolerance must not be negative, got {tolerance}")


def formulation_of(ocp: Ocp, formulation: str) -> str:
    """Return the name of the formulation, ``auto`` replaced by the faster one."""
    given.one_of("formulation", formulation, ("auto", *FORMULATIONS))
    if formulation == "auto":
        return "sequential" if ocp.N_u <= MAX_SEQUENTIAL_N_U else "simultaneous"
    return formulation
