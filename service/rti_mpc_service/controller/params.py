# SPDX-License-Identifier: Apache-2.0
"""
Parameters of a running controller: weights, and bounds within those of its file.

A change is a transaction: it is checked as the file is, tried on a copy of the
present sample, and then taken over between two samples, completely or not at all.
Keys are those of the file. Changes of compiled values, such as the horizon or which
bounds exist, are refused. So is every bound wider than the file's, because the
guard and the robot enforce the bounds of their own files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from threading import Condition
from typing import Any

from pydantic import ValidationError

from rti_mpc.control.controller import Controller
from rti_mpc.control.tuning import Tuning
from rti_mpc.errors import ConfigError, OcpError
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rti import Rti
from rti_mpc_service.config.build import build_rti, retuned
from rti_mpc_service.config.fit import check_names, check_rest, check_tree
from rti_mpc_service.config.refusal import NAME, entries, explain, tree_key
from rti_mpc_service.config.schema import Config
from rti_mpc_service.parameter import BOUND_KEYS, from_json, to_json

WEIGHT_TABLES = ("ocp.weights.Q", "ocp.weights.R", "ocp.weights.R_u")  # of weights, by name
WEIGHT_KEYS = (*WEIGHT_TABLES, "ocp.weights.delta", "ocp.weights.lambda", "ocp.bounds.soft_weight")
VERSION_COUNT = 2**32  # telemetry has 32 bits for the version
SAMPLE_TIMEOUT_PERIODS = 2  # how long to wait for the end of a sample
SAMPLE_ARRAYS = ("x", "u", "u_prev", "u_before", "y_ref", "p")  # arrays of an `Rti` that hold the present sample


class Params:
    """
    The parameters of one controller.

    Attributes:
        ocp: The problem with the present parameters.
        version: Number of changes; 0 for the file's values.
        changes: Values that differ from the file's, by key.
    """

    def __init__(self, config: Config, controller: Controller, rti: Rti, lock: Condition) -> None:
        self.ocp: Ocp = rti.ocp
        self.version = 0
        self.changes: dict[str, Any] = {}
        self._file = config
        self._values = parameter_values(config)
        self._controller = controller
        self._rti = rti
        self._lock = lock  # held during a sample; notified at its end
        self._trial = build_rti(config) if config.params.live else None

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """
        Answer a request, ``{"get": true}`` or ``{"set": {key: value, ...}}``; a bound that is absent is null.

        Raises:
            ConfigError: One line: the key, what must hold, what was got.
        """
        if request.get("get") is True:
            return {"version": self.version, "live": self._trial is not None, "values": to_json(self._values)}
        given = request.get("set")
        if not isinstance(given, dict) or not given:
            raise ConfigError(f'params must be asked for with "get": true or "set": {{key: value}}, got {dict(request)!r}')
        if self._trial is None:
            raise ConfigError("params.live must be true in the controller's file for a change while it runs, got false")
        changes = {**self.changes, **from_json(given)}
        config, ocp = changed_problem(self._file, self.ocp, changes)
        self._try(self._trial, ocp)
        seq = self._take(config, ocp, self.version + 1, changes)
        return {"version": self.version, "from_seq": seq}

    def adopt(self, version: int, changes: Mapping[str, Any]) -> None:
        """
        Take over the leader's changes.

        Raises:
            ConfigError: A change does not fit this controller's file.
        """
        if type(version) is not int or not 0 <= version < VERSION_COUNT:
            raise ConfigError(f"version of parameters must be an integer from 0 to {VERSION_COUNT - 1}, got {version!r}")
        if version != self.version:
            changes = from_json(changes)
            self._take(*changed_problem(self._file, self.ocp, changes), version, changes)

    def _take(self, config: Config, ocp: Ocp, version: int, changes: dict[str, Any]) -> int:
        with self._lock:
            seq = self._controller.retune(ocp, version)
        self.ocp, self.version, self.changes, self._values = ocp, version, changes, parameter_values(config)
        return seq

    def _try(self, trial: Rti, ocp: Ocp) -> None:
        """Solve the present QP with new weights and bounds, on a copy."""
        with self._lock:
            self._lock.wait(SAMPLE_TIMEOUT_PERIODS * self.ocp.dt)  # for the end of a sample, so that the trial runs in the slack
            sample = {name: getattr(self._rti, name).copy() for name in SAMPLE_ARRAYS}
        trial.reset(sample["x"][0], sample["u_prev"])
        for name, value in sample.items():
            getattr(trial, name)[:] = value
        tuning = Tuning(trial)
        tuning.change(ocp, 1)
        tuning.begin()
        tuning.follow(sample["u_prev"])
        trial.prepare(sample["y_ref"], sample["p"], shift=False)
        status = trial.feedback(sample["x"][0])
        if not status.usable:
            raise ConfigError(f"the present sample must have a solution with the new values, its QP is {status.name.lower()}")


def parameter_values(config: Config) -> dict[str, Any]:
    """Return the values that may be changed, by key."""
    document = config.model_dump(by_alias=True)
    tables = {key: entry_at(document, key) for key in (*WEIGHT_KEYS, *BOUND_KEYS)}
    return {
        f"{key}.{name}" if isinstance(table, dict) else key: value
        for key, table in tables.items()
        for name, value in (table.items() if isinstance(table, dict) else [("", table)])
    }


def entry_at(document: Mapping[str, Any], key: str) -> Any:
    """Return the entry at a dotted key."""
    for step in key.split("."):
        document = document[step]
    return document


def changed_problem(file: Config, ocp: Ocp, changes: Mapping[str, Any]) -> tuple[Config, Ocp]:
    """
    Return the configuration with changed values, and its problem, derived from the problem of the file.

    No expression is built, which would take ten times as long: the interpreter's lock
    is shared with the control thread.

    Raises:
        ConfigError: A key may not change, or a value does not fit.
    """
    document = file.model_dump(by_alias=True)
    for key, value in changes.items():
        table, _, name = key.rpartition(".")
        if key not in WEIGHT_KEYS and table not in (*WEIGHT_TABLES, *BOUND_KEYS):
            raise ConfigError(f"{key} {why_fixed(key)}, got {value!r}")
        if "ocp.weights.R_u" in (key, table) and not weighs_inputs(file):
            raise ConfigError(
                f"{key} can be set only where the controller's file has a weight of R_u above 0, since its problem is compiled without R_u "
                f"otherwise: give one there, and restart it, got {value!r}"
            )
        entry_at(document, table)[name] = value
    try:
        config = Config.model_validate(document)
        check_tree(config)
        check_names(config, ocp.model)
        ocp = retuned(config, ocp)
        check_rest(ocp)
    except ValidationError as error:
        raise ConfigError(explain(error, Config, document)) from error
    except OcpError as error:
        raise ConfigError(str(error)) from error
    for wrong in wider_bounds(file, config, changes):
        raise ConfigError(wrong)
    return config, ocp


def weighs_inputs(config: Config) -> bool:
    """Whether the compiled problem has weights of inputs themselves: what is zero for all of them is left out of it."""
    return any(config.ocp.weights.R_u.values()) or any(map(any, config.ocp.stages.R_u.values()))


def why_fixed(key: str) -> str:
    """Return the reason why a key may not change."""
    known = dict(entries(Config))
    entry = tree_key(key.split("."), known)
    table, _, name = entry.rpartition(".")
    named = name == NAME or not any(other.startswith(f"{table}.") for other in known)  # an entry of a table of names
    what = known.get(entry, known.get(table, "") if named else "")
    return (
        f"({what}) is fixed while the controller runs: change its file, and restart it"
        if what
        else f"is none of {', '.join((*WEIGHT_KEYS, *BOUND_KEYS))}"
    )


def wider_bounds(file: Config, config: Config, changes: Mapping[str, Any]) -> Iterator[str]:
    """Yield a complaint for each bound that is new or wider than the file's."""
    now, before = parameter_values(config), parameter_values(file)
    for key in changes:
        if key.rpartition(".")[0] not in BOUND_KEYS:
            continue
        if key not in before:
            yield f"{key} is not in the controller's file, and no bound can be added while it runs, got {list(now[key])}"
            return
        (lower, upper), (least, most) = now[key], before[key]
        if lower < least or upper > most or math.isinf(lower) != math.isinf(least) or math.isinf(upper) != math.isinf(most):
            yield f"{key} must lie inside the file's {[least, most]}, which guard and robot enforce, and finite where that is, got {[lower, upper]}"
