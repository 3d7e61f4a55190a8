# SPDX-License-Identifier: Apache-2.0
"""
Benchmark over problem families: CPU time per sample, unsolved samples, and closed-loop cost relative to converged NMPC.

Each solver drives a closed loop of its own, five times from the same starts. The
shortest of the five times of each sample counts, so that other programs on the machine,
and seconds in which it is slow, do not matter. Times are CPU times of this thread.
"""

from __future__ import annotations

import gc
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from difflib import get_close_matches
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from rti_mpc.array import Array
from rti_mpc.contract.status import QpStatus
from rti_mpc.errors import ConfigError
from rti_mpc.rti.rti import Rti
from rti_mpc_service.bench.bench import quantiles_us
from rti_mpc_service.bench.families import FAMILIES, Family
from rti_mpc_service.bench.yardstick import Ipopt
from rti_mpc_service.console import print_whole, table_console
from rti_mpc_service.host import machine
from rti_mpc_service.json_text import json_text

RUNS = 5  # of the same closed loop, of which the shortest time of each sample counts
DEFAULT_SOLVERS = ("riccati", "osqp")
QUICK_SAMPLES = 40  # per family, with --quick


def drive_family(family: Family, solver: str, samples: int, tick: Callable[[], None]) -> dict[str, Any]:
    """
    Drive the same closed loop several times by one solver; return times, us, counts, the cost, and the largest residual of any plan.

    Residuals are those of the certificate, see docs/engine.md, or of a solver that has none, its own.
    """
    runs = [Rti(family.ocp, solver=solver, formulation="simultaneous") for _ in range(RUNS)]
    driven = [drive(family, rti, samples, tick) for rti in runs]
    step, feedback = (np.min([run.pop(phase) for run in driven], axis=0) for phase in ("step", "feedback"))
    median = np.median(step)
    in_medians = {name: round(float(us / median), 1) for name, us in (("p99", np.percentile(step, 99)), ("max", step.max()))}
    return {"cpu_us": quantiles_us(step), "feedback_us": quantiles_us(feedback), "in_medians": in_medians, **driven[0]}


def drive(family: Family, rti: Rti, samples: int, tick: Callable[[], None]) -> dict[str, Any]:
    """Drive one closed loop; return the times of each sample, us, counts, the cost, and the largest residual."""
    step: Array = np.zeros(samples)
    feedback: Array = np.zeros(samples)
    unsolved, iterations, residuals, cost = 0, [], [], 0.0
    x, u = np.zeros(family.ocp.model.nx), family.u0
    gc.collect()
    gc.disable()
    try:
        for k in range(samples):
            if (start := family.start(k)) is not None:
                x, u = start, family.u0
                rti.reset(x, u)
            y_ref, p = family.at(k)
            began_ns = time.thread_time_ns()
            rti.prepare(y_ref, p, shift=start is None, u_prev=u)
            prepared_ns = time.thread_time_ns()
            status = rti.feedback(x)
            done_ns = time.thread_time_ns()
            step[k], feedback[k] = 1e-3 * (done_ns - began_ns), 1e-3 * (done_ns - prepared_ns)
            unsolved += status is not QpStatus.SOLVED
            iterations.append(rti.solver.iterations)
            residuals.append(max(rti.solver.res_prim, rti.solver.res_dual))
            x, u, cost = advance(family, x, u, rti.u[0].copy(), y_ref, p, cost)
            tick()
    finally:
        gc.enable()
    return {
        "step": step,
        "feedback": feedback,
        "unsolved": unsolved,
        "iterations": {"p50": int(np.median(iterations)), "max": max(iterations)},
        "certificate_max": max(residuals),
        "cost": cost,
    }


def converge(family: Family, samples: int, tick: Callable[[], None]) -> dict[str, Any]:
    """Drive one closed loop by IPOPT, with softened bounds as the problem has them; return its times, us, and the cost."""
    ipopt = Ipopt(family.ocp, softened=True)
    times_us, cost = [], 0.0
    x, u = np.zeros(family.ocp.model.nx), family.u0
    for k in range(samples):
        if (start := family.start(k)) is not None:
            x, u = start, family.u0
            ipopt.reset(x, u)
        y_ref, p = family.at(k)
        began_ns = time.thread_time_ns()
        command = ipopt.solve(x, u, y_ref, p)
        times_us.append(1e-3 * (time.thread_time_ns() - began_ns))
        x, u, cost = advance(family, x, u, command, y_ref, p, cost)
        tick()
    return {"ipopt_us": quantiles_us(times_us), "cost": cost}


