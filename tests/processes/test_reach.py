# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from rti_mpc_service.host.hold_up import Host
from rti_mpc_service.rig.endpoint import free_endpoint
from rti_mpc_service.shipped import SHIPPED
from tests.guarded import write_robot
from tests.in_time import MS, computed_ms, in_time
from tests.processes.system import PATIENCE_S, ROOT, command_line, environment, until

pytestmark = pytest.mark.slow

UNUSED_ENDPOINT = "tcp/127.0.0.1:9"
COMMANDS: dict[str, tuple[object, ...]] = {
    "run": (),
    "guard": (),
    "reference": (),
    "sim": ("-l", "tcp/127.0.0.1:0"),
    **({"view": ("--rerun-save", "run.rrd")} if find_spec("rerun") else {}),
}
MAX_REMINDER_MS = 3000.0  # besides what the process computes: of the 5 s that an operator waits, an idle host of today starts one in 2


@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize("command", COMMANDS)
def test_process_that_reaches_nobody_says_so_within_three_seconds_besides_its_start_and_ends_well(
    command: str, mode: str, tmp_path: Path, host: Host
) -> None:
    config, log = write_robot(tmp_path / "robot.toml"), tmp_path / "log"
    options = [tmp_path / option if option == "run.rrd" else option for option in COMMANDS[command]]
    if mode == "client":
        options = [option for option in options if option != "-l" and "127.0.0.1:0" not in str(option)]
    began_ns = time.monotonic_ns()
    with log.open("wb") as file:
        line = command_line(command, config, "-e", UNUSED_ENDPOINT, "-m", mode, *options)
        process = subprocess.Popen(line, cwd=ROOT, env=environment(), stdout=file, stderr=subprocess.STDOUT)
    try:
        until(lambda: "not connected" in log.read_text(errors="replace"), f"{command} says that it reaches nobody", pause_s=0.01)
        took_ms, limit_ms = (time.monotonic_ns() - began_ns) / MS, MAX_REMINDER_MS + computed_ms(process)
        in_time(host, f"to say of {command} that it reaches nobody", took_ms, limit_ms, began_ns)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
        assert "Traceback" not in log.read_text(errors="replace")
    finally:
        process.kill()
        process.wait()


def certificate(folder: Path, name: str, signer: str) -> None:
    """Make a key and a certificate for this host, signed by an authority; by itself where it is one."""
    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-keyout", f"{name}.key", "-subj", f"/CN={name}")
    if name == signer:
        lines = [("req", "-x509", *key, "-out", f"{name}.pem", "-days", "1")]
    else:
        (folder / "for").write_text("subjectAltName=IP:127.0.0.1\n")
        signed = ("x509", "-req", "-in", "request", "-CA", f"{signer}.pem", "-CAkey", f"{signer}.key", "-CAcreateserial", "-days", "1")
        lines = [("req", "-new", *key, "-out", "request"), (*signed, "-extfile", "for", "-out", f"{name}.pem")]
    for line in lines:
        subprocess.run(["openssl", *line], cwd=folder, check=True, capture_output=True)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed: certificates were NOT tried")
@pytest.mark.parametrize("mode", ["peer", "client"])
@pytest.mark.parametrize(
    ("trusted", "reason"),
    [("ours", "the router refuses {}/stranger.pem, which is of another authority"), ("theirs", "of another authority than {}/theirs.pem")],
    ids=["of a strange authority", "trusting a strange one"],
)
def test_process_with_a_wrong_certificate_says_why_it_is_refused(trusted: str, reason: str, mode: str, tmp_path: Path, host: Host) -> None:
    for name, signer in (("ours", "ours"), ("theirs", "theirs"), ("router", "ours"), ("stranger", "theirs")):
        certificate(tmp_path, name, signer)
    endpoint = free_endpoint().replace("tcp/", "tls/")

    def zenoh(name: str, role: str, about: dict[str, object], authority: str, prefix: str) -> Path:
        files = {f"{prefix}_private_key": f"{name}.key", f"{prefix}_certificate": f"{name}.pem", "root_ca_certificate": f"{authority}.pem"}
        tls = {key: str(tmp_path / file) for key, file in files.items()} | {"enable_mtls": True}
        path = tmp_path / f"{name}.json5"
        path.write_text(json.dumps({"mode": role, **about, "transport": {"link": {"tls": tls}}}))
        return path

    router = zenoh("router", "router", {"listen": {"endpoints": [endpoint]}}, "ours", "listen")
    stranger = zenoh("stranger", mode, {"connect": {"endpoints": [endpoint]}}, trusted, "connect")
    logs, processes = {}, []
    try:
        for command, config, word in (("router", router, "routing"), ("reference", stranger, "not connected")):
            logs[command], began_ns = tmp_path / f"{command}.log", time.monotonic_ns()
            with logs[command].open("wb") as file:
                line = command_line(command, SHIPPED, "-c", config)
                processes.append(subprocess.Popen(line, cwd=ROOT, env=environment(), stdout=file, stderr=subprocess.STDOUT))
            until(lambda c=command, w=word: w in logs[c].read_text(errors="replace"), f"{command} says {word}", pause_s=0.01)
        limit_ms = MAX_REMINDER_MS + computed_ms(processes[-1])
        in_time(host, "to say that nobody is reached", (time.monotonic_ns() - began_ns) / MS, limit_ms, began_ns)
        assert re.search(f"{endpoint}: .*{reason.format(tmp_path)}", logs["reference"].read_text())
        for process in reversed(processes):
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
    finally:
        for process in processes:
            process.kill()
            process.wait()
