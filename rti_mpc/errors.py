# SPDX-License-Identifier: Apache-2.0
"""
Errors raised on purpose.

* RtiMpcError
  + OcpError           the problem is ill-posed: raised at construction
    - ShapeError       an array has the wrong shape, dtype or layout
  + ConfigError        a configuration value is missing, unknown or out of range
  + MessageError       bytes from the wire are not a message of ours
  + JournalError       a journal, or a snapshot in it, cannot be written, read or repeated
  + Stopped            the process was stopped while it waited for somebody

A QP that does not converge is *not* an exception: it is a `QpStatus` in the
telemetry, and the controller decides what to command.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RtiMpcError(Exception):
    """Base class of every error this package raises on purpose."""


def reason(error: Exception) -> str:
    """Return why a file was refused, for a line that names it: without the number and the path that an error of the system repeats."""
    return str((isinstance(error, OSError) and error.strerror) or error)


class OcpError(RtiMpcError):
    """The model or the optimal control problem is ill-posed."""


class ShapeError(OcpError):
    """
    An array has the wrong shape, dtype or memory layout.

    Attributes:
        name: Name of the array, as in the documentation.
        expected: Expected shape.
        got: Shape received.
    """

    def __init__(self, name: str, expected: tuple[int, ...], array: NDArray[np.generic], kind: str = "an array") -> None:
        self.name = name
        self.expected = expected
        self.got = array.shape
        super().__init__(f"{name} must be {kind} of shape {expected}, got {array.dtype} of shape {array.shape}")


class ConfigError(RtiMpcError):
    """A configuration value is missing, unknown or out of range."""


class MessageError(RtiMpcError):
    """Bytes from the wire are not a message of ours."""


class JournalError(RtiMpcError):
    """A journal, or a snapshot in it, cannot be written, read or repeated."""


class Stopped(RtiMpcError):
    """The process was stopped while it waited for somebody: no fault, and nothing was begun."""
