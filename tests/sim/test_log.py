# SPDX-License-Identifier: Apache-2.0
"""Log of the robot: one line per state, with its answer."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.model.robots.pioneer_3dx import pioneer_3dx
from rti_mpc.wire.actuator import Counters
from rti_mpc_sim.log import ANSWER_TIMEOUT_NS, Log

X = np.array([1.0, 2.0, 0.1 + 0.2, 0.0, 0.0])
U = np.zeros(2)


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_lines_name_their_columns_and_keep_every_digit(tmp_path: Path) -> None:
    log = Log(tmp_path / "robot.csv", pioneer_3dx())
    log.measured(1, 0, X, U, Counters(lost=2, starved=1), 0)
    log.close()
    (line,) = read(tmp_path / "robot.csv")
    assert list(line) == [
        *("stamp_ns", "seq", "x", "y", "psi", "u", "omega", "u_c", "omega_c", "command_seq", "latency_us"),
        *("lost", "late", "expired", "refused", "starved"),
    ]
    assert float(line["psi"]) == 0.1 + 0.2
    assert (line["lost"], line["starved"], line["command_seq"], line["latency_us"]) == ("2", "1", "", "")


def test_first_answer_counts_and_a_state_nobody_answers_stays_blank(tmp_path: Path) -> None:
    log = Log(tmp_path / "robot.csv", pioneer_3dx())
    for seq in (1, 2, 3):
        log.measured(seq, 100 * seq, X, U, Counters(), 1000 * seq)
        log.sent(seq, 1000 * seq)
    log.answered(2, 7, 5000)
    log.answered(2, 8, 9000)
    log.answered(99, 9, 9000)
    log.write(10_000)
    assert read(tmp_path / "robot.csv") == []  # the first may still be answered
    log.write(ANSWER_TIMEOUT_NS + 1000)
    assert [(line["seq"], line["command_seq"], line["latency_us"]) for line in read(tmp_path / "robot.csv")] == [("1", "", ""), ("2", "7", "3.0")]
    log.close()
    assert len(read(tmp_path / "robot.csv")) == 3


def test_record_without_a_path_goes_nowhere() -> None:
    log = Log(None, pioneer_3dx())
    log.measured(1, 0, X, U, Counters(), 0)
    log.close()


def test_record_that_cannot_be_written_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"log must be a file that can be written, got .*nowhere"):
        Log(tmp_path / "nowhere" / "robot.csv", pioneer_3dx())
