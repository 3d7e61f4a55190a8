# SPDX-License-Identifier: Apache-2.0
"""Recorder: all streams of one or more robots, into an MCAP file."""
