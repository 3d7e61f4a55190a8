# SPDX-License-Identifier: Apache-2.0
"""Faults injected into real processes, one after another, and what the robot did: the fault matrix."""
