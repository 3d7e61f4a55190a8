# SPDX-License-Identifier: Apache-2.0
"""Robots that ship, one file each."""
