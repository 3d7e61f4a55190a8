# SPDX-License-Identifier: Apache-2.0
"""`rti-mpc paper`: what must be seen in short runs of its experiments, and that its report says what its JSON does, the committed one too."""

from __future__ import annotations

import copy
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rti_mpc.reference.trajectory import eight, positioning
from rti_mpc_service.bench.yardstick import Ipopt
from rti_mpc_service.paper.contender import CONTENDERS
from rti_mpc_service.paper.experiment import BEST_SETTINGS, Experiment
from rti_mpc_service.paper.loop import Loop
from rti_mpc_service.paper.race import EIGHT, shortened
from rti_mpc_service.paper.readings import FOUND, faster, goals, jump_mm, speeds
from rti_mpc_service.paper.report import report, short
from rti_mpc_service.paper.slsqp import Slsqp

ROOT = Path(__file__).parents[3]
PAGE, FOLDER = ROOT / "docs" / "paper.md", ROOT / "docs" / "paper"
RUN: dict[str, Any] = json.loads((FOLDER / "run.json").read_text())
OWN = ("rti_sequential", "rti_simultaneous", "best")


def drive(experiment: Experiment, contender: str = "rti_simultaneous") -> Loop:
    loop = Loop(experiment, CONTENDERS[contender](experiment.ocp()))
    for _ in range(experiment.samples):
        loop.step()
    return loop


def lasting(experiment: Experiment, duration_s: float) -> Experiment:
    return replace(experiment, trajectory=experiment.trajectory.lasting(duration_s))


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def structure(text: str) -> list[str]:
    """Headings, figures, and the heads of tables."""
    lines = text.splitlines()
    heads = [lines[i - 1] for i, line in enumerate(lines) if line.startswith("| ---")]
    return [line for line in lines if line.startswith(("#", "!["))] + heads


def test_best_settings_follow_the_eight_within_a_tenth_of_a_millimetre_at_the_samples_and_between() -> None:
    found = drive(lasting(replace(EIGHT, **BEST_SETTINGS), 60.0)).summary()
    assert max(found["max_mm"], found["between_mm"]) <= 0.1


def test_best_settings_end_at_the_goal_at_rest() -> None:
    found = drive(Experiment(positioning().lasting(30.0), **BEST_SETTINGS)).summary()
    assert found["end_mm"] < 0.01
    assert found["end_speed_mm_s"] < 1e-3


def test_the_reading_found_gives_the_papers_three_millimetres_and_the_tangent_does_not() -> None:
    assert round(drive(lasting(FOUND, 60.0)).summary()["max_mm"]) == 3
    assert drive(replace(lasting(FOUND, 60.0), heading="tangent")).summary()["max_mm"] > 30.0


@pytest.mark.parametrize("formulation", ["sequential", "simultaneous"])
def test_the_papers_algorithms_find_what_converged_nmpc_finds(formulation: str) -> None:
    experiment = lasting(EIGHT, 1.0)
    ocp, y = experiment.ocp(), experiment.reference()[1:8]
    x0, u_prev = np.array([0.1, -0.1, 1.0, 0.2, 0.1]), np.array([0.2, 0.1])
    yardstick, slsqp = Ipopt(ocp), Slsqp(ocp, formulation)
    yardstick.reset(x0)
    slsqp.reset(x0)
    for _ in range(3):  # SciPy's tolerance of 1e-6 is on the cost; from its own last plan it goes on
        u = slsqp.solve(x0, u_prev, y)
        expected = yardstick.solve(x0, u_prev, y)
    assert u == pytest.approx(expected, abs=2e-3)


def test_a_loop_of_the_models_own_robot_is_the_controllers_prediction() -> None:
    loop = drive(replace(lasting(EIGHT, 1.0), plant="euler", transient_s=0.5))
    phi, p = loop.experiment.ocp().phi(), np.array(loop.experiment.robot.p_nominal)
    for before, u, after in zip(loop.x, loop.u, loop.x[1:], strict=False):
        assert np.array(phi(before, u, p)).ravel() == pytest.approx(after, abs=1e-12)  # the same sums, in another order


