# SPDX-License-Identifier: Apache-2.0
"""
Recursions over the stages of a horizon: graphs for CasADi's virtual machine, loops in C for the compiler.

A graph repeats its stage N times. The loop calls the compiled stage with pointers into
the columns of its arguments: nothing is copied, and the code does not grow with N.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import casadi as ca

from rti_mpc.codegen import function_in_c

Columns = list[ca.MX]  # one expression per stage


def columns(matrix: ca.MX) -> Columns:
    """Return the columns of a matrix, which may have no rows."""
    return list(ca.horzsplit(matrix)) if matrix.size1() else [ca.MX(0, 1)] * matrix.size2()


def recur(
    name: str,
    stages: Sequence[tuple[ca.Function, int]],
    carried: Mapping[str, str],
    outputs: Sequence[str],
    *,
    shared: Collection[str] = (),
    backward: bool = False,
    in_c: str | None = None,
) -> ca.Function:
    """
    Repeat stages along the horizon.

    Args:
        name: Name of the recursion.
        stages: Functions of one stage and how often each is repeated, in the order of the horizon; the first has the arguments and results of all.
        carried: Arguments that are results of the stage before, by the names of these; the caller gives the first ones.
        outputs: Results to be returned, a column per stage that has them.
        shared: Arguments that are the same at every stage. Of any other one the caller gives a column for each stage that has it.
        backward: Whether the last stage comes first.
        in_c: Body of an equal function in C, instead of a loop; see `function_in_c`.

    Returns:
        A function with the arguments of the first of the stages, and with these outputs.
    """
    first = stages[0][0]
    stages = [(stage, count) for stage, count in stages if count]
    starts = [sum(count for _, count in stages[:i]) for i in range(len(stages) + 1)]

    def width(argument: str) -> int:
        alone = argument in carried or argument in shared
        return 1 if alone else sum(count for stage, count in stages if argument in stage.name_in())

    given = {argument: ca.MX.sym(argument, first.size1_in(argument), width(argument)) for argument in first.name_in()}
    split = {argument: columns(matrix) for argument, matrix in given.items() if argument not in carried and argument not in shared}
    now = dict(given)
    found: dict[str, Columns] = {output: [] for output in outputs}
    sequence = [(k, stage) for start, (stage, count) in zip(starts, stages, strict=False) for k in range(start, start + count)]
    for k, stage in reversed(sequence) if backward else sequence:
        after = stage(**{argument: split[argument][k] if argument in split else now[argument] for argument in stage.name_in()})
        now |= {argument: after[result] for argument, result in carried.items() if result in after}
        for output in set(outputs) & set(after):
            found[output].append(after[output])
    results = {output: ca.horzcat(*(reversed(parts) if backward else parts)) for output, parts in found.items()}
    return function_in_c(name, given, results, in_c or "\n".join(_loop(stages, starts, given, carried, outputs, backward)))


def _loop(
    stages: Sequence[tuple[ca.Function, int]],
    starts: Sequence[int],
    given: Mapping[str, ca.MX],
    carried: Mapping[str, str],
    outputs: Sequence[str],
    backward: bool,
) -> Iterator[str]:
    """Return the body of the same recursion in C: results that are carried on lie in their column or, by turns, in two buffers."""
    place: dict[str, int] = {argument: i for i, argument in enumerate(given)}
    yield "casadi_int k;"
    yield f"const casadi_real **a = arg + {len(given)};"
    yield f"casadi_real **r = res + {len(outputs)};"
    for argument in carried:
        yield f"const casadi_real *now_{argument} = arg[{place[argument]}];"
        yield f"casadi_real {argument}[2][{max(1, given[argument].size1())}];"
    yield f"for (k = {starts[-1] - 1}; k >= 0; --k) {{" if backward else f"for (k = 0; k < {starts[-1]}; ++k) {{"
    for i, (stage, _) in enumerate(stages):
        yield f"  {'else ' if i else ''}{f'if (k < {starts[i + 1]}) ' if i + 1 < len(stages) else ''}{{"
        for j, argument in enumerate(stage.name_in()):
            whole, rows, source = given[argument].size2() == 1, given[argument].size1(), f"arg[{place[argument]}]"
            at = f"now_{argument}" if argument in carried else source if whole or not rows else f"{source} + {rows} * k"
            yield f"    a[{j}] = {at};"
        for j, result in enumerate(stage.name_out()):
            buffer = next((f"{argument}[k & 1]" for argument, following in carried.items() if following == result), "0")
            column = f"res[{outputs.index(result)}]" if result in outputs else ""
            yield f"    r[{j}] = {f'{column} ? {column} + {stage.size1_out(j)} * k : {buffer}' if column else buffer};"
        yield f"    if (${stage.name()}(a, r, iw, w, 0)) return 1;"
        yield from (f"    now_{argument} = r[{stage.index_out(result)}];" for argument, result in carried.items() if result in stage.name_out())
        yield "  }"
    yield "}"
    yield "return 0;"
