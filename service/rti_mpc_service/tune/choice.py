# SPDX-License-Identifier: Apache-2.0
"""
Choice from a study: the Pareto front of error and effort, and the trial with the least error at no more effort than today's.

It is made before the held-out scenario is looked at, which then only says yes or no.
"""

from __future__ import annotations

from collections.abc import Sequence

from rti_mpc_service.tune.closed_loop import Driven
from rti_mpc_service.tune.study import Tried


def front(trials: Sequence[Tried]) -> list[Tried]:
    """Return the trials that no other one beats in error or effort without losing in the other, by error."""
    best: list[Tried] = []
    for trial in sorted(trials, key=lambda trial: (trial.error, trial.effort, trial.number)):
        if not best or trial.effort < best[-1].effort:
            best.append(trial)
    return best


def choose(trials: Sequence[Tried], today: Driven, effort: float) -> Tried | None:
    """
    Return the trial with the least error that `beats` today's values, None if none does.

    Args:
        trials: All of them.
        today: Drive with the values of the file.
        effort: Effort that is allowed, relative to today's.
    """
    return min((trial for trial in trials if beats(trial, today, effort)), key=lambda trial: (trial.error, trial.effort), default=None)


def beats(one: Tried | Driven, today: Driven, effort: float) -> bool:
    """Whether a drive has less error than today's, at most `effort` times its effort, and no more samples without a plan of their own."""
    return one.error < today.error and one.effort <= effort * today.effort and one.fallbacks <= today.fallbacks
