# SPDX-License-Identifier: Apache-2.0
"""
Summary of a run in numbers: tracking errors, bounds, times and events.

Errors are distances of the plant's true position from the analytic path at the same
stamp, at every state after the transient, and differences of each true output from its
reference. Commanded and applied inputs are compared with the bounds by code that shares
nothing with the solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rti_mpc.array import Array
from rti_mpc.contract.approach import magnitudes
from rti_mpc.contract.message import Event, Reference, Severity, Telemetry
from rti_mpc.contract.status import QpStatus
from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.signals import plane
from rti_mpc.wire.info import Info
from rti_mpc_service.rig.along_path import AlongPath
from rti_mpc_service.rig.robot_log import RobotLog
from rti_mpc_service.rig.run_data import Run, located, wanted
from rti_mpc_service.scenario import Scenario

TRANSIENT_S = 20.0
MAX_HELD_UP_S = 1.0  # before the end, in which a busy host may keep a controller from driving, and it is still taken to drive
ERROR_KEYS = ("max_error_mm", "rms_error_mm", "last_lap_max_error_mm", "final_error_mm", "final_speed_mm_s")
INCREMENT_ROUNDING = 1e-9  # rounding of a difference of two inputs, relative to their largest value; inputs are compared exactly


@dataclass(frozen=True, eq=False)
class Outcome:
    """
    All results of a run.

    Attributes:
        scenario: The scenario to follow.
        reference: Its rows, as published.
        plant: Model of the robot itself.
        anchor_ns: Robot time at which it began.
        duration_s: How long it was to be followed.
        speed: Seconds of robot time per second.
        ocp: The controller's problem, with its bounds.
        info: Names of its vectors.
        log: The robot's record.
        telemetry: One message per sample.
        unheard: Number of samples whose telemetry was lost.
        events: Faults and mode changes.
        echo_us: Round trips of the bare echo.
    """

    scenario: Scenario
    reference: Reference
    plant: Model
    anchor_ns: int
    duration_s: float
    speed: float
    ocp: Ocp
    info: Info
    log: RobotLog
    telemetry: Sequence[Telemetry]
    unheard: int
    events: Sequence[Event]
    echo_us: Sequence[float]

    @property
    def end_ns(self) -> int:
        """Robot time at which the run was to end."""
        return self.anchor_ns + round(1e9 * self.duration_s)

    @property
    def samples(self) -> list[Telemetry]:
        """The samples whose states lie between anchor and end."""
        return [sample for sample in self.telemetry if self.anchor_ns <= sample.state_stamp_ns <= self.end_ns]

    @property
    def driven(self) -> bool:
        """Whether the robot was driven to the end: it got there, and shortly before a plan for the reference was acting."""
        reached = bool(self.log.stamp_ns.size and self.log.stamp_ns[-1] >= self.end_ns)
        since_ns = self.end_ns - 1e9 * max(MAX_HELD_UP_S * self.speed, 2.5 * self.ocp.dt)
        return reached and any(sample.state_stamp_ns > since_ns and sample.mode.planned for sample in self.samples)

    def run(self) -> Run:
        """Return the run between anchor and end for figures; samples whose command never arrived are left out."""
        log = self.log.part((self.anchor_ns <= self.log.stamp_ns) & (self.log.stamp_ns <= self.end_ns))
        latency_us = dict(zip(log.seq.tolist(), log.latency_us.tolist(), strict=True))
        along = None
        if self.scenario.pieces and len(log.x):
            along = AlongPath.of(self.plant, self.scenario.pieces, 1e-9 * (log.stamp_ns - log.stamp_ns[0]), log.x)
        p = np.array(self.plant.p_nominal)[:, None] if along is None else along.p.T
        answered = [sample for sample in self.samples if np.isfinite(latency_us.get(sample.state_seq, np.nan))]
        return Run(
            info=self.info,
            scenario=self.scenario.name,
            stamp_ns=log.stamp_ns,
            x=log.x,
            u_applied=log.u,
            y=np.array(self.plant.outputs_at()(log.x.T, log.u.T, p)).reshape(-1, len(log.x)).T,
            reference=self._wanted(log.stamp_ns),
            sample_stamp_ns=np.array([sample.stamp_ns for sample in answered], dtype=np.int64),
            prepare_us=np.array([sample.prepare_us for sample in answered]),
            feedback_us=np.array([sample.feedback_us for sample in answered]),
            latency_us=np.array([latency_us[sample.state_seq] for sample in answered]),
            speed=self.speed,
            transient_s=min(TRANSIENT_S, self.duration_s / 2),
            along=along,
            discs=tuple(np.stack(located(obstacle, self.reference, log.stamp_ns), axis=-1) for obstacle in self.info.obstacles),
        )

    def _wanted(self, stamp_ns: NDArray[np.int64]) -> Array:
        """Return the outputs that were to be at stamps, shape ``(M, ny)``: of a path exactly, of all else as its rows say."""
        y, columns = wanted(self.reference, stamp_ns), plane(self.plant.outputs)
        if self.scenario.path is not None and columns is not None:
            y[:, columns] = self.scenario.path.position(np.asarray(1e-9 * (stamp_ns - self.anchor_ns)))
        return y


def summarize(outcome: Outcome) -> dict[str, Any]:
    """
    Return the summary of a run, in JSON.

    Lengths are in mm, times in the unit of the name. Misses and events are at times of
    the robot's clock, as `rti-mpc why --at` takes them. Skipped samples count in
    ``in_period_share`` as not in period.
    """
    run, samples, counters = outcome.run(), outcome.samples, outcome.log.counters
    if not run.stamp_ns.size or not samples:
        return {"scenario": run.scenario, "driven": False, "samples": 0, "events": fault_events(outcome)}
    skipped = samples[-1].skipped - samples[0].skipped
    misses = [sample for sample in samples if sample.slack_s < 0.0]
    return {
        "scenario": run.scenario,
        "driven": outcome.driven,
        "duration_s": outcome.duration_s,
        "transient_s": run.transient_s,
        "speed": outcome.speed,
        "states": len(run.stamp_ns),
        "samples": len(samples),
        **errors(run, outcome.scenario.path.lap_s if outcome.scenario.path is not None else None),
        "outputs": output_errors(run),
        "path": None if run.along is None else run.along.summary(),
        "in_period_share": (len(samples) - len(misses)) / (len(samples) + skipped),
        "misses": [
            {
                "at_s": 1e-9 * sample.state_stamp_ns,
                "slack_s": sample.slack_s,
                "prepare_us": sample.prepare_us,
                "feedback_us": sample.feedback_us,
                "latency_us": sample.latency_us,
            }
            for sample in misses
        ],
        "skipped": skipped,
        "fallbacks": samples[-1].fallbacks,
        **{name: counters[name] for name in ("lost", "late", "expired", "refused", "starved")},
        "unheard": outcome.unheard,
        **limits(outcome, samples),
        "prepare_us": quantiles(run.prepare_us),
        "feedback_us": quantiles(run.feedback_us),
        "latency_us": quantiles(run.latency_us),
        "echo_us": quantiles(np.array(outcome.echo_us)),
        "second_opinion": second_opinions(samples),
        "events": fault_events(outcome),
    }


def errors(run: Run, lap_s: float | None) -> dict[str, float | None]:
    """Return errors and the speed at the end; null where the run was too short, or the outputs are no pose in the plane."""
    if not run.planar:
        return dict.fromkeys(ERROR_KEYS)
    settled = run.error_mm[run.settled]
    last_lap = run.error_mm[run.time_s >= run.time_s[-1] - lap_s] if lap_s and run.time_s[-1] - lap_s >= run.transient_s else settled[:0]
    steps_mm, steps_s = 1e3 * np.hypot(*np.diff(run.position, axis=0).T), np.diff(run.time_s)
    numbers = (
        float(settled.max()) if settled.size else None,
        float(np.sqrt((settled**2).mean())) if settled.size else None,
        float(last_lap.max()) if last_lap.size else None,
        float(run.error_mm[-1]),
        float(steps_mm[-1] / steps_s[-1]) if steps_s.size else None,
    )
    return dict(zip(ERROR_KEYS, numbers, strict=True))


def output_errors(run: Run) -> dict[str, dict[str, Any]]:
    """Return the errors of each output, in its unit; null where the run was too short."""
    settled, last = np.abs(run.output_error[run.settled]), np.abs(run.output_error[-1])
    return {
        label.name: {
            "unit": label.unit,
            "max": float(settled[:, i].max()) if len(settled) else None,
            "rms": float(np.sqrt((settled[:, i] ** 2).mean())) if len(settled) else None,
            "final": float(last[i]),
        }
        for i, label in enumerate(run.info.outputs)
    }


def limits(outcome: Outcome, samples: Sequence[Telemetry]) -> dict[str, Any]:
    """Compare every commanded row, the steps between rows, every applied input and every true state with the bounds."""
    ocp, log = outcome.ocp, outcome.log
    commanded = np.vstack([sample.u for sample in samples])
    steps = np.vstack([np.diff(sample.u, axis=0) for sample in samples])
    lbu, ubu, lbdu, ubdu = (ocp.widest(name) for name in ("lbu", "ubu", "lbdu", "ubdu"))
    rounding = INCREMENT_ROUNDING * magnitudes(lbu, ubu, lbdu, ubdu)
    return {
        "commanded_inputs_in_bounds": not excess(commanded, lbu, ubu).any(),
        "commanded_increments_in_bounds": not (excess(steps, lbdu, ubdu) > rounding).any(),
        "applied_inputs_in_bounds": not excess(log.u, lbu, ubu).any(),
        "states_over_share": float(excess_share(log.x, ocp.widest("lbx"), ocp.widest("ubx")).max()),
    }


def second_opinions(samples: Sequence[Telemetry]) -> dict[str, Any]:
    """Return the share of samples that OSQP has solved, too, in the slack; the largest difference from them, null without any; and its times."""
    solved = [sample for sample in samples if sample.second_status is QpStatus.SOLVED]
    return {
        "share": len(solved) / len(samples),
        "max_difference": max((sample.second_difference for sample in solved), default=None),
        "us": quantiles(np.array([sample.second_us for sample in solved])),
    }


def excess(values: Array, lower: Array, upper: Array) -> Array:
    """Return by how much values, shape ``(M, n)``, are outside their bounds, shape ``(n,)``; 0 inside, exactly."""
    return np.asarray(np.maximum(np.maximum(values - upper, lower - values), 0.0))


def excess_share(values: Array, lower: Array, upper: Array) -> Array:
    """Return the same as a share of the violated bound; of the opposite bound where the violated one is 0."""
    above, below = np.maximum(values - upper, 0.0), np.maximum(lower - values, 0.0)
    size = np.where(above > 0.0, np.abs(upper), np.abs(lower))
    other = np.where(above > 0.0, np.abs(lower), np.abs(upper))
    outside: Array = above + below
    return np.asarray(np.divide(outside, np.where(size > 0.0, size, other), out=np.zeros_like(outside), where=outside > 0.0))


def quantiles(values: Array) -> dict[str, float | None]:
    """Return median, 99th percentile and maximum; null if there are no values."""
    if not values.size:
        return {"p50": None, "p99": None, "max": None}
    return {name: round(float(np.percentile(values, share)), 1) for name, share in (("p50", 50), ("p99", 99), ("max", 100))}


def fault_events(outcome: Outcome) -> list[dict[str, Any]]:
    """Return the warnings and errors among the events before the end, after which processes are stopped while the robot may still be moving."""
    return [
        {"at_s": 1e-9 * event.stamp_ns, "source": event.source, "severity": event.severity.name, "code": event.code, "text": event.text}
        for event in outcome.events
        if event.severity is not Severity.INFO and event.stamp_ns <= outcome.end_ns
    ]
