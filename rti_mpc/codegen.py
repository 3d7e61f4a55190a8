# SPDX-License-Identifier: Apache-2.0
"""
Compile CasADi functions, and bind them to arrays that the caller owns.

The shared object is cached by content in the user's cache directory. Without a
compiler CasADi's virtual machine evaluates the same function into the same
arrays: slower, equal to rounding.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.errors import ShapeError

# No contraction into fused operations and no fast-math: a machine with a compiler and one without agree to rounding.
FLAGS = ("-O2", "-ffp-contract=off", "-shared", "-fPIC", "-w")


def cache_dir() -> Path:
    """Return where compiled functions are kept (XDG base directory specification)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rti_mpc"


def compiled(*functions: ca.Function) -> list[ca.Function]:
    """
    Return functions as machine code, or themselves where there is no compiler.

    They are compiled together, which takes half as long as one by one. A build
    that fails for whatever reason, a full disk or a broken compiler, is not an
    error: the virtual machine takes over.

    Args:
        functions: Of different names.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        return list(functions)
    generator = ca.CodeGenerator("functions", {"with_header": False})
    for function in functions:
        generator.add(function)
    source = generator.dump()
    key = hashlib.sha256("\0".join((source, compiler, *FLAGS, os.uname().machine)).encode()).hexdigest()[:32]
    library = cache_dir() / f"{functions[0].name()}-{key}.so"
    try:
        if not library.exists():
            build(compiler, source, library)
        return [ca.external(function.name(), str(library)) for function in functions]
    except (OSError, subprocess.CalledProcessError, RuntimeError):
        return list(functions)


def build(compiler: str, source: str, library: Path) -> None:
    """Compile into a temporary directory, then move: two processes that start at once never see half a file."""
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        code = Path(folder) / "function.c"
        code.write_text(source)
        made = code.with_suffix(".so")
        subprocess.run([compiler, *FLAGS, "-o", str(made), str(code), "-lm"], check=True, capture_output=True)
        made.replace(library)


def bind(function: ca.Function, arguments: Sequence[Array], results: Sequence[Array]) -> Callable[[], None]:
    """
    Fix where a function reads and writes, and return the call.

    CasADi counts column by column: a C-ordered array of shape ``(N, nx)`` is
    its ``(nx, N)``. Results are dense, or only their nonzeros are written.

    Args:
        function: Compiled or not.
        arguments: One array an input, owned by the caller, who keeps their memory in place.
        results: One array an output, overwritten by every call.

    Raises:
        ShapeError: An array is not C-contiguous float64 of the right size.
    """
    buffer, evaluate = cast(tuple[Any, Callable[[], None]], function.buffer())
    for arrays, count, name, sparsity, attach in (
        (arguments, function.n_in(), function.name_in, function.sparsity_in, buffer.set_arg),
        (results, function.n_out(), function.name_out, function.sparsity_out, buffer.set_res),
    ):
        assert len(arrays) == count
        for i, array in enumerate(arrays):
            if array.dtype != np.float64 or not array.flags.c_contiguous or array.size != sparsity(i).nnz():
                raise ShapeError(f"{function.name()}: {name(i)}", sparsity(i).shape[::-1], array)
            attach(i, array.data)

    evaluate.memory = (buffer, *arguments, *results)  # type: ignore[attr-defined] # lives as long as the call
    return evaluate
