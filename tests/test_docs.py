# SPDX-License-Identifier: Apache-2.0
"""The documentation site: its tutorial is run word by word, and what it names exists."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from rti_mpc_service.cli import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
GENERATED = {"reference/configuration.md", "reference/messages.md", "reference/cli.md", "reference/python.md", "runbook.md", "guard.md"}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


def test_tutorial_of_your_robot_runs_word_by_word(tmp_path: Path) -> None:
    module, script, compared = blocks("your_robot.md", "python")
    (table,) = blocks("your_robot.md", "toml")
    for name, text in {"my_robot.py": module, "script.py": script, "compared.py": compared, "car.toml": table}.items():
        (tmp_path / name).write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def run(*arguments: str) -> str:
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=120).stdout

    assert run("script.py") == "off by 0.0 mm after 10 s\n"
    assert [line.partition("  ")[0] for line in run("compared.py").splitlines()] == ["", "R = 0.1", "R = 1.0"]
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert "solved" in run("-P", "-c", "from rti_mpc_service.cli import main; main()", "check", "car.toml")


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
    known = typer.main.get_command(app).commands[command]  # type: ignore[attr-defined]
    options = {name for parameter in known.params for name in parameter.opts}
    assert {word for word in rest if word.startswith("--")} <= options


def test_readme_is_a_page_of_at_most_120_lines() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
