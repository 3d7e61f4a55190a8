# SPDX-License-Identifier: Apache-2.0
"""
The study of [Rosales]_, done again and gone beyond: `rti-mpc paper`.

An `experiment` is one closed loop; the `loop` drives it with one of the
`contender`s, among them the paper's two algorithms (`slsqp`). The `race` has the
figures of the paper, `readings` decide what it leaves open, `sweeps` go beyond.
`study` does all of it in one go; what it found is JSON, from which `report`
writes every number of docs/paper.md.
"""
