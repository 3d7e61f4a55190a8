# SPDX-License-Identifier: Apache-2.0
"""
Elementwise functions of vectors: for CasADi's virtual machine a map, for the compiler one loop, which it vectorizes.

CasADi compiles an expression of vectors operation by operation, each of them a loop
through memory. Here every number is read once, and intermediate ones stay in registers.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import reduce

import casadi as ca

from rti_mpc.codegen import function, function_in_c

# In C, of the operations that CasADi makes expressions of.
IN_C = {
    ca.OP_ASSIGN: "{}",
    ca.OP_ADD: "{} + {}",
    ca.OP_SUB: "{} - {}",
    ca.OP_MUL: "{} * {}",
    ca.OP_DIV: "{} / {}",
    ca.OP_NEG: "-{}",
    ca.OP_FABS: "fabs({})",
    ca.OP_SQRT: "sqrt({})",
    ca.OP_INV: "1 / {}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_FMIN: "{0} < {1} ? {0} : {1}",
    ca.OP_FMAX: "{0} > {1} ? {0} : {1}",
    ca.OP_LT: "{} < {} ? 1.0 : 0.0",
}


def elementwise(name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX], count: int, *, shared: Collection[str] = ()) -> ca.Function:
    """
    Build a function of vectors from one of single numbers.

    Args:
        name: Its name.
        inputs: Symbols by name.
        outputs: Expressions of them by name.
        count: Number of elements.
        shared: Inputs that are the same for all of them.

    Returns:
        A function of vectors of shape ``(count,)``, or numbers for what is shared, that returns vectors of shape ``(count,)``.

    Raises:
        KeyError: An expression has an operation that is not in `IN_C`.
    """
    one = function(f"{name}_of_one", inputs, outputs)
    given = {symbol: ca.MX.sym(symbol, 1 if symbol in shared else count) for symbol in inputs}
    found = {result: ca.MX(0, 1) for result in outputs}
    if count:
        mapped = one.map(count)(**{symbol: ca.repmat(vector, 1, count) if symbol in shared else vector.T for symbol, vector in given.items()})
        found = {result: ca.vec(mapped[result]) for result in outputs}
    return function_in_c(name, given, found, "\n".join(_loop(one, count, [symbol in shared for symbol in inputs])))


def _loop(one: ca.Function, count: int, shared: list[bool]) -> Iterator[str]:
    """Return the body of the same function in C."""
    yield "casadi_int i;"
    yield from (f"const casadi_real *__restrict__ x{k} = arg[{k}];" for k in range(one.n_in()))
    yield f"casadi_real untaken[{count}];"  # CasADi gives no place to results that nobody takes
    yield from (f"casadi_real *__restrict__ y{k} = res[{k}] ? res[{k}] : untaken;" for k in range(one.n_out()))
    yield "#pragma GCC ivdep"
    yield f"for (i = 0; i < {count}; ++i) {{"
    yield f"  casadi_real {', '.join(f'v{k}' for k in range(one.sz_w()))};"
    for operation, to, of, constant in instructions(one):
        if operation == ca.OP_OUTPUT:
            yield f"  y{to[0]}[i] = v{of[0]};"
        elif operation == ca.OP_INPUT:
            yield f"  v{to[0]} = x{of[0]}[{'0' if shared[of[0]] else 'i'}];"
        elif operation == ca.OP_CONST:
            yield f"  v{to[0]} = {constant!r};"
        else:
            yield f"  v{to[0]} = {IN_C[operation].format(*(f'v{number}' for number in of))};"
    yield "}"
    yield "return 0;"


def instructions(one: ca.Function) -> Iterator[tuple[int, list[int], list[int], float]]:
    """Yield the instructions of a function of scalar expressions: operation, what it makes, of what; and a constant, 0 if it is none."""
    for k in range(one.n_instructions()):
        operation = one.instruction_id(k)
        constant = one.instruction_constant(k) if operation == ca.OP_CONST else 0.0
        yield operation, one.instruction_output(k), one.instruction_input(k), constant


def total(numbers: ca.MX) -> ca.MX:
    """Return the sum of the numbers in a column."""
    return _reduced("total", numbers, ca.sum1, ca.OP_ADD)


def largest(numbers: ca.MX) -> ca.MX:
    """Return the largest of the numbers in a column."""
    return _reduced("largest", numbers, ca.mmax, ca.OP_FMAX)


REDUCE = """
const casadi_real *x = arg[0];
casadi_real of[4];
casadi_int i, j;
for (j = 0; j < 4; ++j) of[j] = x[j];
for (i = 4; i + 4 <= COUNT; i += 4) for (j = 0; j < 4; ++j) of[j] = EACH;
for (; i < COUNT; ++i) of[0] = LAST;
res[0][0] = ALL;
return 0;
"""


def _reduced(name: str, numbers: ca.MX, of_all: Callable[[ca.MX], ca.MX], operation: int) -> ca.MX:
    """Return it as one of four results, each of every fourth number: a single one would wait for the one before at each."""
    if numbers.numel() < 4:
        return ca.densify(of_all(numbers))
    of, given = IN_C[operation], ca.MX.sym("x", numbers.numel())
    halves = (f"({of.format(f'of[{j}]', f'of[{j + 2}]')})" for j in range(2))
    parts = {"COUNT": numbers.numel(), "EACH": of.format("of[j]", "x[i + j]"), "LAST": of.format("of[0]", "x[i]"), "ALL": of.format(*halves)}
    body = reduce(lambda text, part: text.replace(part, str(parts[part])), parts, REDUCE)
    return function_in_c(name, {"x": given}, {name: of_all(given)}, body)(numbers)
