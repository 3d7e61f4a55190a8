# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from rti_mpc_service import router_log
from rti_mpc_service.router_log import MAX_REMEMBERED, REPEAT_S, Digest, lines

AT = "\x1b[2m2026-11-28T18:55:40.824281Z\x1b[0m"
JOINED = f"{AT} DEBUG acc-0 ThreadId(05) zenoh_link_tls::unicast: Accepted TLS connection on 127.0.0.1:7447: {{address}}. Common Name: {{name}}."
OPENED = (
    f"{AT} DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: New transport link accepted from {{session}} to 76b4: "
    "TransportLinkUnicast {{ link: Link {{ src: tls/127.0.0.1:7447, dst: tls/{address}, mtu: 49152 }} }}"
)
DROPPED = f"{AT} TRACE  rx-1 ThreadId(12) demux{{{{zid=76b4 src=south:0:client/{{short}}:1}}}}: zenoh::net::routing::interceptor: Msg intercepted!"
OBJECTION = (
    f"{AT} TRACE  rx-1 ThreadId(12) demux{{{{zid=76b4 src=south:0:client/{{short}}:1}}}}: zenoh::net::routing::interceptor::access_control: "
    "Using cached result: {session} is unauthorized to Put (ingress) on {key}"
)
UNLISTED = f"{AT}  INFO acc-0 ThreadId(05) zenoh::net::routing::interceptor::access_control: {{session}} did not match any configured ACL subject. D"
REFUSED = f"{AT}  WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: {{text}}. Hint: increase the system open file limit."
SESSION = "c5a18c6e111b701e1ed591f703de0ce8"


class Journal:
    """What a digest writes, at times that a test sets."""

    def __init__(self, caplog: pytest.LogCaptureFixture) -> None:
        self.now_s = 0.0
        self.digest = Digest(logging.getLogger("router"), lambda: self.now_s)
        self._caplog = caplog

    def after(self, *lines: str) -> list[str]:
        self._caplog.clear()
        for line in lines:
            self.digest.take(line + "\n")
        return [record.getMessage() for record in self._caplog.records]


@pytest.fixture
def journal(caplog: pytest.LogCaptureFixture) -> Journal:
    caplog.set_level(logging.INFO, "router")
    return Journal(caplog)


def joined(name: str, address: str = "127.0.0.1:42428", session: str = SESSION) -> tuple[str, str]:
    return JOINED.format(address=address, name=name), OPENED.format(address=address, session=session)


REFUSALS = {
    "invalid peer certificate: certificate expired: verification time 17958 (UNIX), but ended (172847 seconds ago)": "its certificate has ended",
    "invalid peer certificate: BadSignature": "its certificate is of another authority",
    "invalid peer certificate: UnknownIssuer": "its certificate is of another authority",
    "peer sent no certificates": "it has no certificate",
    "received corrupt message of type InvalidContentType": "it does not speak TLS",
    "received corrupt message of type UnknownProtocolVersion": "it does not speak TLS",
    "received fatal alert: DecryptError": "it does not take the router's certificate, with the alert DecryptError",
    "Too many open files (os error 24)": "Too many open files (os error 24)",
}


@pytest.mark.parametrize("text", REFUSALS)
def test_refused_connection_is_a_line_that_says_why(text: str, journal: Journal) -> None:
    assert journal.after(REFUSED.format(text=text)) == [f"a connection was refused: {REFUSALS[text]}"]


def test_line_that_repeats_is_written_once_a_minute_with_the_number_of_those_left_out(journal: Journal) -> None:
    refused = REFUSED.format(text="peer sent no certificates")
    assert len(journal.after(*[refused] * 30)) == 1
    journal.now_s = REPEAT_S - 1.0
    assert journal.after(refused) == []
    journal.now_s = REPEAT_S
    assert journal.after(refused) == ["a connection was refused: it has no certificate (30 more since the last line)"]


