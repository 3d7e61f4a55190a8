# SPDX-License-Identifier: Apache-2.0
"""Compiled functions: the same numbers as the interpreted ones, cached, and never an obstacle to a start."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from rti_mpc import codegen
from rti_mpc.array import Array
from rti_mpc.cache import cache_dir
from rti_mpc.codegen import bind, compiled
from rti_mpc.errors import ShapeError
from tests.processes.system import until

pytestmark = pytest.mark.usefixtures("optimizing")
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler on this machine")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "rti_mpc"


def product() -> ca.Function:
    """``(2, 3)`` times ``(3,)``, and the sine of it."""
    A, b = ca.SX.sym("A", 2, 3), ca.SX.sym("b", 3)
    return ca.Function("product", [A, b], [A @ b, ca.sin(A @ b)], ["A", "b"], ["c", "s"])


def arrays() -> tuple[Array, Array, Array, Array]:
    rng = np.random.default_rng(1)
    return rng.normal(size=(3, 2)), rng.normal(size=3), np.zeros(2), np.zeros(2)


@needs_compiler
def test_compiled_function_is_machine_code_and_gives_the_same_numbers(cache: Path) -> None:
    assert cache_dir() == cache
    (fast,) = compiled(product())
    assert fast.class_name() == "External"
    A, b, c, s = arrays()
    bind(fast, {"A": A, "b": b}, {"c": c, "s": s})()
    np.testing.assert_allclose(c, A.T @ b, rtol=1e-15)
    np.testing.assert_allclose(s, np.sin(A.T @ b), rtol=1e-15)


@needs_compiler
def test_second_build_comes_from_the_cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled(product())
    (library,) = cache.iterdir()
    assert library.suffix == ".so"
    monkeypatch.setattr(codegen, "build", lambda *_: pytest.fail("built twice"))
    assert compiled(product())[0].class_name() == "External"


def truncated(library: Path, size: int) -> None:
    os.truncate(library, size)


def swapped(library: Path, text: str) -> None:
    """As a program with our rights may, or a backup: a shared object of another content under this name."""
    source = library.with_name("other.c")
    source.write_text(text)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True)
    source.unlink()


def another_problem(library: Path) -> None:
    """The same function names, whole and sealed, other numbers."""
    x, y = ca.SX.sym("A", 2, 3), ca.SX.sym("b", 3)
    compiled(ca.Function("product", [x, y], [2.0 * x @ y, x @ y], ["A", "b"], ["c", "s"]))
    (other,) = set(library.parent.iterdir()) - {library}
    other.replace(library)


def linked(library: Path) -> None:
    library.rename(library.with_suffix(".moved"))
    library.symlink_to(library.with_suffix(".moved"))


@needs_compiler
@pytest.mark.parametrize(
    "harm",
    [
        lambda library: truncated(library, 0),
        lambda library: truncated(library, 8192),
        lambda library: truncated(library, library.stat().st_size - 1),
        lambda library: library.write_bytes(library.read_bytes()[:-1] + b"x"),
        lambda library: swapped(library, "__attribute__((constructor)) static void f(void) { __builtin_trap(); }"),
        another_problem,
        linked,
        lambda library: library.chmod(0o666),
        pytest.param(lambda library: os.chown(library, 12345, 12345), marks=needs_root),
    ],
    ids=["emptied", "cut off", "a byte short", "a byte changed", "swapped", "of another problem", "a link", "writable by all", "another's"],
)
def test_file_in_the_cache_that_is_not_whole_and_ours_is_built_anew_and_never_loaded(cache: Path, harm: Callable[[Path], None]) -> None:
    compiled(product())
    (library,) = cache.iterdir()
    content = library.read_bytes()
    harm(library)
    (fast,) = compiled(product())
    A, b, c, s = arrays()
    bind(fast, {"A": A, "b": b}, {"c": c, "s": s})()
    np.testing.assert_allclose(c, A.T @ b, rtol=1e-15)
    assert (library.read_bytes(), library.is_symlink(), library.stat().st_mode & 0o777) == (content, False, 0o600)
    assert library.stat().st_uid == os.geteuid()


@needs_compiler
@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda cache: cache.chmod(0o777), "nobody else may write: chown it, and chmod 700"),
        (lambda cache: cache.parent.chmod(0o777), "above .*rti_mpc, must belong to root or this user, and not be writable by all"),
        pytest.param(lambda cache: os.chown(cache, 12345, 12345), "a folder of this user", marks=needs_root),
    ],
    ids=["writable by all", "in a folder writable by all", "another's"],
)
def test_folder_that_others_may_write_is_not_used_and_said_so_once_in_one_line(cache: Path, harm: Callable[[Path], None], told: str) -> None:
    compiled(product())
    (library,) = cache.iterdir()
    swapped(library, "__attribute__((constructor)) static void f(void) { __builtin_trap(); }")
    harm(cache)
    with pytest.warns(UserWarning, match=told) as warned:
        assert compiled(product())[0].class_name() == "External", "compiled all the same"
    assert ["\n" in str(warning.message) for warning in warned] == [False]


@needs_compiler
@pytest.mark.parametrize("environment", [{}, {"XDG_CACHE_HOME": "relative"}], ids=["nothing", "a relative folder"])
def test_user_without_a_home_compiles_without_a_cache(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)

    def nobody(uid: int) -> None:
        raise KeyError(uid)

    monkeypatch.setattr("pwd.getpwuid", nobody)
    with pytest.warns(UserWarning, match="XDG_CACHE_HOME or HOME must name a folder"):
        assert compiled(product())[0].class_name() == "External"


@needs_compiler
def test_disk_that_fills_up_leaves_nothing_half_written(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.warns(UserWarning) as warned:
        compiled(product())
    assert "No space left on device" in str(warned[0].message)
    assert list(cache.iterdir()) == []


def full_disk(_: int) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@needs_compiler
def test_another_function_of_the_same_name_is_built_anew(cache: Path) -> None:
    x = ca.SX.sym("x")
    one, two = (compiled(ca.Function("g", [x], [k * x]))[0] for k in (1, 2))
    assert (float(one(3)), float(two(3))) == (3.0, 6.0)
    assert len(list(cache.iterdir())) == 2


def test_machine_without_a_compiler_interprets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    function = product()
    assert compiled(function)[0] is function


@pytest.mark.parametrize("script", ["#!/bin/sh\nexit 1\n", "#!/bin/sh\nwhile [ $# -gt 0 ]; do [ $1 = -o ] && echo junk > $2; shift; done\n"])
def test_compiler_that_fails_or_lies_is_no_error(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    broken = tmp_path / "cc"
    broken.write_text(script)
    broken.chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda _: str(broken))
    function = product()
    with pytest.warns(UserWarning) as warned:
        assert compiled(function)[0] is function
    assert str(warned[-1].message).startswith("product is interpreted, several times slower than compiled")
    assert not any("\n" in str(warning.message) for warning in warned)


def test_no_compiler_is_left_when_another_one_beside_it_fails(tmp_path: Path) -> None:
    begun, worker, compiler = tmp_path / "begun", tmp_path / "worker", tmp_path / "cc"
    os.mkfifo(begun)
    compiler.write_text(f"""#!/bin/sh