def test_references_are_as_slow_as_their_formulas_and_end_without_a_leap() -> None:
    assert speeds()["circle"]["mean"] == pytest.approx(0.1)
    assert max(found["mean"] for found in speeds().values()) < 0.25
    assert jump_mm(goals()["continuous"].trajectory) < 1e-3
    assert jump_mm(goals()["jumping"].trajectory) == pytest.approx(400.0 / np.sqrt(2.0), abs=1e-3)  # r sqrt(2) / 2


def test_a_faster_path_is_the_same_path() -> None:
    path, t = faster(eight(), 2.0), np.array([1.0, 7.0])
    assert path.position(t) == pytest.approx(eight().position(2.0 * t))
    assert path.velocity(t) == pytest.approx(2.0 * eight().velocity(2.0 * t))


def test_noise_is_seen_by_the_controller_and_not_by_the_judge() -> None:
    quiet, noisy = (drive(replace(shortened(EIGHT), noise=noise)) for noise in (False, True))
    assert noisy.x[0] == pytest.approx(quiet.x[0])
    assert np.abs(noisy.u - quiet.u).max() > 1e-3


def test_the_committed_report_is_what_its_run_makes() -> None:
    assert PAGE.read_text() == report(RUN)
    assert not RUN["quick"]


def test_the_page_of_measured_figures_shows_the_short_table_of_the_committed_run() -> None:
    assert short(RUN) in (ROOT / "docs" / "measured.md").read_text(encoding="utf-8")


def test_every_number_of_the_report_comes_from_its_run() -> None:
    changed: dict[str, Any] = copy.deepcopy(RUN)
    changed["race"]["eight"]["ipopt"]["max_mm"] = 123.45
    before, after = (next(line for line in report(run).splitlines() if line.startswith("| converged NMPC, IPOPT")) for run in (RUN, changed))
    assert cells(before)[1] == f"{RUN['race']['eight']['ipopt']['max_mm']:.3g}"
    assert cells(after)[1] == "123"


def test_the_committed_figures_are_those_the_report_shows_and_small() -> None:
    shown = set(re.findall(r"\]\((paper/[^)]*\.png)\)", PAGE.read_text()))
    assert shown == {f"paper/{path.name}" for path in FOLDER.glob("*.png")}
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 1_500_000


def test_every_figure_has_a_caption_that_names_the_papers_or_says_that_there_is_none() -> None:
    captions = re.findall(r"!\[[^\]]*\]\([^)]*\)\n\n\*(.*)\*", PAGE.read_text())
    assert len(captions) == PAGE.read_text().count("![")
    assert all("the paper's figure" in caption or "Not in the paper" in caption or "No figure of the paper" in caption for caption in captions)


def test_the_committed_run_shows_what_is_promised() -> None:
    races = RUN["race"]
    assert max(races["eight"]["best"][key] for key in ("max_mm", "between_mm")) <= 0.1
    assert races["positioning"]["best"]["end_mm"] < 0.01
    assert races["positioning"]["best"]["end_speed_mm_s"] < 1e-3
    assert round(RUN["readings"]["converged"][0]["max_mm"]) == 3
    assert RUN["solves"]["unusable"] == 0
    for race in races.values():
        assert all(race[name]["inside_percent_cpu"] == 1.0 for name in OWN)
        assert all(race[name]["inside_percent_wall"] >= 0.995 for name in OWN)


@pytest.mark.slow
def test_a_short_form_writes_a_report_of_the_same_structure_with_the_numbers_of_its_own_run(tmp_path: Path) -> None:
    command = [sys.executable, "-c", "from rti_mpc_service.cli import main; main()", "paper", "--quick", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    run = json.loads((tmp_path / "paper" / "run.json").read_text())
    text = (tmp_path / "paper.md").read_text()
    assert run["quick"]
    assert text == report(run)
    assert structure(text) == structure(PAGE.read_text())
    assert {path.name for path in (tmp_path / "paper").iterdir()} == {path.name for path in FOLDER.iterdir()}


def test_missing_matplotlib_is_one_line_before_anything_is_driven(tmp_path: Path) -> None:
    (tmp_path / "matplotlib.py").write_text("raise ModuleNotFoundError(name='matplotlib')")
    command = [sys.executable, "-c", "from rti_mpc_service.cli import main; main()", "paper"]
    done = subprocess.run(command, cwd=ROOT, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (2, "rti-mpc: matplotlib must be installed for this command: pip install 'rti-mpc[figure]'\n")
