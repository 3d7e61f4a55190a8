# SPDX-License-Identifier: Apache-2.0
"""Edit of values in a TOML file: everything else stays, character by character."""

from __future__ import annotations

import tomllib

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.tune.edit import commented, edited
from tests.robots import SHIPPED


@pytest.mark.parametrize(
    ("text", "key", "after"),
    [
        ("[a.Q]\nx = 1.0 # of x\n", "a.Q.x", "[a.Q]\nx = 2.5 # of x\n"),
        ("[a]\nQ = { x = 1, y = 1 }\n", "a.Q.y", "[a]\nQ = { x = 1, y = 2.5 }\n"),
        ("a.Q.x = 1e-3\n", "a.Q.x", "a.Q.x = 2.5\n"),
        ('[a]\nQ = { "x" = 1.0 }\n', "a.Q.x", '[a]\nQ = { "x" = 2.5 }\n'),
        ("[a]\nlambda = [0.8]\n", "a.lambda", "[a]\nlambda = 2.5\n"),
        ("# x = 1.0\n[b]\nx = 1.0\n[a]\nx = 1.0 # x = 1.0\n", "a.x", "# x = 1.0\n[b]\nx = 1.0\n[a]\nx = 2.5 # x = 1.0\n"),
        ("[a]\nmax_x = 1.0\nx = -1_0.0\n", "a.x", "[a]\nmax_x = 1.0\nx = 2.5\n"),
        ("[a]  # of a\ny = 1\n", "a.x", "[a]  # of a\nx = 2.5\ny = 1\n"),
        ("[b]\ny = 1\n", "a.x", "[b]\ny = 1\n\n[a]\nx = 2.5\n"),
    ],
)
def test_value_is_changed_where_the_key_stands_and_nowhere_else(text: str, key: str, after: str) -> None:
    assert edited(text, {key: 2.5}) == after


def test_value_that_is_no_plain_number_is_refused_by_its_key() -> None:
    with pytest.raises(ConfigError, match=r"^a\.x must be written as a plain number"):
        edited('[a]\nx = "measured"\n', {"a.x": 2.5})


def test_shipped_file_keeps_its_comments_and_gains_one() -> None:
    text = SHIPPED.read_text(encoding="utf-8")
    after = commented(edited(text, {"ocp.weights.R.omega_c": 0.123, "ocp.N": 12, "timing.delay_s": 0.05}), ["tuned"])
    read = tomllib.loads(after)
    assert (read["ocp"]["weights"]["R"], read["ocp"]["N"], read["timing"]) == ({"u_c": 1.0, "omega_c": 0.123}, 12, {"delay_s": 0.05})
    assert after.startswith("# SPDX-License-Identifier: Apache-2.0\n")
    assert "#\n# tuned\n\nrobot =" in after
    gone = set(text.splitlines()) - set(after.splitlines())
    assert {line.partition("=")[0].strip() for line in gone} == {"N", "R"}