case "$*" in
  *-E*) exit 1 ;;
  *functions_1.c) sh -c 'echo $$ > {worker}; echo > {begun}; exec sleep 20'; exit ;;
  *) read _ < {begun}; echo no such type >&2; exit 1 ;;
esac
""")
    compiler.chmod(0o755)
    with pytest.raises(subprocess.CalledProcessError) as raised:
        codegen.build([str(compiler)], ["first", "second"])
    assert raised.value.stderr == b"no such type\n"
    doing = Path("/proc", worker.read_text().strip(), "cmdline")  # of what the other one had started
    until(lambda: not doing.exists() or doing.read_bytes() == b"", "it has ended", 0.001, 10.0)


@needs_compiler
def test_cache_that_cannot_be_written_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="compiled code is not kept for the next start: .*Not a directory"):
        assert compiled(product())[0].class_name() == "External"


@pytest.mark.parametrize("make", [compiled, lambda function: [function]], ids=["compiled", "interpreted"])
def test_bound_function_follows_its_arrays_and_writes_in_place(make: Any) -> None:
    A, b, c, s = arrays()
    call = bind(make(product())[0], {"A": A, "b": b}, {"c": c, "s": s})
    for _ in range(3):
        A += 1.0
        b *= -0.5
        call()
        np.testing.assert_allclose(c, A.T @ b, rtol=1e-14)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda A, b, c, s: (A[:2], b, c, s), r"product: A must be a C-contiguous float64 array of shape \(3, 2\), got float64 of shape \(2, 2\)"),
        (lambda A, b, c, s: (np.asfortranarray(A), b, c, s), "product: A must be a C-contiguous"),
        (lambda A, b, c, s: (A, np.zeros(6)[::2], c, s), "product: b must be a C-contiguous"),
        (lambda A, b, c, s: (A, b.astype(np.float32), c, s), "got float32"),
        (lambda A, b, c, s: (A, b, np.zeros(3), s), "product: c must be"),
        (lambda A, b, c, s: (A, b, c, np.zeros(2, dtype=np.int64)), "product: s must be .* got int64"),
    ],
)
def test_array_that_casadi_would_misread_is_refused_by_name(change: Any, message: str) -> None:
    A, b, c, s = change(*arrays())
    with pytest.raises(ShapeError, match=message):
        bind(product(), {"A": A, "b": b}, {"c": c, "s": s})


@pytest.mark.parametrize(
    ("inputs", "outputs", "names"),
    [
        (("A",), ("c", "s"), r"\['A', 'b'\], got \['A'\]"),
        (("A", "b", "x"), ("c", "s"), r"\['A', 'b'\], got \['A', 'b', 'x'\]"),
        (("A", "b"), ("c", "S"), r"\['c', 's'\], got \['c', 'S'\]"),
    ],
)
def test_names_that_are_not_those_of_a_function_are_refused(inputs: tuple[str, ...], outputs: tuple[str, ...], names: str) -> None:
    A, b, c, s = arrays()
    known = {"A": A, "b": b, "x": b, "c": c, "s": s, "S": s}
    with pytest.raises(AssertionError, match=f"product must be bound to {names}"):
        bind(product(), {name: known[name] for name in inputs}, {name: known[name] for name in outputs})


def test_order_in_which_arrays_are_named_does_not_matter() -> None:
    A, b, c, s = arrays()
    bind(product(), {"A": A, "b": b}, {"c": c, "s": s})()
    expected = c.copy(), s.copy()
    c[:], s[:] = 0.0, 0.0
    bind(product(), {"b": b, "A": A}, {"s": s, "c": c})()
    np.testing.assert_array_equal(c, expected[0])
    np.testing.assert_array_equal(s, expected[1])


def test_arrays_stay_alive_as_long_as_the_call() -> None:
    def make() -> tuple[Any, Array]:
        A, b, c, s = arrays()
        return bind(product(), {"A": A, "b": b}, {"c": c, "s": s}), c

    call, c = make()
    garbage = [np.full(6, 1e9) for _ in range(1000)]
    call()
    A, b, *_ = arrays()
    np.testing.assert_allclose(c, A.T @ b, rtol=1e-14)
    assert garbage[0][0] == 1e9
