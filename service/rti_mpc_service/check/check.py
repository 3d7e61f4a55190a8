# SPDX-License-Identifier: Apache-2.0
"""
Dry run of one configuration: it loads, a sample is timed here, and a second solver confirms its QPs.

The closed loop has 200 samples along a wave in every output; the next state is the
plan's own prediction plus a seeded disturbance. Excursions to every bound follow.
Every tenth QP of the wave, and the first and the last of each excursion, are solved
again: by the same solver with a tight tolerance, and by a second solver in the other
formulation. If those two agree, in their inputs or at least in their costs, the QP is
solved correctly; the distance of the controller's own plan from theirs is the error of
its tolerance.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.rti.construction import FORMULATIONS
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.rti import BUILT_IN_SOLVERS, Rti
from rti_mpc.si import ones
from rti_mpc.signals import quantity
from rti_mpc_service.check.agreement import AGREEMENT_TOLERANCE, COST_TOLERANCE, Agreement, agreement
from rti_mpc_service.check.excursion import Bounds, excursions
from rti_mpc_service.check.rest import stop_from_everywhere
from rti_mpc_service.compiling import work_shown
from rti_mpc_service.config import signals_file
from rti_mpc_service.config.build import build_ocp, build_rti, build_signals, robot_settings
from rti_mpc_service.config.config import load
from rti_mpc_service.config.fit import check_period, check_stop, unstopped
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import table_console
from rti_mpc_service.description import check_length
from rti_mpc_service.rig.wave import wave

WAVE_SAMPLES = 200
COMPARED_WAVE_SAMPLES = 20  # this many of the wave's samples are solved by the second solver, too
EXCURSION_SAMPLES = 4  # per excursion to a bound; the second solver solves the first and the last of them, too
SECOND_SOLVER = "daqp"  # OSQP is the second solver where daqp is the first
TIGHT_SETTINGS = SolverSettings(eps=1e-9, max_iter=100_000, scaling=10)  # Ruiz scaling helps where bounds are far exceeded
DISTURBANCE_SCALES = 0.01  # standard deviation of the disturbance, in scales of each state
MAX_DISTURBANCE = 0.01  # of it, in the SI unit of each state: the scale of one without bounds, which grows by itself, says little


@dataclass(frozen=True)
class CheckReport:
    """
    Outcome of a dry run.

    Attributes:
        prepare_us: Time of each preparation, shape ``(WAVE_SAMPLES,)``.
        feedback_us: Time of each feedback, shape ``(WAVE_SAMPLES,)``.
        statuses: Number of samples with each status.
        second: Name of the second solver.
        opinions: Agreement of both tight solutions of each QP that both have solved.
        deviation: Largest difference of the controller's own inputs from those of the second solver, likewise.
        bounds: Number of bounds.
        missed: Names of the bounds that no plan has reached.
        failed_at: State of the first sample without a usable plan, shape ``(nx,)``; None if all were usable.
    """

    prepare_us: Array
    feedback_us: Array
    statuses: Counter[QpStatus]
    second: str
    opinions: list[Agreement]
    deviation: float
    bounds: int
    missed: list[str]
    failed_at: Array | None = None

    @property
    def agree(self) -> bool:
        """Whether the second solver confirms the first."""
        return bool(self.opinions) and all(opinion.costs <= COST_TOLERANCE for opinion in self.opinions)

    @property
    def difference(self) -> float:
        """Largest difference between the inputs of both tight solutions, relative to half the range of each input, flat minima left out."""
        return max((opinion.difference for opinion in self.opinions if not opinion.flat), default=0.0 if self.opinions else np.inf)


def main(path: Path) -> int:
    """Check a configuration, print what was found, and return the exit status: 0 if every sample was usable and both solvers agree."""
    config = load(path)
    check_period(config)
    with work_shown("finding how the robot comes to rest", say):
        law = check_stop(config)
    console, ocp = table_console(), build_ocp(config)
    shortened = check_length(ocp)
    try:
        stopped = 'a stop: it coasts, as stop = "coasts" says'
        if config.model.stop == "rests":
            with work_shown("stopping it from wherever it operates", say):
                stopped = stop_from_everywhere(ocp, law, disturbed=bool(config.observer.disturbances))
    except OcpError as error:
        raise ConfigError(unstopped(config, error)) from error
    rti = build_rti(config, say)
    with work_shown("solving samples along a wave and at all bounds, some by a second solver", say):
        report = check(config, rti)
    table = Table("phase, us", "p50", "p99", "max")
    for phase, times in (("preparation", report.prepare_us), ("feedback", report.feedback_us)):
        table.add_row(phase, *(f"{np.percentile(times, share):.0f}" for share in (50, 99, 100)))
    console.print(
        f"{path}: N = {config.ocp.N}, N_u = {config.N_u}, dt = {config.ocp.dt_s} s, configuration {config.config_hash:016x}", soft_wrap=True
    )
    console.print(table)
    console.print(
        f"{sum(report.statuses.values())} samples: " + ", ".join(f"{count} {status.name}" for status, count in sorted(report.statuses.items()))
    )
    if report.failed_at is not None:
        where = ", ".join(f"{state.name} = {quantity(value, state.unit)}" for state, value in zip(ocp.model.states, report.failed_at, strict=True))
        advice = "if the model is not finite or not differentiable near it, bound in ocp.bounds.states where the robot operates"
        console.print(f"the first sample without a plan began at {where}: {advice}", soft_wrap=True)
    verdict = "agree" if report.agree else "DISAGREE"
    difference = f"solved tightly they differ by at most {report.difference:.1e}, {AGREEMENT_TOLERANCE:.0e} allowed"
    console.print(f"{config.solver.name} and {report.second} {verdict}: on {len(report.opinions)} QPs {difference}", soft_wrap=True)
    if flat := [opinion for opinion in report.opinions if opinion.flat]:
        apart, costs = max(opinion.difference for opinion in flat), max(opinion.costs for opinion in flat)
        told = f"on {len(flat)} of them by up to {apart:.1e} in inputs that cost nothing"
        console.print(f"{told}: costs differ by at most {costs:.1e}, {COST_TOLERANCE:.0e} allowed", soft_wrap=True)
    console.print(f"the controller's own plans are within {report.deviation:.1e} of them, relative to half the range of each input", soft_wrap=True)
    reached = f"driven to {report.bounds - len(report.missed)} of {report.bounds} bounds"
    console.print(reached + (f", not to the {', the '.join(report.missed)}" if report.missed else ""), soft_wrap=True)
    console.print(stopped, soft_wrap=True)
    if shortened:
        console.print(shortened, soft_wrap=True)
    if config.guard.enabled or (law is not None and not law.holds):
        console.print(f"the model's signals, for a guard or an adapter: {written(path, config)}", soft_wrap=True)
    return 0 if report.agree and all(status.usable for status in report.statuses) else 1


def written(path: Path, config: Config) -> str:
    """
    Write the signals beside the robot's file, and return where they are, or, if nothing can be written there and no guard is configured, what to do.

    Raises:
        ConfigError: They cannot be written, and a guard is configured, which reads them there.
    """
    try:
        return str(signals_file.write(path, build_signals(config)))
    except ConfigError as error:
        if config.guard.enabled:
            raise
        return f"not written, {error}"


def say(text: str) -> None:
    """Print what `main` waits for, where no terminal shows it."""
    print(text, file=sys.stderr, flush=True)


def check(config: Config, rti: Rti) -> CheckReport:
    """Solve the samples of the wave, and drive to the bounds."""
    ocp = rti.ocp
    model, N = ocp.model, ocp.N
    first, second = config.solver.name, SECOND_SOLVER if config.solver.name != SECOND_SOLVER else "osqp"
    other = next(name for name in FORMULATIONS if name != rti.formulation)
    tight, judge = (tight_copy(rti, solver, formulation) for solver, formulation in ((first, rti.formulation), (second, other)))
    condensed = next(one for one in (tight, judge) if one.formulation == "sequential")
    bounds, scale = Bounds(rti), rti.scale_u
    disturbance = np.minimum(DISTURBANCE_SCALES * rti.scale_x, MAX_DISTURBANCE * ones(model.states))
    rng = np.random.default_rng(1)
    x = np.array(robot_settings(config)["x0"])
    reference = wave(ocp, x, rng)
    prepare_us, feedback_us = np.zeros(WAVE_SAMPLES), np.zeros(WAVE_SAMPLES)
    statuses: Counter[QpStatus] = Counter()
    opinions: list[Agreement] = []
    deviations: list[float] = []
    failed_at: Array | None = None

    def sample(x: Array, y_ref: Array, *, asked: bool) -> tuple[float, float]:
        """Solve one sample, and compare its last QP if `asked`; return the times of both phases, us."""
        nonlocal failed_at
        began_ns = time.perf_counter_ns()
        rti.prepare(y_ref)
        prepared_ns = time.perf_counter_ns()
        status = rti.feedback(x)
        done_ns = time.perf_counter_ns()
        statuses[status] += 1
        if failed_at is None and not status.usable:
            failed_at = x
        bounds.note_plan()
        if asked and status is QpStatus.SOLVED:
            mine, theirs = (solution(one, rti, y_ref, x) for one in (tight, judge))
            if mine is not None and theirs is not None:
                opinions.append(agreement(mine, theirs, scale, condensed))
                deviations.append(float(np.max(np.abs(rti.u - theirs) / scale)))
        return 1e-3 * (prepared_ns - began_ns), 1e-3 * (done_ns - prepared_ns)

    start = x
    rti.reset(x, np.array(model.u_rest))
    for k in range(WAVE_SAMPLES):
        prepare_us[k], feedback_us[k] = sample(x, reference(k + 1 + np.arange(N)), asked=k % (WAVE_SAMPLES // COMPARED_WAVE_SAMPLES) == 0)
        x = rti.x[1] + disturbance * rng.standard_normal(model.nx)
    for excursion in excursions(rti, start):
        x = excursion.x0
        rti.reset(x, np.array(model.u_rest))
        for k in range(EXCURSION_SAMPLES):
            sample(x, excursion.y_ref, asked=k in (0, EXCURSION_SAMPLES - 1))
            x = rti.x[1].copy()
    deviation = max(deviations, default=np.inf)
    return CheckReport(prepare_us, feedback_us, statuses, second, opinions, deviation, len(bounds.names), bounds.missed, failed_at)


def tight_copy(rti: Rti, solver: str, formulation: str) -> Rti:
    """Return a controller of the same problem with a tight tolerance; solvers of qpsolvers keep their own, which is tight."""
    settings = TIGHT_SETTINGS if solver in BUILT_IN_SOLVERS else None
    return Rti(rti.ocp, settings, formulation=formulation, solver=solver, iterations=1, compile=False)


def solution(one: Rti, of: Rti, y_ref: Array, x0: Array) -> Array | None:
    """Return the inputs of the QP at the guess of another copy, shape ``(N_u, nu)``; None if it is not solved."""
    one.guess.plan.x[:], one.u[:], one.u_prev[:] = of.guess.start.values()
    one.u_before[:] = of.u_before
    one.prepare(y_ref, shift=False)
    return one.u.copy() if one.feedback(x0) is QpStatus.SOLVED else None
