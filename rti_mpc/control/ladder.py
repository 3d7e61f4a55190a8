# SPDX-License-Identifier: Apache-2.0
"""
Ladder of fallbacks: what is sent when no plan could be computed. Each rung is counted.

1. The plan of the second solver, with softened bounds, computed inside `Rti`.
2. The previous plan, shifted: at most `MAX_FALLBACK_SAMPLES` samples in a row, and never past its validity.
3. The brake law: a ramp to rest inside the slew limits, from past commands alone.
4. Standstill.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_FALLBACK_SAMPLES = 3  # consecutive samples that the shifted previous plan may serve


@dataclass(slots=True)
class Ladder:
    """
    Counts of the fallbacks used.

    Attributes:
        failed: Consecutive samples without a plan of their own.
        softened: Samples since start whose plan came from another solver than the first, with softened bounds.
        shifted: Samples since start on which the previous plan was continued.
        braked: Samples since start without a plan that were answered by the brake law.
        rested: Samples since start without a plan that were answered by a standstill.
    """

    failed: int = 0
    softened: int = 0
    shifted: int = 0
    braked: int = 0
    rested: int = 0

    def fall(self, *, plan_left: bool) -> bool:
        """Count a sample without a plan of its own, and return whether the previous plan may be continued."""
        self.failed += 1
        plays_on = plan_left and self.failed <= MAX_FALLBACK_SAMPLES
        self.shifted += plays_on
        return plays_on

    def brake(self, *, at_rest: bool) -> None:
        """Count one of the last two rungs: standstill if `at_rest`, else the brake law."""
        self.rested += at_rest
        self.braked += not at_rest

    @property
    def fallbacks(self) -> int:
        """Samples since start without a plan of their own."""
        return self.shifted + self.braked + self.rested
