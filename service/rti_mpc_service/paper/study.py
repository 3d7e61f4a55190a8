# SPDX-License-Identifier: Apache-2.0
"""The whole study: drive all experiments, write the results as JSON, draw them, and write the report."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rti_mpc import __version__
from rti_mpc.errors import ConfigError
from rti_mpc_service.console import plain_console
from rti_mpc_service.host import machine
from rti_mpc_service.paper import readings
from rti_mpc_service.paper.contender import CONTENDERS, Contender, RealTimeIteration
from rti_mpc_service.paper.experiment import BEST_SETTINGS, Experiment
from rti_mpc_service.paper.figures import draw
from rti_mpc_service.paper.loop import Loop
from rti_mpc_service.paper.race import SCENARIOS, grid, race, shortened
from rti_mpc_service.paper.report import report, short
from rti_mpc_service.paper.sweeps import SWEEPS

OWN_CONTENDER, CONVERGED_CONTENDER = "rti_simultaneous", "ipopt"
QUICK_STRIDE = 15  # --quick takes every 15th experiment of a sweep
SIGNIFICANT_DIGITS = 5  # of every written number


class Study:
    """
    A study in progress.

    Attributes:
        run: What has been found, in JSON.
        races: The loops of each scenario of the race, by contender.
    """

    def __init__(self, quick: bool, progress: Progress) -> None:
        self._quick, self._progress = quick, progress
        self._iterations: list[RealTimeIteration] = []
        self._solves = 0
        self.races: dict[str, dict[str, Loop]] = {}
        self.run: dict[str, Any] = {
            "version": __version__,
            "machine": machine.machine_info(),
            "quick": quick,
            "best": BEST_SETTINGS,
            "race": {},
            "readings": {},
            "sweeps": {},
        }

    def everything(self) -> None:
        """Do all of it, the races first: they time each other."""
        for name, experiment in SCENARIOS.items():
            self._race(name, shortened(experiment) if self._quick else experiment)
        found = self.run["readings"]
        found["headings"] = self._drive("readings", readings.headings())
        found["converged"] = self._drive("readings, converged", readings.converged(), CONVERGED_CONTENDER, whole=True)
        found["speeds"] = readings.speeds()
        driven = list(readings.at_printed_speed())
        found["at_printed_speed"] = [
            row | {"mean_speed_m_s": readings.speed(experiment.trajectory)["mean"]}
            for experiment, row in zip(driven, self._drive("printed speed", driven, whole=True), strict=True)
        ]
        goals = readings.goals()
        ends = self._drive("ends of the reference", goals.values(), whole=True)
        found["goals"] = {
            name: row | {"jump_mm": readings.jump_mm(experiment.trajectory)} for (name, experiment), row in zip(goals.items(), ends, strict=True)
        }
        for name, experiments in SWEEPS.items():
            self.run["sweeps"][name] = self._drive(f"sweep of {name}", experiments())
        self.run["solves"] = {"own": self._solves, "unusable": sum(iteration.unusable for iteration in self._iterations)}

    def _build(self, name: str, experiment: Experiment) -> Contender:
        """Return a contender; the solves of a real-time iteration are counted."""
        contender = CONTENDERS[name](experiment.ocp())
        if isinstance(contender, RealTimeIteration):
            self._iterations.append(contender)
            self._solves += experiment.samples
        return contender

    def _race(self, name: str, experiment: Experiment) -> None:
        """Let all contenders drive one of the paper's experiments."""
        tick = self._stage(f"race on {name}", experiment.samples)
        loops = grid(experiment, self._build)
        race(loops, tick)
        self.races[name] = loops
        self.run["race"][name] = {contender: loop.experiment.settings() | loop.summary() for contender, loop in loops.items()}

    def _drive(self, title: str, experiments: Iterable[Experiment], contender: str = OWN_CONTENDER, *, whole: bool = False) -> list[dict[str, Any]]:
        """Drive experiments one after the other; return the settings and the results of each."""
        experiments = list(experiments)
        if self._quick:
            experiments = [shortened(experiment) for experiment in (experiments if whole else experiments[::QUICK_STRIDE])]
        tick = self._stage(title, sum(experiment.samples for experiment in experiments))
        rows = []
        for experiment in experiments:
            loop = Loop(experiment, self._build(contender, experiment))
            for _ in range(experiment.samples):
                loop.step()
                tick()
            rows.append({"contender": contender} | experiment.settings() | loop.summary())
        return rows

    def _stage(self, title: str, samples: int) -> Callable[[], None]:
        """Begin a progress bar; return the function that advances it."""
        task = self._progress.add_task(title, total=samples)
        return lambda: self._progress.advance(task)


def main(out: Path | None = None, *, quick: bool = False) -> int:
    """
    Do the study.

    Args:
        out: Folder to leave ``paper.md`` in, and everything else in its folder ``paper``; one below ``runs`` if None.
        quick: A first look: a few seconds of every experiment after its transient.

    Raises:
        ConfigError: The folder cannot be written.
    """
    out = out or Path("runs") / f"paper-{datetime.now():%Y%m%d-%H%M%S}"
    folder = out / "paper"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out must be a folder that can be written, got {out}: {error.strerror}") from error
    console = plain_console()
    began_ns = time.monotonic_ns()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, refresh_per_second=4, disable=not console.is_terminal) as progress:
        study = Study(quick, progress)
        study.everything()
    run = rounded(study.run | {"took_s": 1e-9 * (time.monotonic_ns() - began_ns)})
    (folder / "run.json").write_text(json.dumps(run, indent=1) + "\n", encoding="utf-8")
    draw(study.races, run, folder)
    (out / "paper.md").write_text(report(run), encoding="utf-8")
    print(short(run))  # as it is, to be copied
    console.print(f"{out / 'paper.md'}, {folder}: {run['solves']['own']} solves, {run['took_s']:.0f} s", soft_wrap=True)
    return 0


def rounded(value: Any) -> Any:
    """Return JSON with the digits that mean something, so that a report written from it again is the same."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    return float(f"{value:.{SIGNIFICANT_DIGITS}g}") if isinstance(value, float) else value
