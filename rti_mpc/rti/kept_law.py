# SPDX-License-Identifier: Apache-2.0
"""
Laws of ways to rest, kept between starts beside the compiled code.

Finding one takes long, 15 s of CPU time for a quadrotor, for which a robot whose
controller was killed would stand. A law is kept under a hash of everything that it is
found from: the whole problem, the disturbances, the delay, and this library's own code.
That a robot needs none is kept likewise: to let it come to rest from many states takes
70 ms for the one of the paper.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, fields
from functools import cache
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.cache import SEAL_BYTES, cache_dir, is_intact, make_private, write_sealed
from rti_mpc.model.model import Model
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.rest import UNDISTURBED, find_stop_law
from rti_mpc.rti.way_to_rest import StopLaw


def find_kept_stop_law(ocp: Ocp, disturbances: Array = UNDISTURBED, delay_s: float = 0.0) -> StopLaw | None:
    """
    Return what `rti_mpc.rti.rest.find_stop_law` does, from the last start that has found it, where there was one.

    A file that fails a check is written anew; without a folder for it, the law is found at every start.

    Raises:
        OcpError: As there.
    """
    key = fingerprint(ocp, disturbances, delay_s)
    try:
        folder = cache_dir()
        make_private(folder)
        path = folder / f"stop-{key[:32]}.npz"
        if is_intact(path, key):
            return law_of(path.read_bytes()[:-SEAL_BYTES])
    except OSError:
        return find_stop_law(ocp, disturbances, delay_s)
    law = find_stop_law(ocp, disturbances, delay_s)
    with suppress(OSError):
        write_sealed(path, key, content_of(law))
    return law


def content_of(law: StopLaw | None) -> bytes:
    """Return a law as the bytes of a file of arrays, of none for a robot that needs none."""
    held = BytesIO()
    np.savez(held, **({} if law is None else asdict(law)))
    return held.getvalue()


def law_of(content: bytes) -> StopLaw | None:
    """Return the law of `content_of`."""
    with np.load(BytesIO(content), allow_pickle=False) as held:
        values: dict[str, Any] = {name: held[name] if held[name].ndim else held[name].item() for name in held.files}
    return StopLaw(**values) if values else None


def fingerprint(ocp: Ocp, disturbances: Array, delay_s: float) -> str:
    """Return a hash of everything that a law is found from."""
    found_from = (code(), *parts(ocp, ocp.model), repr(disturbances.tolist()), repr(delay_s))
    return hashlib.sha256("\0".join(found_from).encode()).hexdigest()


def parts(of: Ocp | Model, model: Model) -> Iterator[str]:
    """Yield every field of a problem and of its model as text: expressions as CasADi serializes them, numbers to the last bit."""
    for field in fields(of):
        value = getattr(of, field.name)
        if isinstance(value, Model):
            yield from parts(value, model)
        elif isinstance(value, ca.SX):
            yield f"{field.name}={ca.Function(field.name, [model.x, model.u, model.p], [value]).serialize()}"
        else:
            yield f"{field.name}={value.tolist() if isinstance(value, np.ndarray) else value!r}"


@cache
def code() -> str:
    """Return a hash of this library's own code, and of what computes for it."""
    folder = Path(__file__).parents[1]
    sources = (path.read_bytes() for path in sorted(folder.rglob("*.py")))
    return hashlib.sha256(b"\0".join((version("casadi").encode(), version("numpy").encode(), *sources))).hexdigest()
