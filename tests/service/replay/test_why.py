# SPDX-License-Identifier: Apache-2.0
"""Explanations of commands, by what they say: a bound, an obstacle, a fallback, a stale state, changed parameters, a takeover."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.status import Mode
from rti_mpc.errors import ConfigError
from rti_mpc.recording.host import HOST
from rti_mpc.recording.writer import RecordingWriter
from rti_mpc.wire.cdr import encode
from rti_mpc.wire.keys import Keys
from rti_mpc_service.config.config import load
from rti_mpc_service.replay.place import Place, acted, find
from rti_mpc_service.replay.rebuild import Journaled, rebuild
from rti_mpc_service.replay.why import explained, lines, main
from rti_mpc_service.shipped import SHIPPED
from tests.recording.samples import telemetry
from tests.service.replay.driven import failing, journal_of, recorded, straight

N = load(SHIPPED).ocp.N
INJECTED = SHIPPED.read_text() + "\n[debug]\ninject = true\n"


def asked(journal: Journaled, place: Place | None, folder: Path) -> tuple[str, dict[str, Any]]:
    assert place is not None
    facts = json.loads(json.dumps(explained(journal, rebuild(journal, folder=folder), place)[0]))
    assert facts["replayed"] == "0 bits differ"
    return "\n".join(lines(facts)), facts


def first(journal: Journaled, wanted: Callable[[Any], bool]) -> Place:
    """The first command as wanted."""
    for seq in range(1, 400):
        place = find(journal, None, seq)
        if place is not None and wanted(place.command):
            return place
    raise AssertionError("no such command")


def test_bound_that_acts_is_named_with_its_stages_and_the_cost_is_told_by_term(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=20, follows=straight(5.0, 0.45))
    text, facts = asked(journal, find(journal, None, 1), tmp_path)
    assert "command 1 of pioneer, at 0.100 s: TRACKING, u_c = 0.25 m/s" in text
    assert "u_c rises as fast as it may, 0.25 m/s per sample: stages 0 to 1" in text
    assert "u_c at its upper bound, 0.5 m/s: stages 1 to " in text
    assert "without it: the same command" in text, "its upper bound begins to act after the command"
    assert "without it: u_c = 0.5 m/s" in text, "it would have risen at once"
    assert "riccati: SOLVED in 1 iteration, 1 QP" in text
    assert "of half an input's range" in text
    assert "error of x 99 %" in text
    assert sum(facts["cost_terms"].values()) == pytest.approx(facts["cost"], rel=1e-6), "all terms are there"
    assert facts["state"]["age_s"] == 0.0


@pytest.mark.slow  # compiles a problem of its own
def test_second_difference_at_its_bound_is_named_and_what_would_be_commanded_without_it(tmp_path: Path) -> None:
    path = tmp_path / "bent.toml"
    path.write_text(SHIPPED.read_text() + "\n[ocp.bounds.second_differences]\nu_c = [-0.05, 0.04]\n")
    journal = journal_of(path, samples=20, follows=straight(5.0, 0.45))
    text, facts = asked(journal, find(journal, None, 1), tmp_path)
    assert "the second difference of u_c at its upper bound, 0.04 m/s per sample squared: stages 0 to " in text
    assert "command 1 of pioneer, at 0.100 s: TRACKING, u_c = 0.04 m/s" in text
    assert "without it: u_c = 0.2 m/s" in text, "it would have risen as fast as the lower bound lets it stop to rise"
    assert sum(facts["cost_terms"].values()) == pytest.approx(facts["cost"], rel=1e-6)


@pytest.mark.slow  # compiles a problem of its own
def test_bound_that_differs_by_stage_is_told_with_its_value_where_it_acts(tmp_path: Path) -> None:
    path = tmp_path / "staged.toml"
    speeds = [0.45, 0.4, 0.4, 0.4, 0.3, 0.25, 0.24, 0.23, *[0.22] * (N - 8)]  # m/s, at nodes 1 to N
    inputs = f"inputs = {{ u_c = {[[-0.5, 0.3], [-0.5, 0.32], *[[-0.5, 0.35]] * (N - 2)]} }}"
    states = f"states = {{ u = {[[-0.5, speed] for speed in speeds]} }}"
    path.write_text(f"{SHIPPED.read_text()}\n[ocp.stages]\n{inputs}\n{states}\n")
    journal = journal_of(path, samples=22, follows=straight(9.0, 0.45))
    text, facts = asked(journal, find(journal, None, 20), tmp_path)
    assert "command 20 of pioneer, at 2.000 s: TRACKING, u_c = 0.3 m/s" in text
    assert "u_c at its upper bound, 0.3 m/s: stage 0; 0.32 m/s: stage 1; 0.35 m/s: stages 2 to 3\n" in text
    assert "u at its upper bound, 0.3 m/s: stage 5; 0.25 m/s: stage 6; 0.24 m/s: stage 7; 0.22 to 0.23 m/s: stages 8 to 20\n" in text
    assert facts["bounds"][0]["bound"] == [0.3, 0.32, 0.35, 0.35], "for machines each stage has its own"


def test_command_is_found_by_its_time_as_by_its_number(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=20)
    by_time, by_seq = find(journal, 1.0, None), find(journal, None, 10)
    assert by_time is not None
    assert by_seq is not None
    assert by_time.entry == by_seq.entry
    assert find(journal, 1000.0, None) is None


def test_braking_for_a_stale_state_says_for_how_long_none_came(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=40, sees=lambda k, state: None if 20 <= k < 26 else state)
    text, facts = asked(journal, first(journal, lambda command: command.mode is Mode.BRAKING), tmp_path)
    assert "BRAKING" in text
    assert "rung 3 of the ladder: a way to rest, from past commands" in text
    assert "state_stale: tracking to braking: no state for 0." in text
    assert facts["solver"] is None


def test_fallback_says_which_plan_goes_on_and_what_failed(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(INJECTED)

    journal = journal_of(path, samples=40, acts={20: failing("qp", 2)})
    text, _ = asked(journal, first(journal, lambda command: command.mode is Mode.FALLBACK), tmp_path)
    assert "rung 2 of the ladder: the previous plan, shifted" in text
    assert "its QP was infeasible" in text
    assert "qp_failed: tracking to fallback: the QP is infeasible: the previous plan is continued" in text
    assert "injected: failure 'qp' was injected on request" in text


@pytest.mark.slow  # compiles the problem with an obstacle
def test_obstacle_that_blocks_is_named_with_the_nodes_at_which_it_acts(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("[ocp.weights]", "[[ocp.obstacles]]\ncentre_m = [0.6, 0.0]\nradius_m = 0.2\n\n[ocp.weights]"))
    journal = journal_of(path, samples=90, follows=straight(0.6))
    place = find(journal, None, 85)
    text, facts = asked(journal, place, tmp_path)
    assert facts["blocked"], text
    assert "the way is blocked: an obstacle or constraint holds it" in text
    assert "disc_0 at its lower bound, 0 m: stages" in text
    assert "without it: u_c = 0.25 m/s" in text


def test_changed_parameters_are_told_with_the_values_of_both(tmp_path: Path) -> None:
    def retune(controller: Any, rti: Any) -> None:
        controller.retune(rti.ocp.retuned(R=np.array([0.25, 1.0])), 3)

    journal = journal_of(SHIPPED, samples=40, acts={20: retune})
    text, facts = asked(journal, find(journal, 3.0, None), tmp_path)
    assert "parameters of version 3: R = [0.25, 1.0], [" in text
    assert "parameters_changed: parameters of version 3" in text
    assert facts["parameters"]["version"] == 3


def test_takeover_is_one_of_the_events(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=30, acts={10: lambda controller, _: controller.stand_by(), 15: lambda controller, _: controller.lead(6)})
    place = first(journal, lambda command: command.epoch == 6)
    text, facts = asked(journal, place, tmp_path)
    assert "took_over: this controller leads, with epoch 6" in text
    assert facts["epoch"] == 6


def test_disagreement_on_request_is_explained_with_what_the_other_solver_says(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(INJECTED)
    journal = journal_of(path, samples=30, acts={20: failing("gradient", 6)})
    place = find(journal, None, 25)
    text, facts = asked(journal, place, tmp_path)
    assert facts["status"] == "SOLVED", "by its own certificate"
    assert facts["second_opinion"]["difference"] > 1e-3
    assert "the two solvers disagree, by more than 0.001: one of them is wrong" in text
    assert "solvers_disagree: OSQP's plans differ by more than 0.001" in text
    assert "injected: failure 'gradient' was injected on request, for 6 samples" in text
    assert "disagree" not in asked(journal, find(journal, None, 15), tmp_path)[0]


def test_last_command_is_explained_where_none_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = journal_of(SHIPPED, samples=12)
    place = find(journal, None, None)
    assert place is not None
    assert place.command.seq == max(one.command.seq for one in acted(journal)) - 1, "the one that is followed by another sample"
    assert main(recorded(journal, tmp_path / "run.mcap"), as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["seq"] == place.command.seq
    with pytest.raises(ConfigError, match=r"--at TIME or with --seq NUMBER, not with both"):
        main(tmp_path / "run.mcap", at_s=1.0, seq=1)


def test_host_that_held_processes_up_is_told_and_a_recording_without_it_explained_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    journal = journal_of(SHIPPED, samples=12)
    command = next(one.command for one in acted(journal) if one.command.seq == 5)
    sample = replace(telemetry(1), epoch=command.epoch, seq=5)
    for name, hosts in (("without", []), ("with", [(0, 0.1), (500_000_000, 0.17), (1_000_000_000, 0.4)])):
        path, keys = tmp_path / f"{name}.mcap", Keys("rti_mpc", journal.robot)

        def add(writer: RecordingWriter, hosts: list[tuple[int, float]] = hosts, keys: Keys = keys) -> None:
            writer.add(journal.robot, keys.telemetry, 700_000_000, encode(sample), 5)
            for from_ns, waited_s in hosts:
                writer.add(journal.robot, keys.of(HOST), from_ns + 500_000_000, json.dumps({"from_ns": from_ns, "waited_s": waited_s}).encode())

        recorded(journal, path, also=add)
    assert main(tmp_path / "with.mcap", seq=5) == 0
    assert "host of the recorder: processes waited for a core for 34% of the 0.5 s around it" in capsys.readouterr().out
    assert main(tmp_path / "with.mcap", seq=5, as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["host"] == {"waited_s": 0.17, "of_s": 0.5}
    assert main(tmp_path / "without.mcap", seq=5) == 0
    assert "host: the recording does not say what it did meanwhile" in capsys.readouterr().out


def test_recording_that_is_not_there_is_refused_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.mcap must be a recording that can be read: No such file or directory"):
        main(tmp_path / "nowhere.mcap")
