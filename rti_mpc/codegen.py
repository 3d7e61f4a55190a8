# SPDX-License-Identifier: Apache-2.0
"""
Compilation of CasADi functions, and their binding to arrays that the caller owns.

The shared object is cached by content, see `rti_mpc.cache`. Without a compiler
CasADi's virtual machine evaluates the same function into the same arrays: slower,
equal to rounding.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import cache
from pathlib import Path
from typing import Any, cast

import casadi as ca
import numpy as np

from rti_mpc.array import Array
from rti_mpc.cache import cache_dir, is_intact, make_private, write_sealed
from rti_mpc.errors import ShapeError
from rti_mpc.units import FEWER_PASSES, FUNCTION, units

COMPILER_FLAGS = ("-O3", "-std=gnu89", "-fno-semantic-interposition", "-shared", "-fPIC", "-w")  # no fast-math

# What a build may use. A portable one has no contraction into fused operations: it agrees with CasADi's virtual machine as far as orders of sums do.
# It has the longer vectors of a processor that has them, in which each number is what it is without.
# With longer vectors than 256 bits, GCC 12 mixes two lengths in a loop, and takes data for aligned that are not.
BUILDS = {"portable": ("-ffp-contract=off",), "native": ("-march=native", "-mprefer-vector-width=256", "-ffp-contract=fast")}

COMPILER_RATE = 60_000  # characters of source per s, as measured on a virtual core
SPARED_RATE = 180_000  # the same of units that are spared passes

BEFORE_BODY = "\f"  # divides what stands before a function in C from its body
_bodies: dict[str, str] = {}  # what `function_in_c` was given, by the name of the function, which ends with a hash of it

# Entered while the compiler runs, with how long that should take, in s: whoever has a terminal or a log puts something here that tells of it.
while_compiling: Callable[[float], AbstractContextManager[object]] = nullcontext


def flags_of(build: str) -> tuple[str, ...]:
    """Return the compiler's flags for a build, by its name in `BUILDS`."""
    return tuple(flag for flag in (*BUILDS[build], *COMPILER_FLAGS) if os.uname().machine == "x86_64" or not flag.startswith("-mprefer-"))


def longer_vectors() -> tuple[str, ...]:
    """Return the compiler's flags for vectors of 256 bits, if this processor has them."""
    return ("-mavx",) if os.uname().machine == "x86_64" and "avx" in processor_flags().split() else ()


@cache
def resolved(compiler: str, flags: tuple[str, ...]) -> str:
    """Return what a compiler makes of its flags on this processor: of ``-march=native`` another list on another one; empty if it refuses them."""
    asked = [compiler, *flags, "-v", "-E", "-x", "c", os.devnull, "-o", os.devnull]
    said = subprocess.run(asked, capture_output=True, check=False, env={"PATH": os.defpath, **os.environ, "LC_ALL": "C"})
    return "" if said.returncode else "\n".join(line for line in said.stderr.decode(errors="replace").splitlines() if "cc1" in line)


