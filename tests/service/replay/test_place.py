# SPDX-License-Identifier: Apache-2.0
"""Which command of a recording is meant, where several controllers or robots are in it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.control.controller import Controller
from rti_mpc.errors import ConfigError
from rti_mpc_service.replay import replay
from rti_mpc_service.replay.place import acted, choose
from rti_mpc_service.replay.rebuild import Journaled
from rti_mpc_service.replay.robot_time import check_time, parse_time
from rti_mpc_service.replay.why import main
from rti_mpc_service.shipped import SHIPPED
from tests.loop import MS
from tests.service.replay.driven import Act, journal_of, recorded, straight

PATH = Path("run.mcap")
EPOCH = (1 << NUMBER_BITS) + 6


@pytest.fixture(scope="module")
def leader() -> Journaled:
    """Number 5: it leads for 1.5 s, with epoch 5, and then stands by."""
    return journal_of(SHIPPED, samples=30, acts={15: lambda controller, _: controller.stand_by()})


@pytest.fixture(scope="module")
def relieved(leader: Journaled) -> Journaled:
    """The leader where it stands by because it hears a command of another."""
    other = replace(next(acted(leader)).command, epoch=EPOCH)

    def hear(controller: Controller, _: object) -> None:
        controller.overhear(other)
        controller.stand_by()

    return journal_of(SHIPPED, samples=30, acts={15: hear})


@pytest.fixture(scope="module")
def standby(leader: Journaled) -> Journaled:
    """Number 6: it hears what the other one commands, and takes over after 1.5 s."""
    acts: dict[int, Act] = {}
    for k, place in enumerate(acted(leader)):
        acts[k] = lambda controller, _, command=place.command: controller.overhear(command)
    acts |= {0: lambda controller, _: controller.stand_by(), 15: lambda controller, _: controller.lead(EPOCH)}
    made = journal_of(SHIPPED, samples=30, acts=acts)
    return replace(made, owner=6, messages=[replace(message, epoch=EPOCH) for message in made.messages])


def test_time_is_that_of_the_robots_clock_whoever_led(leader: Journaled, standby: Journaled) -> None:
    for order in ([leader, standby], [standby, leader]):
        for at_s, owner in ((0.1, 5), (0.6, 5), (2.1, 6)):
            journal, place = choose(PATH, order, at_s, None)
            assert journal.owner == owner
            assert place.command.stamp_ns == pytest.approx(round(1e9 * at_s), abs=50 * MS)
        assert choose(PATH, order, None, None)[0].owner == 6, "the last command of all"


def test_time_as_it_is_printed_finds_its_command_and_one_that_is_not_in_the_recording_is_refused_with_those_that_are() -> None:
    """The clock of this robot is the Unix time, and its stamps are no whole milliseconds."""
    unix_ns = 1_764_000_000_000_700_000
    follows = replace(straight(5.0), stamp_ns=unix_ns)
    journal = journal_of(SHIPPED, samples=12, sees=lambda _, state: replace(state, stamp_ns=state.stamp_ns + unix_ns), follows=follows)
    assert len(list(acted(journal))) > 5
    for place in acted(journal):
        assert choose(PATH, [journal], float(f"{1e-9 * place.command.stamp_ns:.3f}"), None)[1].entry == place.entry
    with pytest.raises(ConfigError, match=r"--at must be a time of the robot's clock in the recording, from 1764\d+\.\d{3} s to \S+ s, got 1\.000 s"):
        choose(PATH, [journal], 1.0, None)
    with pytest.raises(ConfigError, match=r"--from must be .* got 1764000002\.000 s"):
        check_time("--from", 1764000002.0, [journal])


@pytest.mark.parametrize("text", ["1:30", "nan", "inf", ""])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"a time must be in seconds of the robot's clock, such as 72\.5s, got"):
        parse_time(text)


def test_number_that_two_controllers_have_given_needs_the_controller(leader: Journaled, standby: Journaled) -> None:
    seq = 3
    both = [leader, renumbered(leader)]
    with pytest.raises(ConfigError, match=r"--controller must say whose command 3 is explained: 5 at 0\.300 s, 6 at 0\.300 s"):
        choose(PATH, both, None, seq)
    assert choose(PATH, both[1:], None, seq)[0].owner == 6
    with pytest.raises(ConfigError, match=r"run\.mcap must hold a command 400, in the journal of a controller that led then, got commands 1 to 29"):
        choose(PATH, [leader, standby], None, 400)


def renumbered(journal: Journaled) -> Journaled:
    return replace(journal, owner=6, messages=[replace(message, epoch=message.epoch + 1) for message in journal.messages])


def test_robot_must_be_named_where_there_are_several(leader: Journaled) -> None:
    with pytest.raises(ConfigError, match="--robot must name the robot whose command is explained, one of car, pioneer"):
        choose(PATH, [leader, replace(leader, robot="car")], None, 3)


def test_standby_that_is_recorded_from_its_middle_on_has_not_led_until_it_says_so(leader: Journaled, standby: Journaled, relieved: Journaled) -> None:
    """A command that it would have sent is none that was sent; a leader says nothing in a recording of some seconds."""

    def between(journal: Journaled, from_ms: int, to_ms: int) -> Journaled:
        return replace(journal, messages=[message for message in journal.messages if from_ms * MS < message.local_ns < to_ms * MS])

    assert len(list(acted(between(leader, 500, 1400)))) > 5
    assert len(list(acted(between(relieved, 500, 3000)))) == 9, "it led until it stood by, from 0.6 to 1.4 s"
    assert not list(acted(between(standby, 500, 1400)))
    assert {place.command.epoch for place in acted(between(standby, 500, 3000))} == {EPOCH}


def test_controllers_of_a_recording_are_named_where_another_one_is_asked_for(
    leader: Journaled, standby: Journaled, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded(leader, tmp_path / "run.mcap", others=[standby])
    for choice in ({"robot": "car"}, {"owner": 7}, {"robot": "pioneer", "owner": 7}):
        with pytest.raises(ConfigError, match=r"got --robot pioneer --controller 5, --robot pioneer --controller 6$"):
            main(path, **choice)  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match=r"got --robot pioneer --controller 5, --robot pioneer --controller 6$"):
            replay.main(path, **choice)  # type: ignore[arg-type]
    assert main(path, at_s=2.0, as_json=True) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["controller"], facts["other_controllers"], facts["replayed"]) == (6, [5], "0 bits differ")
    assert "took_over" in [one["code"] for one in facts["events"]]
    assert main(path, at_s=0.5) == 0
    assert "it is of controller 5; --controller names others: 6\n" in capsys.readouterr().out
    assert replay.main(path) == 0
    assert capsys.readouterr().out.count("0 bits differ") == 2, "each is replayed"
    assert replay.main(path, owner=6) == 0
    assert capsys.readouterr().out.startswith("pioneer, controller 6\n")
