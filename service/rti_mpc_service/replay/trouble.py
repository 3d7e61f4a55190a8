# SPDX-License-Identifier: Apache-2.0
"""
Trouble in a recording: each sample that failed or was late, with its QP as a case.

The journal decides every command, so it keeps the QP and the guess of every sample: a
replay has them bit for bit, and the controller did nothing for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

from rti_mpc.contract.message import Command
from rti_mpc.contract.status import QpStatus
from rti_mpc.journal.replay import Replay, replay
from rti_mpc.rti.qp.osqp import Solver
from rti_mpc_service.replay.case import QpCase, take
from rti_mpc_service.replay.rebuild import Journaled, Rebuilt, journals, rebuild

MAX_CASES = 100  # of one recording


def cases_of(path: Path, *, folder: Path = Path(), trust: bool = False) -> Iterator[QpCase]:
    """
    Yield the cases of a recording, `MAX_CASES` at most.

    Raises:
        ConfigError: It cannot be replayed here.
    """
    found = (case for journal in journals(path) for case in troubles(journal, rebuild(journal, folder=folder, trust=trust)))
    return islice(found, MAX_CASES)


def troubles(journal: Journaled, built: Rebuilt) -> Iterator[QpCase]:
    """Yield the case of each failed or late sample of a controller."""
    on = Replay(built.controller, built.rti)
    proposal: Command | None = None
    for entry, _ in replay(on, journal.messages):
        if entry.name == "receive_state":
            proposal = on.proposal
            if proposal is not None and proposal.status is not QpStatus.NONE and not proposal.status.usable:
                yield take(built.rti, about(journal, built, proposal, "it failed"))
        elif entry.name == "in_time" and proposal is not None and on.proposal is not proposal:
            if proposal.status.usable:
                yield take(built.rti, about(journal, built, proposal, "it was late"))
            proposal = None


def about(journal: Journaled, built: Rebuilt, command: Command, why: str) -> dict[str, Any]:
    """Return what a case says of its sample."""
    rti, solver = built.rti, built.rti.solver
    return {
        "robot": journal.robot,
        "owner": journal.owner,
        "seq": command.seq,
        "stamp_ns": command.stamp_ns,
        "why": why,
        "solver": solver_of(rti),
        "status": command.status.name,
        "iterations": solver.iterations,
        "files": journal.files,
    }


def solver_of(rti: Any) -> str:
    """Return the name of the solver of the last QP."""
    if rti.solver is rti.active_set:
        return "riccati"
    whole = " with softened bounds" if rti.solver is rti.solvers[-1] and len(rti.solvers) > 1 else ""
    return ("osqp" if isinstance(rti.solver, Solver) else "another solver") + whole
