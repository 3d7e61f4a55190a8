# SPDX-License-Identifier: Apache-2.0
"""User's models: found beside the configuration first, under any name, and refused in one line with file and line."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rti_mpc.errors import OcpError
from rti_mpc.model.find import find_model

ROBOT = """
import casadi as ca
from rti_mpc import Model, Signal

def car():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    s = (Signal("s", "m"),)
    return Model(name="{name}", x=x, u=u, f_expl_expr=u, y_expr=x, states=s, inputs=(Signal("v", "m/s"),), outputs=s)
"""


def write(path: Path, text: str = "", name: str = "car") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text or ROBOT.format(name=name))
    return path


@pytest.mark.parametrize("name", ["my_robot:car", "my_robot.py:car", "./my_robot.py:car"])
def test_module_and_file_are_found_beside_the_configuration(name: str, tmp_path: Path) -> None:
    write(tmp_path / "my_robot.py", name="mine")
    assert find_model(name, tmp_path).name == "mine"


@pytest.mark.parametrize("name", ["robots.fast:car", "robots/fast.py:car", "../elsewhere/robots/fast.py:car"])
@pytest.mark.parametrize("files", [["__init__.py"], []], ids=["package", "mere folder"])
def test_module_in_a_folder_is_found_with_what_it_imports_relatively(name: str, files: list[str], tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    for file in files:
        write(folder / "robots" / file, "# a package")
    write(folder / "robots" / "fast.py", "from .parts import car")
    write(folder / "robots" / "parts.py", name="fast")
    assert find_model(name, folder).name == "fast"


def test_file_of_a_name_that_is_no_identifier_is_found(tmp_path: Path) -> None:
    write(tmp_path / "my-robot.py", name="mine")
    assert find_model("my-robot.py:car", tmp_path).name == "mine"


def test_two_folders_have_a_module_of_one_name_each_and_parts_of_one_name_each(tmp_path: Path) -> None:
    for folder in ("red", "blue"):
        write(tmp_path / folder / "my_robot.py", "import robot_parts\ndef car():\n    from robot_parts import car\n    return car()")
        write(tmp_path / folder / "robot_parts.py", name=folder)
    names = [find_model("my_robot:car", tmp_path / folder).name for folder in ("red", "blue", "red")]
    assert names == ["red", "blue", "red"]
    assert not {"my_robot", "robot_parts"} & sys.modules.keys()


@pytest.mark.parametrize("name", ["signal", "numpy", "random"])
def test_module_called_like_another_one_is_the_users_and_takes_nobodys_place(name: str, tmp_path: Path) -> None:
    before = sys.modules.get(name)
    write(tmp_path / f"{name}.py", name="mine")
    assert find_model(f"{name}:car", tmp_path).name == "mine"
    assert sys.modules.get(name) is before


def test_file_called_like_a_module_of_pythons_own_is_not_taken_for_it(tmp_path: Path) -> None:
    """`wave` is a module of Python's own that nothing else has imported."""
    write(tmp_path / "wave.py", "raise ValueError")
    write(tmp_path / "my_robot.py", "import wave\nassert wave.open\n" + ROBOT.format(name="mine"))
    assert find_model("my_robot:car", tmp_path).name == "mine"


def test_folder_called_like_an_installed_module_is_not_taken_for_it(tmp_path: Path) -> None:
    write(tmp_path / "piqp" / "notes.txt", "no module")
    write(tmp_path / "my_robot.py", "import piqp\nassert piqp.__file__\n" + ROBOT.format(name="mine"))
    assert find_model("my_robot:car", tmp_path).name == "mine"
    assert find_model("rti_mpc.model.robots.pioneer_3dx:pioneer_3dx", tmp_path).name == "pioneer_3dx"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("def car(:\n", "my_robot must be importable, it raised SyntaxError in {file}, line 1: "),
        ("\n\nx = y", "my_robot must be importable, it raised NameError in {file}, line 3: name 'y' is not defined"),
        ("import my_part", "my_robot must be importable, it raised ModuleNotFoundError in {file}, line 1: No module named 'my_part'"),
        ("from .my_part import x", "my_robot must be importable, it raised ModuleNotFoundError in {file}, line 1: No module named 'my_part'"),
        ("import broken_part", "my_robot must be importable, it raised SyntaxError in {folder}/broken_part.py, line 2: "),
        ("def car():\n    return 1 / 0", "my_robot:car must return a model, it raised ZeroDivisionError in {file}, line 2: division by zero"),
        ("\ndef car(size):\n    pass", "my_robot:car must return a model, it raised TypeError in {file}, line 2: car() missing 1 required"),
        ("\ndef car():\n    pass", "my_robot:car must return a rti_mpc.Model, got NoneType in {file}, line 2"),
        ("def cars():\n    pass", "got 'my_robot:car' ({file} has no function car, perhaps cars is meant)"),
        ("car = 1", "got 'my_robot:car' ({file} has no function car)"),
        (
            ROBOT.format(name="mine").replace('(Signal("v", "m/s"),)', "()"),
            "my_robot:car must return a model, it raised OcpError in {file}, line 8: model mine: inputs",
        ),
        ("import json\ndef car():\n    json.loads('{{')", "my_robot:car must return a model, it raised JSONDecodeError in {file}, line 3: "),
    ],
)
def test_what_is_wrong_with_it_is_one_line_with_the_users_file_and_line(text: str, told: str, tmp_path: Path) -> None:
    file = write(tmp_path / "my_robot.py", text)
    write(tmp_path / "broken_part.py", "\nx = (")
    with pytest.raises(OcpError) as refusal:
        find_model("my_robot:car", tmp_path)
    assert told.format(file=file, folder=tmp_path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert "rti_mpc_beside" not in str(refusal.value)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("my_robot:car", "(No module named 'my_robot', neither in {folder} nor installed)"),
        ("my_robot.py:car", "({folder}/my_robot.py is no file)"),
        ("data:car", "(No module named 'data', neither in {folder} nor installed)"),
        ("signal:car", "(signal is Python's own)"),
    ],
)
def test_what_is_not_there_is_refused_with_where_it_was_looked_for(name: str, told: str, tmp_path: Path) -> None:
    write(tmp_path / "data" / "notes.txt", "no module")
    with pytest.raises(OcpError) as refusal:
        find_model(name, tmp_path)
    assert told.format(folder=tmp_path) in str(refusal.value)
