# SPDX-License-Identifier: Apache-2.0
"""A recorded controller, built again from what is attached: it repeats every bit, and what is not as it was is said first."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rti_mpc.contract.message import JournalKind
from rti_mpc.control.controller import Controller
from rti_mpc.errors import ConfigError, RtiMpcError
from rti_mpc.journal.snapshot import OBJECT, Snapshot
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.config import load
from rti_mpc_service.init import main as init
from rti_mpc_service.replay import replay
from rti_mpc_service.replay.drive import Drive, drive
from rti_mpc_service.replay.place import find
from rti_mpc_service.replay.rebuild import CONFIGURATION, Journaled, configuration, rebuild
from rti_mpc_service.replay.replay import lines, overridden, play
from rti_mpc_service.replay.why import explained
from rti_mpc_service.shipped import SHIPPED
from tests.service.replay.driven import journal_of


@pytest.fixture(scope="module")
def journal() -> Journaled:
    return journal_of(SHIPPED)


def test_controller_built_from_the_attached_files_repeats_every_bit(journal: Journaled, tmp_path: Path) -> None:
    built = rebuild(journal, folder=tmp_path)
    assert built.others == []
    account = play(journal, built)
    assert account.on.outcome.samples == 59
    assert not account.on.outcome.differences
    assert "0 bits differ" in list(lines(account, 0.0, ()))


def test_replay_from_a_time_begins_at_the_last_snapshot_before_it(journal: Journaled, tmp_path: Path) -> None:
    whole = play(journal, rebuild(journal, folder=tmp_path)).on.outcome
    late = play(journal, rebuild(journal, folder=tmp_path), start_s=5.5).on.outcome
    assert whole.snapshots == late.snapshots
    assert late.samples == 10
    assert not late.differing


def test_what_is_not_as_it_was_is_said_and_the_first_difference_told(journal: Journaled, tmp_path: Path) -> None:
    versions = json.loads(journal.files["versions.json"])
    versions["machine"]["packages"]["numpy"] = "1.0"
    versions |= {"code_sha256": "0", "commit": "1234567-dirty"}
    files = journal.files | {"versions.json": json.dumps(versions)}
    built = rebuild(replace(journal, files=files), folder=tmp_path)
    assert len(built.others) == 2
    assert built.others[0].startswith("recorded with other code of rti-mpc than that of this ")
    assert built.others[0].endswith(f": {versions['rti_mpc']} (commit 1234567-dirty)"), "all of them may be of one version"
    assert "'numpy': '1.0'" in built.others[1]
    account = play(journal, built, assignments=["ocp.weights.R.u_c=5"])
    assert account.wanted
    text = "\n".join(lines(account, 0.0, ["ocp.weights.R.u_c=5"]))
    assert "with ocp.weights.R.u_c=5, in the same states" in text
    assert "u_c: " in text
    assert "command 1, at 0.1" in str(account.on.outcome.differences[0]) or account.on.outcome.differences[0].seq <= 5


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("ocp.N=5", "a key below ocp.weights. or ocp.bounds."),
        ("ocp.weights.Q.psi", "must be KEY=VALUE"),
        ("ocp.weights.Q.phi=1", "phi"),
        ("ocp.weights.R.u_c=-1", "u_c"),
        ("ocp.weights.R.u_c=fast", "--set must be KEY=VALUE, the value as in the file, got 'ocp.weights.R.u_c=fast'"),
        ("ocp.weights.R.u_c=1\nN = 3", "the value as in the file, got 'ocp.weights.R.u_c=1"),
        ("ocp.weights.S.u_c=1", "a key of the configuration"),
    ],
)
def test_value_that_cannot_be_set_is_refused_in_one_line(assignment: str, words: str) -> None:
    from rti_mpc_service.config.fit import check_model

    config = load(SHIPPED)
    with pytest.raises(ConfigError, match=words) as refusal:
        overridden(config, check_model(config), [assignment])
    assert "\n" not in str(refusal.value)


def test_only_what_is_set_differs() -> None:
    from rti_mpc_service.config.fit import check_model

    config = load(SHIPPED)
    changed = overridden(config, check_model(config), ["ocp.weights.Q.psi=0", "ocp.bounds.increments.u_c=[-0.1, 0.1]"])
    assert set(changed) == {"Q", "lbdu", "ubdu"}
    assert changed["Q"][2, 2] == 0.0
    np.testing.assert_array_equal(changed["ubdu"][0], 0.1)


def test_source_of_a_model_of_ones_own_runs_only_if_it_is_here_or_trusted(tmp_path: Path) -> None:
    home, elsewhere = tmp_path / "home", tmp_path / "elsewhere"
    home.mkdir()
    elsewhere.mkdir()
    init("cart", "unicycle", home)
    journal = journal_of(home / "cart.toml", samples=8)
    assert rebuild(journal, folder=home).others == []
    for folder in (elsewhere, home):
        if folder is home:
            source = home / "cart.py"
            source.write_text(source.read_text() + "\nprint('another one')\n")
        with pytest.raises(ConfigError, match="--trust runs the attached source"):
            rebuild(journal, folder=folder)
    account = play(journal, rebuild(journal, folder=elsewhere, trust=True))
    assert account.on.outcome.samples > 5
    assert not account.on.outcome.differing


@pytest.mark.parametrize("module", ["{folder}/evil", "../evil", "..evil", "evil.", "..evil.py"])
def test_source_that_would_leave_its_folder_is_refused(journal: Journaled, tmp_path: Path, module: str) -> None:
    named = SHIPPED.read_text().replace('name = "pioneer_3dx"', f'name = "{module.format(folder=tmp_path)}:make"')
    files = {CONFIGURATION: named, "evil.py": "", "evil..py": "", ".py": ""}
    (tmp_path / "home").mkdir()
    with pytest.raises(ConfigError, match=r"must be of a module or of a file FILE\.py"):
        configuration(files, tmp_path / "home", folder=tmp_path, trust=True)
    assert not (tmp_path / "evil.py").exists()


def with_data(journal: Journaled, kind: JournalKind, change: Callable[[bytes], bytes]) -> Journaled:
    """The journal with other content in its messages of a kind."""
    return replace(journal, messages=[replace(one, data=change(one.data)) if one.kind is kind else one for one in journal.messages])


def with_versions(journal: Journaled, **other: str) -> Journaled:
    """The journal as another version would have made it."""
    return replace(journal, files=journal.files | {"versions.json": json.dumps(json.loads(journal.files["versions.json"]) | other)})


def other_state(content: bytes) -> bytes:
    """A snapshot with one number more in one of its arrays."""
    snapshot = Snapshot.decode(content)
    return replace(snapshot, pinned=[np.append(snapshot.pinned[0], 0.0), *snapshot.pinned[1:]]).encode()


def gone_class(content: bytes) -> bytes:
    """A snapshot of a class that is not here."""
    return replace(Snapshot.decode(content), tree=(OBJECT, 0, 0, "rti_mpc.control.gone.Gone", [])).encode()


MISFITS: dict[str, tuple[Callable[[Journaled], Journaled], str]] = {
    "snapshot": (lambda journal: with_data(journal, JournalKind.SNAPSHOT, other_state), "a snapshot must be of a controller built like this one"),
    "class": (
        lambda journal: with_data(journal, JournalKind.SNAPSHOT, gone_class),
        "a snapshot must be of a controller built like this one",
    ),
    "encoding": (
        lambda journal: with_data(journal, JournalKind.CALLS, lambda data: bytes((9,)) + data[1:]),
        "a journal must be of encoding 1, got 9",
    ),
    "method": (lambda journal: with_data(journal, JournalKind.CALLS, lambda data: data[:1] + bytes((99,)) + data[2:]), "a journal must name one of"),
    "key": (lambda journal: replace(journal, files=journal.files | {"config.toml": "later = 1\n" + journal.files["config.toml"]}), "later"),
    "equations": (lambda journal: with_versions(journal, model_sha256="0"), "must have the equations that were recorded"),
}


@pytest.mark.parametrize("kind", MISFITS)
def test_what_another_version_made_and_does_not_fit_is_told_by_that_version(journal: Journaled, kind: str, tmp_path: Path) -> None:
    change, words = MISFITS[kind]
    misfit = change(journal)
    with pytest.raises(RtiMpcError, match=words) as refusal:
        play(misfit, rebuild(misfit, folder=tmp_path))
    assert "was made by" not in str(refusal.value), "the same code made it: something else is wrong with it"
    other = with_versions(misfit, rti_mpc="0.0.9", commit="", code_sha256="abcdef0123456789")
    with pytest.raises(ConfigError, match=words) as refusal:
        play(other, rebuild(other, folder=tmp_path))
    assert str(refusal.value).startswith("the recording was made by rti-mpc 0.0.9 of the code abcdef012345, this is ")
    assert "and does not fit this one; use the one that made it" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_entry_that_only_another_version_could_repeat_is_told_by_it_too(journal: Journaled, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    other = with_versions(journal, rti_mpc="0.0.9", code_sha256="abcdef0123456789")
    built = rebuild(other, folder=tmp_path)
    monkeypatch.delattr(Controller, "prepare")
    with pytest.raises(ConfigError, match=r"was made by rti-mpc 0\.0\.9 .*AttributeError: .*prepare"):
        play(other, built)


def test_recording_without_a_configuration_is_refused(journal: Journaled, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="configuration of controller 5 of pioneer must be attached"):
        rebuild(replace(journal, files={}), folder=tmp_path)


def test_controller_without_a_configuration_does_not_keep_the_others_from_being_replayed(
    journal: Journaled, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(replay, "journals", lambda *_: [replace(journal, owner=6, files={}), journal])
    assert replay.main(Path("run.mcap")) == 1
    printed = capsys.readouterr().out
    assert "controller 6\n  not covered: it was dead before the recorder had its configuration\npioneer, controller 5\n" in printed
    assert "0 bits differ" in printed


DISTURBED = "[observer.disturbances]\nu_c = { drift = 0.1, limit = 0.3 }\n"
OBSTACLE = "[[ocp.obstacles]]\ncentre_m = [5.0, 5.0]\nradius_m = 0.2\n\n[ocp.weights]"


@pytest.mark.slow  # compiles a problem of its own
def test_robot_with_an_observer_and_an_obstacle_is_replayed_explained_and_driven_in_closed_loop(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("N = 20 ", "N = 5 ").replace("[ocp.weights]", OBSTACLE, 1) + "\n" + DISTURBED)
    journal = journal_of(path, samples=30)
    outcome = play(journal, rebuild(journal, folder=tmp_path)).on.outcome
    assert (outcome.samples, outcome.differing) == (29, 0)
    place = find(journal, None, 10)
    assert place is not None
    facts = explained(journal, rebuild(journal, folder=tmp_path), place)[0]
    assert facts["replayed"] == "0 bits differ"
    assert facts["mode"] == "TRACKING"
    assert len(facts["disturbances"]) == 1
    was, driven = (drive(Drive(rebuild(journal, folder=tmp_path), 0, body), journal, 0) for body in (None, lockstep_robot))
    assert len(was.states) > 20
    assert [state.x.tolist() for state in driven.states] == [state.x.tolist() for state in was.states]
