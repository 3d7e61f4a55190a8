# SPDX-License-Identifier: Apache-2.0
"""Verdicts on the cases of a conformance test, by what was seen and for how long the host held the test up meanwhile."""

from __future__ import annotations

from typing import cast

import pytest

from rti_mpc_service.conformance.finding import ATTEMPTS, Case, Finding, Unseen, judgements
from rti_mpc_service.host.hold_up import Host

LATE_MS = 100.0


class Witness:
    """A host that holds every case up for the same time."""

    def __init__(self, held_up_ms: float) -> None:
        self.ms = held_up_ms

    def held_up_ms(self, from_ns: int, to_ns: int) -> float:
        return self.ms


def unsettled(_: None) -> Finding:
    raise Unseen("it did not come to rest", LATE_MS)


def unreported(_: None) -> Finding:
    raise Unseen("its states do not report the inputs that act")


@pytest.mark.parametrize(
    ("judge", "held_up_ms", "verdict", "attempts"),
    [
        (lambda _: Finding(True, "kept", LATE_MS), 2 * LATE_MS, "yes", 1),
        (lambda _: Finding(False, "late", LATE_MS), 2 * LATE_MS, "host", ATTEMPTS),
        (lambda _: Finding(False, "late", LATE_MS), LATE_MS / 2, "NO", 1),
        (lambda _: Finding(False, "wrong"), 2 * LATE_MS, "NO", 1),
        (unsettled, 2 * LATE_MS, "host", ATTEMPTS),
        (unsettled, LATE_MS / 2, "not visible", 1),
        (unreported, 2 * LATE_MS, "not visible", 1),
    ],
)
def test_host_excuses_what_its_delays_explain_and_the_case_is_tried_again(judge, held_up_ms, verdict, attempts) -> None:
    tried: list[None] = []

    def counted(trial: None) -> Finding:
        tried.append(trial)
        return judge(trial)

    (judgement,) = judgements([Case("case", "promise", "mend", counted)], None, cast("Host", Witness(held_up_ms)))
    assert (judgement.verdict, len(tried)) == (verdict, attempts)
    assert judgement.broken == (verdict == "NO")
