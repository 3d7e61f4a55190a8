# SPDX-License-Identifier: Apache-2.0
"""Benchmarks of the real-time iteration beside IPOPT."""
