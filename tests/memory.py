# SPDX-License-Identifier: Apache-2.0
"""Memory of a process, and how much of its growth a leak can explain."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

PARTS = 3  # of a run: a leak grows in each; an arena that an allocator begins, or what a stall leaves, is a step in one of them


def anonymous_bytes(pid: int | None = None) -> int:
    """Memory of a process, by default this one, that no file backs: of files the host takes pages away and gives them back."""
    line = next(line for line in Path(f"/proc/{pid or os.getpid()}/status").read_text().splitlines() if line.startswith("RssAnon"))
    return 1024 * int(line.split()[1])


def leaked_bytes(looks: Sequence[int]) -> int:
    """What a leak can have taken of a memory, by looks after equal parts of a run: in each part what it took in the quietest."""
    return (len(looks) - 1) * min(after - before for before, after in pairwise(looks))
