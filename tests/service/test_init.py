# SPDX-License-Identifier: Apache-2.0
"""Files written by `rti-mpc init`: existing files are never overwritten, and every robot is valid."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.config.config import load
from rti_mpc_service.init import KINDS, main
from rti_mpc_service.shipped import DEPLOY

RULE = "init must be given a name of small letters, digits and _, with a letter first, and no word of Python's, for it is that of a module, too"


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_a_robot_load_and_bear_its_name(kind: str, tmp_path: Path) -> None:
    written = main("robby", kind, tmp_path)
    assert [path.name for path in written] == ["robby.toml", "robby.py", "test_robby.py", "robby.md"]
    assert load(tmp_path / "robby.toml").robot == "robby"
    for path in written:
        assert "my_robot" not in path.read_text()
    compile((tmp_path / "test_robby.py").read_text(), "test_robby.py", "exec")


def test_nothing_is_overwritten_and_nothing_written_beside_what_exists(tmp_path: Path) -> None:
    (tmp_path / "robby.py").write_text("mine")
    with pytest.raises(ConfigError, match=rf"^init must not overwrite a file, got {tmp_path}/robby.py, which exists$"):
        main("robby", "unicycle", tmp_path, deploy=True)
    assert [path.name for path in tmp_path.iterdir()] == ["robby.py"]
    assert (tmp_path / "robby.py").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "kind", "refusal"),
    [
        (None, "unicycle", "init must be given the name of a robot, such as my_robot, or --deploy"),
        ("my robot", "unicycle", f"{RULE}, got 'my robot', perhaps my_robot is meant"),
        ("class", "unicycle", f"{RULE}, got 'class'"),
        ("My-Robot", "unicycle", f"{RULE}, got 'My-Robot', perhaps my_robot is meant"),
        ("3dx", "unicycle", f"{RULE}, got '3dx'"),
        ("casadi", "unicycle", "init must be given a name that no installed module has, got 'casadi'"),
        ("robby", "tricycle", "--like must be bicycle or unicycle, got 'tricycle'"),
    ],
)
def test_name_or_template_that_is_none_is_refused_in_one_line(name: str | None, kind: str, refusal: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        main(name, kind, tmp_path)
    assert str(refused.value) == refusal
    assert not list(tmp_path.iterdir())


def test_folder_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"^init must be able to write .*robby\.toml: File exists$"):
        main("robby", "unicycle", tmp_path / "file")


def test_deployment_is_the_shipped_one_word_by_word(tmp_path: Path) -> None:
    main(None, "unicycle", tmp_path, deploy=True)
    there, here = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()} for root in (DEPLOY, tmp_path / "deploy")
    )
    assert here == {path: content for path, content in there.items() if path.parts[0] != "robots"}, "of robots, the user's own is deployed"
    assert len(here) > 10


def test_page_of_next_steps_names_files_that_are_written(tmp_path: Path) -> None:
    main("robby", "unicycle", tmp_path)
    assert set(re.findall(r"^\| `([^`]+)`", (tmp_path / "robby.md").read_text(), re.MULTILINE)) == {"robby.toml", "robby.py", "test_robby.py"}
