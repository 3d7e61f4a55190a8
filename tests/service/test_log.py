# SPDX-License-Identifier: Apache-2.0
"""Log of a process, also when its output is not read."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from datetime import datetime
from threading import Timer
from types import SimpleNamespace
from typing import Any

import pytest

from rti_mpc.contract.message import Notice, Severity
from rti_mpc_service.announce import announce
from rti_mpc_service.log import MAX_WAITING_LINES, Aside, JsonLines, People, robot_ns
from tests.processes.system import PATIENCE_S, ROOT, environment

PIPE_BYTES = 4096
TAKEN = PIPE_BYTES // 60  # lines that the pipe takes before anybody reads it, of 60 bytes and more
LINES = 10 * MAX_WAITING_LINES
TALK = f"""
import logging, sys
from rti_mpc_service import log
log.start()
news = logging.getLogger("controller")
for k in range({LINES}):
    news.info("news %d", k)
print("said", file=sys.stderr, flush=True)
sys.stdin.read()
news.info("the last news")
"""


@pytest.fixture
def talker() -> Iterator[subprocess.Popen[str]]:
    """A process that has written more than its reader takes, and waits for the end of its input."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", TALK]
    with subprocess.Popen(command, cwd=ROOT, env=environment(), stdin=pipe, stdout=pipe, stderr=pipe, pipesize=PIPE_BYTES, text=True) as talker:
        watchdog = Timer(PATIENCE_S, talker.kill)
        watchdog.start()
        try:
            assert talker.stderr is not None
            assert talker.stderr.readline() == "said\n"
            yield talker
        finally:
            watchdog.cancel()
            talker.kill()


def test_standard_output_that_hangs_delays_nobody_and_lets_a_process_end(talker: subprocess.Popen[str]) -> None:
    assert talker.stdin is not None
    talker.stdin.close()
    assert talker.wait() == 0


def test_standard_output_that_goes_on_is_told_what_it_has_missed(talker: subprocess.Popen[str]) -> None:
    assert talker.stdin is not None and talker.stdout is not None
    lines = [talker.stdout.readline() for _ in range(2 * TAKEN)]  # some of which had waited: so there is room for one more
    talker.stdin.close()
    texts = [json.loads(line)["text"] for line in [*lines, *talker.stdout]]
    told = sum(text.startswith("news") for text in texts)
    lost = [int(text.split()[0]) for text in texts if "lost" in text]
    assert lost
    assert told + sum(lost) == LINES
    assert texts[-1] == "the last news"
    assert talker.wait() == 0


def test_record_that_cannot_be_formatted_ends_nobody(capfd: pytest.CaptureFixture[str]) -> None:
    handler = Aside(1)
    handler.handle(logging.makeLogRecord({"name": "controller", "msg": "%d", "args": ("no number",)}))
    handler.handle(logging.makeLogRecord({"name": "controller", "msg": "news"}))
    handler.close()
    out, err = capfd.readouterr()
    assert out == "news\n"
    assert "Logging error" in err


def test_line_holds_wall_time_and_robot_time_where_that_is_known() -> None:
    record = logging.LogRecord("guard", logging.WARNING, "", 0, "news", (), None)
    record.created, record.msecs = 1.0625, 62.5
    line = json.loads(JsonLines().format(record))
    assert (datetime.fromisoformat(line["time"]).timestamp(), line.get("robot_s")) == (1.062, None)
    assert People("%(message)s").format(record) == "news"
    record.robot_ns = 12_345_678_901
    assert json.loads(JsonLines().format(record))["robot_s"] == 12.346
    assert People("%(message)s").format(record) == "news  (robot time 12.346 s)"


def test_mode_change_is_logged_with_the_robot_s_time(caplog: pytest.LogCaptureFixture) -> None:
    announcer: Any = SimpleNamespace(say=lambda notice, stamp_ns: True)
    with caplog.at_level(logging.INFO):
        for stamp_ns in (1_500_000_000, 0):
            announce(logging.getLogger("guard"), announcer, Notice(Severity.INFO, "guard_passing", "commands pass"), stamp_ns)
    assert [robot_ns(record) for record in caplog.records] == [1_500_000_000, None], "none before the first state"
