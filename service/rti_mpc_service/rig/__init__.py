# SPDX-License-Identifier: Apache-2.0
"""Harness of runs with real processes on this machine: shared by the demo, the fault matrix, the doctor and tests."""
