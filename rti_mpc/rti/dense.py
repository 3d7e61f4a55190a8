# SPDX-License-Identifier: Apache-2.0
r"""
The backward recursion of many states in C, as loops over dense columns that the compiler vectorizes.

Unrolled into scalars, a stage of n states and inputs is some :math:`n^3` statements: slow from 9 on, and at 36 a
matter of minutes and of hundreds of MB for the compiler. Here, with one more coordinate that is always 1, cost-to-go M and
stage :math:`\Phi = (1 \; 0 \; 0; \; b \; A \; B; \; 0 \; 0 \; I)` are single matrices, gradients and defects are columns of them, and the
recursion is :math:`M \leftarrow (M \Phi)^T \Phi`, less :math:`S^T G` where an input is eliminated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import casadi as ca

from rti_mpc.codegen import BEFORE_BODY
from rti_mpc.rti.linearization import Linearization
from rti_mpc.rti.ocp import Ocp
from rti_mpc.rti.recursion import block_table, resume, stage_in_c

LEAST_SIZE = 9  # states and inputs from which on loops are faster: 13 us instead of 20 with a dynamic bicycle; with a boat, of 8, as fast
PADDED = 4  # columns are padded to multiples of this, the numbers in the longest vector that is used
SHORTEST = 2  # numbers in a vector of any processor
INPUT_WEIGHTS = ("R", "damping")  # arguments of a stage that are the same at every one, mostly
MOST_VECTORS = 12  # sums that fit into its registers

KEEP = """
    if (res[1]) for (e = SIZE_P * k, j = 0; j < NX + NU; ++j) for (i = 0; i <= j; ++i) res[1][e++] = M[i + 1][j + 1];
    if (res[2]) for (j = 0; j < NX + NU; ++j) res[2][(NX + NU) * k + j] = M[0][j + 1];
