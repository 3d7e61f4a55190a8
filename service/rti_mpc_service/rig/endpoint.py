# SPDX-License-Identifier: Apache-2.0
"""Loopback endpoints for processes on this machine."""

from __future__ import annotations

import socket


def free_port() -> int:
    """Return a TCP port of the loopback interface that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def free_endpoint() -> str:
    """Return a loopback endpoint that is free now."""
    return f"tcp/127.0.0.1:{free_port()}"
