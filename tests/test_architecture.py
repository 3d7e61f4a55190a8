# SPDX-License-Identifier: Apache-2.0
"""Rules of the folders, checked by the imports of each file."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = {"rti_mpc": ROOT / "rti_mpc", "rti_mpc_service": ROOT / "service/rti_mpc_service", "rti_mpc_sim": ROOT / "sim/rti_mpc_sim"}

# What the files of a folder may import of the library, beside their own folder and the files beside the folders.
LIBRARY = {
    "rti_mpc": set(),
    "rti_mpc.model": set(),
    "rti_mpc.model.robots": {"rti_mpc.model"},
    "rti_mpc.contract": set(),
    "rti_mpc.reference": {"rti_mpc.contract"},
    "rti_mpc.rti": {"rti_mpc.model", "rti_mpc.contract", "rti_mpc.rti.qp"},
    "rti_mpc.rti.qp": {"rti_mpc.contract", "rti_mpc.rti"},
    "rti_mpc.control": {"rti_mpc.model", "rti_mpc.contract", "rti_mpc.rti"},
    "rti_mpc.journal": {"rti_mpc.contract", "rti_mpc.control", "rti_mpc.rti", "rti_mpc.rti.qp"},
    "rti_mpc.wire": {"rti_mpc.contract"},
    "rti_mpc.adapter": {"rti_mpc.contract", "rti_mpc.wire"},
    "rti_mpc.recording": {"rti_mpc.contract", "rti_mpc.wire"},
}

# The commands of the service: none is a library of another. What they share is beside them, or in `config`, `host` and `rig`.
NAMES = ("bench", "check", "conformance", "controller", "demo", "doctor", "faults", "paper", "record", "replay", "status", "tune", "view")
COMMANDS = {f"rti_mpc_service.{name}" for name in NAMES}
BORROWED = {
    "rti_mpc_service.paper": {"rti_mpc_service.bench"},
    "rti_mpc_service.replay": {"rti_mpc_service.record"},
    "rti_mpc_service.commands": COMMANDS,
}  # command: what it takes of another all the same

# What no file of a package imports; one file of commands alone knows the simulation, lazily.
FORBIDDEN = {
    "rti_mpc": {"rti_mpc_service", "rti_mpc_sim", "asyncio", "logging", "pydantic", "typer", "rich"},
    "rti_mpc_service": {"rti_mpc_sim"},
    "rti_mpc_sim": {"rti_mpc_service", "osqp", "pydantic", "typer"},
}
SIMULATION = "service/rti_mpc_service/commands/robot.py"
CLOCKS = {"time", "datetime", "threading", "multiprocessing", "concurrent", "random"}  # what would make two runs of one sample differ

# The one place of a foreign package: files, or all files of a folder.
ALONE = {
    "osqp": {"rti_mpc/rti/qp/osqp.py"},
    "qpsolvers": {"rti_mpc/rti/qp"},
    "zenoh": {"rti_mpc/wire"},
    "rerun": {"service/rti_mpc_service/view"},
    "mcap": {"rti_mpc/recording"},
    "casadi": {
        *("rti_mpc/codegen.py", "rti_mpc/model", "rti_mpc/rti", "rti_mpc/control", "sim/rti_mpc_sim/plant.py"),
        *(f"service/rti_mpc_service/{name}" for name in ("bench", "check", "paper")),
    },
}

# Who reads what peers send, or have sent when it was recorded. Zenoh's own configuration is no peer's.
DOORS = {"decode": {"rti_mpc/wire/intake.py", "rti_mpc/recording/reader.py"}, "json.loads": {"rti_mpc/wire/document.py", "rti_mpc/wire/session.py"}}


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def files(package: str) -> list[Path]:
    return sorted(PACKAGES[package].rglob("*.py"))


def every_file() -> Iterator[Path]:
    for package in PACKAGES:
        yield from files(package)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imported(path: Path) -> set[str]:
    """Full names of all that a file imports, in functions too."""
    names = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def roots(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imported(path)}


def folder_of(name: str) -> str:
    """Import package of the folder that a full name lies in, as ``rti_mpc.rti.qp``."""
    top, *rest = name.split(".")
    folder, path = [top], PACKAGES[top]
    for part in rest:
        path /= part
        if not path.is_dir():
            break
        folder.append(part)
    return ".".join(folder)


def folder_of_file(path: Path) -> str:
    package = next(name for name, root in PACKAGES.items() if root in path.parents)
    return ".".join([package, *path.parent.relative_to(PACKAGES[package]).parts])


def folders_imported(path: Path) -> set[str]:
    """Folders of ours that a file imports from, but for its own."""
    return {folder_of(name) for name in imported(path) if name.partition(".")[0] in PACKAGES} - {folder_of_file(path)}


@pytest.mark.parametrize("package", FORBIDDEN)
def test_package_does_not_import_upwards(package: str) -> None:
    assert files(package)
    for path in files(package):
        if relative(path) != SIMULATION:
            assert not roots(path) & FORBIDDEN[package], path


@pytest.mark.parametrize("folder", LIBRARY)
def test_folder_of_the_library_imports_only_from_folders_before_it(folder: str) -> None:
    paths = [path for path in files("rti_mpc") if folder_of_file(path) == folder and path != ROOT / "rti_mpc/__init__.py"]
    assert paths
    for path in paths:
        assert folders_imported(path) <= LIBRARY[folder] | {"rti_mpc"}, path


def test_every_folder_of_the_library_has_its_place() -> None:
    assert {folder_of_file(path) for path in files("rti_mpc")} == set(LIBRARY)


def test_command_is_no_library_of_another() -> None:
    for path in files("rti_mpc_service"):
        folder = folder_of_file(path)
        if folder != "rti_mpc_service":
            assert folders_imported(path) & COMMANDS <= BORROWED.get(folder, set()), path


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_imports_itself_by_way_of_others(package: str) -> None:
    names = {".".join([package, *path.relative_to(PACKAGES[package]).with_suffix("").parts]): path for path in files(package)}
    imports = {name: {each.rpartition(".")[0] for each in imported(path)} | imported(path) for name, path in names.items()}
    left = {name: {other for other in of if other in names} for name, of in imports.items()}
    while free := {name for name, of in left.items() if not of}:
        left = {name: of - free for name, of in left.items() if name not in free}
    assert not left, "each of these imports another of them, or itself"


def test_library_has_no_clock_and_no_thread_but_on_the_bus() -> None:
    for path in files("rti_mpc"):
        if folder_of_file(path) not in ("rti_mpc.wire", "rti_mpc.adapter"):
            assert not roots(path) & CLOCKS, path


@pytest.mark.parametrize("package", ALONE)
def test_foreign_package_has_one_place(package: str) -> None:
    importers = [path for path in every_file() if package in roots(path)]
    assert importers
    for path in importers:
        assert {relative(path), *map(relative, path.parents[: len(path.relative_to(ROOT).parts) - 1])} & ALONE[package], path


def called(path: Path) -> set[str]:
    """Names of all functions and methods a file calls, of what it imports or of a module: `decode(...)`, `json.loads(...)`."""
    calls = [node.func for node in ast.walk(parsed(path)) if isinstance(node, ast.Call)]
    names = {func.id for func in calls if isinstance(func, ast.Name)}
    return names | {f"{func.value.id}.{func.attr}" for func in calls if isinstance(func, ast.Attribute) and isinstance(func.value, ast.Name)}


@pytest.mark.parametrize("name", DOORS)
def test_what_peers_send_is_read_in_one_place(name: str) -> None:
    assert {relative(path) for path in every_file() if name in called(path)} == DOORS[name]


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("rti_mpc.wire.bus", {"casadi", "osqp", "scipy", "pydantic", "rerun"}),
        ("rti_mpc.adapter", {"casadi", "osqp", "scipy", "pydantic", "rerun"}),
        ("rti_mpc.reference.trajectory", {"casadi", "osqp", "scipy", "zenoh"}),
        ("rti_mpc.contract.guard", {"casadi", "osqp", "scipy", "zenoh"}),
        ("rti_mpc.rti.rti", {"zenoh", "rerun", "qpsolvers", "pydantic"}),
        ("rti_mpc_service.config.config", {"casadi", "osqp", "scipy", "zenoh", "rerun"}),
        ("rti_mpc_service.guard", {"casadi", "osqp", "scipy", "rerun", "qpsolvers"}),
        ("rti_mpc_service.demo.demo", {"osqp", "scipy", "rerun", "matplotlib"}),
        ("rti_mpc_service.cli", {"casadi", "osqp", "scipy", "zenoh", "rerun", "rti_mpc_sim"}),
    ],
)
def test_import_loads_only_what_it_needs(module: str, absent: set[str]) -> None:
    code = f"import sys, {module}; print(*{{name.partition('.')[0] for name in sys.modules}})"
    loaded = set(subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())
    assert module.partition(".")[0] in loaded
    assert not loaded & absent


def test_module_of_tests_imports_what_takes_long_only_where_it_is_used() -> None:
    """Each worker imports every module: these would take a third of the time to find tests."""
    slow = r"^(?:import|from) (?:matplotlib|nbclient|polars|sqlalchemy|scipy\.(?:integrate|ndimage|signal|stats))\b.*"
    found = {path.name: re.findall(slow, path.read_text(encoding="utf-8"), re.MULTILINE) for path in (ROOT / "tests").rglob("*.py")}
    assert {name: lines for name, lines in found.items() if lines} == {}


def test_file_names_its_licence_first() -> None:
    for path in every_file():
        assert path.read_text().startswith("# SPDX-License-Identifier: Apache-2.0\n"), path


def test_every_cited_reference_is_defined_and_every_defined_one_cited() -> None:
    cited = {key for path in every_file() for key in re.findall(r"\[(\w+)\]_", path.read_text(encoding="utf-8"))}
    defined = re.findall(r"^\* \[(\w+)\] ", (ROOT / "rti_mpc/__init__.py").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(cited) == sorted(defined)


def test_module_opens_with_what_it_is_and_not_with_a_question() -> None:
    for path in every_file():
        first = (ast.get_docstring(parsed(path)) or "").partition(" ")[0]
        assert first not in {"", "What", "Who", "Whose", "Whether", "How", "Where", "Which", "When", "Why", "That"}, path


def test_no_two_classes_share_a_name() -> None:
    names = [node.name for path in every_file() for node in parsed(path).body if isinstance(node, ast.ClassDef)]
    assert sorted(name for name in set(names) if names.count(name) > 1) == []