"""

BODY = """
  vector M_[SIZE][VECTORS], T_[SIZE][VECTORS], S_[NU][VECTORS], G_[NU][VECTORS], column_[VECTORS];
  casadi_real (*M)[WIDTH] = (casadi_real (*)[WIDTH]) M_;  /* cost-to-go, symmetric; the linear terms are its first column and row */
  casadi_real (*T)[WIDTH] = (casadi_real (*)[WIDTH]) T_;  /* M Phi, transposed */
  casadi_real (*S)[WIDTH] = (casadi_real (*)[WIDTH]) S_;
  casadi_real (*G)[WIDTH] = (casadi_real (*)[WIDTH]) G_;
  casadi_real *column = (casadi_real *) column_;
  casadi_real Phi[NONZEROS], g[NONZEROS_G + 1], L[NU][NU], per_L[NU], R_k[NU][NU], spare[GAIN];
  const vector zero = {0};
  int i, j, k, r, e, d;
  casadi_clear((casadi_real *) M_, SIZE * WIDTH);
  casadi_clear((casadi_real *) T_, SIZE * WIDTH);
  casadi_clear((casadi_real *) S_, NU * WIDTH);
  for (j = 0; j < NX + NU; ++j) {
    for (i = 0; i <= j; ++i) M[i + 1][j + 1] = M[j + 1][i + 1] = *arg_P++;
    M[0][j + 1] = arg_p[j];
  }
  for (k = UNTIL - 1; k >= 0; --k) {
    STAGE_ARGUMENTS
    casadi_real *gain = res[0] ? res[0] + GAIN * OF_BLOCK : spare;

    /* the cost of the node at the end */
    for (e = 0; e < NONZEROS_H; ++e) M[1 + column_H[e]][1 + row_H[e]] += H[e];
    for (i = 0; i < OF_OUTPUTS; ++i) M[0][1 + i] += h[i];
    if (g_x) casadi_copy(g_x, NONZEROS_G_X, g);
    if (g_u) casadi_copy(g_u, NONZEROS_G - NONZEROS_G_X, g + NONZEROS_G_X);
    for (r = 0; r < NG; ++r) {
      for (e = first_G[r]; e < first_G[r + 1]; ++e) {
        const casadi_real slope = g[nonzero_G[e]];
        M[0][1 + column_G[e]] += pull_g[r] * slope;
        for (d = first_G[r]; d < first_G[r + 1]; ++d) M[1 + column_G[d]][1 + column_G[e]] += weight_g[r] * slope * g[nonzero_G[d]];
      }
    }

    /* over the stage */
    Phi[0] = 1;
    casadi_copy(b, NX, Phi + 1);
    casadi_copy(A, NONZEROS_A, Phi + 1 + NX);
    for (r = 0, e = 1 + NX + NONZEROS_A; r < NU; ++r) {
      for (d = first_B[r]; d < first_B[r + 1]; ++d) Phi[e++] = B[d];
      Phi[e++] = 1;
    }
    for (j = 0; j < SIZE; ++j) {
      for (i = 0; i < VECTORS; ++i) column_[i] = zero;
      ADD_ALL(column_, Phi + first[j], row + first[j], first[j + 1] - first[j], M_[0]);
      for (i = 0; i < SIZE; ++i) T[i][j] = column[i];
    }
#define PRODUCT(count) \
    for (j = FIRST_OF(count); j < AFTER_LAST_OF(count); ++j) { \
      for (i = 0; i < count; ++i) M_[j][i] = zero; \
      add_##count(M_[j], Phi + first[j], row + first[j], first[j + 1] - first[j], T_[0]); \
    }
    OF_EACH_LENGTH(PRODUCT)

    if (IS_FREE) {  /* its input is eliminated */
      for (j = 0; j < NU; ++j) for (i = 0; i < NU; ++i) R_k[j][i] = 0;
      for (e = 0; e < NONZEROS_R; ++e) R_k[column_R[e]][row_R[e]] = arg_R[e] * lambda_k[0];
      for (r = 0; r < NU; ++r) {
        casadi_real *of = M[1 + NX + r];
        R_k[r][r] += weight_du[r];
        for (i = 0; i <= NX; ++i) S[r][i] = of[i];
        S[r][0] += force[r] + pull_du[r] + pull_u[r];
        for (i = 0; i < NU; ++i) S[r][1 + NX + i] = -R_k[r][i];
        for (i = 0; i <= r; ++i) L[r][i] = of[1 + NX + i] + R_k[r][i];
        L[r][r] += weight_u[r] + arg_damping[r];
        of[0] = -(force[r] + pull_du[r]);
        for (i = 0; i < NX; ++i) of[1 + i] = 0;
        for (i = 0; i < NU; ++i) of[1 + NX + i] = R_k[r][i];
      }
      for (i = 0; i < NU; ++i) {  /* Cholesky */
        for (j = 0; j <= i; ++j) {
          for (d = 0; d < j; ++d) L[i][j] -= L[i][d] * L[j][d];
          L[i][j] = i == j ? sqrt(L[i][i]) : L[i][j] * per_L[j];
        }
        per_L[i] = 1 / L[i][i];
      }
      for (r = 0; r < NU; ++r) {
        for (i = 0; i < WIDTH; ++i) G[r][i] = S[r][i];
        for (d = 0; d < r; ++d) for (i = 0; i < WIDTH; ++i) G[r][i] -= L[r][d] * G[d][i];
        for (i = 0; i < WIDTH; ++i) G[r][i] *= per_L[r];
      }
      for (r = NU - 1; r >= 0; --r) {
        for (d = r + 1; d < NU; ++d) for (i = 0; i < WIDTH; ++i) G[r][i] -= L[d][r] * G[d][i];
        for (i = 0; i < WIDTH; ++i) G[r][i] *= per_L[r];
        for (i = 0; i < WIDTH; ++i) S[r][i] = -S[r][i];
        for (j = 0; j < NX + NU; ++j) gain[NU * j + r] = G[r][1 + j];
        gain[NU * (NX + NU) + r] = G[r][0];
      }
      for (e = NU * (NX + NU + 1), j = 0; j < NU; ++j) for (i = j; i < NU; ++i) gain[e++] = L[i][j];
#define DECREASE(count) for (j = FIRST_OF(count); j < AFTER_LAST_OF(count); ++j) add_##count(M_[j], gain + NU * (j - 1), in_order, NU, S_[0]);
      OF_EACH_LENGTH(DECREASE)
    }
    for (j = 1; j < SIZE; ++j) for (i = 0; i < j; ++i) M[i][j] = M[j][i];
    KEEP
  }
  return 0;
