# SPDX-License-Identifier: Apache-2.0
"""
Study: Optuna proposes values, workers drive them, until there are enough trials.

Trials are asked for in batches of a fixed size and told in order, with a seed that follows
from the number of trials there are. So a study is the same for any number of processes. It
lives in Optuna's storage: another start, or another machine, goes on with it.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import optuna
from optuna.storages import BaseStorage
from optuna.trial import FrozenTrial, TrialState

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.schema import Config
from rti_mpc_service.tune.closed_loop import Course, Driven
from rti_mpc_service.tune.varied import Varied
from rti_mpc_service.tune.workers import DriveAll

BATCH_TRIALS = 8  # asked for at once, whatever the number of processes
OPENINGS = 4  # of a storage: one that others begin at the same time refuses those who find its tables half made
REOPENED_S = 0.25  # between two of them
FINISHED = (TrialState.COMPLETE, TrialState.FAIL)
SAME_TOLERANCE = 1e-3  # relative: two machines round differently; another model or version of the controller differs by more
STUDIED = "studied"  # name of the course of the study among the workers'


@dataclass(frozen=True)
class Tried:
    """
    One trial.

    Attributes:
        number: Optuna's number of it.
        values: Values that were driven, by key.
        error: As of `rti_mpc_service.tune.closed_loop.Driven`; likewise the others.
        effort: Of the commands.
        fallbacks: Samples without a plan of their own.
    """

    number: int
    values: Mapping[str, float]
    error: float
    effort: float
    fallbacks: int


def name_of(config: Config, course: Course, varied: Sequence[Varied]) -> str:
    """Return the name of a study, which is another one for another configuration, robot, scenario or range."""
    sections = [section.model_dump(mode="json") for section in (config.sim, config.reference)]
    content = [config.config_hash, *sections, asdict(course), [asdict(each) for each in varied]]
    return f"{config.robot}-{hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]}"


def open_storage(url: str) -> BaseStorage:
    """
    Open a storage, or make it.

    Args:
        url: Optuna's.

    Raises:
        ConfigError: It cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    for left in reversed(range(OPENINGS)):
        try:
            return optuna.storages.get_storage(url)
        except Exception as error:  # SQLAlchemy's, a database driver's or Optuna's, by the kind of URL
            if isinstance(driver := error.__cause__ or error.__context__, ModuleNotFoundError):
                kind = url.partition(":")[0]
                raise ConfigError(
                    f"--storage {kind}: needs the Python package {driver.name}, which is not installed: pip install {driver.name}"
                ) from error
            if not left:
                reason = (str(error).splitlines() or [type(error).__name__])[0]
                raise ConfigError(f"--storage must be a storage of Optuna that can be used, such as sqlite:///studies.db: {reason}") from error
            time.sleep(REOPENED_S)
    raise AssertionError("the last opening returns or raises")


def open_study(storage: BaseStorage, name: str, today: Driven) -> optuna.Study:
    """
    Open a study, or begin it.

    Args:
        storage: An open one.
        name: Of the study.
        today: Drive with the values of the file.

    Raises:
        ConfigError: The study was made with another model or version, since today's values lead elsewhere there.
    """
    study = optuna.create_study(storage=storage, study_name=name, directions=["minimize", "minimize"], load_if_exists=True)
    known = study.user_attrs.get("today")
    if known is None:
        study.set_user_attr("today", [today.error, today.effort])
    elif any(abs(was - now) > SAME_TOLERANCE * max(abs(now), abs(was)) for was, now in zip(known, (today.error, today.effort), strict=True)):
        raise ConfigError(
            f"study {name} was made with another model or version: today's values led to error {known[0]:.4g} and effort {known[1]:.4g} there, "
            f"and lead to {today.error:.4g} and {today.effort:.4g} here; give another --out or --storage"
        )
    return study


def finished(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that have an outcome."""
    return study.get_trials(deepcopy=False, states=FINISHED)


def tried(study: optuna.Study) -> list[Tried]:
    """Return the trials that the robot has driven to the end."""
    return [
        Tried(trial.number, trial.user_attrs["driven"], trial.values[0], trial.values[1], trial.user_attrs["fallbacks"])
        for trial in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    ]


def run(study: optuna.Study, varied: Sequence[Varied], trials: int, seed: int, drive_all: DriveAll, advance: Callable[[int], object]) -> None:
    """
    Go on with a study until it has a number of trials, those of other machines and earlier starts included.

    Args:
        study: Of two objectives, error and effort.
        varied: What varies.
        trials: How many there are to be.
        seed: Of the proposals.
        drive_all: Drives a batch, in order.
        advance: Told the number of finished trials, whenever it has changed.
    """
    distributions: dict[str, Any] = {each.key: each.distribution for each in varied}
    if not study.trials and all(each.low <= each.today <= each.high for each in varied):
        study.enqueue_trial({each.key: each.rounded(each.today) for each in varied})
    while (left := trials - len(finished(study))) > 0:
        asked = []
        for _ in range(min(left, BATCH_TRIALS)):
            study.sampler = optuna.samplers.TPESampler(seed=seed + len(study.get_trials(deepcopy=False)))
            trial = study.ask(distributions)
            trial.set_user_attr("driven", {each.key: each.rounded(trial.params[each.key]) for each in varied})
            asked.append(trial)
        for trial, driven in zip(asked, drive_all((STUDIED, trial.user_attrs["driven"]) for trial in asked), strict=True):
            if driven is None:
                study.tell(trial, state=TrialState.FAIL)
            else:
                trial.set_user_attr("fallbacks", driven.fallbacks)
                study.tell(trial, (driven.error, driven.effort))
            advance(len(finished(study)))
