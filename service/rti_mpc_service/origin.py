# SPDX-License-Identifier: Apache-2.0
"""
Origin of a controller's commands: configuration, model, versions and host, as files for recordings.

A recorder asks for them piece by piece on the query ``origin``, which changes nothing. The
section ``bus`` stays out: it names the files of keys and passwords.
"""

from __future__ import annotations

import base64
import importlib.util
import json
import shutil
import zlib
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import rti_mpc
from rti_mpc.codegen import flags_of
from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.model.find import SHIPPED_MODELS
from rti_mpc.model.model import Model
from rti_mpc.wire.cdr import MESSAGE_VERSION
from rti_mpc_service.config import toml
from rti_mpc_service.config.schema import Config
from rti_mpc_service.host import machine

CHECKOUT = Path(rti_mpc.__file__).parents[1]  # if it is one
PIECE_CHARS = 40_000  # of one answer: parsing JSON holds the interpreter's lock
MAX_EXPRESSION_CHARS = 200_000  # of a model's equations as text
PRIVATE = {"bus": True, "model": {"folder"}}


class Origin:
    """The files of one controller, and the answers to a recorder."""

    def __init__(self, files: Mapping[str, str], epoch: Callable[[], int]) -> None:
        """
        Pack the files.

        Args:
            files: Their texts by name, see `origin_files`.
            epoch: Returns the epoch of the controller.
        """
        self._epoch = epoch
        self._bundle = base64.b64encode(zlib.compress(json.dumps(dict(files)).encode(), 9)).decode()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """
        Return the piece of the bundle that begins at a character.

        Raises:
            ValueError: The request names none.
        """
        begin = request.get("from")
        if type(begin) is not int or not 0 <= begin < len(self._bundle):
            raise ValueError(f"from must be a number from 0 to {len(self._bundle) - 1}, got {str(begin)[:20]}")
        owner = self._epoch() % (1 << NUMBER_BITS)
        return {"ok": True, "owner": owner, "size": len(self._bundle), "from": begin, "piece": self._bundle[begin : begin + PIECE_CHARS]}


def origin_files(config: Config, model: Model) -> dict[str, str]:
    """Return the text of each file by its name."""
    files = {"config.toml": toml.write(config, without=PRIVATE)}
    source = model_source(config)
    if source is not None:
        files[source.name] = source.read_text(encoding="utf-8", errors="replace")
    equations = model_equations(model)
    if len(equations) <= MAX_EXPRESSION_CHARS:
        files["equations.txt"] = equations
    versions = {
        "rti_mpc": rti_mpc.__version__,
        "commit": machine.commit(CHECKOUT),
        "messages": MESSAGE_VERSION,
        "config_hash": config.config_hash,
        "code_sha256": code_hash(),
        "model_file": source.name if source is not None else None,
        "model_sha256": sha256(equations.encode()).hexdigest(),
        "build": [shutil.which("cc") or "CasADi's virtual machine", *flags_of(config.solver.build)],
        "machine": machine.machine_info(),
    }
    return {**files, "versions.json": json.dumps(versions, indent=1)}


def model_source(config: Config) -> Path | None:
    """Return the file of the model's function; None if there is none in Python."""
    module = SHIPPED_MODELS.get(config.model.name, config.model.name).rpartition(":")[0]
    beside = Path(config.model.folder or "", module if module.endswith(".py") else module.replace(".", "/") + ".py")
    if beside.is_file():
        return beside
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return Path(spec.origin) if spec is not None and spec.origin is not None and spec.origin.endswith(".py") else None


def model_equations(model: Model) -> str:
    """Return the model's equations as text."""
    parts = {"states": model.states, "inputs": model.inputs, "outputs": model.outputs, "parameters": model.parameters}
    names = [f"{name}: {', '.join(f'{signal.name} [{signal.unit}]' for signal in signals)}" for name, signals in parts.items()]
    equations = [f"dx/dt: {model.f_expl_expr}"] if model.dt is None else [f"x after {model.dt:g} s: {model.disc_dyn_expr}"]
    return "\n".join([f"model: {model.name}", *names, *equations, f"y: {model.y_expr}", f"p: {list(model.p_nominal)}", ""])


def model_hash(model: Model) -> str:
    """Return the hash of all that a controller knows of its model: of one name, two hosts may have other code."""
    content = f"{model_equations(model)}h: {model.h_expr}\nstop: {model.stop_expr}\nat rest: {model.u_rest}\n"
    return sha256(content.encode()).hexdigest()[:16]


def code_hash() -> str:
    """Return the hash of the library's Python files: two processes with the same one run the same code."""
    folder, digest = Path(rti_mpc.__file__).parent, sha256()
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
