# SPDX-License-Identifier: Apache-2.0
"""Closed loop from a recording: the recorded controller, or one with other weights, drives the simulated robot."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.contract.message import JournalKind, State
from rti_mpc.control.controller import Controller
from rti_mpc.errors import ConfigError
from rti_mpc.recording import Recording
from rti_mpc.reference.speed_profile import SpeedLimits
from rti_mpc.rti.rti import Rti
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.build import build_model
from rti_mpc_service.config.config import load
from rti_mpc_service.path_reference import PathReferences, find_path
from rti_mpc_service.replay.beside import write_both
from rti_mpc_service.replay.closed_loop import free_name, numbers_of, run_of
from rti_mpc_service.replay.drive import Drive, Passage, drive
from rti_mpc_service.replay.place import find
from rti_mpc_service.replay.rebuild import Journaled, rebuild
from rti_mpc_service.replay.replay import main, overridden, snapshot_before
from rti_mpc_service.replay.robot_time import first_stamp
from rti_mpc_service.replay.why import explained
from rti_mpc_service.shipped import SHIPPED
from tests.loop import MS
from tests.processes.test_path import robot_in
from tests.service.replay.driven import journal_of, recorded, straight


def stop(controller: Controller, rti: Rti) -> None:
    controller.stop("by an operator")


def enable(controller: Controller, rti: Rti) -> None:
    controller.enable()


def passages(journal: Journaled, folder: Path, assignments: tuple[str, ...] = (), start_s: float | None = None) -> tuple[Passage, Passage]:
    """The drive as it was recorded, and in closed loop."""
    found = []
    for make_body in (None, lockstep_robot):
        built = rebuild(journal, folder=folder)
        override = overridden(built.config, built.rti.ocp, assignments) if make_body is not None else {}
        found.append(drive(Drive(built, first_stamp(start_s), make_body, override), journal, snapshot_before(journal, start_s)))
    return found[0], found[1]


def states(passage: Passage) -> list[Any]:
    return [[state.seq, state.stamp_ns, state.command_seq, *state.x, *state.u] for state in passage.states]


def test_same_settings_in_closed_loop_drive_as_recorded_also_through_a_stop_and_missing_states(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=60, acts={25: stop, 40: enable}, sees=lambda k, state: None if k == 10 else state)
    was, driven = passages(journal, tmp_path)
    assert len(was.states) == 59
    assert states(driven) == states(was), "the simulated robot is that of the recording, and commands arrive when they did: no bit differs"
    assert [command.u.tolist() for command in driven.commands] == [command.u.tolist() for command in was.commands]
    assert {"stop", "enable"} <= {event.code for event in driven.events}
    assert driven.solved["stopped"] > 5


def test_standby_that_took_over_is_driven_from_its_takeover_on_and_explained(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=40, acts={0: lambda controller, _: controller.stand_by(), 15: lambda controller, _: controller.lead(6)})
    was, driven = passages(journal, tmp_path)
    assert was.states[0].stamp_ns == driven.states[0].stamp_ns == 1500 * MS, "the first state that it answers"
    assert len(was.samples) == len(driven.samples) > 20
    assert states(driven) == pytest.approx(np.array(states(was)), abs=1e-9), "it goes on from a state that was read, not from the robot's own"
    place = find(journal, 0.0, None)
    assert place is not None
    assert place.command.epoch == 6, "the first command that acted"
    facts = explained(journal, rebuild(journal, folder=tmp_path), place)[0]
    assert facts["replayed"] == "0 bits differ"
    assert ["stands_by", "took_over"] == [one["code"] for one in facts["events"] if one["code"] in ("stands_by", "took_over")][-2:]


SAMPLED = """
import casadi as ca
from rti_mpc import Model, Signal

def robot():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    after = ca.vertcat(x[0] + 0.1 * x[1], 0.8 * x[1] + 0.2 * u)
    signals = (Signal("position", "m"), Signal("speed", "m/s"))
    return Model(name="sampled", x=x, u=u, y_expr=x, disc_dyn_expr=after, dt=0.1, states=signals, outputs=signals, inputs=(Signal("u_c", "m/s"),))
