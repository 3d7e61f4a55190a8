# SPDX-License-Identifier: Apache-2.0
"""
Blocks of stages that share an input (move blocking), along the columns of expressions.

The horizon is divided into *sections*: some stages with an input of their own, then some
that hold the last of these. A control horizon is one section, other blocks are several.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import casadi as ca

Blocks = tuple[int, ...]  # stages of each block, one after the other


def sections(blocks: Blocks) -> list[tuple[int, int]]:
    """Return how many stages have an input of their own, and how many hold the last one of them after that, by turns."""
    found, own = [], 0
    for length in blocks:
        own += 1
        if length > 1:
            found.append((own, length - 1))
            own = 0
    return [*found, (own, 0)] if own else found


def repeated(free: ca.Function, held: ca.Function, blocks: Blocks) -> list[tuple[ca.Function, int]]:
    """Return the functions of stages with an input of their own, and of those that hold one, each with its count, in the order of the horizon."""
    return [stage for own, holding in sections(blocks) for stage in ((free, own), (held, holding))]


def all_inputs(u: ca.MX, blocks: Blocks) -> ca.MX:
    """Return the inputs of all stages, shape ``(nu, N)``, from those of the blocks, shape ``(nu, N_u)``."""
    parts, at = [], 0
    for own, holding in sections(blocks):
        at += own
        parts += [u[:, at - own : at], ca.repmat(u[:, at - 1], 1, holding)]
    return ca.horzcat(*parts)


def at_starts(stages: ca.MX, blocks: Blocks) -> ca.MX:
    """Return the columns of the first stages of all blocks."""
    parts, at = [], 0
    for own, holding in sections(blocks):
        parts.append(stages[:, at : at + own])
        at += own + holding
    return ca.horzcat(*parts)


def summed(stages: ca.MX, blocks: Blocks) -> ca.MX:
    """Return the sum over the columns of each block."""
    parts, at = [], 0
    for own, holding in sections(blocks):
        last = at + own - 1
        parts += [stages[:, at:last], ca.sum2(stages[:, last : last + 1 + holding])]
        at = last + 1 + holding
    return ca.horzcat(*parts)


def at_each(columns: Any, count: int) -> Any:
    """Return a column for each stage or block: the only one repeated, or as they are."""
    return columns if columns.size2() > 1 else ca.repmat(columns, 1, count)


def stacked(columns: Any, count: int) -> Any:
    """Return the columns of `at_each`, one below another."""
    return ca.vec(columns) if columns.size2() > 1 else ca.repmat(columns, count)


def moved_on(columns: ca.MX, blocks: Blocks) -> ca.MX:
    """Return what each block has one stage later, when the plan is that of the next sample: columns are blocks, the last one is repeated."""
    return ca.horzcat(*(columns[:, first:after] for first, after in _runs(_one_later(blocks))))


def _one_later(blocks: Blocks) -> list[int]:
    """Return the block of the stage after the first one of each block; the last one has none after it."""
    acting = [j for j, length in enumerate(blocks) for _ in range(length)]
    starts = [sum(blocks[:j]) for j in range(len(blocks))]
    return [acting[min(start + 1, len(acting) - 1)] for start in starts]


def _runs(indices: list[int]) -> Iterator[tuple[int, int]]:
    """Yield where the parts of a list begin and end that count up by one."""
    breaks = [i for i, (a, b) in enumerate(pairwise(indices), 1) if b != a + 1]
    for first, after in pairwise([0, *breaks, len(indices)]):
        yield indices[first], indices[after - 1] + 1