def advance(family: Family, x: Array, u_prev: Array, u: Array, y_ref: Array, p: Array | None, cost: float) -> tuple[Array, Array, float]:
    """Return the plant's next state, the applied input, and the cost including that of this period."""
    x = family.plant(x, u)
    return x, u, cost + family.cost(x, u, u_prev, y_ref[0], None if p is None else p[1])


def build(name: str, N: int, solver: str) -> tuple[float, float]:
    """Build a problem with an empty cache; return the time, s, and the peak memory of this process or of a compiler, MiB."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        began_s = time.monotonic()
        Rti(FAMILIES[name][0](N).ocp, solver=solver, formulation="simultaneous")
        took_s = time.monotonic() - began_s
    return took_s, max(peak_kib(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss) / 1024


def peak_kib() -> int:
    """Return the peak memory of this process; that of `getrusage` begins with what the process had that has started it."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def build_alone(name: str, N: int, solver: str) -> tuple[float, float]:
    """Call `build` in a separate process, and return its result."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(build, name, N, solver).result()


def main(names: Sequence[str], horizons: Sequence[int], solvers: Sequence[str], *, quick: bool, path: Path | None) -> int:
    """
    Measure families, print a table, and write the rows to a file if asked to.

    Args:
        names: Families, or ``all``.
        horizons: Stages; those of each family if none are given.
        solvers: Solvers by name.
        quick: Only the first samples of each.
        path: JSON file to write.

    Raises:
        ConfigError: A family is unknown.
    """
    for name in names:
        if name not in FAMILIES and name != "all":
            near = "".join(f"perhaps {other} is meant, " for other in get_close_matches(name, FAMILIES, 1))
            raise ConfigError(f"--problem must be all or one of {', '.join(FAMILIES)}; {near}got {name!r}")
    chosen = list(FAMILIES) if "all" in names else list(dict.fromkeys(names))
    console = table_console()
    console.print(", ".join(f"{key} {value}" for key, value in machine.machine_info().items()), soft_wrap=True)
    rows: list[dict[str, Any]] = []
    with Progress(console=console, transient=True) as progress:
        for name in chosen:
            make, usual = FAMILIES[name]
            for N in horizons or usual:
                family = make(N)
                samples = min(QUICK_SAMPLES, family.samples) if quick else family.samples
                task = progress.add_task(f"{name}, N = {N}", total=samples * (1 + RUNS * len(solvers)))
                tick = lambda t=task: progress.advance(t)  # noqa: E731
                converged = converge(family, samples, tick)
                for solver in solvers:
                    compile_s, compile_mib = build_alone(name, N, solver)
                    row = drive_family(family, solver, samples, tick)
                    row |= {"cost_over_converged": row["cost"] / converged["cost"] - 1.0, "ipopt_us": converged["ipopt_us"], "samples": samples}
                    row |= {"compile_s": round(compile_s, 2), "compile_mib": round(compile_mib)}
                    rows.append({"problem": name, "N": N, "solver": solver, **row})
    print_table(console, rows)
    if path is not None:
        path.write_text(json_text(rows) + "\n", encoding="utf-8")
    return 0


def print_table(console: Console, rows: list[dict[str, Any]]) -> None:
    """Print the rows."""
    table = Table(title="CPU time per sample, us: median / p99 / most")
    for heading in ("problem", "N", "solver", "step", "in medians", "feedback", "IPOPT", "unsolved", "iterations", "certificate", "cost", "compile"):
        table.add_column(heading, justify="left" if heading in ("problem", "solver") else "right")
    for row in rows:
        step, *others = ("{p50:.0f} / {p99:.0f} / {max:.0f}".format(**row[key]) for key in ("cpu_us", "feedback_us", "ipopt_us"))
        table.add_row(
            row["problem"],
            str(row["N"]),
            row["solver"],
            step,
            "{p99} / {max}".format(**row["in_medians"]),
            *others,
            f"{row['unsolved']} of {row['samples']}",
            "{p50} / {max}".format(**row["iterations"]),
            f"{row['certificate_max']:.1e}",
            f"{row['cost_over_converged']:+.2%}",
            f"{row['compile_s']:.1f} s, {row['compile_mib']} MiB",
        )
    print_whole(console, table)
