# SPDX-License-Identifier: Apache-2.0
"""
Benchmark of a sample and its parts, by horizon, solver and formulation, interleaved with IPOPT on the same states.

The problem is the paper's (Euler, bounds on inputs and on speeds), in closed loop
with its robot on the eight and on positioning; every sample counts. One contender
drives. At each state all contenders solve in random order, so that each finds the
caches as cold as in a service. A random quarter of the samples is timed in parts
instead of as a whole.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.integrator import integrator
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.reference.trajectory import eight, positioning
from rti_mpc.rti.qp.osqp import SolverSettings
from rti_mpc.rti.qp.qpsolvers import check_name
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.families import paper_ocp, reference_rows
from rti_mpc_service.bench.parts import PARTS, Parts
from rti_mpc_service.bench.yardstick import Ipopt
from rti_mpc_service.console import print_whole, table_console
from rti_mpc_service.host import machine
from rti_mpc_service.json_text import json_text

DEFAULT_HORIZONS = (7, 20, 50, 100, 200)
DEFAULT_ENTRIES = (("riccati", "simultaneous"), ("osqp", "simultaneous"), ("osqp", "sequential"))
FORMULATIONS = ("simultaneous", "sequential")  # measured for a solver that is requested by name
DT_S = 0.1
EXACT_SETTINGS = SolverSettings(eps=1e-9, max_iter=20_000)


@dataclass
class Times:
    """Times of one contender per sample, us, as a whole or in parts, and how often it stopped at its iteration limit."""

    prepare: list[float] = field(default_factory=list)
    feedback: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    taken: list[int] = field(default_factory=list)
    capped: int = 0
    parts: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in PARTS})

    @property
    def step(self) -> Array:
        """The whole step, us."""
        return np.asarray(np.add(self.prepare, self.feedback))


def samples(N: int, quick: bool) -> Iterator[tuple[str, int, Array, Array]]:
    """Yield scenario, sample, reference rows at nodes 1 to N, and the initial state, for all samples of both scenarios."""
    for trajectory, duration_s in ((eight(), 4.0 if quick else 80.0), (positioning(), 4.0 if quick else 40.0)):
        x0 = np.array([*trajectory.pose0, 0.0, 0.0])
        count = round(duration_s / DT_S)
        y = reference_rows(trajectory, count, N)
        for k in range(count):
            yield trajectory.name, k, y[k + 1 : k + 1 + N], x0


def closed_loop_cost(N: int, quick: bool, contender: Rti | Ipopt) -> float:
    """Return the closed-loop cost of a contender on both scenarios: true state against reference at k + 1, increments from 0."""
    model = pioneer_3dx()
    plant, p = integrator(model, "rk4", 20), np.array(model.p_nominal)
    total, x, u = 0.0, np.zeros(model.nx), np.zeros(model.nu)
    for _, k, y_ref, x0 in samples(N, quick):
        if k == 0:
            x, u = x0.copy(), np.zeros(model.nu)
            contender.reset(x) if isinstance(contender, Ipopt) else contender.reset(x, u)
        last = u
        u = solve(contender, x, last, y_ref, shift=k > 0)
        x = np.array(plant(x, u, p, DT_S)).ravel()
        e = x[:3] - y_ref[0]
        total += 28 * float(e @ (np.array([1, 1, 0.05]) * e)) + 0.8 * float((u - last) @ (u - last))
    return total


def solve(contender: Rti | Ipopt, x: Array, u_prev: Array, y_ref: Array, *, shift: bool) -> Array:
    """Return a contender's command."""
    if isinstance(contender, Ipopt):
        return contender.solve(x, u_prev, y_ref)
    contender.prepare(y_ref, shift=shift)
    contender.feedback(x)
    return np.array(contender.u[0])


