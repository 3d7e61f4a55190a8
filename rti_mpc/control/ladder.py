# SPDX-License-Identifier: Apache-2.0
"""
Ladder of fallbacks for a plan that cannot be made, each rung counted.

1. The plan of the second solver, with softened bounds: made inside `Rti`.
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
    How far down the commands have come.

    Attributes:
        failed: Samples in a row without a plan of their own.
        softened: Samples since start whose plan another solver had to find than the first, with softened bounds.
        shifted: Samples since start on which the previous plan played on.
        braked: Samples since start that were answered by the brake law, for want of a plan.
        rested: Samples since start that were answered by a standstill, for want of a plan.
    """

    failed: int = 0
    softened: int = 0
    shifted: int = 0
    braked: int = 0
    rested: int = 0

    def fall(self, *, plan_left: bool) -> bool:
        """Note a sample without a plan of its own, and tell whether the previous one may play on."""
        self.failed += 1
        plays_on = plan_left and self.failed <= MAX_FALLBACK_SAMPLES
        self.shifted += plays_on
        return plays_on

    def brake(self, *, at_rest: bool) -> None:
        """Note which of the last two rungs was taken."""
        self.rested += at_rest
        self.braked += not at_rest

    @property
    def fallbacks(self) -> int:
        """Samples since start without a plan of their own."""
        return self.shifted + self.braked + self.rested