"""
SAMPLED_TOML = """
robot = "sampled"
model = { name = "sampled:robot" }
[ocp]
N = 5
dt_s = 0.1
weights = { Q = { position = 5.0, speed = 0.1 }, R = { u_c = 1.0 } }
[ocp.bounds]
inputs = { u_c = [-0.5, 0.5] }
increments = { u_c = [-0.25, 0.25] }
"""


@pytest.mark.slow  # compiles a problem of its own
def test_robot_in_discrete_time_is_driven_as_it_was_and_explained(tmp_path: Path) -> None:
    (tmp_path / "sampled.py").write_text(SAMPLED)
    (tmp_path / "robot.toml").write_text(SAMPLED_TOML)
    follows = straight(5.0, 0.45)
    journal = journal_of(tmp_path / "robot.toml", samples=20, follows=replace(follows, y=follows.y[:, :2]))
    was, driven = passages(journal, tmp_path)
    assert len(was.states) == 20
    assert states(driven) == states(was), "no bit differs"
    place = find(journal, None, 3)
    assert place is not None
    facts = explained(journal, rebuild(journal, folder=tmp_path), place)[0]
    assert facts["replayed"] == "0 bits differ"
    assert sum(facts["cost_terms"].values()) == pytest.approx(facts["cost"], rel=1e-6), "all terms are there"
    assert facts["bounds"]


@pytest.mark.slow  # compiles a problem of its own
def test_robot_that_follows_a_path_is_driven_as_it_was_and_explained(tmp_path: Path) -> None:
    """Each reference holds the path around the robot, as its source sends it ten times a second."""
    path = robot_in(tmp_path)
    references = PathReferences(build_model(load(path)), find_path(str(tmp_path / "track.csv"), 0.25, SpeedLimits(0.4, 0.3, 0.3, 0.3)), 1)
    start = np.zeros(7)
    references.begin(start)
    follows = references.answer(0, start)
    assert follows is not None
    seen: list[State] = []

    def see(k: int, state: State) -> State:
        seen.append(state)
        return state

    def send(controller: Controller, rti: Rti) -> None:
        if seen and (reference := references.answer(seen[-1].stamp_ns, seen[-1].x)) is not None:
            controller.receive_reference(reference)

    journal = journal_of(path, samples=60, acts=dict.fromkeys(range(60), send), sees=see, follows=follows)
    was, driven = passages(journal, tmp_path)
    assert was.states[-1].x[5] > 1.2, "m of progress"
    assert len(was.references) > 50
    assert states(driven) == states(was), "no bit differs"
    for seq in (1, 40):
        place = find(journal, None, seq)
        assert place is not None
        facts = explained(journal, rebuild(journal, folder=tmp_path), place)[0]
        assert facts["replayed"] == "0 bits differ"
        assert sum(facts["cost_terms"].values()) == pytest.approx(facts["cost"], rel=1e-6), "contour and lag of the path that it was sent"
    assert {"error of contour", "error of lag", "error of pace_error"} <= set(facts["cost_terms"])


@pytest.mark.slow
def test_drive_from_the_middle_begins_with_the_state_and_the_inputs_of_that_time(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=60)
    was, driven = passages(journal, tmp_path, start_s=4.0)
    assert was.states[0].stamp_ns == 4000 * MS
    assert states(driven) == pytest.approx(np.array(states(was)), abs=1e-9), "the robot goes on from a state that has wrapped its angles"


@pytest.mark.slow
def test_other_weights_drive_another_way(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=40, follows=straight(5.0, 0.3))
    built = rebuild(journal, folder=tmp_path)
    was, driven = (
        numbers_of(passage, run_of(passage, built.rti.ocp, 1.0, ""), built.rti.ocp)
        for passage in passages(journal, tmp_path, ("ocp.weights.R.u_c=30", "ocp.weights.R.omega_c=30"))
    )
    assert driven["effort"] < 0.9 * was["effort"], "changes of the inputs cost more"
    assert driven["x_rms"] > 1.05 * was["x_rms"], "so it catches up later"
    assert driven["samples"] == was["samples"]


@pytest.mark.slow
def test_closed_loop_ends_where_entries_are_missing(tmp_path: Path) -> None:
    journal = journal_of(SHIPPED, samples=60)
    calls = [message for message in journal.messages if message.kind is JournalKind.CALLS and message.stamp_ns == 3000 * MS]
    gap = replace(journal, messages=[message for message in journal.messages if message is not calls[0]])
    was, driven = passages(gap, tmp_path)
    assert was.states[-1].stamp_ns == driven.states[-1].stamp_ns == 2900 * MS


@pytest.mark.slow
def test_both_drives_are_told_in_numbers_drawn_and_written_into_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    journal = journal_of(SHIPPED, samples=60)
    was, _ = passages(journal, tmp_path)
    path = recorded(journal, tmp_path / "run.mcap", was.states)
    status = main(path, assignments=["ocp.weights.R.u_c=30"], make_body=lockstep_robot, out=tmp_path / "out", json_path=tmp_path / "run.json")
    text = capsys.readouterr().out
    assert status == 0, text
    assert "0 bits differ" in text
    assert "in closed loop with ocp.weights.R.u_c=30, 5.8 s from 0.100 s on, numbers after 2.9 s" in text
    (result,) = json.loads((tmp_path / "run.json").read_text())
    loop = result["closed_loop"]
    assert loop["closed_loop"]["distance_mm_rms"] != loop["recorded"]["distance_mm_rms"]
    assert loop["closed_loop"]["samples_by"] == {"riccati": 59}
    both = Recording(tmp_path / "out" / "pioneer-5.mcap")
    assert both.robots == ["pioneer", "pioneer_closed_loop"]
    begins = {robot: next(both.messages(robot, ("state",))) for robot in both.robots}
    assert len({(each.local_ns, each.message.stamp_ns) for each in begins.values()}) == 1, "both begin at once, so one axis of time fits both"
    assert set(both.streams["pioneer_closed_loop"]) == {"state", "command", "telemetry", "info", "reference/anchored", "event"}
    assert (tmp_path / "out" / "pioneer-5.png").stat().st_size > 20_000


def test_files_of_an_earlier_comparison_stay(tmp_path: Path) -> None:
    for taken, free in (("other-5.mcap", "robot-5"), ("robot-5.mcap", "robot-5-2"), ("robot-5-2.png", "robot-5-3")):
        (tmp_path / taken).touch()
        assert free_name(tmp_path, "robot-5") == free


def test_folder_that_is_a_file_is_refused_before_anything_is_driven(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(journal_of(SHIPPED, samples=5), tmp_path / "run.mcap")
    with pytest.raises(ConfigError, match=r"--out must be a folder, or a name that is free, got the file .*run\.mcap"):
        main(path, make_body=lockstep_robot, out=path)
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_recording_that_says_too_little_for_a_comparison_is_told_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From where it has ended or is about to, without states, and of a robot that follows nothing after the first half, of which JSON has no NaN."""
    path = recorded(journal_of(SHIPPED, samples=20, acts={8: stop}), tmp_path / "run.mcap")
    with pytest.raises(ConfigError, match=r"--from must be a time of the robot's clock in the recording, from 0\.000 s to 1\.900 s, got 7\.000 s"):
        main(path, make_body=lockstep_robot, start_s=7.0)
    assert main(path, make_body=lockstep_robot, start_s=1.9) == 0
    assert "no closed loop: " in capsys.readouterr().out
    with pytest.raises(ConfigError, match=r"--out must have a recording with the states of pioneer, got .* with its journal alone"):
        main(path, make_body=lockstep_robot, out=tmp_path / "out")
    main(path, make_body=lockstep_robot, json_path=tmp_path / "run.json")
    text = (tmp_path / "run.json").read_text()
    assert "NaN" not in text
    (result,) = json.loads(text)
    assert result["closed_loop"]["recorded"]["x_rms"] is None


def test_recording_is_not_overwritten_by_that_of_both_drives(tmp_path: Path) -> None:
    path = tmp_path / "pioneer-5.mcap"
    path.write_bytes(b"precious")
    nothing: Any = None  # is looked at before
    with pytest.raises(ConfigError, match=r"--out must be a folder in which pioneer-5\.mcap is not the recording itself"):
        write_both(path, path, nothing, nothing, nothing)
    assert path.read_bytes() == b"precious"
