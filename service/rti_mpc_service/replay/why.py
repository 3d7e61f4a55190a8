# SPDX-License-Identifier: Apache-2.0
"""
Explanation of one command of a recording, from the controller that repeats it.

The recorded controller is built again and repeats its journal up to the command and the
sample after it, in a process of its own. What it then holds is what the recorded one
held, bit for bit.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rti_mpc.contract.epoch import NUMBER_BITS
from rti_mpc.contract.message import Command, JournalKind, Telemetry
from rti_mpc.contract.status import DISAGREEMENT, Mode, QpStatus
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.journal.entry import JournalEntry
from rti_mpc.journal.replay import Difference, Replay
from rti_mpc.recording.reader import Recording
from rti_mpc.rti.ocp import WEIGHTS_AND_BOUNDS
from rti_mpc_service.case import QpCase, about_sample, solver_of, take
from rti_mpc_service.json_text import json_text
from rti_mpc_service.replay.place import Place, Unreached, choose
from rti_mpc_service.replay.plan import acting_bounds, cost_terms
from rti_mpc_service.replay.rebuild import Journaled, Rebuilt, journals, rebuild, repeat
from rti_mpc_service.replay.trouble import placed
from rti_mpc_service.replay.without import without

LOOK_BACK_S = 10.0  # of the robot's time, over which the events before a command are told
MAX_EVENTS = 8  # of those, the last ones
MAX_VALUES = 4  # of a bound that differs by stage, told each by itself
MIN_COST_SHARE = 0.005  # of the cost, below which a term is left out of the lines
RUNGS = {
    Mode.TRACKING: "a plan of its own",
    Mode.HOLDING: "a plan of its own",
    Mode.FALLBACK: "rung 2 of the ladder: the previous plan, shifted",
    Mode.BRAKING: "rung 3 of the ladder: a way to rest, from past commands",
    Mode.STOPPED: "a way to rest, as long as the stop is latched",
}


def main(
    path: Path,
    *,
    at_s: float | None = None,
    seq: int | None = None,
    robot: str | None = None,
    owner: int | None = None,
    folder: Path = Path(),
    trust: bool = False,
    as_json: bool = False,
    case_path: Path | None = None,
    name: str = "",
) -> int:
    """
    Explain one command of a recording: the last one whose sample is followed by another, if neither a time nor a number is given.

    Args:
        path: The recording.
        at_s: Time of the robot's clock, from which on the first command is explained.
        seq: Number of the command instead.
        robot: Name of a robot; None: the one of a recording of one.
        owner: Number of a controller; None: the one that led then.
        folder: Where a model of the user's own is looked for.
        trust: Whether to run the attached source of a model.
        as_json: Whether to print JSON.
        case_path: File for the sample's QP as a case; None: none.
        name: What a refusal calls the recording; empty: its path.

    Returns:
        Exit status 0.

    Raises:
        ConfigError: There is no such command, there are several, or it cannot be repeated here.
        Unreached: No replay reaches it.
    """
    if at_s is not None and seq is not None:
        raise ConfigError("why must be asked with --at TIME or with --seq NUMBER, not with both")
    found = journals(path, robot, owner, name=name)
    journal, place = choose(name or path, found, at_s, seq)
    facts, case = explained(journal, rebuild(journal, folder=folder, trust=trust), place)
    if case_path is not None:
        if case is None:
            raise ConfigError(f"--case needs a command whose sample had a QP, got command {place.command.seq}: {facts['rung']}")
        case.save(case_path)
    facts["times"], arrived_ns = phase_times(path, journal, place.command)
    facts["host"] = host_meanwhile(path, journal, arrived_ns)
    facts["other_controllers"] = [other.owner for other in found if other is not journal]
    print(json_text(facts) if as_json else "\n".join(lines(facts)))
    return 0


def explained(journal: Journaled, built: Rebuilt, place: Place) -> tuple[dict[str, Any], QpCase | None]:
    """
    Return the facts about a command, and the QP of its sample, if it had one.

    Raises:
        Unreached: No replay reaches it.
    """
    controller, on = built.controller, Replay(built.controller, built.rti)
    told: deque[dict[str, Any]] = deque(maxlen=64)
    facts: dict[str, Any] = {}
    case: QpCase | None = None
    stamp_ns, prepared = 0, 0
    for entry, difference in repeat(journal, on, snapshot_for(journal, place)):
        if entry.name == "receive_state":
            stamp_ns = entry.args[0].stamp_ns
        said = [*said_by(entry), *((notice.code, notice.text) for notice in controller.notices())]
        told.extend(event(code, text, stamp_ns) for code, text in said)
        if entry.seq == place.entry:
            facts = facts_of(built, on, place, entry, difference)
            if facts["solver"] is not None:
                case = placed(take(built.rti, about_sample(built.rti, place.command, "asked for")), journal)
            facts["events"] = [one for one in told if place.command.stamp_ns - one["stamp_ns"] <= 1e9 * LOOK_BACK_S][-MAX_EVENTS:]
        elif facts and entry.name == "prepare":
            prepared += 1
            if prepared == 2 or not place.command.mode.planned:
                break
    if not facts:
        missing = ", ".join(map(str, on.outcome.gaps)) or "no snapshot before it"
        needed = "a replay begins at a snapshot of the controller, and needs every entry of its journal from there on"
        raise Unreached(f"command {place.command.seq} cannot be repeated: {needed}, got {missing}")
    facts["second_opinion"] = second_opinion(controller.telemetry(**NO_TIMES), place.command.seq)
    for bound in facts["bounds"]:  # the replay has ended: the arrays of its controller are free
        bound["without"] = None if case is None else without(case, built.rti, built.config, bound)
    return facts, case


NO_TIMES: dict[str, float] = {"prepare_us": 0.0, "feedback_us": 0.0, "latency_us": 0.0, "slack_s": 0.0}


def snapshot_for(journal: Journaled, place: Place) -> int:
    """Return the number of the snapshot to start from: before the events that are told, if there is one."""
    numbers = [(message.seq, message.stamp_ns) for message in journal.messages if message.kind is JournalKind.SNAPSHOT and message.seq < place.entry]
    early = [seq for seq, stamp_ns in numbers if place.command.stamp_ns - stamp_ns >= 1e9 * LOOK_BACK_S]
    return max(early, default=min((seq for seq, _ in numbers), default=0))


def said_by(entry: JournalEntry) -> Iterator[tuple[str, str]]:
    """Yield what an entry means, a code and a text, where the controller itself says nothing."""
    if entry.name == "retune":
        yield ("parameters_changed", f"parameters of version {entry.args[1]}")
    elif entry.name == "lead":
        yield ("took_over", f"this controller leads, with epoch {entry.args[0]}")
    elif entry.name == "stand_by":
        yield ("stands_by", "this controller stands by")
    elif entry.name == "inject":
        yield ("injected", f"failure {entry.args[0]!r} was injected on request, for {entry.args[1]} samples")


def event(code: str, text: str, stamp_ns: int) -> dict[str, Any]:
    """Return what was said, with its time."""
    return {"stamp_ns": stamp_ns, "robot_s": 1e-9 * stamp_ns, "code": code, "text": text}


def facts_of(built: Rebuilt, on: Replay, place: Place, entry: JournalEntry, difference: Difference | None) -> dict[str, Any]:
    """Return what is known of a command before the next sample is prepared."""
    controller, rti, command = built.controller, built.rti, place.command
    sample: Telemetry = controller.telemetry(**NO_TIMES)
    planned = command.mode.planned
    changed = changed_weights(built)
    terms = cost_terms(rti, built.config) if planned else {}
    return {
        "robot": built.config.robot,
        "controller": command.epoch % (1 << NUMBER_BITS),
        "seq": command.seq,
        "epoch": command.epoch,
        "stamp_ns": command.stamp_ns,
        "robot_s": 1e-9 * command.stamp_ns,
        "mode": command.mode.name,
        "status": command.status.name,
        "inputs": {signal.name: {"value": float(command.u[0, j]), "unit": signal.unit} for j, signal in enumerate(rti.ocp.model.inputs)},
        "replayed": "0 bits differ" if difference is None else str(difference),
        "rung": RUNGS.get(command.mode, "none"),
        "fallbacks": {"softened": sample.softened, "shifted": sample.shifted, "braked": sample.braked, "rested": sample.rested},
        "solver": solver_of(rti) if planned or command.status is not QpStatus.NONE else None,
        "iterations": sample.iterations,
        "qps": rti.taken,
        "res_prim": sample.res_prim,
        "res_dual": sample.res_dual,
        "cost": sample.cost if planned else None,
        "cost_terms": terms,
        "bounds": acting_bounds(rti, built.config) if planned else [],
        "blocked": controller.blocked,
        "state": {"seq": command.state_seq, "age_s": 1e-9 * (command.stamp_ns - command.state_stamp_ns)},
        "reference": reference_of(built, command),
        "delay_s": sample.delay_s,
        "parameters": {"version": sample.parameter_version, "changed": changed},
        "disturbances": sample.d.tolist(),
    }


def reference_of(built: Rebuilt, command: Command) -> dict[str, Any] | None:
    """Return age and rest of the reference at a command's time."""
    followed = built.controller.followed
    if followed is None:
        return None
    left_s = 1e-9 * (followed.stamp_ns + (len(followed.y) - 1) * followed.period_ns - command.stamp_ns)
    return {"epoch": followed.epoch, "seq": followed.seq, "age_s": 1e-9 * (command.stamp_ns - followed.stamp_ns), "left_s": left_s}


