# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from functools import cache
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from typer.testing import CliRunner

from rti_mpc.errors import ConfigError
from rti_mpc_service.cli import app
from rti_mpc_service.commands.arguments import claimed, new_file
from rti_mpc_service.demo.board import COMMAND_COUNTS
from rti_mpc_service.faults.table import FAULTS
from rti_mpc_service.shipped import SHIPPED, TEMPLATES
from tests.command import built, command
from tests.in_time import ends_in_time
from tests.robots import toml
from tests.slow import slow_but

ROOT = Path(__file__).parents[2]
ZENOH = ("--mode", "--connect", "--listen", "--config", "--cfg", "--no-multicast-scouting")
RTI_MPC = (sys.executable, "-c", "from rti_mpc_service.cli import main; main()")
COMMANDS = sorted(built().commands)
OF_RECORDINGS = {"export", "replay", "solve-case"}  # commands that read a recording, or a case of one, and no bus


def rti_mpc(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line as a process, as a shell would."""
    return subprocess.run(
        [*RTI_MPC, *arguments], cwd=ROOT, env={**os.environ, "COLUMNS": "200", **environment}, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_explains_every_option(name: str) -> None:
    parameters = built().commands[name].params
    for parameter in parameters:
        assert getattr(parameter, "help", None), f"{name} {parameter.name}"
    assert command(name, "--help").returncode == 0


@pytest.mark.parametrize(
    "name",
    sorted(set(COMMANDS) - OF_RECORDINGS - {"bench", "certs", "check", "demo", "doctor", "faults", "init", "paper", "robots", "schema", "tune"}),
)
def test_every_process_takes_the_options_of_zenoh_programs(name: str) -> None:
    parameters = built().commands[name].params
    options = {option for parameter in parameters for option in (*parameter.opts, *parameter.secondary_opts)}
    assert set(ZENOH) | {"-m", "-e", "-l", "-c"} <= options


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - OF_RECORDINGS - {"bench", "certs", "demo", "init", "paper", "robots", "schema"}))
def test_bad_configuration_is_one_line_and_exit_status_2(name: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace("dt_s", "dt_ms"))
    done = command(name, path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith(f"rti-mpc: {path}: ocp.dt_ms is unknown, perhaps ocp.dt_s is meant")


@pytest.mark.parametrize("name", slow_but(["reference", "demo"], "reference"))
def test_outputs_that_no_path_fills_are_refused_by_name_in_the_terminal(name: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(toml("arm"))
    rti_mpc("reference", "--help")  # what is compiled to bytecode once
    with subprocess.Popen(
        [*RTI_MPC, name, str(path), "--scenario", "eight"], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert ends_in_time(process, "the refusal", 5000.0) == 2
        stdout, stderr = process.communicate()
    assert stdout == ""
    said = "rti-mpc: model arm: a path in the plane fills outputs whose role is x, y, heading, not x, elbow: "
    assert stderr == f"{said}give each its role, or follow sines, steps or a FILE.csv with the columns t, x, elbow\n"


@pytest.mark.parametrize(
    "name",
    sorted(
        set(COMMANDS)
        - OF_RECORDINGS
        - {
            "bench",
            "certs",
            "enable",
            "guard",
            "init",
            "paper",
            "params",
            "record",
            "robots",
            "router",
            "schema",
            "snapshot",
            "status",
            "stop",
            "why",
        }
    ),
)
def test_model_that_cannot_be_imported_is_refused_by_every_process_that_loads_it_with_file_and_line(name: str, tmp_path: Path) -> None:
    (tmp_path / "my_robot.py").write_text("\n\ndef car(:\n")
    path = tmp_path / "robot.toml"
    path.write_text(SHIPPED.read_text().replace('"pioneer_3dx"', '"my_robot:car"'))
    refused = CliRunner().invoke(app, [name, str(path)]).exception
    assert isinstance(refused, ConfigError)
    assert str(refused).startswith(f"{path}: model.name: my_robot must be importable, it raised SyntaxError in {tmp_path}/my_robot.py, line 3: ")
    assert "\n" not in str(refused)


def test_bad_option_is_exit_status_2() -> None:
    assert command("sim", "--speed", -1).returncode == 2
    done = rti_mpc("sim", "--x0", "phi=1")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith("rti-mpc: --x0 phi is no state of the model, perhaps psi [rad] is meant, got 1")


@pytest.mark.parametrize("name", ["bench", "conformance", "doctor", "faults"])
def test_file_that_cannot_be_written_is_refused_before_anything_is_measured(name: str, tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere" / "found.json", tmp_path):
        done = command(name, "--json", path)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert done.stderr.startswith(f"rti-mpc: --json must be a file that can be written, got {path}: ")


def test_file_of_results_is_neither_made_nor_emptied_where_there_are_none(tmp_path: Path) -> None:
    path = tmp_path / "rows.json"
    refused = "bench", "--problem", "slalm", "--json", path
    assert command(*refused).returncode == 2
    assert not path.exists()
    path.write_text("[]")
    assert command(*refused).returncode == 2
    assert path.read_text() == "[]"
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "later.json")
    assert claimed(link) == link
    assert link.is_symlink(), "only what was made is removed"
    assert not link.exists()
    os.mkfifo(tmp_path / "pipe")
    assert claimed(tmp_path / "pipe") == tmp_path / "pipe", "it is not waited for a reader"


@pytest.mark.parametrize("option", ["--interpreted", "--costs"])
def test_option_that_a_family_of_problems_would_ignore_is_refused(option: str) -> None:
    done = command("bench", "--problem", "tight", option)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "rti-mpc: --interpreted and --costs must be left out with --problem, which always compiles and compares costs\n"


NOBODY = ": no process answers at tcp/127.0.0.1:1: no process listens there, or the address is wrong"
READ = {"config", "zenoh", "tls", "state", "folder", "recording", "repair", "authority", "at", "folders"}  # parameters that name what is read or kept
REPLACED = {"--json"}  # the present state of something, which monitors ask for again and again
ADDED_TO = {"replay --out", "certs issue --out", "certs authority folder"}  # each has a test that it overwrites no file
NEEDED = {"export": ("run.mcap",)}


def outputs() -> list[tuple[str, str]]:
    """All options and arguments for a file or folder that a command writes, each with its command."""
    commands = {**built().commands, **{f"certs {name}": each for name, each in built().commands["certs"].commands.items()}}
    found = [
        (name, next((option for option in parameter.opts if option.startswith("--")), parameter.name))
        for name, each in commands.items()
        for parameter in each.params
        if parameter.type_descriptor.annotation is Path and parameter.name not in READ and (name, parameter.name) != ("solve-case", "case")
    ]
    return [(name, option) for name, option in found if option not in REPLACED and f"{name} {option}" not in ADDED_TO]


@pytest.mark.parametrize(("name", "option"), outputs())
def test_no_command_overwrites_what_an_earlier_one_has_written(name: str, option: str, tmp_path: Path) -> None:
    file, folder = tmp_path / "robot.toml", tmp_path / "earlier"
    (folder / "paper").mkdir(parents=True)
    kept = [file, folder / "config.toml", folder / "paper.md", folder / "paper" / "run.json"]
    for path in kept:
        path.write_text("precious")
    before = sorted(tmp_path.rglob("*"))
    for given in (file, folder):
        done = command(name, *NEEDED.get(name, ()), option, given)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done
        assert done.stderr.startswith(f"rti-mpc: {option} must ")
        assert str(given) in done.stderr
    assert sorted(tmp_path.rglob("*")) == before
    assert all(path.read_text() == "precious" for path in kept)


def test_name_that_no_file_can_have_is_left_to_whoever_writes() -> None:
    path = Path("a" * 300)
    assert new_file(cast(Any, SimpleNamespace(opts=["--out"])), path) == path


@pytest.mark.parametrize("vary", ["ocp.weights.q.psi", "ocp.M=1:3", "ocp.N=3:1", "ocp.N=1.5:3", "ocp.weights.Q.psi=-1:5", "timing.delay_s=0:nan"])
def test_key_that_cannot_be_varied_is_refused_before_the_robots_file_is_read(vary: str, tmp_path: Path) -> None:
    done = command("tune", tmp_path / "nowhere.toml", "--vary", vary)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("rti-mpc: --vary ")


def test_what_is_written_may_go_into_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (parameter,) = (each for each in built().commands["sim"].params if each.name == "log")
    for path in (tmp_path / "pipe", Path("/dev/null"), tmp_path / "new"):
        assert new_file(parameter, path) == path


def test_operator_is_told_in_one_line_that_nobody_has_confirmed_and_what_was_noted(tmp_path: Path) -> None:
    path = tmp_path / "state" / "rti_mpc%2Fpioneer.json"
    for word, counter in (("enable", 0), ("stop", 1), ("stop", 1), ("enable", 2)):
        done = command(word, "--timeout", "0.3", "-e", "tcp/127.0.0.1:1", "--state", path.parent)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
        assert done.stderr.startswith(f"rti-mpc: pioneer: the controller has not confirmed {word} within 0.3 s; nobody has{NOBODY}; ")
        assert f"processes started later read {path}: {'stopped since' if word == 'stop' else 'released'}" in done.stderr
        assert path.exists() == (counter > 0)
        assert not counter or json.loads(path.read_text())["counter"] == counter


def test_stop_that_meets_no_router_is_noted_all_the_same(tmp_path: Path) -> None:
    done = rti_mpc("stop", "--timeout", "0.3", "-m", "client", "-e", "tcp/127.0.0.1:1", "--state", str(tmp_path))
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert "; nobody was asked to stop; processes started later read" in done.stderr
    assert json.loads((tmp_path / "rti_mpc%2Fpioneer.json").read_text())["stopped"] is True


def test_operator_is_told_in_one_line_that_nothing_could_be_noted_either() -> None:
    done = rti_mpc("stop", "--timeout", "0.3", "-e", "tcp/127.0.0.1:1", "--state", "/proc/none")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert f"nobody has{NOBODY}; it could not be stored for later either: " in done.stderr


@pytest.mark.parametrize(("words", "changes"), [(["params", "get"], ""), (["params", "set", "ocp.N=3"], "; nothing was changed"), (["snapshot"], "")])
def test_request_that_meets_nobody_says_why_and_speaks_of_changes_only_where_one_was_asked_for(words: list[str], changes: str) -> None:
    done = command(*words, "--timeout", "0.3", "-e", "tcp/127.0.0.1:1")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"rti-mpc: pioneer has no controller that answers within 0.3 s{NOBODY}{changes}\n"


def test_change_of_nothing_is_refused_before_a_controller_is_asked() -> None:
    done = command("params", "set")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "rti-mpc: params set must be followed by KEY=VALUE, such as ocp.weights.Q.x=2.0, got nothing\n"


@pytest.mark.parametrize("words", [["view"], ["why"], ["certs", "issue"]])
def test_usage_has_the_brackets_and_dots_of_an_argument_once(words: list[str]) -> None:
    usage = command(*words, "--help").stdout.splitlines()[0]
    assert "[[" not in usage
    assert "......" not in usage.replace("}", "").replace("]", "")


def test_check_of_the_shipped_configuration_prints_both_phases_and_the_verdict() -> None:
    done = command("check")
    assert done.returncode == 0, done.stderr
    for words in ("preparation", "feedback", " samples: ", "riccati and daqp agree", "own plans are within"):
        assert words in done.stdout


def test_missing_viewer_is_one_line_that_says_what_to_install(tmp_path: Path) -> None:
    (tmp_path / "rerun.py").write_text("raise ModuleNotFoundError(name='rerun')")
    done = rti_mpc("view", PYTHONPATH=str(tmp_path))
    assert done.returncode == 2
    assert done.stderr == "rti-mpc: rerun must be installed for this command: pip install 'rti-mpc[view]'\n"


def test_news_of_matplotlib_is_not_ours_to_tell() -> None:
    """Matplotlib logs the fonts it has found, once per machine, in the middle of the first demo."""
    say = """
import logging
from rti_mpc_service import log
log.start()
for name in ("matplotlib.font_manager", "controller"):
    logging.getLogger(name).info("news")
"""
    done = subprocess.run([sys.executable, "-c", say], cwd=ROOT, capture_output=True, text=True)
    (line,) = map(json.loads, done.stdout.splitlines())
    assert (line["level"], line["logger"], line["text"]) == ("INFO", "controller", "news")


def test_list_of_commands_holds_whole_sentences_on_a_narrow_terminal() -> None:
    done = command("--help", columns=80)
    assert "..." not in done.stdout.partition("Commands:")[2]
    for each in built().commands.values():
        assert each.get_short_help_str(limit=1000) in " ".join(done.stdout.split())
    assert max(len(line) for line in done.stdout.splitlines()) <= 80


def test_help_of_faults_names_each_with_what_is_done_to_whom() -> None:
    shown = " ".join(command("faults", "--help", columns=80).stdout.split())
    for fault in FAULTS:
        assert f"{fault.name} {fault.text}" in shown


def test_help_of_the_demo_and_the_page_of_its_output_explain_each_count_of_commands() -> None:
    shown, page = " ".join(command("demo", "--help", columns=80).stdout.split()), (ROOT / "docs/measured.md").read_text(encoding="utf-8")
    for count, text in COMMAND_COUNTS.items():
        assert f"{count} {text}" in shown
        assert f"| `{count}` | {text} |" in page


def test_version_names_what_decides_what_a_command_does() -> None:
    done = rti_mpc("--version")
    assert (done.returncode, done.stderr) == (0, "")
    for word in (f"rti-mpc {metadata.version('rti-mpc')}", "messages of version 2", f"osqp {metadata.version('osqp')}"):
        assert word in done.stdout


@cache
def schema() -> Any:
    """What `rti-mpc schema` prints."""
    return json.loads(command("schema").stdout)


TYPES: dict[str, Any] = {"number": (int, float), "integer": int, "string": str, "boolean": bool, "array": list, "object": dict, "null": type(None)}


def refused(value: Any, schema: Any, root: Any) -> bool:
    """Whether a JSON schema refuses a value, by the words of the language that ours is written in, limits of numbers and texts aside."""
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rpartition("/")[2]]
    if "anyOf" in schema:
        return all(refused(value, option, root) for option in schema["anyOf"])
    if "type" in schema and not isinstance(value, TYPES[schema["type"]]):
        return True
    if value not in schema.get("enum", [value]) or value != schema.get("const", value):
        return True
    if isinstance(value, list):
        fixed = schema.get("prefixItems", [])
        too_few, too_many = len(value) < schema.get("minItems", 0), len(value) > schema.get("maxItems", len(value))
        return too_few or too_many or any(refused(part, (*fixed, *[schema.get("items", {})] * len(value))[i], root) for i, part in enumerate(value))
    if isinstance(value, dict):
        known, rest = schema.get("properties", {}), schema.get("additionalProperties", {})
        missing = not set(schema.get("required", ())) <= value.keys()
        unknown = rest is False and not value.keys() <= known.keys()
        return missing or unknown or any(refused(part, known.get(name, rest), root) for name, part in value.items())
    return False


@pytest.mark.parametrize("path", [SHIPPED, *sorted(TEMPLATES.glob("*.toml"))], ids=lambda path: path.stem)
def test_schema_for_editors_takes_what_is_shipped_and_refuses_what_the_service_refuses(path: Path) -> None:
    ours, document = schema(), tomllib.loads(path.read_text())
    assert not refused(document, ours, ours)
    weights = document["ocp"]["weights"]
    assert not refused({**document, "ocp": {**document["ocp"], "weights": {**weights, "delta": 28.0, "lambda": [0.1, 0.2]}}}, ours, ours)
    for wrong in ({"N": "20"}, {"M": 20}, {"weights": {**weights, "delta": "28"}}, {"bounds": {"inputs": {"v": [1.0]}}}):
        assert refused({**document, "ocp": {**document["ocp"], **wrong}}, ours, ours), wrong


def test_schema_for_editors_describes_every_table_and_refuses_unknown_keys() -> None:
    ours, shipped = schema(), tomllib.loads(SHIPPED.read_text())
    assert shipped.keys() <= ours["properties"].keys()
    assert ours["additionalProperties"] is False
    assert ours["title"] == "rti-mpc robot"
    for table in ours["$defs"].values():
        assert table["additionalProperties"] is False
        assert all("description" in field for field in table["properties"].values()), table["title"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (
            ["--path", "oval", "--scenario", "eight"],
            "--path is followed in place of a scenario and says nothing of time: --scenario must be left out",
        ),
        (
            ["--path", "oval", "--heading", "none", "--duration", "9"],
            "--path is followed in place of a scenario and says nothing of time: --heading, --duration must be left out",
        ),
        (["--path-limits", "1", "1", "1", "1"], "--path-limits are those of a --path, which must be given as well"),
    ],
    ids=["scenario", "heading and duration", "limits alone"],
)
def test_path_beside_options_that_it_would_ignore_is_refused(given: list[str], said: str) -> None:
    done = CliRunner().invoke(app, ["reference", *given])
    assert isinstance(done.exception, ConfigError)
    assert str(done.exception) == said
