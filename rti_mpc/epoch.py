# SPDX-License-Identifier: Apache-2.0
"""
Epochs: one life of a publisher, higher than all it knows of.

The low bits are the number of its owner, drawn at its start: whatever two
processes have heard, they never arrive at the same epoch.
"""

from __future__ import annotations

NUMBER_BITS = 20


def epoch_above(epoch: int, number: int) -> int:
    """Return the lowest epoch above another that ends with a number of `NUMBER_BITS`."""
    return epoch + 1 + (number - epoch - 1) % (1 << NUMBER_BITS)
