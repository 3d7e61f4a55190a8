# SPDX-License-Identifier: Apache-2.0
"""Replay of recordings: the recorded controller, built again, repeats what it did, and explains it."""
