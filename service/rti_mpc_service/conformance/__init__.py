# SPDX-License-Identifier: Apache-2.0
"""Conformance: robots and guards of any make, judged over the bus alone."""
