# SPDX-License-Identifier: Apache-2.0
"""Files and values that no configuration may have: each is refused in one line that says what would be right, with status 2."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.reference.trajectory import find_trajectory
from rti_mpc.wire.session import BusSettings, zenoh_config
from rti_mpc_service.config.config import load
from rti_mpc_service.request import parse_assignments
from rti_mpc_service.shipped import ROBOTS, SHIPPED
from tests.command import command

TEXT = SHIPPED.read_text()
NESTING_DEPTH = 30_000


def pipe(path: Path) -> None:
    os.mkfifo(path)


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (lambda _: None, "must be a readable file, got No such file or directory"),
    "empty": (lambda path: path.touch(), "robot is missing"),
    "folder": (lambda path: path.mkdir(), "must be a file of TOML, got a folder"),
    "pipe": (pipe, "must be a file of TOML, got a pipe or device"),
    "socket": (bound_socket, "must be a file of TOML, got a pipe or device"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "must be a file of TOML, got a pipe or device"),
    "link to itself": (lambda path: path.symlink_to(path), "must be a readable file, got Too many levels of symbolic links"),
    "link to nothing": (lambda path: path.symlink_to("nothing"), "must be a readable file, got No such file or directory"),
    "huge": (huge, "must be TOML of at most 131072 bytes, got 1099511627776"),
    "not UTF-8": (lambda path: path.write_bytes(TEXT.encode() + b"# J\xfcrgen"), "must be TOML in UTF-8, got byte 0xfc after"),
    "UTF-16": (lambda path: path.write_text(TEXT, encoding="utf-16"), "must be TOML in UTF-8, got byte 0xff after 0 others"),
    "zeros": (lambda path: path.write_bytes(bytes(4096)), "at line 1, column 1: Invalid statement"),
    "deep list": (
        lambda path: path.write_text(f"a = {'[' * NESTING_DEPTH}{']' * NESTING_DEPTH}"),
        "must be TOML of at most 16 tables and lists inside each other",
    ),
    "open list": (lambda path: path.write_text(f"a = {'[' * NESTING_DEPTH}"), "must be TOML of at most 16 tables and lists inside each other"),
    "deep table": (lambda path: path.write_text("a" + ".a" * 2000 + " = 1"), "must be TOML of at most 16 tables and lists inside each other"),
    "deep inside": (lambda path: path.write_text(TEXT + "\n[sim]\nx0.x = " + "[" * 20 + "]" * 20), "at most 16 tables and lists"),
    "twice": (lambda path: path.write_text(TEXT + '\n[model]\nname = "pioneer_3dx"\n'), "must be TOML, got '[model]' at line"),
}


@pytest.mark.parametrize("kind", FILES)
def test_file_that_is_no_configuration_is_one_line(kind: str, tmp_path: Path) -> None:
    make, told = FILES[kind]
    path = tmp_path / "robot.toml"
    make(path)
    with pytest.raises(ConfigError) as refusal:
        load(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert told in str(refusal.value)
    assert "\n" not in str(refusal.value)


VALUES = [
    ("dt_s = 0.1", "dt_s = 1e400", ["ocp.dt_s", "finite", "inf"]),
    ("dt_s = 0.1", f"dt_s = 1{'0' * 400}", ["ocp.dt_s", "in seconds"]),
    ("dt_s = 0.1", f"dt_s = 1{'0' * 5000}", ["must be TOML", "4300 digits"]),
    ("dt_s = 0.1", "dt_s = -0.0", ["ocp.dt_s", "at least 0.0001"]),
    ("dt_s = 0.1", "dt_s = 5e-324", ["ocp.dt_s", "at least 0.0001"]),
    ("dt_s = 0.1", "dt_s = 2026-11-28", ["ocp.dt_s", "must be a number", "2026"]),
    ("dt_s = 0.1", "dt_s = 12:00:00", ["ocp.dt_s", "must be a number", "time(12, 0)"]),
    ("dt_s = 0.1", "dt_s = {}", ["ocp.dt_s", "must be a number", "{}"]),
    ("N = 20", f"N = {2**64}", ["ocp.N", "at most 1000"]),
    ("N = 20", f"N = 1{'0' * 400}", ["ocp.N"]),
    ("N = 20", "N = -1", ["ocp.N", "at least 1"]),
    ("delta = 28.0", "delta = []", ["ocp.weights.delta", "20"]),
    ("delta = 28.0", f"delta = {[1.0] * 5000}", ["ocp.weights.delta", "20"]),
    ("x = 1.0", "x = inf", ["ocp.weights.Q.x", "finite"]),
    ("x = 1.0", "x = 1e308", ["ocp.weights.Q.x", "at most 1000000000000000"]),
    ("u_c = [-0.5, 0.5]", "u_c = [-1e400, nan]", ["ocp.bounds.inputs.u_c", "lower < upper"]),
    ("u_c = [-0.5, 0.5]", f"u_c = [-1, 1{'0' * 400}]", ["ocp.bounds.inputs.u_c"]),
    ("u_c = [-0.5, 0.5]", "u_c = [true, false]", ["ocp.bounds.inputs.u_c", "two numbers"]),
    ('robot = "pioneer"', 'robot = ""', ["robot", "letters, digits"]),
    ('robot = "pioneer"', 'robot = "my robot"', ["robot (", "letters, digits", "must be written so, got 'my robot'"]),
    (
        'robot = "pioneer"',
        'robot = "pioneer"\n[bus]\nconnect = ["tcp://127.0.0.1:7447"]',
        ["bus.connect[0]", "such as tcp/127.0.0.1:7447) must be written so"],
    ),
    (
        "Q = { x = 1.0, y = 1.0, psi = 0.05 }",
        "Q = [1.0, 1.0, 0.05]",
        ["ocp.weights.Q (", "must be a table, such as { name = 1.0 }, got [1.0, 1.0, 0.05]"],
    ),
    ('robot = "pioneer"', 'robot = "a\\u0000b"', ["robot", "letters, digits"]),
    ('robot = "pioneer"', f'robot = "{"a" * 50_000}!"', ["robot", "letters, digits", "..."]),
    ('robot = "pioneer"', 'robot = "pioneer"\n"a\\nb\\u001b[2J" = 1', ["is unknown"]),
    ('name = "pioneer_3dx"', 'name = ":x"', ["model.name", "':x'"]),
    ('name = "pioneer_3dx"', 'name = ".os:system"', ["model.name", "'.os:system'"]),
    ('name = "pioneer_3dx"', 'name = "sys:exit"', ["model.name", "Python's own"]),
    ('name = "pioneer_3dx"', "name = 1979-05-27T07:32:00Z", ["model.name", "must be text"]),
]


@pytest.mark.parametrize(("right", "wrong", "told"), VALUES, ids=[wrong[:40] for _, wrong, _ in VALUES])
def test_value_that_is_none_is_one_line_of_bounded_length(right: str, wrong: str, told: list[str], tmp_path: Path) -> None:
    assert right in TEXT
    path = tmp_path / "robot.toml"
    path.write_text(TEXT.replace(right, wrong, 1))
    with pytest.raises(ConfigError) as refusal:
        load(path)
    for words in told:
        assert words in str(refusal.value)
    assert len(str(refusal.value)) < 2000


def test_byte_order_mark_and_windows_lines_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_bytes(b"\xef\xbb\xbf" + TEXT.replace("\n", "\r\n").encode())
    assert load(path) == load(SHIPPED)


@pytest.mark.parametrize(
    ("text", "status", "told"),
    [
        (TEXT.replace('name = "pioneer_3dx"', 'name = "sys:exit"'), 2, "sys is Python's own"),
        (f"a = {'[' * NESTING_DEPTH}", 2, "tables and lists inside each other"),
        ('"a\\nb\\u001b[2J" = 1\n' + TEXT, 2, "a\\nb\\x1b[2J is unknown"),
    ],
)
def test_hostile_file_is_one_line_of_plain_characters_and_status_2(text: str, status: int, told: str, tmp_path: Path) -> None:
    """Status 2, which the systemd units do not restart."""
    path = tmp_path / "robot.toml"
    path.write_text(text)
    done = command("check", path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (status, "", 1)
    assert told in done.stderr
    assert done.stderr[:-1].isprintable()


@pytest.mark.parametrize("kind", ["missing", "folder", "pipe", "device", "huge", "not UTF-8"])
def test_other_files_of_a_users_are_refused_likewise(kind: str, tmp_path: Path) -> None:
    make, _ = FILES[kind]
    path = tmp_path / "waypoints.csv"
    make(path)
    with pytest.raises(ConfigError, match=r"waypoints\.csv: must be "):
        find_trajectory(str(path))
    with pytest.raises(ConfigError, match=r"waypoints\.csv: must be "):
        zenoh_config(BusSettings(config=path))


def test_zenoh_file_of_many_brackets_is_refused_and_ends_no_process(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(f"{{ mode: {'[' * 100_000}")
    with pytest.raises(ConfigError, match="at most 65536 bytes"):
        zenoh_config(BusSettings(config=path))


@pytest.mark.parametrize("value", ["[" * NESTING_DEPTH, f"1{'0' * 5000}", "", "1\nb = 2", "{" * NESTING_DEPTH])
def test_parameter_that_is_no_value_is_one_line(value: str) -> None:
    with pytest.raises(ConfigError, match="params must be set by KEY=VALUE"):
        parse_assignments([f"ocp.weights.Q.x={value}"])


@pytest.mark.parametrize("typed", ["my_robot", "my-robot.toml", "my_robt.toml", "my_robot.py"])
def test_file_that_was_probably_meant_is_told(typed: str, tmp_path: Path) -> None:
    for name in ("car.toml", "my_robot.toml"):
        (tmp_path / name).write_text(TEXT)
    with pytest.raises(ConfigError) as refusal:
        load(tmp_path / typed)
    assert str(refusal.value).startswith(f"{tmp_path / typed}: must be a readable file, got No such file or directory, ")
    assert str(refusal.value).endswith(f", perhaps {tmp_path / 'my_robot.toml'} is meant")


def test_robot_that_ships_is_told_by_its_file() -> None:
    with pytest.raises(ConfigError, match=f"got No such file or directory, perhaps {ROBOTS['boat']} is meant"):
        load(Path("boat"))
