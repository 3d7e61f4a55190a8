# SPDX-License-Identifier: Apache-2.0
"""
Tuning of a robot's weights: a study on one scenario, a choice from its Pareto front, and a held-out scenario that decides.

Nothing is written into the robot's own file. What a study has found stays in its storage,
so the same command goes on with it, after Ctrl-C and after SIGKILL.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from signal import SIGINT

from rich.table import Table

from rti_mpc.errors import ConfigError
from rti_mpc.signals import in_plane
from rti_mpc_service.config.build import build_model, build_rti
from rti_mpc_service.config.config import load
from rti_mpc_service.config.schema import Config
from rti_mpc_service.console import print_whole, table_console
from rti_mpc_service.entry import EXIT_BY_SIGNAL
from rti_mpc_service.shipped import DEPLOY
from rti_mpc_service.tune.choice import beats, choose, front
from rti_mpc_service.tune.closed_loop import ClosedLoop, Course, Driven, MakeBody, laid_out
from rti_mpc_service.tune.edit import commented, edited
from rti_mpc_service.tune.progress import counting, doing
from rti_mpc_service.tune.recorded import as_recorded, is_recording
from rti_mpc_service.tune.recorded_robot import read
from rti_mpc_service.tune.study import STUDIED, Tried, finished, name_of, open_storage, open_study, run, tried
from rti_mpc_service.tune.varied import Varied, find_varied, with_values
from rti_mpc_service.tune.workers import workers

HELD_OUT = "held out"  # name of its course among the workers'
OTHER_PATHS = {"circle": "eight"}  # held out for a study of a path; the circle for all others
OTHER_OUTPUTS = {"steps": "sines"}  # likewise of outputs; steps for all others
NOTHING_GAINED = 1  # exit status
LONG_S = 60.0  # time of a study from which on it is told before


def main(
    path: Path,
    course: Course,
    held_out: str | None,
    make_body: MakeBody,
    *,
    vary: Sequence[str] = (),
    trials: int = 100,
    jobs: int = 1,
    effort: float = 1.0,
    seed: int = 1,
    storage: str | None = None,
    out: Path | None = None,
) -> int:
    """
    Tune a robot, and write a copy of its file with the values that are better on the held-out scenario.

    Args:
        path: The robot's file.
        course: Scenario of the study.
        held_out: Scenario that decides, with the same options; None: another one of the same kind, or the second half of a recording.
        make_body: Maker of the simulated robot.
        vary: Each ``KEY`` or ``KEY=LOW:HIGH``.
        trials: Number of trials that the study is to have.
        jobs: Number of processes.
        effort: Effort that is allowed, relative to today's.
        seed: Of the proposals.
        storage: Optuna's URL; None: a file beside `out`.
        out: File to write; None: beside the robot's, or here for one that ships.

    Returns:
        Exit status: 0 if a file was written, 1 if nothing was gained, 130 after Ctrl-C.

    Raises:
        ConfigError: An option does not fit.
    """
    from rti_mpc_service.tune.figure import figure  # before anything is driven: Matplotlib may be missing

    config, console = load(path), table_console()
    out = written_to(path, config, out)
    course = replace(course, name=course.name or config.reference.scenario)
    model = build_model(config)
    varied = find_varied(config, model, vary)
    course, other = parted(course, held_out, planar=in_plane(model.outputs))
    shared = None if storage is None else open_storage(storage)  # what was asked for is looked at first
    courses = {STUDIED: course, HELD_OUT: other}
    robot, heard = "", {}
    for name in dict.fromkeys(each.name for each in courses.values() if each.name is not None and is_recording(each.name)):
        with doing(console, f"reading {name}") as tell:
            heard[name] = read(name, config.robot, model, config.ocp.dt_s, tell)
    if course.name in heard:
        with doing(console, f"looking for noise, delay and lag of {config.robot} in {course.name}"):
            config, robot = as_recorded(config, heard[course.name], course.part, course.duration_s)
        console.print(robot, soft_wrap=True)
    laid = {name: laid_out(config, each, heard) for name, each in courses.items()}
    with doing(console, "building the problem"):
        build_rti(config)  # shows that it compiles
        loops = {name: ClosedLoop(config, each, make_body, laid[name]) for name, each in courses.items()}
    titles = {name: loop.scenario.title for name, loop in loops.items()}
    if titles[STUDIED] == titles[HELD_OUT]:
        raise ConfigError(f"--held-out must be another scenario than that of the study, got {titles[HELD_OUT]} for both")
    with doing(console, "driving with today's values"):
        began_s = time.monotonic()
        today = {name: loop.drive({}) for name, loop in loops.items()}
        drive_s = (time.monotonic() - began_s) / len(loops)
    if lost := next((titles[name] for name, driven in today.items() if not driven.finite), ""):
        raise ConfigError(f"the values of {path} must drive {lost} to its end, so that others can be compared with them")
    study_name = name_of(config, course, varied)
    study_url = f"sqlite:///{study_file(out.resolve())}" if storage is None else storage
    study = open_study(shared or open_storage(study_url), study_name, today[STUDIED])
    ranges = ", ".join(f"{each.key} {each.low:g}:{each.high:g}" for each in varied)
    console.print(f"study {study_name} in {without_password(study_url)}, {len(finished(study))} of {trials} trials are there", soft_wrap=True)
    console.print(f"{titles[STUDIED]}, held out {titles[HELD_OUT]}; varied: {ranges}", soft_wrap=True)
    if (left_s := max(0, trials - len(finished(study))) * drive_s / jobs) > LONG_S:
        each = f"a drive of {loops[STUDIED].scenario.duration_s:.0f} s takes {drive_s:.1f} s"
        console.print(f"{each}: about {left_s / 60:.0f} min in all; less with --duration or --trials", soft_wrap=True)
    kept = {name: laid[name] for name, each in courses.items() if each.name in heard}
    try:
        with workers(loops, (config, courses, kept, make_body), jobs) as drive_all:
            with counting(console, "trials", trials, len(finished(study))) as count:
                run(study, varied, trials, seed, drive_all, count)
            best, chosen = front(tried(study)), choose(tried(study), today[STUDIED], effort)
            on_held_out = dict(zip((each.number for each in best), drive_all((HELD_OUT, each.values) for each in best), strict=True))
            verdict = None if chosen is None else loops[HELD_OUT].drive(chosen.values)
    except KeyboardInterrupt:
        console.print(f"interrupted: {len(finished(study))} of {trials} trials are kept, the same command goes on", soft_wrap=True)
        return EXIT_BY_SIGNAL + SIGINT
    unit = unit_of(loops[STUDIED])
    print_whole(console, front_table(unit, best, chosen, today, on_held_out, varied))
    picture = out.with_suffix(".png")
    held = [driven for driven in on_held_out.values() if driven is not None]
    figure(
        picture,
        unit,
        effort,
        (titles[STUDIED], tried(study), best, today[STUDIED], chosen),
        (titles[HELD_OUT], held, today[HELD_OUT], verdict),
    )
    console.print(f"figure: {picture}", soft_wrap=True)
    if chosen is None:
        console.print(f"nothing gained: no trial has less error than today's values at {allowed(effort)}; {path} stays as it is", soft_wrap=True)
        return NOTHING_GAINED
    assert verdict is not None
    gains = [
        f"on the studied {titles[STUDIED]}: {gain(unit, today[STUDIED], chosen)}",
        f"on the held-out {titles[HELD_OUT]}: {gain(unit, today[HELD_OUT], verdict)}",
    ]
    for line in gains:
        console.print(line, soft_wrap=True)
    if not beats(verdict, today[HELD_OUT], effort):
        console.print(f"nothing gained: the chosen trial must have less error at {allowed(effort)} on the held-out scenario, too", soft_wrap=True)
        return NOTHING_GAINED
    before = ", ".join(f"{each.key} = {each.today:g}" for each in varied)
    comment = [f"Tuned by `rti-mpc tune`, {len(finished(study))} trials; error is rms, effort the rms of increments.", *gains, f"Before: {before}"]
    comment += [robot[0].upper() + robot[1:]] if robot else []
    write(out, path, chosen.values, comment, config)
    console.print(f"written: {out}", soft_wrap=True)
    return 0


def without_password(url: str) -> str:
    """Return a URL that may be printed."""
    return re.sub(r"(//[^/@:]*:)[^/]*@", r"\1***@", url)


def study_file(out: Path) -> Path:
    """Return where the study of a file is kept, unless a storage is given."""
    return out.with_suffix(".study.db")


def written_to(path: Path, config: Config, out: Path | None) -> Path:
    """
    Return the file to write.

    Raises:
        ConfigError: It is the robot's own, or there already without its study, or what that finds beside itself would be missing beside this one.
    """
    tuned = f"{path.stem}.tuned.toml"
    out = out or (Path(tuned) if DEPLOY.resolve() in path.resolve().parents else path.with_name(tuned))
    if out.suffix != ".toml" or out.resolve() == path.resolve():
        raise ConfigError(f"--out must be a TOML file other than {path}, got {out}")
    if (":" in config.model.name or config.bus.config or config.bus.tls) and out.resolve().parent != path.resolve().parent:
        raise ConfigError(f"--out must be beside {path}, whose model or bus is found from there, got {out}")
    if os.path.exists(out) and not os.path.exists(study_file(out)):
        raise ConfigError(f"--out must not overwrite a file but of the study beside it, got {out}, which exists without {study_file(out).name}")
    if not out.resolve().parent.is_dir():
        raise ConfigError(f"--out must be in a folder that exists, got {out}")
    return out


def parted(course: Course, held_out: str | None, *, planar: bool) -> tuple[Course, Course]:
    """Return the course of the study and the held-out one, with other noise: of a recording its first and second half if none was asked for."""
    if is_recording(course.name) and held_out in (None, course.name):
        return replace(course, part=(0.0, 0.5)), replace(course, part=(0.5, 1.0), seed=course.seed + 1)
    return course, replace(course, name=default_held_out(course.name, planar=planar) if held_out is None else held_out, seed=course.seed + 1)


def default_held_out(studied: str | None, *, planar: bool) -> str:
    """Return the scenario that decides if none was asked for."""
    return OTHER_PATHS.get(studied or "eight", "circle") if planar else OTHER_OUTPUTS.get(studied or "sines", "steps")


def unit_of(loop: ClosedLoop) -> str:
    """Return the unit of the error: of the first weighted output."""
    return next(output.unit for output in loop.model.outputs if loop.config.ocp.weights.Q[output.name] > 0.0)


def allowed(effort: float) -> str:
    """Return what is allowed in words."""
    return "no more effort" if effort == 1.0 else f"{effort:g} times the effort"


def gain(unit: str, today: Driven, now: Tried | Driven) -> str:
    """Return by how much error and effort have changed, in words."""
    return ", ".join(
        f"{name} {factor * was:.4g} -> {factor * value:.4g} {of} ({100 * (value / was - 1):+.1f} %)"
        if was
        else f"{name} 0 -> {factor * value:.4g} {of}"
        for name, factor, of, was, value in (("error", 1, unit, today.error, now.error), ("effort", 100, "%", today.effort, now.effort))
    )


def front_table(
    unit: str,
    best: Sequence[Tried],
    chosen: Tried | None,
    today: Mapping[str, Driven],
    on_held_out: Mapping[int, Driven | None],
    varied: Sequence[Varied],
) -> Table:
    """Return the Pareto front, today's values first, with the held-out scenario beside the studied one."""
    table = Table(
        "trial", f"error, {unit}", "effort, %", f"held out: error, {unit}", "effort, %", *(each.key.removeprefix("ocp.") for each in varied)
    )

    def row(name: str, drives: Sequence[Tried | Driven | None], values: Mapping[str, float]) -> None:
        figures = [f"{value:.4g}" for one in drives for value in ((float("nan"),) * 2 if one is None else (one.error, 100 * one.effort))]
        table.add_row(name, *figures, *(f"{values[each.key]:.{max(3, len(str(int(each.high))))}g}" for each in varied))

    row("today", (today[STUDIED], today[HELD_OUT]), {each.key: each.today for each in varied})
    for trial in best:
        name = f"{trial.number}, chosen" if chosen is not None and trial.number == chosen.number else str(trial.number)
        row(name, (trial, on_held_out[trial.number]), trial.values)
    return table


def write(out: Path, path: Path, values: Mapping[str, float], comment: Sequence[str], config: Config) -> None:
    """
    Write the robot's file with other values and a comment.

    Raises:
        ConfigError: A value cannot be changed in its text, or the file cannot be written.
    """
    text = commented(edited(path.read_text(encoding="utf-8"), values), list(comment))
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"--out must be a file that can be written, got {out}: {error.strerror}") from error
    assert load(out).config_hash == with_values(config, values).config_hash, "the file says what was driven"
