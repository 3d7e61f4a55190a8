# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import subprocess
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from rti_mpc_service.cli import SHIPPED
from rti_mpc_service.host.hold_up import Host
from tests.in_time import MS, in_time
from tests.processes.system import ROOT, command_line, environment, until

pytestmark = pytest.mark.slow

UNUSED_ENDPOINT = "tcp/127.0.0.1:9"
COMMANDS: dict[str, tuple[object, ...]] = {
    "run": (),
    "guard": (),
    "reference": (),
    "sim": ("-l", "tcp/127.0.0.1:0"),
    **({"view": ("--rerun-save", "run.rrd")} if find_spec("rerun") else {}),
}
MAX_REMINDER_MS = 5000.0


@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize("command", COMMANDS)
def test_process_that_reaches_nobody_says_so_within_five_seconds_and_ends_well(command: str, mode: str, tmp_path: Path, host: Host) -> None:
    config, log = tmp_path / "robot.toml", tmp_path / "log"
    config.write_text(SHIPPED.read_text() + "\n[guard]\nenabled = true\n")
    options = [tmp_path / option if option == "run.rrd" else option for option in COMMANDS[command]]
    if mode == "client":
        options = [option for option in options if option != "-l" and "127.0.0.1:0" not in str(option)]
    began_ns = time.monotonic_ns()
    with log.open("wb") as file:
        line = command_line(command, config, "-e", UNUSED_ENDPOINT, "-m", mode, *options)
        process = subprocess.Popen(line, cwd=ROOT, env=environment(), stdout=file, stderr=subprocess.STDOUT)
    try:
        until(lambda: "not connected" in log.read_text(errors="replace"), f"{command} says that it reaches nobody", pause_s=0.01, patience_s=60.0)
        in_time(host, f"to say of {command} that it reaches nobody", (time.monotonic_ns() - began_ns) / MS, MAX_REMINDER_MS, began_ns)
        process.terminate()
        assert process.wait(30.0) == 0
        assert "Traceback" not in log.read_text(errors="replace")
    finally:
        process.kill()
        process.wait()
