# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from queue import Queue
from threading import Event

import pytest

from rti_mpc.contract.message import Notice
from rti_mpc.errors import ConfigError
from rti_mpc.wire import certificate
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.certificate import ends, warn_of_end
from rti_mpc.wire.keys import Keys
from tests.wire.fake_session import FakeSession

pytest.importorskip("cryptography", reason="the extra certs is not installed: certificates were NOT tried")

from rti_mpc_service.certs.authority import Authority, new_key, pem


@pytest.mark.parametrize("days", [-0.01, 90.0, 3650.0, 36_500.0])  # the last one ends after 2049, which is written in another way
def test_end_of_a_certificate_is_that_which_the_package_for_cryptography_reads(days: float, tmp_path: Path) -> None:
    authority = Authority.make("rti-mpc authority", 40_000.0)
    made = authority.certify("guard@rti_mpc/pioneer", new_key().public_key(), days, ["robot.local"])
    path = tmp_path / "guard.pem"
    path.write_bytes(b"what it is for\n" + pem(made) + pem(authority.certificate))
    assert ends(path) == made.not_valid_after_utc
    assert abs(ends(path) - datetime.now(UTC) - timedelta(days=days)) < timedelta(minutes=10)


@pytest.mark.parametrize("text", ["", "no certificate", "-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n"])
def test_file_that_is_no_certificate_is_refused_by_name(text: str, tmp_path: Path) -> None:
    (tmp_path / "guard.pem").write_text(text)
    with pytest.raises(ConfigError, match=r"guard\.pem: must be a certificate, PEM"):
        ends(tmp_path / "guard.pem")


def test_process_warns_once_a_day_from_thirty_days_before_the_end_on_and_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Authority.make("rti-mpc authority", 100.0).certificate
    path, end, told, over = tmp_path / "guard.pem", made.not_valid_after_utc, Queue[Notice](), Event()
    path.write_bytes(pem(made))
    days = iter([31.0, 30.0, 29.0, 0.5, -1.0])
    asked: list[float] = []

    def now() -> datetime:
        asked.append(next(days, -2.0))
        if asked[-1] == -2.0:
            over.set()
        return end - timedelta(days=asked[-1])

    monkeypatch.setattr(certificate, "now", now)
    monkeypatch.setattr(certificate, "CHECK_INTERVAL_S", 0.001)
    warn_of_end(path, told.put, over)
    texts = [(notice.code, notice.text) for notice in (told.get(timeout=30.0) for _ in range(4))]
    assert {code for code, _ in texts} == {"certificate_ends"}
    on = f"on {end:%Y-%m-%d} at {end:%H:%M} UTC, and links close then: `rti-mpc certs renew`, and restart this process"
    assert [text for _, text in texts] == [f"{path} {when}, {on}" for when in ("ends in 29.0 days", "ends in 0.5 days", "has ended", "has ended")]
    assert asked == [31.0, 30.0, 29.0, 0.5, -1.0, -2.0], "thirty days are enough"


def test_process_warns_of_the_certificate_with_which_it_has_joined_and_of_none_without_tls(tmp_path: Path) -> None:
    told = Queue[str]()
    session = FakeSession()
    Bus(session, Keys()).watch_connection(lambda notice: told.put(notice.text))
    session.certificate = tmp_path / "guard.pem"
    session.certificate.write_bytes(pem(Authority.make("rti-mpc authority", 5.0).certificate))
    Bus(session, Keys()).watch_connection(lambda notice: told.put(notice.text))
    assert told.get(timeout=30.0).startswith(f"{session.certificate} ends in 5.0 days")
    assert told.empty()