def race(N: int, contenders: dict[str, Rti], ipopt: Ipopt, quick: bool, tick: Any) -> tuple[dict[str, Times], list[float]]:
    """Let all contenders solve every sample of a closed loop that the first of them drives; return their times, and IPOPT's, us."""
    model = pioneer_3dx()
    plant, p = integrator(model, "rk4", 20), np.array(model.p_nominal)
    rng = np.random.default_rng(1)
    times = {name: Times() for name in contenders}
    parts = {name: Parts(rti) for name, rti in contenders.items()}
    ipopt_us: list[float] = []
    x, u = np.zeros(model.nx), np.zeros(model.nu)
    driver = next(iter(contenders.values()))
    gc.collect()
    gc.disable()
    try:
        for _, k, y_ref, x0 in samples(N, quick):
            if k == 0:
                x, u = x0.copy(), np.zeros(model.nu)
                ipopt.reset(x)
                for rti in contenders.values():
                    rti.reset(x, u)
            for name in rng.permutation([*contenders, "ipopt"]):
                if name == "ipopt":
                    began_ns = time.perf_counter_ns()
                    ipopt.solve(x, u, y_ref)
                    ipopt_us.append(1e-3 * (time.perf_counter_ns() - began_ns))
                    continue
                rti, row = contenders[name], times[name]
                with parts[name].maybe(rng.random() < 0.25) as parts_us:
                    began_ns = time.perf_counter_ns()
                    rti.prepare(y_ref, shift=k > 0, u_prev=u)
                    prepared_ns = time.perf_counter_ns()
                    status = rti.feedback(x)
                    done_ns = time.perf_counter_ns()
                for part, part_us in parts_us.items():
                    row.parts[part].append(part_us)
                if not parts_us:
                    row.prepare.append(1e-3 * (prepared_ns - began_ns))
                    row.feedback.append(1e-3 * (done_ns - prepared_ns))
                row.iterations.append(rti.solver.iterations)
                row.taken.append(rti.taken)
                row.capped += status is QpStatus.MAX_ITER
            u = driver.u[0].copy()
            x = np.array(plant(x, u, p, DT_S)).ravel()
            tick()
    finally:
        gc.enable()
    return times, ipopt_us


def quantiles_us(values: Any) -> dict[str, float]:
    """Return median, p99 and maximum, us."""
    return {name: round(float(np.percentile(values, share)), 1) for name, share in (("p50", 50), ("p99", 99), ("max", 100))}


def measure_horizon(N: int, *, entries: Sequence[tuple[str, str]], compiled: tuple[bool, ...], quick: bool, tick: Any) -> list[dict[str, Any]]:
    """Race at one horizon, an entry being solver and formulation; return a row for each contender."""
    ocp = paper_ocp(N)
    contenders = {
        f"{solver} {formulation} {'compiled' if compile else 'interpreted'}": Rti(ocp, formulation=formulation, solver=solver, compile=compile)
        for solver, formulation in entries
        for compile in compiled
    }
    ipopt = Ipopt(ocp)
    times, ipopt_us = race(N, contenders, ipopt, quick, tick)
    against = quantiles_us(ipopt_us)
    result = []
    for name, row in times.items():
        rti = contenders[name]
        step, feedback = quantiles_us(row.step), quantiles_us(row.feedback)
        native_us = float(np.median(np.sum(list(row.parts.values()), axis=0)))
        result.append(
            {
                "N": N,
                "formulation": rti.formulation,
                "solver": name.split()[0],
                "compiled": name.endswith(" compiled"),
                "step_us": step,
                "prepare_us": quantiles_us(row.prepare),
                "feedback_us": feedback,
                "ipopt_us": against,
                "speedup": round(against["p50"] / step["p50"], 1),
                "feedback_speedup": round(against["p50"] / feedback["p50"], 1),
                "qps": {"p50": int(np.median(row.taken)), "p99": int(np.percentile(row.taken, 99)), "mean": round(float(np.mean(row.taken)), 2)},
                "iterations": {"p50": int(np.median(row.iterations)), "p99": int(np.percentile(row.iterations, 99))},
                "capped_share": round(row.capped / len(row.iterations), 4),
                "parts_us": {part: round(float(np.median(us)), 1) for part, us in row.parts.items()},
                "python_us": round(step["p50"] - native_us, 1),
                "samples": len(row.iterations),
            }
        )
    return result


