# SPDX-License-Identifier: Apache-2.0
"""A recorded drive and the same one in closed loop, side by side: in numbers, a figure, and one recording of both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from rti_mpc.array import Array
from rti_mpc.contract.message import Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.errors import ConfigError
from rti_mpc.recording.reader import Recording
from rti_mpc.rti.ocp import Ocp
from rti_mpc.si import ones
from rti_mpc.wire.info import Info
from rti_mpc_service.description import controller_info
from rti_mpc_service.replay.beside import write_both
from rti_mpc_service.replay.drive import Drive, Passage
from rti_mpc_service.replay.rebuild import Journaled
from rti_mpc_service.rig.run_data import Run
from rti_mpc_service.rig.summary import TRANSIENT_S

NAMES = "recorded", "closed loop"
PHASES = "prepare_us", "feedback_us"
FOLLOWING = Mode.TRACKING, Mode.HOLDING, Mode.FALLBACK, Mode.BRAKING  # a robot that brakes for a fault has an error, one that was stopped has none
LABEL_CHARACTERS = 34
Numbers = dict[str, float]
Column = tuple[str, str]  # name and unit of a number


def compare(
    path: Path, journal: Journaled, recorded: Drive, driven: Drive, assignments: Sequence[str], start_s: float | None, out: Path | None
) -> dict[str, Any] | None:
    """
    Print a recorded drive beside the same one in closed loop, write figure and recording, and return the numbers.

    Args:
        path: The recording.
        journal: The controller.
        recorded: Its drive as it was.
        driven: Its drive in closed loop.
        assignments: What is other in closed loop, for the title.
        start_s: Time of the robot's clock from which on was asked for; None: the transient at the beginning does not count.
        out: Folder for figure and recording; None: neither.

    Returns:
        None if there is no drive; numbers that are not known are None.

    Raises:
        ConfigError: Figure or recording cannot be written.
    """
    if len(recorded.passage.samples) < 2 or len(driven.passage.samples) < 2:
        print(f"  no closed loop: {undriven(journal, start_s)}")
        return None
    ocp = recorded.ocp
    heard = heard_samples(path, journal)
    runs = [run_of(on.passage, ocp, start_s, title) for on, title in zip((recorded, driven), NAMES, strict=True)]
    numbers = [numbers_of(on.passage, run, ocp) for on, run in zip((recorded, driven), runs, strict=True)]
    times = [[heard[key] for sample in recorded.passage.samples if (key := (sample.epoch, sample.seq)) in heard], driven.passage.samples]
    for each, samples in zip(numbers, times, strict=True):
        each |= phase_times(samples)
    apart = distance(*runs)
    run = runs[0]
    begin_s = 1e-9 * int(run.stamp_ns[0])
    said = f"with {', '.join(assignments)}" if assignments else "with the same settings"
    after = f", numbers after {run.transient_s:g} s" if run.transient_s else ""
    print(f"  in closed loop {said}, {run.time_s[-1]:.1f} s from {begin_s:.3f} s on{after}:")
    for line in (*lines(numbers, run), told_apart(apart, ocp)):
        print(f"    {line}")
    if driven.passage.unsent:
        print(f"    {driven.passage.unsent} commands were not sent: when it was recorded, there was none to send")
    if out is not None:
        write(out, path, journal, recorded, driven, runs, said)
    solved = [dict(on.passage.solved) for on in (recorded, driven)]
    sides = {name.replace(" ", "_"): known(each) | {"samples_by": by} for name, each, by in zip(NAMES, numbers, solved, strict=True)}
    return {"with": [*assignments], "begin_s": begin_s, "duration_s": float(run.time_s[-1]), **sides, "apart": known(apart)}


def undriven(journal: Journaled, start_s: float | None) -> str:
    """Return why there is no drive."""
    last_s = 1e-9 * max(message.stamp_ns for message in journal.messages)
    if start_s is not None and start_s > last_s:
        return f"--from must be before this controller's last state, at {last_s:.3f} s, got {start_s:.3f} s"
    return "from there on this controller has not led two samples in a row, after a state whose command is in the recording"


def known(numbers: Numbers) -> dict[str, float | None]:
    """Return numbers for JSON, which has no NaN."""
    return {name: value if np.isfinite(value) else None for name, value in numbers.items()}


def heard_samples(path: Path, journal: Journaled) -> dict[tuple[int, int], Telemetry]:
    """Return the telemetry of a recording by epoch and number; only this has the times that phases took then."""
    messages = (recorded.message for recorded in Recording(path).messages(journal.robot, ("telemetry",)))
    return {(message.epoch, message.seq): message for message in messages}


def run_of(passage: Passage, ocp: Ocp, start_s: float | None, title: str) -> Run:
    """Return a drive with a row per sample: states and outputs when its command begins to act, the input that it commands."""
    samples = passage.samples
    stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
    duration_s = 1e-9 * (stamps[-1] - stamps[0])
    return Run(
        info=Info.from_json({"role": "controller", **controller_info(ocp, ocp.model.np_)}),
        scenario=title,
        stamp_ns=stamps,
        x=np.array([sample.x0 for sample in samples]),
        u_applied=np.array([sample.u[0] for sample in samples]),
        y=np.array([sample.y for sample in samples]),
        reference=np.array(passage.wanted),
        sample_stamp_ns=stamps,
        prepare_us=np.array([sample.prepare_us for sample in samples]),
        feedback_us=np.array([sample.feedback_us for sample in samples]),
        latency_us=np.array([sample.latency_us for sample in samples]),
        transient_s=0.0 if start_s is not None else min(TRANSIENT_S, duration_s / 2),
    )


def numbers_of(passage: Passage, run: Run, ocp: Ocp) -> Numbers:
    r"""
    Return what a drive is judged by: its samples that follow a reference, after the transient.

    The cost is the mean of :math:`\delta_1 e^T Q e + \lambda_1 \Delta u^T R \Delta u` with the recorded weights, for both drives; effort is
    the root of the mean squared increment of the inputs, each relative to half its range, summed over the inputs.
    """
    follows = np.array([sample.mode in FOLLOWING for sample in passage.samples])
    settled = run.settled & follows & np.isfinite(run.reference).all(axis=1)
    e, du = run.output_error[settled], np.diff(run.u_applied, axis=0, prepend=run.u_applied[:1])[settled]
    half = 0.5 * (ocp.widest("ubu") - ocp.widest("lbu"))
    relative = du / np.where(np.isfinite(half) & (half > 0.0), half, ones(ocp.model.inputs))
    found: Numbers = {}
    for i, output in enumerate(ocp.model.outputs):
        found |= {f"{output.name}_rms": rms(e[:, i]), f"{output.name}_max": largest(e[:, i])}
    if run.planar:
        found |= {"distance_mm_rms": rms(run.error_mm[settled]), "distance_mm_max": largest(run.error_mm[settled])}
    found["cost"] = float(np.mean(np.einsum("ki,ij,kj->k", e, ocp.Q_at(0), e) + np.einsum("ki,ij,kj->k", du, ocp.R_at(0), du))) if len(e) else np.nan
    found["effort"] = float(np.sqrt((relative**2).sum(axis=1).mean())) if len(e) else np.nan
    return found | {"samples": float(len(passage.samples))} | {f"by {who}": float(count) for who, count in sorted(passage.solved.items())}


def rms(values: Array) -> float:
    """Return the root mean square; NaN of nothing."""
    return float(np.sqrt((values**2).mean())) if values.size else np.nan


def largest(values: Array) -> float:
    """Return the largest magnitude; NaN of nothing."""
    return float(np.abs(values).max()) if values.size else np.nan


def phase_times(samples: Sequence[Telemetry]) -> Numbers:
    """Return median and 99th percentile of the phases, us; nothing without samples."""
    return {f"{name}_p{q}": float(np.percentile([getattr(sample, name) for sample in samples], q)) for name in PHASES for q in (50, 99) if samples}


def distance(recorded: Run, driven: Run) -> dict[str, float]:
    """Return how far the drives are apart at most at samples of the same time, by name of state and input, in their units."""
    _, mine, other = np.intersect1d(recorded.stamp_ns, driven.stamp_ns, return_indices=True)
    x = recorded.info.rotations("states").difference(driven.x[other], recorded.x[mine])
    u = driven.u_applied[other] - recorded.u_applied[mine]
    names = [label.name for label in (*recorded.info.states, *recorded.info.inputs)]
    return dict(zip(names, map(largest, np.hstack([x, u]).T), strict=True))


def lines(numbers: Sequence[Mapping[str, float]], run: Run) -> Iterator[str]:
    """Yield a table of the numbers of both drives."""
    yield row("", NAMES)
    rows = [(f"error of {output}, {kind}", f"{output.name}_{kind}") for output in run.info.outputs for kind in ("rms", "max")]
    if run.planar:
        rows += [(f"distance [mm], {kind}", f"distance_mm_{kind}") for kind in ("rms", "max")]
    rows += [("cost of a sample, recorded weights", "cost"), ("effort [half an input's range]", "effort"), ("samples", "samples")]
    solvers = sorted({name for each in numbers for name in each if name.startswith("by ")})
    rows += [(f"  {name}", name) for name in solvers]
    rows += [(f"{name.removesuffix('_us')}, p{q} [us]", f"{name}_p{q}") for name in PHASES for q in (50, 99)]
    for label, name in rows:
        missing = 0.0 if name.startswith("by ") else np.nan
        yield row(label, [told(each.get(name, missing)) for each in numbers])


def told(value: float) -> str:
    """Return a number with four digits; of none a dash."""
    return f"{value:.4g}" if np.isfinite(value) else "-"


def row(label: str, cells: Sequence[str]) -> str:
    """Return a row of the table."""
    return f"{label:<{LABEL_CHARACTERS}}" + "".join(f" {cell:>12}" for cell in cells)


def told_apart(apart: Mapping[str, float], ocp: Ocp) -> str:
    """Return how far the drives are apart, in words."""
    units = {signal.name: signal.unit for signal in (*ocp.model.states, *ocp.model.inputs)}
    return f"apart at most: {', '.join(f'{name} {value:.3g} {units[name]}' for name, value in apart.items())}"


def free_name(out: Path, name: str) -> str:
    """Return a name of which a folder has neither recording nor figure: the name itself, or with the first number from 2 on that is free."""
    names = chain([name], (f"{name}-{number}" for number in count(2)))
    return next(one for one in names if not any((out / f"{one}{suffix}").exists() for suffix in (".mcap", ".png")))


def write(out: Path, path: Path, journal: Journaled, recorded: Drive, driven: Drive, runs: Sequence[Run], said: str) -> None:
    """
    Write the figure, where matplotlib is installed, and the recording of both drives.

    Raises:
        ConfigError: The folder cannot be written, or the recording has no state of the drive.
    """
    from importlib.util import find_spec

    try:
        out.mkdir(parents=True, exist_ok=True)
        name = free_name(out, f"{journal.robot}-{journal.owner}")
        write_both(out / f"{name}.mcap", path, journal, recorded.passage, driven)
        if find_spec("matplotlib") is not None:
            from rti_mpc_service.replay.figure import figure

            figure(runs, out / f"{name}.png", f"{journal.robot}, {said}")
            print(f"    figure     {out / f'{name}.png'}")
    except OSError as error:
        raise ConfigError(f"--out must be a folder that can be written, got {out}: {error.strerror}") from error
    print(f"    view both  rti-mpc view {out / f'{name}.mcap'}")