def changed_weights(built: Rebuilt) -> list[str]:
    """Return the weights and bounds that differ from the file's, in words."""
    file, now = built.rti.ocp, built.controller.wanted
    if now is file:
        return []
    return [
        f"{name} = {short(getattr(now, name))}, {short(getattr(file, name))} in the file" for name in WEIGHTS_AND_BOUNDS if not same(now, file, name)
    ]


def same(now: Any, file: Any, name: str) -> bool:
    """Whether two problems have the same weight or bound."""
    return np.array_equal(getattr(now, name), getattr(file, name))


def short(values: Any) -> Any:
    """Return a weight as it is given: its diagonal if it has no other numbers."""
    return np.diag(values).tolist() if values.ndim == 2 and not (values - np.diag(np.diag(values))).any() else values.tolist()


def second_opinion(sample: Telemetry, seq: int) -> dict[str, Any] | None:
    """Return what OSQP thought of the plan of a command."""
    if sample.second_seq != seq:
        return None
    difference = sample.second_difference
    return {
        "status": sample.second_status.name,
        "difference": difference if np.isfinite(difference) else None,
        "iterations": sample.second_iterations,
    }


def phase_times(path: Path, journal: Journaled, command: Command) -> tuple[dict[str, float], int] | tuple[None, None]:
    """Return the times of a sample from its recorded telemetry, and when that arrived, local ns; None if there is none."""
    for recorded in Recording(path).messages(journal.robot, ("telemetry", "telemetry/standby")):
        try:
            sample: Telemetry = recorded.message
        except MessageError:
            continue
        if (sample.epoch, sample.seq) == (command.epoch, command.seq):
            return {name: getattr(sample, name) for name in ("prepare_us", "feedback_us", "latency_us", "slack_s", "second_us")}, recorded.local_ns
    return None, None


