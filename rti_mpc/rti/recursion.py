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
from rti_mpc.errors import OcpError

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
    resumed: bool = False,
    limited: bool = False,
    in_c: str | None = None,
) -> ca.Function:
    """
    Repeat stages along the horizon.

    Args:
        name: Name of the recursion.
        stages: Functions of one stage and how often each is repeated, in the order of the horizon; the first has the arguments and results of all.
            There are two at most, which may take turns.
        carried: Arguments that are results of the stage before, by the names of these; the caller gives the first ones.
        outputs: Results to be returned, a column per stage that has them.
        shared: Arguments that are the same at every stage. Of any other one the caller gives a column for each stage that has it.
        backward: Whether the last stage comes first.
        resumed: Whether it may go on from an earlier call, the last stage first, with other arguments of the first stages only. It then takes their
            number, ``until``, and as ``known_<output>`` the outputs of that call, among which must be all that is carried. These may be in the memory
            of the outputs: then what stays is not touched.
        limited: Whether compiled code goes over the first stages only, whose number it takes, ``until``. It writes no columns of the others.
        in_c: Body of an equal function in C, instead of a loop; see `function_in_c`.

    Returns:
        A function with the arguments of the first of the stages, and those to go on from, and with these outputs.

    Raises:
        OcpError: It is to go on from an earlier call, but does not begin with the last stage, or does not return all that is carried.
    """
    if resumed and not (backward and set(carried.values()) <= set(outputs)):
        raise OcpError(f"recursion {name} must be backward and return {', '.join(carried.values())} to be resumed, got outputs {', '.join(outputs)}")
    first = stages[0][0]
    stages = [(stage, count) for stage, count in stages if count]
    kinds = {stage.name(): stage for stage, _ in stages}
    sequence = [stage for stage, count in stages for _ in range(count)]
    block = [sum(stage.name() == first.name() for stage in sequence[: k + 1]) - 1 for k in range(len(sequence))]  # column of what the first alone has

    def width(argument: str) -> int:
        alone = argument in carried or argument in shared
        return 1 if alone else sum(count for stage, count in stages if argument in stage.name_in())

    given = {argument: ca.MX.sym(argument, first.size1_in(argument), width(argument)) for argument in first.name_in()}
    split = {argument: columns(matrix) for argument, matrix in given.items() if argument not in carried and argument not in shared}
    now = dict(given)
    found: dict[str, Columns] = {output: [] for output in outputs}
    everywhere = set.intersection(*(set(stage.name_in()) for stage in kinds.values()))
    for k in range(len(sequence))[:: -1 if backward else 1]:
        stage, at = sequence[k], {argument: k if argument in everywhere else block[k] for argument in split}
        after = stage(**{argument: split[argument][at[argument]] if argument in split else now[argument] for argument in stage.name_in()})
        now |= {argument: after[result] for argument, result in carried.items() if result in after}
        for output in set(outputs) & set(after):
            found[output].append(after[output])
    results = {output: ca.horzcat(*(reversed(parts) if backward else parts)) for output, parts in found.items()}
    if resumed or limited:
        given["until"] = ca.MX.sym("until")
    if resumed:
        given |= {f"known_{output}": ca.MX.sym(f"known_{output}", *result.shape) for output, result in results.items()}
    code = in_c or "\n".join(_loop(stages, [*kinds.values()], block, given, carried, outputs, backward, resumed, limited))
    return function_in_c(name, given, results, code)


