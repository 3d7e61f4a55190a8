# SPDX-License-Identifier: Apache-2.0
"""Commands and statements of the README, run and checked as they stand there."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.command import built

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return [block for name, block in re.findall(r"```(\w*)\n(.*?)```", README, flags=re.DOTALL) if name == language]


def test_the_script_of_your_own_robot_runs_and_prints_what_is_said() -> None:
    (script,) = blocks("python")
    assert sum(bool(line.strip()) for line in script.splitlines()) <= 22, "it is to stay a page anybody reads"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120)
    assert f"It prints `{done.stdout.strip()}`" in README


@pytest.mark.parametrize("line", [line for block in blocks("sh") for line in block.splitlines() if line.startswith(("rti-mpc", "make"))])
def test_every_command_shown_exists_with_its_options(line: str) -> None:
    program, command, *rest = line.partition("#")[0].split()
    if program == "make":
        assert re.search(rf"^{command}:", (ROOT / "Makefile").read_text(), flags=re.MULTILINE), line
        return
    known = built().commands[command]
    options = {name for parameter in known.params for name in parameter.opts}
    assert {word for word in rest if word.startswith("--")} <= options, line


def test_a_misspelt_key_is_answered_by_the_line_shown(tmp_path: Path) -> None:
    (shown,) = (block.strip() for block in blocks("") if block.startswith("rti-mpc: robot.toml"))
    shipped = (ROOT / "deploy" / "pioneer_3dx.toml").read_text()
    (tmp_path / "robot.toml").write_text(shipped.replace("\ndt_s = ", "\ndt_ms = "))
    command = [sys.executable, "-m", "rti_mpc_service.cli", "check", "robot.toml"]
    done = subprocess.run(command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT), "PATH": ""}, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr.strip()) == (2, shown)


@pytest.mark.parametrize("target", re.findall(r"\]\(([^)h][^)]*)\)", README))
def test_every_link_into_the_repository_leads_somewhere(target: str) -> None:
    path, _, anchor = target.partition("#")
    assert (ROOT / path).exists()
    headings = re.findall(r"^#+ (.*)", (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE) if anchor else []
    assert not anchor or anchor in {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in headings}


def test_every_function_named_with_its_file_is_there() -> None:
    named = re.findall(r"`(\w+)\.(\w+)` in\s+\[`[^`]+`\]\(([^)]+)\)", README)
    assert {"prepare", "feedback", "solve"} <= {method for _, method, _ in named}
    for owner, method, path in named:
        classes = [node for node in ast.parse((ROOT / path).read_text()).body if isinstance(node, ast.ClassDef) and node.name == owner]
        assert any(isinstance(node, ast.FunctionDef) and node.name == method for found in classes for node in found.body), (
            f"{owner}.{method} in {path}"
        )


PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "deploy").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_named_in_a_page_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`((?:rti_mpc|service|sim|tests|deploy|docs)/[\w./@-]+\.[a-z0-9]+)`", text) + re.findall(r"tests/[\w/]+\.py", text):
        assert (ROOT / name).exists(), name
