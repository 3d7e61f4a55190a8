# SPDX-License-Identifier: Apache-2.0
"""The sample's QP, sparse and condensed, and its solvers: OSQP in one workspace, others through qpsolvers."""