def _loop(
    stages: Sequence[tuple[ca.Function, int]],
    kinds: Sequence[ca.Function],
    block: Sequence[int],
    given: Mapping[str, ca.MX],
    carried: Mapping[str, str],
    outputs: Sequence[str],
    backward: bool,
    resumed: bool,
    limited: bool,
) -> Iterator[str]:
    """Return the body of the same recursion in C: results that are carried on lie in their column or, by turns, in two buffers."""
    place: dict[str, int] = {argument: i for i, argument in enumerate(given)}
    is_first, of_block = stage_in_c(block)

    def column(name: str) -> str:
        return "k" if all(name in (*kind.name_in(), *kind.name_out()) for kind in kinds) else of_block

    if len(stages) > len(kinds):
        yield block_table(block)
    yield "casadi_int k;"
    yield f"const casadi_real **a = arg + {len(given)};"
    yield f"casadi_real **r = res + {len(outputs)};"
    for argument in carried:
        yield f"const casadi_real *now_{argument} = arg[{place[argument]}];"
        yield f"casadi_real {argument}[2][{max(1, given[argument].size1())}];"
    if resumed:
        sizes = {output: given[f"known_{output}"].shape for output in outputs}
        yield from resume(len(block), len(given) - len(outputs) - 1, [rows * width for rows, width in sizes.values()])
        for argument, result in carried.items():
            yield f"if (until < {len(block)}) now_{argument} = arg[{place[f'known_{result}']}] + {sizes[result][0]} * until;"
    if limited:
        yield f"const casadi_int until = (casadi_int) *arg[{len(given) - 1}];"
    count = "until" if resumed or limited else len(block)
    yield f"for (k = {count} - 1; k >= 0; --k) {{" if backward else f"for (k = 0; k < {count}; ++k) {{"
    for i, stage in enumerate(kinds):
        if not any(stage.numel_out(j) for j in range(stage.n_out())):
            continue  # CasADi calls no function without results, so that there is no code of it
        yield f"  {'else ' if i else ''}{f'if ({is_first}) ' if i + 1 < len(kinds) else ''}{{"
        for j, argument in enumerate(stage.name_in()):
            whole, rows, source = given[argument].size2() == 1, given[argument].size1(), f"arg[{place[argument]}]"
            at = f"now_{argument}" if argument in carried else source if whole or not rows else f"{source} + {rows} * {column(argument)}"
            yield f"    a[{j}] = {at};"
        for j, result in enumerate(stage.name_out()):
            buffer = next((f"{argument}[k & 1]" for argument, following in carried.items() if following == result), "0")
            to = f"res[{outputs.index(result)}]" if result in outputs else ""
            yield f"    r[{j}] = {f'{to} ? {to} + {stage.size1_out(j)} * {column(result)} : {buffer}' if to else buffer};"
        yield f"    if (${stage.name()}(a, r, iw, w, 0)) return 1;"
        yield from (f"    now_{argument} = r[{stage.index_out(result)}];" for argument, result in carried.items() if result in stage.name_out())
        yield "  }"
    yield "}"
    yield "return 0;"


def resume(stages: int, at: int, sizes: Sequence[int]) -> Iterator[str]:
    """
    Return in C how a recursion goes on from an earlier call: the stages that have changed, and what it takes over of all others.

    Args:
        stages: Number of stages.
        at: Position of ``until`` among the arguments, which the outputs of the earlier call follow.
        sizes: Numbers in each of the outputs.
    """
    yield f"const casadi_int until = (casadi_int) *arg[{at}];"
    for i, size in enumerate(sizes):
        yield f"if (until < {stages} && res[{i}] != arg[{at + 1 + i}]) casadi_copy(arg[{at + 1 + i}], {size}, res[{i}]);"


def stage_in_c(block: Sequence[int]) -> tuple[str, str]:
    """
    Return in C whether a stage k is the first one of its block, and the number of that block.

    Without more than one block of several stages, at the end, these are known without `block_table`.
    """
    own = block[-1] + 1
    if list(block) == [min(k, own - 1) for k in range(len(block))]:
        return f"k < {own}", "k"
    return "!k || block[k] != block[k - 1]", "block[k]"


def block_table(block: Sequence[int]) -> str:
    """Return in C the number of the block of each stage."""
    return f"static const int block[] = {{ {', '.join(map(str, block))} }};"
