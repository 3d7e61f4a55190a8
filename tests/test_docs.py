# SPDX-License-Identifier: Apache-2.0
"""The documentation site: its tutorial is run word by word, and what it names exists."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import rti_mpc
from rti_mpc.errors import ConfigError
from rti_mpc.reference.trajectory import followed_roles
from rti_mpc.signals import Signal
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load
from rti_mpc_service.conformance import guard, robot
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.command import built
from tests.processes.system import PATIENCE_S, until
from tests.recording.samples import write

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
GENERATED = {"reference/configuration.md", "reference/messages.md", "reference/cli.md", "reference/python.md", "runbook.md", "guard.md"}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


@pytest.mark.slow
def test_tutorial_of_your_robot_runs_word_by_word(tmp_path: Path) -> None:
    module, script, compared, loop = blocks("your_robot.md", "python")
    (table,) = blocks("your_robot.md", "toml")
    for name, text in {"my_robot.py": module, "script.py": script, "compared.py": compared, "loop.py": loop, "car.toml": table}.items():
        (tmp_path / name).write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def run(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=120).stdout

    assert run("script.py") == "off by 0.0 mm after 10 s\n"
    assert [line.partition("  ")[0] for line in run("compared.py").splitlines()] == ["", "R = 0.1", "R = 1.0"]
    *changes, end = run("loop.py").splitlines()
    assert [line.partition(": ")[2].partition(":")[0] for line in changes] == ["idle to waiting", "waiting to tracking", "tracking to braking"]
    assert f"`{end}`" in (DOCS / "your_robot.md").read_text()
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert "solved" in run("-P", "-c", "from rti_mpc_service.cli import main; main()", "check", "car.toml")


@pytest.mark.slow
def test_problem_of_the_comparison_is_solved_as_its_page_says(tmp_path: Path) -> None:
    (ours,) = blocks("comparison.md", "python")
    command = [sys.executable, "-c", ours]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=120)
    assert done.stdout == "0.9 mm off\n", done.stderr


def test_constraint_of_the_page_on_problems_is_tightened_as_it_says(tmp_path: Path) -> None:
    (script,) = blocks("problem.md", "python")
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert done.stdout == "at most 1.24 m/s^2, then 0.51 m/s^2\n", done.stderr
    assert f"It prints `{done.stdout.strip()}`" in (DOCS / "problem.md").read_text()


@pytest.mark.slow
def test_tutorial_of_the_adapter_drives_the_robot_word_by_word(tmp_path: Path) -> None:
    """With another endpoint, since the default one may be in use."""
    endpoint = free_endpoint()
    for name, text in zip(("robot.py", "planner.py"), blocks("adapter.md", "python"), strict=True):
        assert len([line for line in text.splitlines() if line.strip()]) <= 30
        listening = f"listen=('{endpoint}',), " if name == "robot.py" else ""
        joined = text.replace('("my_robot"', f"(\"my_robot\", bus=BusSettings({listening}connect=('{endpoint}',))")
        (tmp_path / name).write_text(f"from rti_mpc.wire.bus import BusSettings\n{joined}")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "STATE_DIRECTORY": str(tmp_path / "state")}
    cli = ("-c", "from rti_mpc_service.cli import main; main()")
    subprocess.run([sys.executable, *cli, "init", "my_robot"], cwd=tmp_path, env=environment, check=True, timeout=PATIENCE_S)
    processes: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for name, line in {"robot": ("robot.py",), "run": (*cli, "run", "my_robot.toml", "-e", endpoint), "planner": ("planner.py",)}.items():
            with (tmp_path / f"{name}.log").open("w") as log:
                processes[name] = subprocess.Popen([sys.executable, *line], cwd=tmp_path, env=environment, stdout=log, stderr=log)
            if name == "run":
                until(lambda: "waiting: first state" in (tmp_path / "run.log").read_text(), "the controller hears the robot", pause_s=0.1)
        assert processes["planner"].wait(PATIENCE_S) == 0
        for name in ("robot", "run"):
            processes[name].send_signal(signal.SIGINT)
            assert processes[name].wait(PATIENCE_S) == 0
    finally:
        for process in processes.values():
            process.kill()
            process.wait()
    said = re.search(r"stands at x = (\S+) m, y = (\S+) m", (tmp_path / "robot.log").read_text())
    assert said is not None
    assert abs(float(said[1]) - 1.0) < 0.1, "m: where a busy host holds up robot or controller, it overshoots"
    assert abs(float(said[2])) < 0.05, "m"


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, as a reader of a page does."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.slow
def test_scripts_of_the_page_on_paths_run(tmp_path: Path) -> None:
    (tmp_path / "track.csv").write_text("x,y\n0,0\n1,0\n2,1\n3,1\n")
    for script in blocks("paths.md", "python"):
        done = run(tmp_path, "-c", script)
        assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "at 3.00, 1.00 after 15 s\n", "the last one drives to the end of its path"


def test_table_of_the_page_on_paths_is_that_of_a_robot_that_follows_one(tmp_path: Path) -> None:
    (table,) = blocks("paths.md", "toml")
    (statement,) = re.findall(r"`(def robot\(\): return .*?)`", (DOCS / "paths.md").read_text(encoding="utf-8"))
    imports = "from rti_mpc import find_model\nfrom rti_mpc.model.path_following import path_following\n"
    (tmp_path / "follower.py").write_text(f"{imports}{statement}\n")
    (tmp_path / "robot.toml").write_text(table)
    ocp = build_ocp(load(tmp_path / "robot.toml"))
    assert (ocp.model.ny, len(ocp.lh)) == (3, 2)


def test_table_of_the_page_on_tuning_can_be_appended_to_the_shipped_file(tmp_path: Path) -> None:
    (table,) = blocks("tune.md", "toml")
    (tmp_path / "noisy.toml").write_text(f"{SHIPPED.read_text()}\n{table}")
    assert load(tmp_path / "noisy.toml").sim.actuator_lag_s == 0.1


@pytest.mark.slow
def test_scripts_of_the_page_on_recordings_read_one(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    pytest.importorskip("pandas")
    first, second = blocks("recording.md", "python")
    write(tmp_path / "run.mcap", 10)
    script = f"{first}{second}".replace('"pioneer"', '"wheels"').replace("u.omega_c", "u.v")  # what the robot of this recording has
    done = run(tmp_path, "-c", script)
    assert (done.returncode, done.stderr) == (0, "")


def test_an_error_in_a_model_is_answered_by_the_line_shown(tmp_path: Path) -> None:
    """Of the tutorial's model, with a name misspelt."""
    (shown,) = re.findall(r"^rti-mpc: car.toml: .*$", (DOCS / "your_robot.md").read_text(encoding="utf-8"), re.MULTILINE)
    (tmp_path / "my_robot.py").write_text(blocks("your_robot.md", "python")[0].replace("/ lag_s", "/ lag"))
    (tmp_path / "car.toml").write_text(blocks("your_robot.md", "toml")[0])
    done = run(tmp_path, "-m", "rti_mpc_service.cli", "check", "car.toml")
    assert (done.returncode, done.stderr.strip()) == (2, shown.replace("/home/you", str(tmp_path)))