def host_meanwhile(path: Path, journal: Journaled, arrived_ns: int | None) -> dict[str, float] | None:
    """Return for how long processes of the recorder's host waited for a core around a local time, and in what time, s; None if it is not recorded."""
    if arrived_ns is None:
        return None
    for recorded in Recording(path).messages(journal.robot, ("host",)):
        with suppress(MessageError, LookupError, TypeError, ValueError):  # what another program may have written
            from_ns, waited_s = int(recorded.message["from_ns"]), float(recorded.message["waited_s"])
            if from_ns < arrived_ns <= recorded.local_ns:
                of_s = 1e-9 * (recorded.local_ns - from_ns)
                return {"waited_s": min(waited_s, of_s), "of_s": of_s}  # the host counts a little after the time is read
    return None


def lines(facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield the facts in words."""
    inputs = ", ".join(f"{name} = {of['value']:.4g} {of['unit']}" for name, of in facts["inputs"].items())
    yield f"command {facts['seq']} of {facts['robot']}, at {facts['robot_s']:.3f} s: {facts['mode']}, {inputs}"
    if others := facts.get("other_controllers"):
        yield f"it is of controller {facts['controller']}; --controller names others: {', '.join(map(str, others))}"
    if facts["replayed"] != "0 bits differ":
        yield f"the replay differs from it: {facts['replayed']}"
    yield f"it is {facts['rung']}"
    if facts["blocked"]:
        yield f"the way is blocked: {facts['blocked']}"
    yield from solved(facts)
    state, reference = facts["state"], facts["reference"]
    yield f"state {state['seq']} was {state['age_s']:.3f} s old when it began to act" + (
        f", delay {facts['delay_s']:.3f} s" if facts["delay_s"] else ""
    )
    if reference is not None:
        end = f"ends in {reference['left_s']:.1f} s" if reference["left_s"] >= 0 else f"ended {-reference['left_s']:.1f} s ago"
        yield f"reference {reference['seq']} began {reference['age_s']:.1f} s ago and {end}"
    if facts["parameters"]["changed"]:
        yield f"parameters of version {facts['parameters']['version']}: {'; '.join(facts['parameters']['changed'])}"
    if (times := facts.get("times")) is not None:
        phases = ", ".join(
            f"{name} {times[f'{key}_us']:.0f} us" for name, key in (("preparation", "prepare"), ("feedback", "feedback"), ("latency", "latency"))
        )
        yield f"times: {phases}; {1e3 * times['slack_s']:.1f} ms of slack"
        if (host := facts["host"]) is None:
            yield "host: the recording does not say what it did meanwhile"
        else:
            yield f"host of the recorder: processes waited for a core for {host['waited_s'] / host['of_s']:.0%} of the {host['of_s']:.1f} s around it"
    if facts["events"]:
        yield f"what led there, in the {LOOK_BACK_S:g} s before:"
    for one in facts["events"]:
        yield f"  {one['robot_s']:.3f} s  {one['code']}: {one['text']}"


def solved(facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield how a plan was made, which bounds act in it, and what it costs."""
    if facts["solver"] is None:
        return
    if facts["cost"] is None:
        yield f"its QP was {facts['status'].lower()} for {facts['solver']}, after {count(facts['iterations'], 'iteration')}"
        return
    residuals = f"violation {facts['res_prim']:.0e}, gap {facts['res_dual']:.0e}"
    yield f"{facts['solver']}: {facts['status']} in {count(facts['iterations'], 'iteration')}, {count(facts['qps'], 'QP')}, {residuals}"
    if (second := facts["second_opinion"]) is not None and second["difference"] is not None:
        worked = f"{second['status']} in {count(second['iterations'], 'iteration')}"
        yield f"OSQP: {worked}, and differs by {second['difference']:.1e} of half an input's range"
        if second["difference"] > DISAGREEMENT and second["status"] == "SOLVED":
            yield f"the two solvers disagree, by more than {DISAGREEMENT:g}: one of them is wrong"
    else:
        yield "OSQP: no opinion"
    total = sum(facts["cost_terms"].values())
    terms = sorted(facts["cost_terms"].items(), key=lambda term: -term[1])
    shares = ", ".join(f"{name} {100 * value / total:.0f} %" for name, value in terms if total and value >= MIN_COST_SHARE * total)
    yield f"cost {facts['cost']:.4g}" + (f": {shares}" if shares else "")
    yield "bounds that act:" if facts["bounds"] else "no bound acts"
    for bound in facts["bounds"]:
        yield f"  {bound_text(bound)}"
        yield f"    {without_text(bound['without'], facts['inputs'])}"


def count(number: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{number} {what}{'s' * (number != 1)}"


def bound_text(bound: Mapping[str, Any]) -> str:
    """Return a bound in words."""
    second = bound["kind"] == "second difference"
    per = {"increment": " per sample", "second difference": " per sample squared"}.get(bound["kind"], "")
    where = values_at(bound["bound"], bound["stages"], f"{bound['unit']}{per}")
    if bound["kind"] == "increment":
        way = "rises" if bound["side"] == "upper" else "falls"
        return f"{bound['name']} {way} as fast as it may, {where}"
    name = f"the second difference of {bound['name']}" if second else bound["name"]
    return f"{name} at its {bound['side']} bound, {where}" + (f", exceeded by {bound['violation']:.3g} {bound['unit']}" if bound["violation"] else "")


def values_at(values: Sequence[float], stages: Sequence[int], unit: str) -> str:
    """Return a bound's values, each with the stages at which it acts; of many that differ the first ones, and what the others range over."""
    runs = [list(run) for _, run in groupby(zip(values, stages, strict=True), key=lambda at: f"{at[0]:.4g}")]
    each, rest = (runs, []) if len(runs) <= MAX_VALUES else (runs[: MAX_VALUES - 1], [at for run in runs[MAX_VALUES - 1 :] for at in run])
    words = [f"{run[0][0]:.4g} {unit}: {spans([stage for _, stage in run])}" for run in each]
    if rest:
        low, high = (extreme(value for value, _ in rest) for extreme in (min, max))
        words.append(f"{low:.4g} to {high:.4g} {unit}: {spans([stage for _, stage in rest])}")
    return "; ".join(words)


def without_text(planned: Mapping[str, float] | None, inputs: Mapping[str, Mapping[str, Any]]) -> str:
    """Return in words what would have been planned without a bound."""
    if planned is None:
        return "without it: no plan was found"
    changed = [f"{name} = {value:.4g} {inputs[name]['unit']}" for name, value in planned.items() if f"{value:.4g}" != f"{inputs[name]['value']:.4g}"]
    return f"without it: {', '.join(changed)}" if changed else "without it: the same command"


def spans(stages: Sequence[int]) -> str:
    """Return numbers of stages as spans, such as ``stages 0 to 3, 7``."""
    ends = [k for k, (a, b) in enumerate(pairwise(stages)) if b != a + 1]
    starts, stops = [0, *(k + 1 for k in ends)], [*ends, len(stages) - 1]
    listed = ", ".join(f"{stages[i]}" if i == j else f"{stages[i]} to {stages[j]}" for i, j in zip(starts, stops, strict=True))
    return f"stage{'s' * (len(stages) > 1)} {listed}"
