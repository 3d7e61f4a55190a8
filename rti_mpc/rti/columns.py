# SPDX-License-Identifier: Apache-2.0
"""
Map of a function over columns: for CasADi's virtual machine a map, in C a few columns at a time, one in each number of the processor's vectors.

The stages of a horizon are such columns. One of them has nothing that a compiler could
vectorize, but an operation of four stages is one instruction. Each column is to the last
bit what the function makes of it alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import casadi as ca

from rti_mpc.codegen import BEFORE_BODY, function_in_c
from rti_mpc.rti.elementwise import IN_C, instructions

LEAST_COUNT = 4  # columns: as many as the longest vector has numbers
LEAST_SIZE = 200  # instructions from which on it pays; with 93 it takes 1.2 times as long, with 600 half as long
MOST_SIZE = 5000  # beyond which a compiler takes too much of time and memory: 5964 of a chain's stage take it 3 s and 40 MB more
OF_VECTORS = {ca.OP_ASSIGN, ca.OP_ADD, ca.OP_SUB, ca.OP_MUL, ca.OP_DIV, ca.OP_NEG, ca.OP_INV, ca.OP_SQ, ca.OP_TWICE}  # in C as of numbers
OF_NUMBERS = {
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_SQRT: "sqrt",
    ca.OP_FABS: "fabs",
}
OF_PAIRS = {ca.OP_POW: "pow", ca.OP_CONSTPOW: "pow", ca.OP_ATAN2: "atan2"}
KNOWN = {*OF_VECTORS, *OF_NUMBERS, *OF_PAIRS, ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST}

BEFORE = """
#ifndef COLUMNS
#ifdef __AVX__
#define COLUMNS 4
#define SAME(c) {c, c, c, c}
#define TAKEN(x, n) {(x)[0], (x)[n], (x)[2 * n], (x)[3 * n]}
#define OF_EACH(f, a) {f(a[0]), f(a[1]), f(a[2]), f(a[3])}
#define OF_BOTH(f, a, b) {f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2]), f(a[3], b[3])}
#else
#define COLUMNS 2
#define SAME(c) {c, c}
#define TAKEN(x, n) {(x)[0], (x)[n]}
#define OF_EACH(f, a) {f(a[0]), f(a[1])}
#define OF_BOTH(f, a, b) {f(a[0], b[0]), f(a[1], b[1])}
#endif
typedef casadi_real columns __attribute__((vector_size(sizeof(casadi_real) * COLUMNS)));
#endif
"""


def over_columns(one: ca.Function, count: int) -> ca.Function:
    """
    Build the map of a function of dense columns, with one result, over so many of them.

    That is CasADi's own where there are fewer than `LEAST_COUNT` columns, or the function has fewer than `LEAST_SIZE` or more than `MOST_SIZE`
    instructions, is made of more than scalar expressions, or of operations that are not `KNOWN`, or of a constant that is infinite.
    """
    whole = one.map(count)
    if count < LEAST_COUNT or not one.is_a("SXFunction") or not LEAST_SIZE <= one.n_instructions() <= MOST_SIZE:
        return whole
    if not all(operation in KNOWN and math.isfinite(constant) for operation, _, _, constant in instructions(one)):
        return whole
    given = {name: ca.MX.sym(name, *whole.size_in(name)) for name in whole.name_in()}
    body = "\n".join([BEFORE, BEFORE_BODY, *_body(one, count)])
    return function_in_c(f"{one.name()}_over_columns", given, whole(**given), body)


def _body(one: ca.Function, count: int) -> Iterator[str]:
    """Return the body in C. Where the number of columns is no multiple of that of a vector, the last vector begins earlier."""
    size = one.numel_out(0)
    yield "casadi_int i, j, e;"
    yield f"columns y[{size}];"
    yield "if (!res[0]) return 0;"
    yield "for (i = 0;; i += COLUMNS) {"
    yield f"  columns {', '.join(f'v{k}' for k in range(one.sz_w()))};"
    yield f"  if (i > {count} - COLUMNS) i = {count} - COLUMNS;"
    for operation, to, of, constant in instructions(one):
        if operation == ca.OP_OUTPUT:
            yield f"  y[{to[1]}] = v{of[0]};"
            continue
        if operation == ca.OP_INPUT:
            rows = one.numel_in(of[0])
            value = f"(columns) TAKEN(arg[{of[0]}] + {rows} * i + {of[1]}, {rows})"
        elif operation == ca.OP_CONST:
            value = f"(columns) SAME({constant!r})"
        elif operation in OF_VECTORS:
            value = IN_C[operation].format(*(f"v{number}" for number in of))
        elif operation in OF_NUMBERS:
            value = f"(columns) OF_EACH({OF_NUMBERS[operation]}, v{of[0]})"
        else:
            value = f"(columns) OF_BOTH({OF_PAIRS[operation]}, v{of[0]}, v{of[1]})"
        yield f"  v{to[0]} = {value};"
    yield f"  for (j = 0; j < COLUMNS; ++j) for (e = 0; e < {size}; ++e) res[0][{size} * (i + j) + e] = y[e][j];"
    yield f"  if (i + COLUMNS >= {count}) return 0;"
    yield "}"