def processor_flags() -> str:
    """Return what this processor can do, as the system tells it; empty if it does not."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def compiled(*functions: ca.Function, build: str = "portable") -> list[ca.Function]:
    """
    Return functions as machine code, or themselves where there is no compiler.

    They are compiled together, which takes half as long as one by one. If the cache
    cannot be used or trusted, they are compiled at every start. If compilation fails,
    CasADi's virtual machine evaluates them. Either is reported by a warning of one line.

    Args:
        functions: Functions with different names.
        build: ``"portable"`` for the same numbers on any processor of this kind, or ``"native"``, for this very one; see `BUILDS`.
    """
    found = shutil.which("cc")
    if found is None:
        return list(functions)
    compiler = str(Path(found).absolute())
    generator = ca.CodeGenerator("functions", {"with_header": False})
    for function in functions:
        generator.add(function)
    sources = units(with_bodies(generator.dump()))
    native = build == "native"
    flags = flags_of(build) if native else (*flags_of(build), *longer_vectors())
    target = (resolved(compiler, flags), processor_flags()) if native else (os.uname().machine,)
    key = hashlib.sha256("\0".join((*sources, compiler, *flags, *target)).encode()).hexdigest()[:32]
    name = f"{functions[0].name()}-{key}.so"
    try:
        try:
            folder = cache_dir()
            make_private(folder)
            return load(functions, folder / name, key, [compiler, *flags], sources)
        except OSError as error:
            warnings.warn(f"compiled code is not kept for the next start: {error}", stacklevel=2)
        with tempfile.TemporaryDirectory(prefix="rti_mpc-") as private:
            return load(functions, Path(private) / name, key, [compiler, *flags], sources)
    except (OSError, subprocess.CalledProcessError) as error:
        warnings.warn(f"{functions[0].name()} is interpreted, several times slower than compiled: {_brief(error)}", stacklevel=2)
        return list(functions)


def load(functions: Sequence[ca.Function], library: Path, key: str, compiler: Sequence[str], sources: Sequence[str]) -> list[ca.Function]:
    """
    Load functions from a file, which is built first if it is not there or fails a check, see `rti_mpc.cache`.

    Raises:
        OSError: The file cannot be written, or not be loaded.
        CalledProcessError: The compiler failed.
    """
    if not is_intact(library, key):
        write_sealed(library, key, build(compiler, sources))
    try:
        path = os.fsencode(library).decode()  # CasADi needs UTF-8 in any locale
        return [ca.external(function.name(), path) for function in functions]
    except (RuntimeError, UnicodeDecodeError) as error:
        why = str(error).partition("Error code: ")[2] or str(error)
        raise OSError(f"{library} cannot be loaded: {_first_line(why)}") from None


def build(compiler: Sequence[str], sources: Sequence[str]) -> bytes:
    """
    Compile translation units, see `rti_mpc.units`, by a compiler with its flags, and return the shared object.

    The first unit is compiled beside all others: on two cores that halves the time.
    """
    rest, *alone = sources
    took_s = max(len(rest) / COMPILER_RATE, sum(map(len, alone)) / SPARED_RATE)
    with tempfile.TemporaryDirectory(prefix="rti_mpc-") as folder, while_compiling(took_s):
        files = [Path(folder) / f"functions_{number}.c" for number in range(len(sources))]
        for file, source in zip(files, sources, strict=True):
            file.write_text(source, encoding="utf-8")
        names = [file.name for file in files]
        fewer = FEWER_PASSES if alone and resolved(compiler[0], FEWER_PASSES) else ()
        _run_together(folder, [*compiler, "-c", names[0]], *([[*compiler, "-c", *fewer, *names[1:]]] if alone else ()))
        _run_together(folder, [*compiler, "-o", "functions.so", *(file.with_suffix(".o").name for file in files), "-lm"])
        return (Path(folder) / "functions.so").read_bytes()


def _run_together(folder: str, *commands: Sequence[str]) -> None:
    """
    Run commands in a folder at the same time, and wait for all of them; none is left when this ends, however it does.

    Raises:
        CalledProcessError: One has failed.
    """
    environment = {"PATH": os.defpath, **os.environ}  # where the compiler was looked for, for its linker
    with ExitStack() as running:
        processes = []
        for command in commands:
            process = subprocess.Popen(
                command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
            )
            processes.append(running.enter_context(process))
            running.callback(_end, process)  # before its context waits for it
        for process in processes:
            _, said = process.communicate()
            if process.returncode:
                raise subprocess.CalledProcessError(process.returncode, process.args, stderr=said)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill a process, and those that it has started: a compiler works in others."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)


def _brief(error: Exception) -> str:
    """Return the first line of an error, a compiler's own where it has one."""
    said = getattr(error, "stderr", None)
    return _first_line(said.decode(errors="replace") if said else str(error))


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


