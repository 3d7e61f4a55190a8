# SPDX-License-Identifier: Apache-2.0
"""Viewer process: the streams of one robot drawn live in Rerun."""
