# SPDX-License-Identifier: Apache-2.0
"""Loopback endpoints for processes on this machine."""

from __future__ import annotations

import socket


def free_endpoint() -> str:
    """Return a loopback endpoint that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