"""


def backward_in_c(ocp: Ocp, lin: Linearization, free: ca.Function, held: ca.Function, *, resumed: bool = False) -> str | None:
    """
    Return the recursion whose stages are `rti_mpc.rti.riccati.backward_free` and `backward_held` in C, see `function_in_c`; None for few states.

    Args:
        ocp: The problem.
        lin: Its linearization.
        free: A stage with an input, for its arguments.
        held: A stage without.
        resumed: Whether it may go on from an earlier call, and returns P and p before each stage: see `rti_mpc.rti.recursion.recur`.
    """
    nx, nu = ocp.model.nx, ocp.model.nu
    if nx + nu < LEAST_SIZE:
        return None
    size = 1 + nx + nu
    width = -(-size // PADDED) * PADDED
    A, B, H, R, G = lin.A_k, lin.B_k, lin.H_i, lin.R.sparsity(), ca.horzcat(lin.G_x, lin.G_u)
    Phi = [[*range(nx + 1)], *([1 + i for i in column] for column in rows_by_column(A))]
    Phi += [[*(1 + i for i in column), 1 + nx + j] for j, column in enumerate(rows_by_column(B))]
    by_row = [[(e, j) for e, (i, j) in enumerate(zip(*G.get_triplet(), strict=True)) if i == r] for r in range(G.size1())]
    sizes = {"NX": nx, "NU": nu, "NG": ocp.ng, "SIZE": size, "SIZE_P": (size - 1) * size // 2}
    sizes |= {"STAGES": ocp.N, "FREE": ocp.N_u, "NONZEROS": sum(map(len, Phi)), "GAIN": free.size1_out("gain")}
    sizes |= {f"NONZEROS_{name}": pattern.nnz() for name, pattern in {"A": A, "H": H, "R": R, "G": G, "G_X": lin.G_x}.items()}
    tables = {
        "first": starts(Phi),
        "row": [i for column in Phi for i in column],
        "in_order": [*range(nu)],
        "first_B": B.colind(),
        "row_H": H.get_triplet()[0],
        "column_H": H.get_triplet()[1],
        "row_R": R.get_triplet()[0],
        "column_R": R.get_triplet()[1],
        "first_G": starts(by_row),
        "nonzero_G": [e for row in by_row for e, _ in row],
        "column_G": [j for row in by_row for _, j in row],
    }
    shared = ("P", "p", *input_weights_shared(ocp))
    names = free.name_in()
    once = [f"const casadi_real *arg_{name} = arg[{names.index(name)}];" for name in shared]
    block = ocp.held.tolist()
    is_free, of_block = stage_in_c(block)
    at = {name: "k" if name in held.name_in() else of_block for name in names}
    each = [
        f"const casadi_real *{'arg_' * (name in INPUT_WEIGHTS)}{name} = arg[{i}] + {free.size1_in(i)} * {at[name]};"
        for i, name in enumerate(names)
        if name not in shared
    ]
    if resumed:
        once += resume(ocp.N, len(names), [free.size1_out("gain") * ocp.N_u, sizes["SIZE_P"] * ocp.N, (size - 1) * ocp.N])
        known = {"P": ("SIZE_P", len(names) + 2), "p": ("(NX + NU)", len(names) + 3)}
        once += [f"if (until < STAGES) arg_{name} = arg[{at}] + {numbers} * until;" for name, (numbers, at) in known.items()]
    lines = [f"enum {{ {', '.join(f'{name} = {number}' for name, number in sizes.items())} }};"]
    lines += [block_table(block)] if of_block != "k" else []
    lines += [f"static const int {name}[] = {{ {', '.join(map(str, numbers or [0]))} }};" for name, numbers in tables.items()]
    body = BODY.strip("\n").replace("STAGE_ARGUMENTS", "\n    ".join(each)).replace("OF_OUTPUTS", "NX" if H.size1() == nx else "NX + NU")
    body = body.replace("UNTIL", "until" if resumed else "STAGES").replace("    KEEP\n", KEEP.lstrip("\n") if resumed else "")
    body = body if "lambda_k" in names else body.replace(" * lambda_k[0]", "")
    body = body.replace("IS_FREE", "k < FREE" if of_block == "k" else is_free).replace("OF_BLOCK", of_block)
    before = ["#ifndef LANES", *additions(width), "#endif"]  # once for all recursions of a problem
    return "\n".join([*before, BEFORE_BODY, *(f"  {line}" for line in lines + once), body])


def input_weights_shared(ocp: Ocp) -> list[str]:
    """Return which of `INPUT_WEIGHTS` are the same at every stage."""
    return [name for name, weight in zip(INPUT_WEIGHTS, (ocp.lambda_, ocp.R_u), strict=True) if weight.ndim == 1]


def additions(width: int) -> Iterator[str]:
    """
    Return functions that add multiples of columns to a column, its numbers in registers: one for each number of vectors.

    `OF_EACH_LENGTH` is for the columns of a symmetric matrix up to its diagonal, those of one length after those of another. The recursion takes
    three quarters of the time that it takes with one loop over all columns, in which each call is of another function.
    """
    arguments = "vector *sum, const casadi_real *factor, const int *of, int count, const vector *columns"
    yield "#ifdef __AVX__"
    yield from lengths(width, PADDED)
    yield "#else"
    yield from lengths(width, SHORTEST)
    yield "#endif"
    yield f"enum {{ WIDTH = {width}, VECTORS = WIDTH / LANES }};"
    yield "#define FIRST_OF(count) (count == 1 ? 1 : (count - 1) * LANES)"
    yield "#define AFTER_LAST_OF(count) (count * LANES < SIZE ? count * LANES : SIZE)"
    yield "typedef casadi_real vector __attribute__((vector_size(sizeof(casadi_real) * LANES), may_alias));"
    for vectors in range(1, width // SHORTEST + 1):
        yield f"static void add_{vectors}({arguments}) {{"
        if vectors > MOST_VECTORS:
            parts = -(-vectors // MOST_VECTORS)
            ends = [vectors * part // parts for part in range(parts + 1)]
            yield from (f"  add_{b - a}(sum + {a}, factor, of, count, columns + {a});" for a, b in pairwise(ends))
        else:
            yield f"  vector {', '.join(f's{i} = sum[{i}]' for i in range(vectors))};"
            yield "  int e;"
            yield "  for (e = 0; e < count; ++e) {"
            yield "    const vector *c = columns + VECTORS * of[e];"
            yield from (f"    s{i} += factor[e] * c[{i}];" for i in range(vectors))
            yield "  }"
            yield from (f"  sum[{i}] = s{i};" for i in range(vectors))
        yield "}"


def lengths(width: int, lanes: int) -> Iterator[str]:
    """Return the numbers of vectors of so many numbers that columns of such a width may have."""
    yield f"#define LANES {lanes}"
    yield f"#define ADD_ALL add_{width // lanes}"
    yield f"#define OF_EACH_LENGTH(of) {' '.join(f'of({count})' for count in range(1, width // lanes + 1))}"


def rows_by_column(pattern: ca.Sparsity) -> list[list[int]]:
    """Return the rows of the nonzeros of each column."""
    ends = pattern.colind()
    return [pattern.row()[a:b] for a, b in pairwise(ends)]


def starts(parts: Sequence[Sequence[object]]) -> list[int]:
    """Return where each part begins, and the last one ends."""
    return [sum(map(len, parts[:i])) for i in range(len(parts) + 1)]
