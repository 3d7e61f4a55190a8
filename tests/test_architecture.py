# SPDX-License-Identifier: Apache-2.0
"""The layers of the system, held by what each file imports."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("rti_mpc", "service", "sim")

# What no file of a layer imports; the command line alone may start a simulation, lazily.
FORBIDDEN = {
    "rti_mpc": {"service", "sim", "asyncio", "logging", "pydantic", "typer", "rich"},
    "service": {"sim"},
    "sim": {"service", "osqp", "pydantic", "typer"},
}
EXCEPT = {"service/cli.py"}
COMMANDS = {f"service.{name}" for name in ("bench", "check", "daemon", "demo", "doctor", "faults.run", "guard", "router", "view")}
PARTS_OF_COMMANDS = {"service/family_bench.py"}  # of `rti-mpc bench`
CLOCKS = {"time", "datetime", "threading", "multiprocessing", "concurrent", "random"}  # what would make two runs of one sample differ

# Who alone imports a package, wherever in the file.
ALONE = {
    "osqp": {"rti_mpc/solver.py"},
    "zenoh": {"rti_mpc/wire/session.py", "rti_mpc/wire/zenoh_session.py"},
    "rerun": {"service/blueprint.py", "service/outlet.py", "service/recording.py", "service/view.py"},
    "qpsolvers": {"rti_mpc/qp.py", "rti_mpc/foreign_solver.py"},
    "casadi": {
        "rti_mpc/rest.py",
        *(f"rti_mpc/{name}.py" for name in ("simultaneous", "sequential", "terminal", "obstacle", "blockage", "disturbance", "observer")),
        *(
            f"rti_mpc/{name}.py"
            for name in (
                "model",
                "pioneer_3dx",
                "integrator",
                "ocp",
                "linearization",
                "transcription",
                "riccati",
                "places",
                "certificate",
                "codegen",
                "qp",
                "active_set",
                "track",
                "envelope",
                "scale",
            )
        ),
        "sim/plant.py",
        "service/excursion.py",
        "service/yardstick.py",
        "service/families.py",
        "service/paper/slsqp.py",
    },
}

LOCAL = {"rti_mpc/wire/session.py"}  # reads JSON that is not a peer's: Zenoh's own configuration

# Inside the library, a file imports only from groups before its own.
FLOW: tuple[set[str], ...] = (
    {"errors", "array", "status", "robot_clock", "ladder", "grid", "epoch", "cache", "angle", "call", "signals"},
    {"message", "approach", "text_file", "latch"},
    {"polyline"},
    {"lives", "cadence", "heading", "mode", "schedule", "issued"},
    {"trajectory", "belief"},
    {"guard", "sent", "leadership"},
    {"codegen"},
    {"model"},
    {"pioneer_3dx", "integrator", "track", "obstacle", "disturbance"},
    {"ocp"},
    {"linearization", "terminal", "rest"},
    {"transcription", "scale"},
    {"simultaneous", "sequential", "riccati", "certificate"},
    {"places"},
    {"qp", "prediction", "observer", "envelope", "delay", "turns"},
    {"scaled", "active_set", "state_stream"},
    {"solver", "foreign_solver"},
    {"rti"},
    {"tuning"},
    {"record", "blockage"},
    {"controller"},
)
BEFORE_WIRE = {"errors", "array", "signals", "status", "message", "epoch", "text_file"}


def imported(path: Path) -> set[str]:
    """Full names of all modules a file imports, in functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def roots(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imported(path)}


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def inside(path: Path) -> set[str]:
    """Modules of the library that a file of the library imports, by their first name."""
    return {name.split(".")[1] for name in imported(path) if name.startswith("rti_mpc.")}


@pytest.mark.parametrize("layer", FORBIDDEN)
def test_layer_does_not_import_upwards(layer: str) -> None:
    assert files(layer)
    for path in files(layer):
        if path.relative_to(ROOT).as_posix() not in EXCEPT:
            assert not roots(path) & FORBIDDEN[layer], path


def test_library_has_no_clock_and_no_thread_but_on_the_wire() -> None:
    for path in files("rti_mpc"):
        if path.parent.name != "wire":
            assert not roots(path) & CLOCKS, path


