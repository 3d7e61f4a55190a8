# SPDX-License-Identifier: Apache-2.0
"""
Epochs: the number of one life of a publisher, higher than all epochs it knows of.

Epochs of controllers and guards are Unix seconds times ``2 ** NUMBER_BITS``, or above.
Their low bits are the number of the owner, drawn at its start: whatever two processes
have heard, they never choose the same epoch. Robots and planners use lower numbers, the
milliseconds since 1970.

Receivers prefer the highest epoch, so an epoch that nothing can exceed would shut out
everybody else. `highest_believed` limits epochs by the time of day, which goes on: above
any epoch that is accepted, a higher one is believed at once by those who have followed
the former, and a second later by all others. A process that chooses an epoch believes
slightly higher ones than those who receive it, so that it does not miss what they follow
where clocks differ.
"""

from __future__ import annotations

NUMBER_BITS = 20  # low bits of an epoch that hold the number of its owner
EPOCH_LEAD = 1 << 52  # epochs this far above the present second are believed: a host whose clock stands at 1970 believes those of 2105
EPOCH_SKEW = 1 << 26  # added where an epoch is to be chosen above those believed: clocks of hosts may differ by a minute
EPOCH_SUCCESSION = 1 << 22  # epochs this far above the highest one followed are believed: room for four more owners
MAX_SEQ_GAP = 1_000_000  # messages of one epoch that may be lost in a row; a larger gap is another sender's numbering


def epoch_above(epoch: int, number: int) -> int:
    """Return the lowest epoch above another whose low `NUMBER_BITS` are a number."""
    return epoch + 1 + (number - epoch - 1) % (1 << NUMBER_BITS)


def highest_believed(unix_s: int, known: int = 0, *, choosing: bool = False) -> int:
    """
    Return the highest epoch that is believed.

    Args:
        unix_s: Unix time, s.
        known: Highest epoch followed so far, 0 if there is none.
        choosing: Whether an epoch is to be chosen above all that are believed.
    """
    return max(EPOCH_LEAD + EPOCH_SKEW * choosing + (unix_s << NUMBER_BITS), known + EPOCH_SUCCESSION)
