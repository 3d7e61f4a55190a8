# SPDX-License-Identifier: Apache-2.0
"""Tuning: better on a scenario that no trial has seen, or refused; interrupted or killed it goes on."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import optuna
import pytest

from rti_mpc.errors import ConfigError
from rti_mpc_service.commands.robot import lockstep_robot
from rti_mpc_service.config.config import load
from rti_mpc_service.tune.choice import beats, choose, front
from rti_mpc_service.tune.closed_loop import Body, ClosedLoop, Course, Driven
from rti_mpc_service.tune.study import Tried, open_storage, open_study
from rti_mpc_service.tune.tune import main, written_to
from tests.processes.system import until
from tests.robots import SHIPPED

pytestmark = pytest.mark.usefixtures("shared_problems")

NERVOUS = {"u_c = 1.0, omega_c = 1.0 }": "u_c = 0.003, omega_c = 0.003 }"}  # answers every noise of the sensors
NOISE = "\n[sim]\nnoise_std = { x = 0.005, y = 0.005, psi = 0.01, u = 0.01, omega = 0.02 }\nactuator_lag_s = 0.1\n"
WIDE = ("ocp.weights.R.u_c=0.001:100", "ocp.weights.R.omega_c=0.001:100")
SHORT = Course(duration_s=30.0)
BRIEF = Course(duration_s=4.0)  # where it does not matter how well the robot is driven


def noisy_robot(folder: Path, other: Mapping[str, str] | None = None) -> Path:
    """The shipped robot with noise and lag, and with its shipped weights unless told others."""
    path, text = folder / "robot.toml", SHIPPED.read_text(encoding="utf-8")
    for shipped, worse in (other or {}).items():
        assert shipped in text
        text = text.replace(shipped, worse)
    path.write_text(text + NOISE, encoding="utf-8")
    return path


def nervous_robot(folder: Path) -> Path:
    return noisy_robot(folder, NERVOUS)


def loop_of(path: Path, course: Course = SHORT) -> ClosedLoop:
    return ClosedLoop(load(path), course, lockstep_robot)


def trials_of(path: Path) -> list[optuna.trial.FrozenTrial]:
    from sqlalchemy.exc import SQLAlchemyError

    try:
        storage = optuna.storages.get_storage(f"sqlite:///{path}")
    except SQLAlchemyError:
        return []  # its tables are half made
    if not (studies := optuna.get_all_study_summaries(storage)):
        return []  # the file is made before the study
    (study,) = studies
    return optuna.load_study(study_name=study.study_name, storage=storage).get_trials(states=(optuna.trial.TrialState.COMPLETE,))


def test_front_has_what_nothing_beats_and_the_choice_is_its_least_error_at_the_effort_allowed() -> None:
    points = [(3.0, 1.0), (1.0, 3.0), (2.0, 2.0), (2.5, 2.5), (0.5, 9.0), (2.0, 2.2)]
    trials = [Tried(number, {}, error, effort, 0) for number, (error, effort) in enumerate(points)]
    today = Driven(error=2.6, effort=2.5, outputs=(), fallbacks=0)
    assert [trial.number for trial in front(trials)] == [4, 1, 2, 0]
    assert choose(trials, today, 1.0) is trials[2]
    assert choose(trials, today, 1.2) is trials[1]
    assert choose(trials, replace(today, error=1.9), 1.0) is None
    assert not beats(replace(today, error=1.0, fallbacks=1), today, 1.0), "samples without a plan are no gain"


def test_drive_is_the_same_each_time_and_a_common_factor_of_all_weights_changes_nothing(tmp_path: Path) -> None:
    loop = loop_of(nervous_robot(tmp_path))
    keys = ("ocp.weights.delta", "ocp.weights.lambda", "ocp.bounds.soft_weight", "ocp.bounds.soft_weight_L2")
    one, again, scaled = loop.drive({}), loop.drive({}), loop.drive(dict(zip(keys, (280.0, 8.0, 1e4, 1e4), strict=True)))
    assert one == again
    assert (scaled.error, scaled.effort) == pytest.approx((one.error, one.effort), rel=1e-4)  # the tolerance of the iterations
    assert loop.drive({"ocp.weights.R.u_c": 30.0}).effort < 0.9 * one.effort
    other = loop_of(nervous_robot(tmp_path), replace(SHORT, seed=1)).drive({})
    assert other.error != one.error, "the held-out scenario has other noise"
    assert other.error == pytest.approx(one.error, rel=0.5)


@pytest.mark.slow
def test_bad_weights_are_beaten_on_a_scenario_that_no_trial_has_seen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = nervous_robot(tmp_path)
    assert main(path, SHORT, None, lockstep_robot, vary=WIDE, trials=12) == 0
    out, said = tmp_path / "robot.tuned.toml", capsys.readouterr().out
    text = out.read_text(encoding="utf-8")
    for line in ("on the studied eight, heading consistent: error", "on the held-out circle, heading consistent: error"):
        assert line in said
        assert f"# {line}" in text
    assert "# Before: ocp.weights.R.u_c = 0.003, ocp.weights.R.omega_c = 0.003" in text
    before, after = (loop_of(file, Course("circle", duration_s=30.0, seed=7)).drive({}) for file in (path, out))  # again other noise
    assert max(after.outputs[:2]) < min(before.outputs[:2]), "m: the error is judged by each file's own Q, the position is not"
    assert after.effort < 0.5 * before.effort
    assert (tmp_path / "robot.tuned.png").stat().st_size > 10_000
    assert len(trials_of(tmp_path / "robot.tuned.study.db")) == 12


@pytest.mark.slow
def test_shipped_weights_are_beaten_on_a_scenario_that_no_trial_has_seen_and_it_says_by_how_much(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = noisy_robot(tmp_path)
    shipped, ranges = load(SHIPPED).ocp.weights, ("ocp.weights.R.u_c=0.1:100", "ocp.weights.R.omega_c=0.1:100")
    assert load(path).ocp.weights == shipped, "the study begins with what ships"
    assert main(path, Course("eight", duration_s=40.0), "circle", lockstep_robot, vary=ranges, trials=8) == 0
    said = re.search(
        r"on the held-out circle, .*: error \S+ -> \S+ m \((-\d+\.\d) %\), effort \S+ -> \S+ % \((-\d+\.\d) %\)", capsys.readouterr().out
    )
    assert said is not None, "by how much"
    assert float(said[1]) < -10.0, "-29.5 % in 8 trials"
    tuned = load(tmp_path / "robot.tuned.toml").ocp.weights
    assert tuned.Q == shipped.Q, "so both files judge errors alike"
    before, after = (loop_of(file, Course("circle", duration_s=40.0, seed=7)).drive({}) for file in (path, tmp_path / "robot.tuned.toml"))
    assert after.error < 0.9 * before.error, "with noise that neither scenario had"
    assert after.effort < 0.5 * before.effort


@pytest.mark.slow
def test_study_whose_choice_loses_on_the_held_out_scenario_says_so_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = noisy_robot(tmp_path)
    smooth = (
        "ocp.weights.R.u_c=11:13",
        "ocp.weights.R.omega_c=28:32",
    )  # less error on 20 s of the eight, more on the circle, which begins with a wide turn
    assert main(path, Course("eight", duration_s=20.0), "circle", lockstep_robot, vary=smooth, trials=1) == 1
    said = capsys.readouterr().out
    assert "nothing gained: the chosen trial must have less error at no more effort on the held-out scenario, too" in said
    assert re.search(r"on the held-out circle, .*: error \S+ -> \S+ m \(\+\d+\.\d %\)", said), "by how much it loses"
    assert not (tmp_path / "robot.tuned.toml").exists()


@pytest.mark.slow
def test_nothing_is_written_where_nothing_is_gained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = nervous_robot(tmp_path)
    vary = ("ocp.bounds.soft_weight=999:1001",)  # no bound is exceeded
    assert main(path, BRIEF, "circle", lockstep_robot, vary=vary, trials=2) == 1
    assert "nothing gained: no trial has less error than today's values at no more effort" in capsys.readouterr().out
    assert not (tmp_path / "robot.tuned.toml").exists()


@pytest.mark.slow
def test_interrupted_study_keeps_what_is_done_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, made = nervous_robot(tmp_path), 0

    def make_body(settings: dict[str, object]) -> Body:
        nonlocal made
        made += 1
        if made == 6:  # two for today's values, three trials
            raise KeyboardInterrupt
        return lockstep_robot(settings)  # type: ignore[no-any-return]

    vary, study = ("ocp.weights.R.u_c=0.1:10",), tmp_path / "robot.tuned.study.db"
    assert main(path, BRIEF, None, make_body, vary=vary, trials=5) == 130
    assert "interrupted: 3 of 5 trials are kept" in capsys.readouterr().out
    kept = [trial.values for trial in trials_of(study)]
    main(path, BRIEF, None, make_body, vary=vary, trials=5)
    assert "3 of 5 trials are there" in capsys.readouterr().out
    assert [trial.values for trial in trials_of(study)][:3] == kept
    assert len(trials_of(study)) == 5


def test_file_that_is_there_is_written_again_only_by_its_own_study(tmp_path: Path) -> None:
    path, out = nervous_robot(tmp_path), tmp_path / "robot.tuned.toml"
    assert written_to(path, load(path), None) == out
    out.write_text("")
    with pytest.raises(ConfigError, match=r"--out must not overwrite a file .* which exists without robot\.tuned\.study\.db"):
        written_to(path, load(path), None)
    (tmp_path / "robot.tuned.study.db").write_text("")
    assert written_to(path, load(path), None) == out


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"storage": "nowhere://x"}, "--storage must be a storage of Optuna that can be used, such as sqlite:///studies.db: "),
        ({"storage": "postgresql://u:secret@127.0.0.1:1/s"}, "--storage postgresql: needs the Python package psycopg"),
        ({"storage": ""}, "--storage must be a storage of Optuna that can be used"),
        ({"held_out": ""}, "a scenario must be one of"),
        ({"held_out": "circel"}, "of outputs over time, got 'circel', perhaps circle is meant"),
        ({"held_out": "eight"}, "--held-out must be another scenario than that of the study, got eight, heading consistent for both"),
        ({"out": Path("robot.png")}, "--out must be a TOML file other than"),
        ({"out": Path("/nowhere/robot.toml")}, "--out must be in a folder that exists"),
    ],
)
def test_option_that_does_not_fit_is_refused_in_one_line(tmp_path: Path, options: dict[str, object], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as refusal:
        main(nervous_robot(tmp_path), BRIEF, **{"held_out": None, "make_body": lockstep_robot, **options})
    assert "\n" not in str(refusal.value)


def command(path: Path, *options: str) -> list[str]:
    cli = "from rti_mpc_service.cli import main; main()"
    return [
        sys.executable,
        "-c",
        cli,
        "tune",
        str(path),
        "--duration",
        "30",
        "--trials",
        "24",
        "--jobs",
        "2",
        *options,
        *(f"--vary={key}" for key in WIDE),
    ]


def begin(together: Barrier, storage: str) -> None:
    """Begin a study at the same time as others; a process that cannot ends with another status than 0."""
    together.wait()
    open_study(open_storage(storage), "study", Driven(error=1.0, effort=1.0, outputs=(), fallbacks=0))


@pytest.mark.slow
def test_processes_that_begin_a_study_at_the_same_time_all_do(tmp_path: Path) -> None:
    """Of 24 in six such rounds seven found tables half made."""
    spawn = multiprocessing.get_context("spawn")
    together = spawn.Barrier(4)
    for number in range(2):
        processes = [spawn.Process(target=begin, args=(together, f"sqlite:///{tmp_path / str(number)}.db")) for _ in range(4)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
        assert [process.exitcode for process in processes] == [0] * 4


@pytest.mark.slow
def test_killed_study_leaves_no_process_and_goes_on_where_it_was(tmp_path: Path) -> None:
    path, study = nervous_robot(tmp_path), tmp_path / "robot.tuned.study.db"
    with (tmp_path / "killed.log").open("w") as log:
        process = subprocess.Popen(command(path), stdout=log, stderr=log)
    try:
        until(lambda: study.exists() or process.poll() is not None, "it begins", 0.1, 120.0)
        until(lambda: len(trials_of(study)) >= 3 or process.poll() is not None, "three trials are told", 0.1, 120.0)
        assert process.poll() is None, "it is killed before its end"
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        assert len(children) >= 2
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    until(lambda: not any(running(int(child)) for child in children), "its workers end", 0.1, 60.0)
    kept = [trial.values for trial in trials_of(study)]
    assert 3 <= len(kept) < 24
    again = subprocess.run(command(path), capture_output=True, text=True, timeout=240, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    assert f"{len(kept)} of 24 trials are there" in again.stdout
    assert "written: " in again.stdout
    values = [trial.values for trial in trials_of(study)]
    assert values[: len(kept)] == kept
    assert len(values) == 24


def running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.slow
def test_study_is_the_same_for_any_number_of_processes(tmp_path: Path) -> None:
    path = nervous_robot(tmp_path)
    found = []
    for jobs in (1, 3):
        assert main(path, SHORT, None, lockstep_robot, vary=WIDE, trials=12, jobs=jobs, out=tmp_path / f"{jobs}.toml") == 0
        found.append([(trial.params, trial.values) for trial in trials_of(tmp_path / f"{jobs}.study.db")])
    assert found[0] == found[1]
    assert (tmp_path / "1.toml").read_text() == (tmp_path / "3.toml").read_text()