def test_outputs_that_no_path_fills_are_answered_by_the_line_shown() -> None:
    with pytest.raises(ConfigError) as refused:
        followed_roles("arm", (Signal("q1", "rad"), Signal("q2", "rad")))
    assert f"\nrti-mpc: {refused.value}\n" in (DOCS / "your_robot.md").read_text(encoding="utf-8")


def test_every_page_of_the_site_exists_and_is_reached() -> None:
    listed = set(re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2]))
    written = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    assert listed == written | GENERATED


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#h][^)#]*)", page.read_text()):
        assert target in GENERATED or (page.parent / target).exists(), target


def commands() -> list[str]:
    pages = (page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    return sorted(
        {line for page in pages for block in re.findall(r"```sh\n(.*?)```", page, re.DOTALL) for line in block.splitlines() if "rti-mpc " in line}
    )


@pytest.mark.parametrize("line", commands())
def test_every_command_of_a_page_exists_with_its_options(line: str) -> None:
    command, *rest = line.partition("#")[0].partition("rti-mpc ")[2].split()
    known = built().commands[command]
    known = known.commands[rest[0]] if command == "certs" else known
    options = {name for parameter in known.params for name in parameter.opts}
    assert {word for word in rest if word.startswith("--")} <= options


READ = [*DOCS.glob("*.md"), *DOCS.glob("*.py"), *ROOT.glob("examples/*.*"), *ROOT.glob("deploy/*.md"), ROOT / "README.md"]


@pytest.mark.parametrize("path", sorted(READ), ids=lambda path: path.name)
def test_what_users_read_imports_public_names_from_the_package_itself(path: Path) -> None:
    """Readers copy imports, and only the public names are kept where they are."""
    imports = re.findall(r"from (rti_mpc\.[\w.]+) import (\([^)]*\)|[^\n\\]*)", path.read_text(encoding="utf-8"))
    assert not [(module, name) for module, names in imports for name in re.findall(r"\w+", names) if name in rti_mpc.__all__]


def test_contract_says_what_conformance_judges_word_by_word() -> None:
    told = re.findall(r"^\| `(\w+)` \| (.*) \|$", (DOCS / "contract.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert told == [(case.name, case.promise) for case in (*robot.CASES, *guard.CASES)]


def test_readme_is_a_page_of_at_most_120_lines() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
