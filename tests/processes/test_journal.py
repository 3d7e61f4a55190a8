# SPDX-License-Identifier: Apache-2.0
"""Journal of a controller that runs: caught on the bus, it replays without a differing bit, twice."""

from __future__ import annotations

import json
import re
import signal
from pathlib import Path

import pytest

from rti_mpc.contract.message import Command, Telemetry
from rti_mpc.contract.status import Mode
from rti_mpc.errors import ConfigError
from rti_mpc.wire.cdr import decode
from rti_mpc_service.replay.rebuild import journals, rebuild
from rti_mpc_service.replay.trouble import kept, troubles
from rti_mpc_service.shipped import SHIPPED
from tests.guarded import write_robot
from tests.processes.system import ANSWERED, PATIENCE_S, System, heard, rti_mpc, until

pytestmark = pytest.mark.slow


def ask(system: System, **request: object) -> None:
    assert system.bus.request(system.keys.request, request, PATIENCE_S)["ok"]


def known(run: Path) -> int:
    """Return of how many controllers a recording that goes on has both a journal and the files."""
    try:
        return sum(bool(journal.files) for journal in journals(run))
    except ConfigError:  # of nobody yet
        return 0


def asked(system: System, *request: object) -> None:
    done = rti_mpc(*request, system.config, "-e", system.endpoint, *ANSWERED)
    assert done.returncode == 0, done.stderr


def test_journal_of_a_run_with_whatever_an_operator_and_a_link_do_replays_without_a_differing_bit_twice(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("live = false", "live = true") + "\n[debug]\ninject = true\n")
    run = tmp_path / "run.mcap"
    with System(tmp_path, path, recorder=("record", "--out", run)) as system:
        commands = system.bus.subscriber(system.keys.command, capacity=4096)
        system.start("recorder")
        system.opened("recorder")
        system.start("robot", "controller", "reference")
        system.tracking()
        asked(system, "stop")
        heard(system.bus.subscriber(system.keys.command), Command, lambda command: command.mode is Mode.STOPPED)
        asked(system, "enable")
        system.tracking()
        done = rti_mpc("params", "set", system.config, "ocp.weights.R.u_c=2.0", "-e", system.endpoint, *ANSWERED)
        assert done.returncode == 0, done.stderr
        ask(system, request="inject", failure="qp", samples=6)
        telemetry = system.bus.subscriber(system.keys.telemetry)
        heard(telemetry, Telemetry, lambda sample: sample.fallbacks >= 5)
        system.fault(signal.SIGSTOP, "robot")
        heard(system.bus.subscriber(system.keys.command), Command, lambda command: command.mode is Mode.BRAKING)
        system.running["robot"].send_signal(signal.SIGCONT)
        system.tracking()
        asked(system, "snapshot")
        system.kill("robot")
        system.start("robot")
        system.tracking()
        heard(telemetry, Telemetry, lambda sample: sample.mode is Mode.TRACKING)
        system.interrupt("controller")
        last = [decode(Command, received.payload) for received in commands.drain()][-1]
        system.interrupt("recorder")
    for _ in range(2):
        done = rti_mpc("replay", run)
        print(done.stdout)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "0 bits differ" in done.stdout
        assert "not covered" not in done.stdout
        assert int(done.stdout.partition(" commands of")[0].split()[-1]) >= last.seq
    done = rti_mpc("replay", run, "--set", "ocp.weights.Q.psi=0", "--set", "ocp.weights.R.u_c=2.000000002")
    print(done.stdout)
    assert done.returncode == 0, done.stderr
    assert re.search(r"omega_c: \S+ rad/s away on average", done.stdout)
    (journal,) = journals(run)
    was = {case.about["seq"]: case for case in kept(journal)}
    assert any(case.about["why"] == "it failed" for case in was.values())
    built = rebuild(journal, folder=Path())
    for made in troubles(journal, built):
        if (one := was.pop(made.about["seq"], None)) is not None:
            assert one.qp.A.data.tobytes() == made.qp.A.data.tobytes()
            assert one.z.tobytes() == made.z.tobytes()
    assert not was, "a replay makes each of them, too"
    why = rti_mpc("why", run, "--seq", 20)
    print(why.stdout)
    assert why.returncode == 0, why.stderr
    assert why.stdout.startswith("command 20 of pioneer")
    assert "times: preparation " in why.stdout
    done = rti_mpc("replay", run, "--from", f"{1e-9 * last.stamp_ns:.3f}s", "--json", tmp_path / "replay.json")
    (told,) = json.loads((tmp_path / "replay.json").read_text())
    assert (told["differing"], told["not_covered"]) == (0, [])
    assert 0 < told["commands"] < last.seq


def test_both_controllers_of_a_takeover_behind_a_guard_replay_without_a_differing_bit(tmp_path: Path) -> None:
    """The leader is killed: its journal ends within the second before that, and its standby's goes on through the takeover."""
    path, run = write_robot(tmp_path / "robot.toml"), tmp_path / "run.mcap"
    with System(tmp_path, path, recorder=("record", "--out", run), standby=("run", "--standby")) as system:
        system.start("recorder")
        system.opened("recorder")
        system.start("robot", "guard", "controller", "reference")
        first = system.tracking()
        system.start("standby")
        shadow = system.bus.subscriber(system.keys.standby_telemetry)
        heard(shadow, Telemetry, lambda sample: sample.mode is Mode.TRACKING)
        until(lambda: known(run) == 2, "the recorder has what both replays need", pause_s=0.5)
        system.kill("controller")
        commands = system.bus.subscriber(system.keys.command, capacity=4096)
        heard(commands, Command, lambda command: command.epoch > first.epoch and command.mode is Mode.TRACKING)
        system.interrupt("standby")
        system.interrupt("recorder")
    done = rti_mpc("replay", run, "--json", tmp_path / "replay.json")
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr
    accounts = json.loads((tmp_path / "replay.json").read_text())
    assert len(accounts) == 2
    for account in accounts:
        assert (account["differing"], account["not_covered"], account["other"]) == (0, [], [])
        assert account["commands"] > 3
