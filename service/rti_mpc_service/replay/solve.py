# SPDX-License-Identifier: Apache-2.0
"""`rti-mpc solve-case`: the QP of a case, or of each failed or late sample of a recording, solved by any solver and judged against the plan."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rti_mpc.contract.status import DISAGREEMENT
from rti_mpc_service.case import QpCase
from rti_mpc_service.json_text import json_text
from rti_mpc_service.replay.answer import answer, check_solver, compared
from rti_mpc_service.replay.trouble import cases_of
from rti_mpc_service.replay.why import count

CHEAPER = 1e-6  # relative to 1 + the objective: a plan that costs this much more is another one


def main(path: Path, solvers: Sequence[str], *, folder: Path = Path(), trust: bool = False, as_json: bool = False) -> int:
    """
    Solve a case, and print what comes out.

    Args:
        path: A case, or a recording: then all its failed and late samples.
        solvers: Names of solvers.
        folder: Where a model of the user's own is looked for.
        trust: Whether to run the attached source of a model.
        as_json: Whether to print JSON.

    Returns:
        Exit status: 0 if each solver has solved each case, else 1.

    Raises:
        ConfigError: It is neither, or a solver is not known.
    """
    for solver in solvers:  # also where there is no case to solve
        check_solver(solver)
    recorded = path.is_dir() or path.suffix == ".mcap"
    cases = cases_of(path, folder=folder, trust=trust) if recorded else iter([QpCase.load(path)])
    results = []
    for case in cases:
        result = solved(case, [compared(case, answer(case, solver, folder=folder, trust=trust)) for solver in solvers])
        if not as_json:
            print("\n".join(lines(result)))
        results.append(result)
    if as_json:
        print(json_text(results))
    elif not results:
        print("no sample has failed, and none was late")
    return int(any(one["status"] not in ("SOLVED", "INACCURATE") for result in results for one in result["answers"]))


def solved(case: QpCase, answers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a case and its answers, for JSON."""
    m, n = case.qp.A.shape
    plan = {"objective": case.objective(case.z), "violation": case.violation(case.z)} if case.usable else None
    about = {name: value for name, value in case.about.items() if name != "files"}
    return {**about, "variables": n, "rows": m, "sound": case.sound, "plan": plan, "answers": [*answers]}


def lines(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield a case and its answers in words."""
    when = f"sample {result['seq']} of {result['robot']}, at {1e-9 * result['stamp_ns']:.3f} s"
    yield f"{when}: {result['why']}; a QP of {result['variables']} variables and {result['rows']} rows"
    if not result["sound"]:
        yield "  its data is not finite: no solver can do anything with it"
    plan = result["plan"]
    if plan is not None:
        yield f"  plan of {result['solver']}: {result['status']}, objective {plan['objective']:.6g}, violation {plan['violation']:.0e}"
    else:
        yield f"  {result['solver']} had no plan: {result['status']}"
    for one in result["answers"]:
        iterations = f"{count(one['iterations'], 'iteration')}, " if one["iterations"] else ""  # not every solver tells them
        worked = f"  {one['solver']}: {one['status']} in {iterations}{one['time_us']:.0f} us"
        if "objective" not in one:
            yield worked
            continue
        residuals = ", ".join(f"{name} {one[name]:.0e}" for name in ("violation", "dual", "gap") if name in one)
        units = {signal["name"]: signal["unit"] for signal in result["inputs"]}
        first = ", ".join(f"{name} = {value:.4g} {units[name]}" for name, value in one["inputs"].items())
        yield f"{worked}, objective {one['objective']:.6g}, {residuals}: {first}"
        yield f"    {verdict(plan, one)}"


def verdict(plan: Mapping[str, float] | None, one: Mapping[str, Any]) -> str:
    """Return what an answer says about the plan, in words."""
    if plan is None:
        return "it finds a plan where the sample had none"
    apart, more = one["difference"], plan["objective"] - one["objective"]
    if apart <= DISAGREEMENT:
        return f"the same plan: inputs differ by {apart:.1e} of half their range at most"
    if abs(more) <= CHEAPER * (1.0 + abs(one["objective"])):
        return f"another plan that costs the same: inputs differ by {apart:.1e} of half their range"
    return f"another plan: inputs differ by {apart:.1e} of half their range, and the sample's costs {abs(more):.3g} {'more' if more > 0 else 'less'}"
