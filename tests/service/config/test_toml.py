# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.config import toml
from rti_mpc_service.config.config import load
from rti_mpc_service.shipped import SHIPPED
from tests.service.config.test_config import MINIMAL

ODD = """
[solver]
eps = 1e-7
[bus]
listen = ['tcp/[::1]:7448']
[sim.parameters]
theta_1 = 0.25
"""

TABLES = """
[ocp.terminal.lqr]
states = { u = 0.25 }
inputs = { u_c = 0.25 }
[[ocp.obstacles]]
centre_m = [1, -2.5]
radius_m = 0.3
[[ocp.obstacles]]
centre_m = [-1.0, 0.0]
radius_m = 0.2
velocity_m_s = [0.0, 0.1]
"""


@pytest.mark.parametrize("text", [SHIPPED.read_text(), MINIMAL, MINIMAL + ODD, MINIMAL + TABLES])
def test_configuration_written_is_the_one_that_was_read(tmp_path: Path, text: str) -> None:
    path, again = tmp_path / "robot.toml", tmp_path / "again.toml"
    path.write_text(text)
    config = load(path)
    again.write_text(toml.write(config))
    assert load(again) == config
    assert toml.write(load(again)) == toml.write(config)


def test_what_was_left_out_stays_out(tmp_path: Path) -> None:
    written = toml.write(load(SHIPPED))
    assert "[ocp.weights" in written
    for name in ("[sim", "[bus", "prefix"):
        assert name not in written


def test_infinite_bounds_and_a_zenoh_file_are_kept(tmp_path: Path) -> None:
    path, again = tmp_path / "robot.toml", tmp_path / "again.toml"
    (tmp_path / "peer.json5").write_text("{}")
    path.write_text(SHIPPED.read_text().replace("u_c = [-0.5, 0.5]", "u_c = [-inf, 0.5]") + "[bus]\nconfig = 'peer.json5'\n")
    config = load(path)
    again.write_text(toml.write(config))
    assert load(again) == config


@pytest.mark.parametrize(
    "value", ["runs/\N{RACING CAR}.csv", "\N{GREEK SMALL LETTER PSI}_dot", 'tab\t, "quotes", \\ and\nlines', "".join(map(chr, range(160)))]
)
def test_any_text_is_written_as_toml_reads_it(value: str) -> None:
    """As JSON, a character beyond 16 bits would be two surrogates, which TOML refuses: a demo's children would not load its configuration."""
    assert toml.read(f"value = {toml.text(value)}") == {"value": value}
    assert toml.read(f"value = {toml.text({value: 1})}") == {"value": {value: 1}}


def test_path_whose_bytes_are_no_text_is_written_without_them() -> None:
    assert toml.text("run-\udcff.csv").encode() == b'"run-?.csv"'


SLIPS = {
    "dt_s = 0,05  # of a stage": "decimals take a point",
    "Q = { x = 1,0, y = 2,0 }": "decimals take a point",
    "dt_s = .05": "a digit on both sides",
    "dt_s = 1.": "a digit on both sides",
    "dt_s = 50ms": "a number has no unit",
    "dt_s: 0.05": "are joined by =",
    "enabled = True": "a switch is true or false",
    "path = none": "a key without a value is left out",
    "robot = pioneer": "text is in straight quotes",
    "robot = “pioneer”": "text is in straight quotes",
    'robot = "pioneer': "with which it began",
    "u = (-0.5, 0.5)": "a list is in square brackets",
    "Q = { x = 1.0,": "ends on the line on which it begins",
    "Q = { x = 1.0, }": "has no comma at its end",
    "guard = { enabled = true, }": "has no comma at its end",
    "guard = { enabled = true,": "ends on the line on which it begins",
    "ub = Inf": "infinity is inf",
    "ub = -Infinity": "infinity is inf",
    "y = NaN": "no number is nan",
    "name = on-board": "text is in straight quotes",
    "length = 5 bar": "a number has no unit",
    "robot = 'twice'": "each key and each table stands once",
}


@pytest.mark.parametrize("line", SLIPS)
def test_slip_is_told_with_its_line_and_with_what_toml_has_there(line: str) -> None:
    with pytest.raises(ConfigError) as refused:
        toml.read(f"robot = 'first'\n\n[ocp]\n{line}\ny = 2.0 }}\n" if "twice" not in line else f"robot = 'first'\n\n\n{line}\n")
    content = line.partition("  #")[0]
    assert str(refused.value).startswith(f"must be TOML, got {content!r} at line 4, column ")
    assert SLIPS[line] in str(refused.value)


@pytest.mark.parametrize(
    "line", ["u = [1,2,3] 4", "[ocp", "text = 'a, b' 'c'", "x = 1 # 0,5 } {", "enabled = true;", "x = 1_000_", "x = 1e", "x = 0xZZ"]
)
def test_no_advice_is_given_on_what_is_no_known_slip(line: str) -> None:
    assert toml.advice(line.partition("#")[0].rstrip()) == ""
