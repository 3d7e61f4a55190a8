# SPDX-License-Identifier: Apache-2.0
"""The real-time iteration: problem, linearization, Riccati recursion, active set and certificate."""
