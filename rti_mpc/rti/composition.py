# SPDX-License-Identifier: Apache-2.0
"""
Composition of functions, called one after the other, into one.

For CasADi's virtual machine they are one graph. Compiled, each is called with pointers
to what the caller has given and to what those before it have written: nothing is copied,
and the code of each is there once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import prod

import casadi as ca

from rti_mpc.codegen import function_in_c

Names = Mapping[str, str | tuple[str, int]]  # of arguments and results, or of the column in which an argument lies, and where it begins there


def compose(name: str, calls: Sequence[tuple[ca.Function, Names]], outputs: Sequence[str] = ()) -> ca.Function:
    """
    Build one function of several.

    Each takes results of those before it; what none has returned is an argument of the composed function. A result may share its memory with an
    argument, if no function reads the argument after the one that returns the result, and if that one reads each entry before it overwrites it.

    Args:
        name: Its name, see `rti_mpc.codegen.function_in_c`.
        calls: The functions in their order, with the names that their arguments and results have in the composed function, where these differ.
        outputs: Names of the results that are returned, all of which the caller must take; all if none are given. The others stay in the work memory.

    Raises:
        ValueError: The sparsity pattern of an argument differs from that of what it is given.
    """
    outputs = outputs or [str(names.get(result, result)) for function, names in calls for result in function.name_out()]
    given: dict[str, ca.MX] = {}
    now: dict[str, ca.MX] = {}
    lies = {output: f"res[{i}]" for i, output in enumerate(outputs)}
    lines, kept = [], 0
    for function, names in calls:
        taken = {}
        for i, argument in enumerate(function.name_in()):
            source, shape = names.get(argument, argument), function.size_in(argument)
            of, first = source if isinstance(source, tuple) else (source, 0)
            if of not in now:
                lies[of] = f"arg[{len(given)}]"
                now[of] = given[of] = ca.MX.sym(of, *shape)
            taken[argument] = now[of] if now[of].shape == shape else ca.reshape(now[of][first : first + prod(shape)], shape)
            if taken[argument].sparsity() != function.sparsity_in(argument):
                raise ValueError(f"{name}: {argument} of {function.name()} must be {function.sparsity_in(argument)}, got {now[of].sparsity()}")
            lines.append(f"a[{i}] = {lies[of]} + {first};")
        found = function(**taken)
        for i, result in enumerate(function.name_out()):
            to = str(names.get(result, result))
            now[to] = ca.project(found[result], function.sparsity_out(result))  # the graph of a constant may have fewer nonzeros
            if to not in outputs:
                lies[to] = f"(w + {kept})"
                kept += function.nnz_out(i)
            lines.append(f"r[{i}] = {lies[to]};")
        lines.append(f"if (${function.name()}(a, r, iw, w + KEPT, 0)) return 1;")
    begin = [f"enum {{ KEPT = {kept} }};", f"const casadi_real **a = arg + {len(given)};", f"casadi_real **r = res + {len(outputs)};"]
    whole = function_in_c(name, given, {output: now[output] for output in outputs}, "\n".join([*begin, *lines, "return 0;"]))
    assert whole.sz_w() >= kept + max(function.sz_w() for function, _ in calls), f"{name} keeps more than its graph: a result that nothing takes"
    return whole
