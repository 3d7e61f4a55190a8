# SPDX-License-Identifier: Apache-2.0
"""
Search for a model by its name: a shipped one, or a function of the user's own.

A module of the user's is looked for beside his configuration first. It is loaded
under a name that holds its folder, so that modules of one name in two folders are two,
and one that is called like a module of Python's own takes nobody's place.
"""

from __future__ import annotations

import importlib
import re
import sys
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from hashlib import sha256
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import CodeType, ModuleType

import rti_mpc
from rti_mpc.errors import OcpError
from rti_mpc.given import nearest
from rti_mpc.model.model import Model

SHIPPED = (
    "pioneer_3dx",
    "unicycle",
    "differential_drive",
    "kinematic_bicycle",
    "dynamic_bicycle",
    "truck_trailer",
    "omnidirectional",
    "boat",
    "quadrotor",
    "quadrotor_quaternion",
    "two_link_arm",
    "cart_pole",
    "chain",
)
SHIPPED_MODELS = {name: f"rti_mpc.model.robots.{name}:{name}" for name in SHIPPED}
MODEL_NAME_PATTERN = re.compile(r"([^\W\d]\w*(?:\.[^\W\d]\w*)*|.+\.py):([^\W\d]\w*)")  # package.module:function, file.py:function
PACKAGE_PREFIX = "rti_mpc_beside_"  # of the package that stands for a folder


def find_model(name: str, folder: Path | None = None) -> Model:
    """
    Find a model.

    Args:
        name: That of a shipped one, or ``package.module:function`` or ``file.py:function`` of the user's own.
        folder: Where module or file are looked for first; a module that is not there must be installed. None: the working directory for a file.

    Raises:
        OcpError: There is no such model, its module cannot be imported, or the function returns none. One line, which names the user's file and line.
    """
    wanted = f"a model must be one of {', '.join(SHIPPED_MODELS)} or an importable package.module:function of your own, got {name!r}"
    match = MODEL_NAME_PATTERN.fullmatch(SHIPPED_MODELS.get(name, name)) if isinstance(name, str) else None
    if match is None:
        raise OcpError(wanted + nearest(name, SHIPPED_MODELS))
    module_name, function_name = match.groups()
    if module_name.endswith(".py"):
        file = Path(folder or "", module_name)
        folder, module_name = file.parent, file.stem
        if not file.is_file():
            raise OcpError(f"{wanted} ({file} is no file)")
    with beside(folder) as package:
        try:
            module = load(module_name, package)
        except ModuleNotFoundError as error:
            if not f"{module_name}.".startswith(f"{error.name}."):
                raise OcpError(f"{module_name} must be importable, {raised(error)}") from error
            where = "" if folder is None else f", neither in {folder} nor installed"
            raise OcpError(f"{wanted} ({error}{where})") from None
        except (Exception, SystemExit) as error:
            raise OcpError(f"{module_name} must be importable, {raised(error)}") from error
        if module is None:
            raise OcpError(f"{wanted} ({module_name.partition('.')[0]} is Python's own)")
        build: Callable[[], Model] | None = getattr(module, function_name, None)
        if not callable(build):
            near = get_close_matches(function_name, [name for name, value in vars(module).items() if callable(value)], 1)
            perhaps = f", perhaps {near[0]} is meant" if near else ""
            raise OcpError(f"{wanted} ({file_of(module) or module_name} has no function {function_name}{perhaps})")
        code = getattr(build, "__code__", None)
        try:
            model = build()
        except (Exception, SystemExit) as error:  # a user's function may raise anything; the error names it as the user's
            raise OcpError(f"{name} must return a model, {raised(error, code)}") from error
        if not isinstance(model, Model):
            raise OcpError(f"{name} must return a rti_mpc.Model, got {type(model).__name__}{at(code)}")
    return model


def load(module_name: str, package: str) -> ModuleType | None:
    """
    Import a module from the folder that a package stands for, or else an installed one; None if that is Python's own.

    Raises:
        ModuleNotFoundError: There is none, or one that it imports.
    """
    if package:
        try:
            module = importlib.import_module(f"{package}.{module_name}")
            if file_of(module):  # not a mere folder of this name
                return module
        except ModuleNotFoundError as error:
            if not f"{package}.{module_name}.".startswith(f"{error.name}."):
                raise
    if module_name.partition(".")[0] in sys.stdlib_module_names:
        return None
    module = importlib.import_module(module_name)
    if not file_of(module):
        raise ModuleNotFoundError(f"No module named {module_name!r}", name=module_name)
    return module


class Beside:
    """
    Finder of what a user's module imports from its own folder: before what is installed, never in place of Python's own.

    Attributes:
        found: Names of top-level modules that were found there.
    """

    def __init__(self, folder: Path) -> None:
        self._path = [str(folder)]
        self.found: set[str] = set()

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Find a top-level module, as `importlib.abc.MetaPathFinder` has it."""
        if path is not None or name in sys.stdlib_module_names or name.startswith(PACKAGE_PREFIX):
            return None
        spec = PathFinder.find_spec(name, self._path)
        if spec is None or (spec.origin is None and PathFinder.find_spec(name) is not None):  # a mere folder comes after what is installed
            return None
        self.found.add(name)
        return spec


@contextmanager
def beside(folder: Path | None) -> Iterator[str]:
    """Let imports look into a folder first, and forget its names afterwards; yield the name of the package that stands for it, empty without one."""
    if folder is None:
        yield ""
        return
    folder = folder.resolve()
    package = ModuleType(PACKAGE_PREFIX + sha256(str(folder).encode(errors="surrogateescape")).hexdigest()[:16])
    package.__path__ = [str(folder)]
    sys.modules.setdefault(package.__name__, package)
    finder = Beside(folder)
    importlib.invalidate_caches()  # a file written a moment ago is there
    sys.meta_path.insert(0, finder)
    try:
        yield package.__name__
    finally:
        sys.meta_path.remove(finder)
        for name in [name for name in sys.modules if name.partition(".")[0] in finder.found]:
            del sys.modules[name]


def file_of(module: ModuleType) -> str:
    """Return the file of a module, empty if it has none."""
    return getattr(module, "__file__", None) or ""


def at(code: CodeType | None) -> str:
    """Say where a function is, empty for one that is not written in Python."""
    return "" if code is None else f" in {code.co_filename}, line {code.co_firstlineno}"


def raised(error: BaseException, code: CodeType | None = None) -> str:
    """Return in one line what a user's code has raised, and where: in the user's own line, or else in the function that was called."""
    kind, text = type(error).__name__, " ".join(str(error).split()) or "nothing said"
    if isinstance(error, SyntaxError) and error.filename:
        return f"it raised {kind} in {error.filename}, line {error.lineno}: {error.msg}"
    foreign = (str(Path(rti_mpc.__file__).parent), "<", sysconfig.get_paths()["purelib"], sysconfig.get_paths()["stdlib"])
    theirs = [frame for frame in traceback.extract_tb(error.__traceback__) if not frame.filename.startswith(foreign)]
    where = f" in {theirs[-1].filename}, line {theirs[-1].lineno}" if theirs else at(code)
    return f"it raised {kind}{where}: {re.sub(rf'{PACKAGE_PREFIX}[0-9a-f]+[.]', '', text)}"
