# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np

from rti_mpc.wire.info import Info, Label
from rti_mpc_service.rig import robot_log

INFO = Info(role="controller", states=(Label("x", "m"), Label("v", "m/s")), inputs=(Label("a", "m/s^2"),))
TEXT = """stamp_ns,seq,x,v,a,command_seq,latency_us,lost,late,expired,refused,starved
0,1,0.5,0.0,0.0,,,0,0,0,0,0
100000000,2,0.6,1.0,-1.0,7,310.5,0,1,0,2,0
"""


def test_record_is_read_by_the_names_of_the_model(tmp_path: Path) -> None:
    (tmp_path / "robot.csv").write_text(TEXT)
    log = robot_log.read(tmp_path / "robot.csv", INFO)
    assert log.stamp_ns.tolist() == [0, 100_000_000]
    assert log.x.tolist() == [[0.5, 0.0], [0.6, 1.0]]
    assert log.u.tolist() == [[0.0], [-1.0]]
    np.testing.assert_array_equal(log.latency_us, [np.nan, 310.5])
    assert log.counters == {"lost": 0, "late": 1, "expired": 0, "refused": 2, "starved": 0}
    assert log.part(log.stamp_ns > 0).seq.tolist() == [2]


def test_record_of_a_robot_that_never_measured_is_empty(tmp_path: Path) -> None:
    (tmp_path / "robot.csv").write_text(TEXT.splitlines()[0] + "\n")
    log = robot_log.read(tmp_path / "robot.csv", INFO)
    assert (log.x.shape, log.u.shape, log.latency_us.shape) == ((0, 2), (0, 1), (0,))
