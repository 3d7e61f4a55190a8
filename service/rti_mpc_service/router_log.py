# SPDX-License-Identifier: Apache-2.0
"""
Log of a router about those whom it refuses, made from Zenoh's own.

Zenoh writes to standard output, in its own form, a line for each attempt and each message.
Of these a process's log gets one line for each connection that was refused, and one for each
name whose messages the access control list denies, not repeated within `REPEAT_S`.

Zenoh tells which key was denied only where it also writes a line for each message that
passes, which would delay them all: for that, `RUST_LOG` takes other targets than `TARGETS`.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable, Iterator
from threading import Thread
from typing import Any

from rti_mpc.wire.session import start_zenoh_log
from rti_mpc_service import log as process_log

TARGETS = ",".join(
    (
        "off",
        "zenoh_link_tls=debug",  # who connects, with which certificate, and who is refused
        "zenoh_link_quic=debug",
        "zenoh_transport::unicast::establishment::accept=debug",  # as which session
        "zenoh::net::primitives::demux=trace",  # whose message it is
        "zenoh::net::routing::interceptor=trace",  # that a message is dropped
        "zenoh::net::routing::interceptor::access_control=info",  # that a certificate is in no list; more would be a line for each message
    )
)
CHUNK_BYTES = 1 << 16  # of Zenoh's log that are read at once
PAUSE_S = 0.1  # when all is read
MAX_FILE_BYTES = 1 << 22  # at which it is cut off
REPEAT_S = 60.0  # between two lines of one kind about one name
MAX_REMEMBERED = 256  # names, sessions and kinds of lines
COLOUR = re.compile(r"\x1b\[\d*m")
LINE = re.compile(
    r"\S+ +(?P<level>[A-Z]+) +(?:\S+ +)?ThreadId\((?P<thread>\d+)\) (?P<span>.*?)(?P<target>zenoh\w*(?:::\w+)*): (?P<text>.*)", re.DOTALL
)
JOINED = re.compile(r"Accepted \w+ connection on \S+: (?P<address>\S+)\. Common Name: (?P<name>.+)\.")
OPENED = re.compile(r"New transport link accepted from (?P<session>\w+) to .*? dst: \w+/(?P<address>[^,]+),")
UNLISTED = re.compile(r"(?P<session>\w+) did not match any configured ACL subject")
DENIED = re.compile(r"is unauthorized to (?P<act>.+) \(ingress\) on (?P<key>.+?)(?:/@adv/\S*)?$")
SENDER = re.compile(r"src=\S*/(?P<session>\w+)[:}]")
SHORT = 6  # characters by which a session is known: spans have the first eight, without zeros in front

# What TLS calls it, as a pattern: what it means here.
REFUSALS = {
    "expired": "its certificate has ended",
    "BadSignature|UnknownIssuer": "its certificate is of another authority",
    "no certificates": "it has no certificate",
    "corrupt message": "it does not speak TLS",
    "fatal alert: (\\w+)": "it does not take the router's certificate, with the alert {}",
}


def follow() -> None:
    """Have Zenoh write its log, and make lines of it; once, before the first session, in a process whose log is `rti_mpc_service.log`."""
    file = process_log.divert()
    start_zenoh_log(TARGETS)
    digest = Digest(logging.getLogger("router"))

    def read() -> None:
        for line in lines(file):
            digest.take(line)

    Thread(target=read, name="zenoh log", daemon=True).start()


def lines(file: int) -> Iterator[str]:
    """Yield the lines that are appended to a file, without end; who appends faster than they are read loses some, and takes no more memory."""
    begun, place = b"", 0
    while True:
        received = os.pread(file, CHUNK_BYTES, place)
        place += len(received)
        if os.fstat(file).st_size > MAX_FILE_BYTES:
            os.ftruncate(file, 0)
            place = 0
        *whole, begun = (begun[-CHUNK_BYTES:] + received).split(b"\n")
        yield from (line.decode(errors="replace") for line in whole)
        if len(received) < CHUNK_BYTES:
            time.sleep(PAUSE_S)


class Digest:
    """Lines for people, made from those of Zenoh."""

    def __init__(self, log: logging.Logger, now_s: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._now_s = now_s
        self._names: dict[str, str] = {}  # in the certificate, by address
        self._sessions: dict[str, tuple[str, str]] = {}  # name, empty if it is in no list, and address, by session
        self._unlisted = ""  # session whose name is in no list, until its address is known
        self._early: dict[str, str] = {}  # what is denied, by session, that Zenoh's threads have told of before they told whose it is
        self._objections: dict[str, str] = {}  # what was said last about a message, by thread
        self._said: dict[str, tuple[float, int]] = {}  # when a line of a kind was written, and how many were left out since

    def take(self, line: str) -> None:
        """Take a line of Zenoh, and write one if it is news."""
        match = LINE.match(COLOUR.sub("", line.rstrip()))
        if match is None:
            return
        text, target = match["text"], match["target"]
        if target.startswith("zenoh_link_") and match["level"] == "WARN":
            self._say(refusal(text), f"a connection was refused: {refusal(text)}")
        elif joined := JOINED.match(text):
            remember(self._names, joined["address"], joined["name"])
        elif unlisted := UNLISTED.match(text):
            self._unlisted = unlisted["session"]
        elif opened := OPENED.match(text):
            name, address = self._names.pop(opened["address"], "a process without a certificate"), opened["address"]
            listed = opened["session"] != self._unlisted
            remember(self._sessions, opened["session"][:SHORT], (name if listed else "", address))
            early = self._early.pop(opened["session"][:SHORT], "")
            if not listed:
                self._say(name, f"{name} at {address} is denied everything: the access control list does not have its name")
            elif early:
                self._deny(name, address, early)
        elif target.endswith("::access_control"):
            if denied := DENIED.search(text):
                self._objections[match["thread"]] = f"{denied['act'].lower()} on {denied['key']}"
        elif target.endswith("::interceptor") and (sender := SENDER.search(match["span"])):
            what = self._objections.pop(match["thread"], "what its role may not write")
            session = sender["session"][:SHORT]
            name, address = self._sessions.get(session, ("", ""))
            if name:
                self._deny(name, address, what)
            elif not address:  # otherwise everything is denied, which was said when it came
                remember(self._early, session, what)
        elif match["level"] in ("WARN", "ERROR"):
            self._say(text, f"Zenoh: {text}")

    def _deny(self, name: str, address: str, what: str) -> None:
        self._say(f"{name} {what}", f"{name} at {address} is denied {what}")

    def _say(self, kind: str, text: str) -> None:
        """Write a line, unless one of its kind was written just before."""
        now_s = self._now_s()
        last_s, more = self._said.get(kind, (now_s - REPEAT_S, 0))
        if now_s - last_s < REPEAT_S:
            self._said[kind] = last_s, more + 1
            return
        remember(self._said, kind, (now_s, 0))
        self._log.warning("%s%s", text, f" ({more} more since the last line)" if more else "")


def refusal(text: str) -> str:
    """Return why a connection was refused, in words."""
    found = next(((match, words) for pattern, words in REFUSALS.items() if (match := re.search(pattern, text))), None)
    return text.partition(". Hint:")[0] if found is None else found[1].format(*found[0].groups())


def remember(memory: dict[str, Any], name: str, value: Any) -> None:
    """Remember a value, and forget the oldest where there are too many."""
    memory.pop(name, None)
    memory[name] = value
    if len(memory) > MAX_REMEMBERED:
        del memory[next(iter(memory))]
