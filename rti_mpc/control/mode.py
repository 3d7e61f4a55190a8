# SPDX-License-Identifier: Apache-2.0
"""Mode of the controller: a small state machine, each of whose transitions has a reason."""

from __future__ import annotations

from collections import deque

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.contract.status import Mode

ANSWERING_MODES = {Mode.TRACKING, Mode.HOLDING, Mode.BRAKING, Mode.STOPPED}  # modes that may follow any other but IDLE and STOPPED

# From each mode the ones that may follow; idle follows all, when the robot begins another life.
TRANSITIONS: dict[Mode, set[Mode]] = {
    Mode.IDLE: {Mode.WAITING},
    Mode.WAITING: ANSWERING_MODES | {Mode.IDLE},
    Mode.TRACKING: ANSWERING_MODES | {Mode.FALLBACK, Mode.IDLE},
    Mode.HOLDING: ANSWERING_MODES | {Mode.FALLBACK, Mode.IDLE},
    Mode.FALLBACK: ANSWERING_MODES | {Mode.IDLE},
    Mode.BRAKING: ANSWERING_MODES | {Mode.IDLE},
    Mode.STOPPED: {Mode.WAITING, Mode.IDLE},
}


class ModeMachine:
    """
    The mode, and what is to be said of its changes.

    Attributes:
        mode: What the controller is doing.
        notices: Mode changes and faults since somebody last emptied it; the oldest make room.
    """

    def __init__(self) -> None:
        self.mode = Mode.IDLE
        self.notices: deque[Notice] = deque(maxlen=64)

    def take(self) -> list[Notice]:
        """Take all notices, oldest first; in any thread."""
        taken: list[Notice] = []
        try:
            while True:
                taken.append(self.notices.popleft())
        except IndexError:  # there is none left, or another thread took it
            return taken

    def enter(self, mode: Mode, reason: str, severity: Severity = Severity.INFO, code: str = "mode") -> None:
        """Change the mode, and say why; nothing happens if it is the mode already."""
        if mode is self.mode:
            return
        assert mode in TRANSITIONS[self.mode], f"{self.mode.name} to {mode.name}"
        self.notices.append(Notice(severity, code, f"{self.mode.name.lower()} to {mode.name.lower()}: {reason}", change=True))
        self.mode = mode

    def say(self, severity: Severity, code: str, text: str) -> None:
        """Say something that changes no mode."""
        self.notices.append(Notice(severity, code, text))
