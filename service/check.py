# SPDX-License-Identifier: Apache-2.0
"""
A dry run of one configuration: does it load, how long does a sample take here, is its QP solver right?

The plan's own prediction, disturbed, is the next state: 200 samples of closed
loop around a wave in every output, seeded. Every tenth QP is solved by another
solver too.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import qpsolvers
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from rti_mpc.array import Array
from rti_mpc.ocp import Ocp
from rti_mpc.rti import Rti
from rti_mpc.status import QpStatus
from service.config import Config, load

SAMPLES = 200
OPINIONS = 20  # samples whose QP the second solver is asked about
SECOND = "daqp"
TOLERANCE = 5e-3  # what two answers to one QP may differ by, in the unit of each input; OSQP stops at a residual, not at a distance

WAVE_S = 40.0  # period of the reference, s
NOISE = 0.01  # standard deviation of the disturbance, in the unit of each state


@dataclass(frozen=True)
class Report:
    """
    Outcome of a dry run.

    Attributes:
        prepare_us: Time of each preparation, shape ``(SAMPLES,)``.
        feedback_us: Time of each feedback, shape ``(SAMPLES,)``.
        statuses: How often each status came out.
        opinions: How many solved QPs the second solver was asked about.
        difference: Largest difference of their inputs, in the unit of each.
    """

    prepare_us: Array
    feedback_us: Array
    statuses: Counter[QpStatus]
    opinions: int
    difference: float

    @property
    def agree(self) -> bool:
        """Whether the second solver was asked and confirms the first."""
        return self.opinions > 0 and self.difference <= TOLERANCE


def main(path: Path) -> int:
    """Check a configuration, print what was found, and return the exit status: 0 if every sample was usable and both solvers agree."""
    config = load(path)
    console = Console()
    report = check(config, track(range(SAMPLES), "solving", console=console, transient=True, disable=not console.is_terminal))
    table = Table("phase, us", "p50", "p99", "max")
    for phase, times in (("preparation", report.prepare_us), ("feedback", report.feedback_us)):
        table.add_row(phase, *(f"{np.percentile(times, share):.0f}" for share in (50, 99, 100)))
    console.print(
        f"{path}: N = {config.ocp.N}, N_u = {config.N_u}, dt = {config.ocp.dt_s} s, configuration {config.config_hash:016x}", soft_wrap=True
    )
    console.print(table)
    console.print(f"{SAMPLES} samples: " + ", ".join(f"{count} {status.name}" for status, count in sorted(report.statuses.items())))
    verdict = "agree" if report.agree else "DISAGREE"
    difference = f"their solutions differ by at most {report.difference:.1e}, {TOLERANCE} allowed"
    console.print(f"the controller and {SECOND} {verdict}: on {report.opinions} QPs {difference}", soft_wrap=True)
    return 0 if report.agree and all(status.usable for status in report.statuses) else 1


def check(config: Config, samples: Iterable[int] = range(SAMPLES)) -> Report:
    """Solve one QP for each of the samples."""
    rti = config.build_rti()
    ocp = rti.ocp
    model, N = ocp.model, ocp.N
    twin = Rti(ocp, config.solver_settings(), formulation="sequential", solver="osqp", compile=False)
    rng = np.random.default_rng(1)
    x = np.array(config.robot_settings()["x0"])
    reference = wave(ocp, x, rng)
    prepare_us, feedback_us = np.zeros(SAMPLES), np.zeros(SAMPLES)
    statuses: Counter[QpStatus] = Counter()
    differences: list[float] = []
    rti.reset(x, np.array(model.u_rest))
    for k in samples:
        y_ref = reference(k + 1 + np.arange(N))
        began_ns = time.perf_counter_ns()
        rti.prepare(y_ref)
        prepare_us[k] = 1e-3 * (time.perf_counter_ns() - began_ns)
        asked = k % (SAMPLES // OPINIONS) == 0
        if asked:
            for name in ("x", "u", "u_prev"):
                getattr(twin, name)[:] = getattr(rti, name)
        prepared_ns = time.perf_counter_ns()
        status = rti.feedback(x)
        feedback_us[k] = 1e-3 * (time.perf_counter_ns() - prepared_ns)
        statuses[status] += 1
        if asked and status is QpStatus.SOLVED:
            other = opinion(twin, y_ref, x)
            differences.append(np.inf if other is None else float(np.max(np.abs(rti.u - other))))
        x = rti.x[1] + NOISE * rng.standard_normal(model.nx)
    return Report(prepare_us, feedback_us, statuses, len(differences), max(differences, default=np.inf))


def wave(ocp: Ocp, x: Array, rng: np.random.Generator) -> Callable[[NDArray[np.int64]], Array]:
    """Return a reference that leaves a state, shape ``(nx,)``, in a wave of every output: stages, shape ``(M,)``, to rows, ``(M, ny)``."""
    model = ocp.model
    phases = rng.uniform(-np.pi, np.pi, model.ny)
    start = np.array([x[[state.name for state in model.states].index(y.name)] if y in model.states else 0.0 for y in model.outputs])
    return lambda k: np.asarray(start + np.sin(2 * np.pi / WAVE_S * ocp.dt * k[:, None] + phases) - np.sin(phases))


def opinion(twin: Rti, y_ref: Array, x0: Array) -> Array | None:
    """Return what the second solver makes of the inputs at the guess of a sequential twin, None if nothing; shape ``(N_u, nu)``."""
    guess = twin.u.copy()
    twin.prepare(y_ref, shift=False)
    twin.feedback(x0)
    solution = qpsolvers.solve_problem(twin.qp.to_problem(), SECOND)
    if not solution.found or solution.x is None:
        return None
    return np.asarray(guess + solution.x[: guess.size].reshape(guess.shape))