def test_denied_process_is_named_by_its_certificate_and_address(journal: Journal) -> None:
    assert journal.after(*joined("viewer@rti_mpc/pioneer")) == []
    denied = "viewer@rti_mpc/pioneer at 127.0.0.1:42428 is denied "
    dropped, objection = DROPPED.format(short="c5a18c6e"), OBJECTION.format(short="c5a18c6e", session=SESSION, key="KEY")
    assert journal.after(dropped, dropped) == [denied + "what its role may not write"]
    assert journal.after(objection.replace("KEY", "rti_mpc/pioneer/command"), dropped) == [denied + "put on rti_mpc/pioneer/command"]
    cache = objection.replace("KEY", "rti_mpc/pioneer/reference/@adv/pub/31ae/7/_")
    assert journal.after(cache, dropped) == [denied + "put on rti_mpc/pioneer/reference"]
    again = joined("viewer@rti_mpc/pioneer", "127.0.0.1:5", "aa4811baf8987c9b4fb0234c6b954e1c")
    assert journal.after(*again, DROPPED.format(short="aa4811ba")) == [], "who joins again and again is told once a minute"


def test_session_whose_number_begins_with_a_zero_is_known_by_the_shorter_number_that_zenoh_writes(journal: Journal) -> None:
    journal.after(*joined("viewer@rti_mpc/pioneer", session="23281df111b701e1ed591f703de0ce8"))
    assert journal.after(DROPPED.format(short="23281df")) == ["viewer@rti_mpc/pioneer at 127.0.0.1:42428 is denied what its role may not write"]


def test_denial_that_is_told_before_whose_it_is_waits_for_the_name(journal: Journal) -> None:
    accepted, opened = joined("viewer@rti_mpc/pioneer")
    assert journal.after(accepted, *[DROPPED.format(short="c5a18c6e")] * 3) == []
    assert journal.after(opened) == ["viewer@rti_mpc/pioneer at 127.0.0.1:42428 is denied what its role may not write"]


def test_certificate_that_is_in_no_list_is_told_once_and_not_for_each_message(journal: Journal) -> None:
    accepted, opened = joined("controller@rti_mpc/other")
    said = journal.after(accepted, UNLISTED.format(session=SESSION), opened, *[DROPPED.format(short="c5a18c6e")] * 9)
    assert said == ["controller@rti_mpc/other at 127.0.0.1:42428 is denied everything: the access control list does not have its name"]


def test_other_lines_of_zenoh_are_passed_on_from_warnings_up(journal: Journal) -> None:
    assert journal.after("no line of Zenoh's", "", f"{AT} DEBUG main ThreadId(01) zenoh::api::session: Config") == []
    assert journal.after(f"{AT} ERROR main ThreadId(01) zenoh::api::session: broken") == ["Zenoh: broken"]


def test_memory_is_bounded_whoever_comes(journal: Journal) -> None:
    for k in range(3 * MAX_REMEMBERED):
        journal.after(*joined(f"viewer@rti_mpc/{k}", f"10.0.0.1:{k}", f"{k:06d}00"), DROPPED.format(short=f"{k:06d}00"))
        journal.after(JOINED.format(address=f"10.0.0.2:{k}", name="viewer"), DROPPED.format(short=f"f{k:05d}00"))  # and never opens a session
    digest = journal.digest
    assert max(len(memory) for memory in (digest._names, digest._sessions, digest._said, digest._early)) == MAX_REMEMBERED


def test_file_of_zenohs_lines_is_cut_off_and_read_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(router_log, "PAUSE_S", 0.0)
    monkeypatch.setattr(router_log, "MAX_FILE_BYTES", 1000)
    file = os.open(tmp_path / "log", os.O_RDWR | os.O_CREAT | os.O_APPEND)
    try:
        read = lines(file)
        for k in range(100):
            os.write(file, f"line {k} of".encode())
            os.write(file, f" {100 * 'x'}\nbegun".encode())
            assert next(read).startswith("line 0 of " if k == 0 else f"begunline {k} of ")
            assert os.fstat(file).st_size <= 1000 + 300
        os.write(file, b"\n" + 2000 * b"flood\n")
        assert [next(read) for _ in range(2000)] == ["begun", *["flood"] * 1999]
    finally:
        os.close(file)
