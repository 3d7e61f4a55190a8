# SPDX-License-Identifier: Apache-2.0
"""Files of deploy/, used as they are."""

from __future__ import annotations

import configparser
import re
import shutil
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer.main

from rti_mpc.wire.session import BusSettings, zenoh_config
from rti_mpc_service.certs.roles import ROLES_OF_COMMAND
from rti_mpc_service.cli import app
from rti_mpc_service.config.build import build_ocp
from rti_mpc_service.config.config import load

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
UNITS = {"run": DEPLOY / "systemd" / "rti-mpc@.service", "guard": DEPLOY / "systemd" / "rti-mpc-guard@.service"}
UNITS["router"] = DEPLOY / "systemd" / "rti-mpc-router@.service"
RUNBOOK = (DEPLOY / "runbook.md").read_text()
SHELL = [line for block in re.findall(r"```sh\n(.*?)```", RUNBOOK, re.DOTALL) for line in block.splitlines()]


@pytest.mark.parametrize("path", sorted(DEPLOY.glob("*.toml")), ids=lambda path: path.name)
def test_configuration_builds_its_problem(path: Path) -> None:
    config = load(path)
    assert build_ocp(config).N == config.ocp.N
    assert config.keys().command.endswith(f"{config.robot}/command")


@pytest.mark.parametrize("path", sorted(DEPLOY.rglob("*.json5")), ids=lambda path: path.name)
def test_zenoh_takes_its_configuration_without_multicast(path: Path) -> None:
    config = zenoh_config(BusSettings(config=path))
    assert config.get_json("mode") == f'"{path.stem}"'
    assert config.get_json("scouting/multicast/enabled") == "false"


DROP_INS = {"run": ["rti-mpc@.service.d/realtime.conf", "standby.conf", "tls-controller.conf"], "guard": ["tls-guard.conf"], "router": []}


def verified(folder: Path, command: str, more: str = "") -> subprocess.CompletedProcess[str]:
    """Let systemd verify a unit with all of its drop-ins, and a further one."""
    unit = UNITS[command]
    instance = folder / unit.name.replace("@", "@pioneer_3dx")
    (drop_ins := folder / f"{instance.name}.d").mkdir()
    texts = {Path(name).name: (DEPLOY / "systemd" / name).read_text() for name in DROP_INS[command]} | {"more.conf": more}
    for path, text in {instance: unit.read_text(), **{drop_ins / name: text for name, text in texts.items()}}.items():
        path.write_text(text.replace("/opt/rti-mpc/bin/rti-mpc", "/bin/true"))  # verify wants the program to be there
    return subprocess.run(["systemd-analyze", "verify", "--man=no", instance], capture_output=True, text=True, timeout=60)


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed: the unit was NOT verified")
@pytest.mark.parametrize("command", UNITS)
def test_systemd_finds_nothing_to_complain_about_in_the_unit_with_its_drop_ins(tmp_path: Path, command: str) -> None:
    done = verified(tmp_path, command)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed: the unit was NOT verified")
def test_systemd_complains_about_a_drop_in_with_a_wrong_credential(tmp_path: Path) -> None:
    done = verified(tmp_path, "router", "[Service]\nLoadCredential=a/b:/etc/x\n")
    assert 'more.conf:2: Credential name "a/b" not valid' in done.stderr


def test_every_file_of_systemd_is_verified() -> None:
    files = {str(path.relative_to(DEPLOY / "systemd")) for path in (DEPLOY / "systemd").rglob("*") if path.is_file()}
    assert files == {unit.name for unit in UNITS.values()} | {name for names in DROP_INS.values() for name in names}


@pytest.mark.parametrize("expected", UNITS)
def test_unit_runs_a_command_that_exists_and_never_gives_up(expected: str) -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(UNITS[expected].read_text())
    program, command, config = unit["Service"]["ExecStart"].split()
    assert Path(program).name == "rti-mpc"
    assert (command, command in typer.main.get_group(app).commands) == (expected, True)
    assert config == "/etc/rti-mpc/%i.toml"
    assert (unit["Service"]["Restart"], unit["Unit"]["StartLimitIntervalSec"]) == ("always", "0")
    assert unit["Service"]["RestartPreventExitStatus"] == "2"


