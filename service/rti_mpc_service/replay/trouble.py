# SPDX-License-Identifier: Apache-2.0
"""
Trouble in a recording: each sample that failed or was late, with its QP as a case.

The controller keeps one case a second in its journal, which any reader has as it was.
The others, and all of a recording without them, a replay makes again: the journal
decides every command, so it has the QP of every sample, bit for bit.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from rti_mpc.contract.message import Command, JournalKind
from rti_mpc.errors import ConfigError, MessageError
from rti_mpc.journal.replay import Replay
from rti_mpc_service.case import QpCase, about_sample, take, trouble_of
from rti_mpc_service.replay.rebuild import Journaled, Rebuilt, journals, rebuild, repeat

MAX_CASES = 100  # of one recording


def cases_of(path: Path, *, folder: Path, trust: bool) -> Iterator[QpCase]:
    """
    Yield the cases of a recording, `MAX_CASES` at most: those of a controller that cannot be replayed here as far as they were kept.

    Raises:
        ConfigError: It is no recording of a controller, or has no case, and cannot be replayed here.
    """
    return islice((case for journal in journals(path) for case in cases_of_one(journal, folder, trust)), MAX_CASES)


def cases_of_one(journal: Journaled, folder: Path, trust: bool) -> Iterator[QpCase]:
    """
    Yield the cases of a controller in the order of their samples: as they were kept, else made again.

    Raises:
        ConfigError: None was kept, and it cannot be replayed here.
    """
    was = {(case.about["stamp_ns"], case.about["seq"]): case for case in kept(journal)}
    try:
        made = {
            (case.about["stamp_ns"], case.about["seq"]): case
            for case in islice(troubles(journal, rebuild(journal, folder=folder, trust=trust)), MAX_CASES)
        }
    except ConfigError as error:
        if not was:
            raise
        made = {}
        print(
            f"controller {journal.owner} of {journal.robot} cannot be replayed here, so only the cases that it kept are solved: {error}",
            file=sys.stderr,
        )
    yield from (case for _, case in sorted((made | was).items(), key=lambda item: item[0]))


def kept(journal: Journaled) -> Iterator[QpCase]:
    """Yield the cases that a controller has kept; what is none is left out."""
    for message in journal.messages:
        if message.kind is JournalKind.CASE and message.data:
            try:
                yield placed(QpCase.decode(message.data), journal)
            except MessageError as error:
                print(f"entry {message.seq} of controller {journal.owner} of {journal.robot} must be a case, got {error}", file=sys.stderr)


def troubles(journal: Journaled, built: Rebuilt) -> Iterator[QpCase]:
    """Yield the case of each failed or late sample of a controller, from its replay."""
    on = Replay(built.controller, built.rti)
    proposal: Command | None = None
    for entry, _ in repeat(journal, on):
        if entry.name == "receive_state":
            proposal = on.proposal
        elif entry.name == "in_time" and proposal is not None:
            if why := trouble_of(proposal, on.proposal):
                yield placed(take(built.rti, about_sample(built.rti, proposal, why)), journal)
            proposal = None


def placed(case: QpCase, journal: Journaled) -> QpCase:
    """Return a case that says of which controller it is, with the files attached for that."""
    case.about.update(robot=journal.robot, owner=journal.owner, files=journal.files)
    return case
