# SPDX-License-Identifier: Apache-2.0
"""Pose in the plane, the first states and the outputs of robots that drive on it."""

from __future__ import annotations

from rti_mpc.model.model import Signal

POSE_SIGNALS = (Signal("x", "m", role="x"), Signal("y", "m", role="y"), Signal("psi", "rad", angle=True, role="heading"))
