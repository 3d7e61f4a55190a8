# SPDX-License-Identifier: Apache-2.0
"""Mode of the controller: a small state machine, each of whose transitions has a reason."""

from __future__ import annotations

from collections import deque

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.contract.status import Mode

ANSWERING_MODES = {Mode.TRACKING, Mode.HOLDING, Mode.BRAKING, Mode.STOPPED}  # modes that may follow any other but IDLE and STOPPED

# For each mode those that may follow it. IDLE may follow every other mode, when another life of the robot begins.
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
    The mode of the controller, and the notices of its changes.

    Attributes:
        mode: What the controller is doing.
        stopped: Why an operator's stop is latched; empty if none is.
        standing_by: Whether the commands of another controller act, and not those of this one.
        notices: Notices of mode changes and faults that have not been taken yet; when it is full the oldest is dropped.
    """

    def __init__(self) -> None:
        self.mode = Mode.IDLE
        self.stopped = ""
        self.standing_by = False
        self.notices: deque[Notice] = deque(maxlen=64)

    def take(self) -> list[Notice]:
        """Take all notices, oldest first; may be called in any thread."""
        taken: list[Notice] = []
        try:
            while True:
                taken.append(self.notices.popleft())
        except IndexError:  # there is none left, or another thread took it
            return taken

    def enter(self, mode: Mode, reason: str, severity: Severity = Severity.INFO, code: str = "mode") -> None:
        """Change the mode and add a notice with the reason; does nothing if the mode is the same."""
        if mode is self.mode:
            return
        assert mode in TRANSITIONS[self.mode], f"{self.mode.name} to {mode.name}"
        self.notices.append(Notice(severity, code, f"{self.mode.name.lower()} to {mode.name.lower()}: {reason}", change=True))
        self.mode = mode

    def say(self, severity: Severity, code: str, text: str) -> None:
        """Add a notice that is no change of mode."""
        self.notices.append(Notice(severity, code, text))