def function(name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> ca.Function:
    """Build a CasADi function from expressions by name; no output may have the name of an input."""
    return ca.Function(name, [*inputs.values()], [*outputs.values()], [*inputs], [*outputs])


def function_in_c(name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any], body: str) -> ca.Function:
    """
    Build a function as `function`, and give the code that is compiled in place of the generated one.

    Args:
        name: Its name, to which a hash of the body is added: two functions with one name have the same body.
        inputs: Its arguments by name.
        outputs: Its results by name, as the virtual machine evaluates them.
        body: The same function in C, from the arguments of a CasADi function, ``arg, res, iw, w``, of which it uses no more than the
            expressions do. It calls a function that they call as ``$name(arg, res, iw, w, 0)``. What it declares outside comes first, before
            `BEFORE_BODY`.
    """
    unique = f"{name}_{hashlib.sha256(body.encode()).hexdigest()[:16]}"
    _bodies[unique] = body
    return function(unique, inputs, outputs)


CALL = re.compile(r"casadi_f\d+(?=\()")  # of a static function, as CasADi names them; what it exports is declared otherwise


def with_bodies(source: str) -> str:
    """Replace functions in generated code by what `function_in_c` has been given, and remove those that are not called then."""
    found = list(FUNCTION.finditer(source))
    symbols: dict[str, set[str]] = {}
    for match in found:
        symbols.setdefault(match["name"], set()).add(match["symbol"])

    def called(match: re.Match[str]) -> str:
        (symbol,) = symbols[match[1]]
        return symbol

    parts, rest = [], len(source)
    needed = set(CALL.findall(FUNCTION.sub("", source)))
    for match in reversed(found):  # a function stands before those that call it
        text = match[0]
        if match["name"] in _bodies:
            before, _, body = re.sub(r"[$](\w+)", called, _bodies[match["name"]]).rpartition(BEFORE_BODY)
            text = f"{before}{text[: match.start('body') - match.start()]}{body}\n}}\n"
        if match["symbol"] not in needed:
            text = ""
        needed.update(CALL.findall(text))
        parts += [source[match.end() : rest], text]
        rest = match.start()
    return "".join(reversed([*parts, source[:rest]]))


def at_points(function: ca.Function, *points: Array) -> Array:
    """
    Evaluate a function at many points at once, ten times as fast as CasADi, which converts arrays number by number.

    Args:
        function: A CasADi function with one result.
        points: A row per point of each argument, shapes ``(n, size)``.

    Returns:
        A row per column of the results, shape ``(n * columns, rows)``.
    """
    if not function.sparsity_out(0).is_dense():
        symbols = function.mx_in()
        function = ca.Function(function.name(), symbols, [ca.densify(function(*symbols))])
    many = function.map(len(points[0]))
    found: Array = np.empty(many.size_out(0)[::-1])
    given = (np.ascontiguousarray(rows, dtype=float) for rows in points)
    bind(many, dict(zip(many.name_in(), given, strict=True)), {many.name_out(0): found})()
    return found


def bind(function: ca.Function, inputs: Mapping[str, Array], outputs: Mapping[str, Array]) -> Callable[[], None]:
    """
    Fix the arrays that a function reads and writes, and return the call.

    CasADi stores matrices column by column: a C-ordered array of shape ``(N, nx)`` is its
    ``(nx, N)``. Outputs are dense, or only their nonzeros are written.

    Args:
        function: A CasADi function, compiled or not.
        inputs: One array for each input, by its name, owned by the caller, who must keep its memory in place.
        outputs: One array for each output, by its name, overwritten by every call.

    Raises:
        ShapeError: An array is not C-contiguous float64 of the right size.
    """
    buffer, evaluate = cast(tuple[Any, Callable[[], None]], function.buffer())
    for arrays, names, sparsity, attach in (
        (inputs, function.name_in(), function.sparsity_in, buffer.set_arg),
        (outputs, function.name_out(), function.sparsity_out, buffer.set_res),
    ):
        assert set(arrays) == set(names), f"{function.name()} must be bound to {names}, got {[*arrays]}"
        for i, name in enumerate(names):
            array = arrays[name]
            if array.dtype != np.float64 or not array.flags.c_contiguous or array.size != sparsity(i).nnz():
                raise ShapeError(f"{function.name()}: {name}", sparsity(i).shape[::-1], array, "a C-contiguous float64 array")
            attach(i, array.data)

    evaluate.memory = (buffer, *inputs.values(), *outputs.values())  # type: ignore[attr-defined] # lives as long as the call
    return evaluate