def test_drop_in_changes_the_unit_s_command_to_one_that_exists() -> None:
    first, second = [
        line.partition("=")[2] for line in (DEPLOY / "systemd" / "standby.conf").read_text().splitlines() if line.startswith("ExecStart=")
    ]
    program, name, *words = second.split()
    assert (first, program) == ("", "/opt/rti-mpc/bin/rti-mpc"), "a second command would be refused by systemd, so the first is taken back"
    context = typer.main.get_group(app).commands[name].make_context(name, words)
    assert context.params["standby"] is True


@pytest.mark.parametrize(("file", "command"), [("rti-mpc-router@.service", "router"), ("tls-controller.conf", "run"), ("tls-guard.conf", "guard")])
def test_unit_with_tls_loads_what_its_command_reads(file: str, command: str) -> None:
    loaded = re.findall(r"^LoadCredential=(\S+):/etc/rti-mpc/tls/(\S+)$", (DEPLOY / "systemd" / file).read_text(), re.MULTILINE)
    role = ROLES_OF_COMMAND[command][0]
    assert loaded == [(name, name) for name in ("authority.pem", f"{role}.pem", f"{role}.key", f"{role}.json5")]


@pytest.mark.parametrize("line", [line for line in SHELL if re.match(r"(\S*/)?rti-mpc ", line)])
def test_command_in_the_runbook_exists_with_its_options(line: str) -> None:
    _, name, *words = line.split()
    command: Any = typer.main.get_group(app).commands[name]
    if name == "certs":
        command, *words = command.commands[words[0]], *words[1:]
    command.make_context(name, words)  # parses all, runs nothing


def test_checks_that_the_contract_of_a_guard_names_exist() -> None:
    suite = (ROOT / "tests" / "guard_conformance" / "test_guard.py").read_text()
    named = re.findall(r"`(test_\w+?)_?(?:\.\.\.)?`", (DEPLOY / "guard.md").read_text())
    assert len(named) > 12
    assert set(re.findall(r"def (test_\w+)", suite)) == {check for check in re.findall(r"def (test_\w+)", suite) if check.startswith(tuple(named))}


def test_the_runbook_begins_with_what_to_do_when_the_robot_stands() -> None:
    assert re.findall(r"^## (.*)", RUNBOOK, re.MULTILINE)[0] == "When the robot stands"


@pytest.mark.parametrize("page", sorted(DEPLOY.glob("*.md")), ids=lambda path: path.name)
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#h][^)#]*)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_files_in_the_runbook_exist() -> None:
    named = {word for line in SHELL for word in line.split() if word.startswith("deploy/")} | set(
        re.findall(r"^\| `([^`]+)` \|", RUNBOOK, re.MULTILINE)
    )
    assert len(named) > 4
    for name in named:
        assert list(ROOT.glob(name) if name.startswith("deploy/") else DEPLOY.glob(name)), name


def test_versions_are_pinned_with_hashes_and_without_an_index() -> None:
    text = (ROOT / "constraints.txt").read_text() + (ROOT / "docs" / "requirements.txt").read_text()
    pinned = {line.split("==")[0] for line in text.splitlines() if "==" in line}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [*project["build-system"]["requires"], *project["project"]["dependencies"]]
    wanted += [entry for group in project["dependency-groups"].values() for entry in group if isinstance(entry, str)]
    wanted += [entry for extra in project["project"]["optional-dependencies"].values() for entry in extra]
    assert {re.split(r"[\[<>=]", entry)[0] for entry in wanted} <= pinned
    assert "://" not in text
    for requirement in re.split(r"\n(?=\S)", text):
        assert requirement.startswith("#") or "--hash=sha256:" in requirement, requirement