def main(
    horizons: tuple[int, ...] = DEFAULT_HORIZONS,
    *,
    entries: tuple[tuple[str, str], ...] = DEFAULT_ENTRIES,
    solvers: tuple[str, ...] = (),
    interpreted: bool,
    quick: bool,
    costs: bool,
    path: Path | None,
) -> int:
    """
    Measure, print a table, and write the rows to a file if asked to.

    Args:
        horizons: Stages.
        entries: Solver and formulation; the sequential one is left out beyond 20 stages, where it takes long to compile.
        solvers: Further solvers to compare with, by their names in qpsolvers, in both formulations.
        interpreted: Whether to measure CasADi's virtual machine, too.
        quick: A short run: eight seconds of driving in all.
        costs: Whether to compare closed-loop costs with those of exact QPs and of converged NMPC, too.
        path: JSON file to write.
    """
    for solver in solvers:
        check_name(solver)
    entries += tuple((solver, formulation) for solver in solvers for formulation in FORMULATIONS)
    console = table_console()
    console.print(", ".join(f"{name} {value}" for name, value in machine.machine_info().items()), soft_wrap=True)
    result: list[dict[str, Any]] = []
    with Progress(console=console, transient=True) as progress:
        for N in horizons:
            task = progress.add_task(f"N = {N}", total=sum(1 for _ in samples(N, quick)))
            chosen = [entry for entry in entries if entry[1] != "sequential" or N <= 20]
            found = measure_horizon(
                N, entries=chosen, compiled=(True, False) if interpreted else (True,), quick=quick, tick=lambda t=task: progress.advance(t)
            )
            if costs:
                exact = closed_loop_cost(N, quick, Rti(paper_ocp(N), EXACT_SETTINGS, formulation="simultaneous", solver="osqp"))
                converged = closed_loop_cost(N, quick, Ipopt(paper_ocp(N)))
                for row in found:
                    cost = closed_loop_cost(N, quick, Rti(paper_ocp(N), formulation=row["formulation"], solver=row["solver"]))
                    row |= {"cost": round(cost, 3), "over_exact": round(cost / exact - 1, 6), "over_converged": round(cost / converged - 1, 6)}
            result += found
    print_tables(console, result, costs=costs)
    if path is not None:
        path.write_text(json_text(result) + "\n", encoding="utf-8")
    return 0


def print_tables(console: Console, result: list[dict[str, Any]], *, costs: bool) -> None:
    """Print the rows, and how the step grows with N."""
    table = Table(title="time per sample, us: median / p99")
    for name in (
        "N",
        "solver",
        "formulation",
        "step",
        "preparation",
        "feedback",
        "IPOPT",
        "faster",
        "feedback",
        "QPs",
        "iterations",
        "capped",
        *(["cost"] if costs else []),
    ):
        table.add_column(name, justify="right")
    for row in result:
        pairs = ["{p50:.0f} / {p99:.0f}".format(**row[key]) for key in ("step_us", "prepare_us", "feedback_us", "ipopt_us")]
        table.add_row(
            str(row["N"]),
            row["solver"],
            row["formulation"] + ("" if row["compiled"] else ", interpreted"),
            *pairs,
            f"{row['speedup']:.1f} x",
            f"{row['feedback_speedup']:.1f} x",
            "{p50} / {p99}".format(**row["qps"]),
            "{p50} / {p99}".format(**row["iterations"]),
            f"{row['capped_share']:.1%}",
            *([f"{row['over_exact']:+.3%} exact, {row['over_converged']:+.3%} converged"] if costs else []),
        )
    print_whole(console, table)
    made = Table(title="parts of a step, medians, us")
    for name in ("N", "solver", "formulation", *PARTS, "Python around"):
        made.add_column(name, justify="right")
    for row in result:
        head = str(row["N"]), row["solver"], row["formulation"] + ("" if row["compiled"] else ", interpreted")
        share = row["python_us"] / row["step_us"]["p50"]
        made.add_row(*head, *(f"{row['parts_us'][part]:.0f}" for part in PARTS), f"{row['python_us']:.0f}, {share:.0%}")
    print_whole(console, made)
    for solver in dict.fromkeys(row["solver"] for row in result):
        sparse = [row for row in result if (row["solver"], row["formulation"]) == (solver, "simultaneous") and row["compiled"] and row["N"] >= 20]
        if len(sparse) > 1:
            slope = np.polyfit(np.log([row["N"] for row in sparse]), np.log([row["step_us"]["p50"] for row in sparse]), 1)[0]
            console.print(f"{solver}, simultaneous, from N = 20 on: the step grows as N^{slope:.2f}")