@pytest.mark.parametrize("package", ALONE)
def test_foreign_package_is_behind_its_own_files(package: str) -> None:
    importers = {path.relative_to(ROOT).as_posix() for layer in PACKAGES for path in files(layer) if package in roots(path)}
    assert importers <= ALONE[package]


def called(path: Path) -> set[str]:
    """Names of all functions and methods a file calls, of what it imports or of a module: `decode(...)`, `json.loads(...)`."""
    calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    names = {func.id for func in calls if isinstance(func, ast.Name)}
    return names | {f"{func.value.id}.{func.attr}" for func in calls if isinstance(func, ast.Attribute) and isinstance(func.value, ast.Name)}


@pytest.mark.parametrize(("name", "doors"), [("decode", {"rti_mpc/wire/intake.py"}), ("json.loads", {"rti_mpc/wire/document.py"})])
def test_what_peers_send_is_read_in_one_place(name: str, doors: set[str]) -> None:
    callers = {path.relative_to(ROOT).as_posix() for layer in PACKAGES for path in files(layer) if name in called(path)}
    assert callers - LOCAL == doors


def test_data_flows_one_way_through_the_library() -> None:
    before: set[str] = set()
    for group in FLOW:
        for name in group:
            assert inside(ROOT / "rti_mpc" / f"{name}.py") <= before, name
        before |= group
    assert {path.stem for path in (ROOT / "rti_mpc").glob("*.py")} == before | {"__init__"}, "every file has its place"


def test_wire_depends_on_messages_only() -> None:
    for path in files("rti_mpc/wire"):
        assert inside(path) <= BEFORE_WIRE | {"wire"}, path


def test_commands_are_not_libraries() -> None:
    for path in files("service"):
        if path.relative_to(ROOT).as_posix() not in EXCEPT | PARTS_OF_COMMANDS:
            modules = imported(path) | {name.rpartition(".")[0] for name in imported(path)}
            assert not modules & COMMANDS, path


@pytest.mark.parametrize("package", PACKAGES)
def test_no_file_imports_itself_by_way_of_others(package: str) -> None:
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in files(package)}
    imports = {name: {each.rpartition(".")[0] for each in imported(path)} | imported(path) for name, path in names.items()}
    left = {name: {other for other in of if other in names} for name, of in imports.items()}
    while free := {name for name, of in left.items() if not of}:
        left = {name: of - free for name, of in left.items() if name not in free}
    assert not left, "each of these imports another of them, or itself"


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("rti_mpc.wire.bus", {"casadi", "osqp", "scipy", "pydantic", "rerun"}),
        ("rti_mpc.trajectory", {"casadi", "osqp", "scipy", "zenoh"}),
        ("rti_mpc.rti", {"zenoh", "rerun", "qpsolvers", "pydantic"}),
        ("service.config", {"casadi", "osqp", "scipy", "zenoh", "rerun"}),
        ("service.guard", {"casadi", "osqp", "scipy", "rerun", "qpsolvers"}),
        ("service.cli", {"casadi", "osqp", "scipy", "zenoh", "rerun", "sim"}),
    ],
)
def test_import_loads_only_what_it_needs(module: str, absent: set[str]) -> None:
    code = f"import sys, {module}; print(*{{name.partition('.')[0] for name in sys.modules}})"
    loaded = set(subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())
    assert module.partition(".")[0] in loaded
    assert not loaded & absent


@pytest.mark.parametrize("package", PACKAGES)
def test_file_names_its_licence_first(package: str) -> None:
    for path in files(package):
        assert path.read_text().startswith("# SPDX-License-Identifier: Apache-2.0\n"), path


def test_every_cited_reference_is_defined_and_every_defined_one_cited() -> None:
    sources = [path.read_text(encoding="utf-8") for package in PACKAGES for path in files(package)]
    cited = {key for source in sources for key in re.findall(r"\[(\w+)\]_", source)}
    defined = re.findall(r"^\* \[(\w+)\] ", (ROOT / "rti_mpc/__init__.py").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(cited) == sorted(defined)
