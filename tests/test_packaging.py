# SPDX-License-Identifier: Apache-2.0
"""Wheel as its users get it, in a separate environment, outside the clone."""

from __future__ import annotations

import doctest
import os
import pydoc
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

import rti_mpc

ROOT = Path(__file__).parents[1]
TOPS = {"rti_mpc", "rti_mpc_service", "rti_mpc_sim"}


def build(kind: str, source: Path, folder: Path) -> Path:
    """Build a ``wheel`` or an ``sdist`` of a source tree with what is installed here; return the file."""
    before = set(folder.iterdir())
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)], cwd=source, capture_output=True, check=True)
    (made,) = set(folder.iterdir()) - before
    return made


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Interpreter of an environment that holds the wheel, and finds its dependencies, but no clone."""
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder, with_pip=False)
    python = folder / "bin/python"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages(python))
    (packages(python) / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")  # a path from a .pth reads no .pth of its own
    return python


def packages(python: Path) -> Path:
    return python.parents[1] / f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"


def run(python: Path, folder: Path, *arguments: str) -> str:
    """Run the command line in a folder; return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [str(python), "-c", "from rti_mpc_service.cli import main; main()", *arguments]
    done = subprocess.run(command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_wheel_installs_three_typed_packages_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0] for name in names if not name.partition("/")[0].endswith(".dist-info")} == TOPS
    assert {f"{top}/py.typed" for top in TOPS} <= set(names)
    assert "rti_mpc_service/deploy/pioneer_3dx.toml" in names


@pytest.mark.slow
def test_sdist_builds_the_same_wheel(sdist: Path, wheel: Path, tmp_path: Path) -> None:
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    (source,) = tmp_path.iterdir()
    again = zipfile.ZipFile(build("wheel", source, source.parent))
    first = zipfile.ZipFile(wheel)
    assert {name: first.read(name) for name in first.namelist()} == {name: again.read(name) for name in again.namelist()}


def test_long_description_holds_absolute_links_alone(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = message_from_bytes(archive.read(name))
    targets = [part.partition(")")[0] for part in str(metadata.get_payload()).split("](")[1:]]
    assert targets
    assert [target for target in targets if not target.startswith(("https://", "#"))] == []
    assert {label.partition(",")[0] for label in metadata.get_all("Project-URL", [])} >= {"Documentation", "Source", "Changelog", "Issues"}


def test_help_of_the_package_shows_its_public_names_and_an_example_that_runs() -> None:
    shown = pydoc.render_doc(rti_mpc, renderer=pydoc.plaintext)
    assert [name for name in rti_mpc.__all__ if name.strip("_") not in shown.lower() and name not in shown] == []
    failed, tried = doctest.testmod(rti_mpc)
    assert (failed, tried > 4) == (0, True)


@pytest.mark.slow
def test_packages_of_the_user_s_own_called_service_and_sim_clash_with_nothing(python: Path, tmp_path: Path) -> None:
    """Beside ours, in front of ours on the path, and once they are removed from beside ours."""
    theirs = [root / name for root in (packages(python), tmp_path) for name in ("service", "sim")]
    for folder in theirs:
        folder.mkdir()
        (folder / "__init__.py").write_text("WHOSE = 'theirs'\n")
    assert "solved" in run(python, tmp_path, "check")
    found = subprocess.run(
        [str(python), "-c", "import service, sim; print(service.WHOSE, sim.WHOSE)"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    assert found.stdout == "theirs theirs\n"
    for folder in theirs[:2]:
        shutil.rmtree(folder)
    assert "solved" in run(python, tmp_path, "check")


@pytest.mark.slow
def test_demo_runs_in_an_empty_folder_from_the_wheel_alone(python: Path, tmp_path: Path) -> None:
    (tmp_path / "sim").mkdir()
    (tmp_path / "sim/__init__.py").write_text("raise ImportError('of the user')\n")
    assert "tracking" in run(python, tmp_path, "demo", "--duration", "5", "--out", "out").lower()


@pytest.mark.slow
def test_robot_of_one_s_own_is_driven_in_an_empty_folder_from_the_wheel_alone(python: Path, tmp_path: Path) -> None:
    run(python, tmp_path, "init", "my_robot", "--deploy")
    assert (tmp_path / "deploy/runbook.md").is_file()
    assert "riccati and daqp agree" in run(python, tmp_path, "check", "my_robot.toml")
    assert "fallbacks" in run(python, tmp_path, "demo", "my_robot.toml", "--duration", "10", "--out", "out")
    assert "1 of 1 within their promise" in run(python, tmp_path, "faults", "my_robot.toml", "--only", "controller_killed")
    done = subprocess.run([str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
