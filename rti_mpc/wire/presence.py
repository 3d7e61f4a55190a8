# SPDX-License-Identifier: Apache-2.0
"""
Check of a process whether its router passes on what it shows, from where the others are.

A router drops what its access control list denies, and tells the sender nothing. Answers
from others would tell, but not each message is due one, and a refusal is an answer, too. So a
second session, short and of the same certificate, looks whether the presence of the first one
arrives: roles in lists may show theirs just where they may write.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from threading import Event, Thread
from typing import Any

import zenoh

from rti_mpc.errors import ConfigError, Stopped
from rti_mpc.wire.keys import Key
from rti_mpc.wire.zenoh_session import ZenohSession

FIRST_LOOK_S = 2.0  # after presence is first shown, when the process has started
LOOK_INTERVAL_S = 1.0  # between two looks
LOOKS = 5  # in vain, one after the other and with both sessions linked to one router, until it is said
OPEN_TIMEOUT_S = 10.0  # for the second session


def watch(session: ZenohSession, key: Key[Any], tell: Callable[[], object], over: Event) -> None:
    """
    Look, in a thread of its own, whether presence is seen, and tell once if it is certain that it is not.

    Args:
        session: Session of the process, a client of a router; nothing happens if it is linked to none.
        key: Key of presence that no other process shows; it is shown for the time of the look.
        tell: Called if the router does not pass it on.
        over: Ends the look when set.
    """

    def look() -> None:
        if over.wait(FIRST_LOOK_S) or not session.routers:
            return
        with suppress(ConfigError, Stopped, zenoh.ZError):  # the router is gone, which is said elsewhere, or this process ends
            other = session.again(OPEN_TIMEOUT_S, over)
            token = session.token(key)
            try:
                if unseen(session, other, key, over):
                    tell()
            finally:
                other.close()
                token.undeclare()

    Thread(target=look, name="presence", daemon=True).start()


def unseen(session: ZenohSession, other: ZenohSession, key: Key[Any], over: Event) -> bool:
    """Whether presence is certainly not seen by another session at the same router."""
    in_vain = 0
    while in_vain < LOOKS:
        if other.present(key, LOOK_INTERVAL_S) or over.wait(LOOK_INTERVAL_S):
            return False
        in_vain = in_vain + 1 if session.routers and session.routers == other.routers else 0
    return True
