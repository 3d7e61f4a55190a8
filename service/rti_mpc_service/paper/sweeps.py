# SPDX-License-Identifier: Apache-2.0
"""Beyond the paper: what each setting gains, and what it costs, on the eight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from rti_mpc_service.paper.experiment import BEST_SETTINGS, Experiment
from rti_mpc_service.paper.race import EIGHT

WITH_PAPER_WEIGHTS = replace(EIGHT, N=20, method="rk4")  # the paper's weights, with the shipped horizon and integrator
WITH_BEST_WEIGHTS = replace(WITH_PAPER_WEIGHTS, **BEST_SETTINGS)
BOTH_WEIGHTS = (WITH_PAPER_WEIGHTS, WITH_BEST_WEIGHTS)

LAMBDAS = (8.0, 0.8, 0.08, 0.008, 0.0008)
HORIZONS = (3, 5, 7, 10, 15, 20, 30, 50, 70, 100)
CONTROL_HORIZONS = (1, 2, 3, 5, 7, 10, 15, 20)
PERIODS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)
TERMINAL_WEIGHT_S = 1.0  # time that the last stage stands for: 20 stages of 1 ms are far shorter than the robot's lag of 0.24 s
MISMATCH_FACTORS = (0.8, 0.9, 1.0, 1.1, 1.2)
MISMATCHES = {"inertia": ("theta_1", "theta_2"), "friction": ("theta_4", "theta_6"), "offset": ("a",)}


def increments() -> list[Experiment]:
    """The weight on increments, with and without one on the heading, and all again with noise."""
    return [
        replace(WITH_PAPER_WEIGHTS, lambda_=value, heading=heading, noise=noise)
        for noise in (False, True)
        for heading in ("consistent", "none")
        for value in LAMBDAS
    ]


def horizons() -> list[Experiment]:
    """The horizon, by integrator."""
    return [replace(base, N=N, method=method) for base in BOTH_WEIGHTS for method in ("euler", "rk4") for N in HORIZONS]


def control_horizons() -> list[Experiment]:
    """The control horizon, of a horizon of 20."""
    return [replace(base, N_u=N_u) for base in BOTH_WEIGHTS for N_u in CONTROL_HORIZONS]


def periods() -> list[Experiment]:
    """The sampling time, at 20 stages."""
    return [replace(WITH_BEST_WEIGHTS, T0=T0, delta_N=TERMINAL_WEIGHT_S / T0) for T0 in PERIODS]


def mismatches() -> list[Experiment]:
    """A robot whose parameters are not the model's."""
    return [
        replace(base, mismatch=dict.fromkeys(names, factor)) for base in BOTH_WEIGHTS for names in MISMATCHES.values() for factor in MISMATCH_FACTORS
    ]


SWEEPS: dict[str, Callable[[], Sequence[Experiment]]] = {
    "lambda": increments,
    "N": horizons,
    "N_u": control_horizons,
    "T0": periods,
    "mismatch": mismatches,
}
