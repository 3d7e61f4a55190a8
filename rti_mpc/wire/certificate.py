# SPDX-License-Identifier: Apache-2.0
"""
End of a certificate's life, read without a package for cryptography, and the warning before it.

Making certificates takes one (the extra ``certs``), but a robot only has to know when
its own ends. The date is at a fixed place of the certificate (RFC 5280, 4.1).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event, Thread

from rti_mpc.contract.message import Notice, Severity
from rti_mpc.errors import ConfigError
from rti_mpc.text_file import read_text_file

WARN_DAYS = 30.0  # before its end, from which on a certificate is to be renewed
CHECK_INTERVAL_S = 86_400.0  # between two looks at the calendar, and two warnings
EXPLICIT_VERSION = 0xA0  # tag that precedes the serial number in every certificate but those of version 1
UTC_TIME = 0x17  # tag of a time with two digits for the year, which RFC 5280 takes to be 1950 to 2049


def warn_of_end(path: Path, tell: Callable[[Notice], object], over: Event) -> None:
    """
    Warn at once and then every day, in a thread of its own, while a certificate that is in use has less than `WARN_DAYS` left.

    The file is read once: a process uses the certificate with which it has joined, whatever is written there later.

    Args:
        path: The certificate, PEM.
        tell: Receiver of the warning.
        over: Ends the watch when set.
    """

    def watch() -> None:
        with suppress(ConfigError):  # one that cannot be read joins no bus
            end = ends(path)
            while True:
                if (notice := warning(path, end, now())) is not None:
                    tell(notice)
                if over.wait(CHECK_INTERVAL_S):
                    return

    Thread(target=watch, name="certificate", daemon=True).start()


def warning(path: Path, end: datetime, at: datetime) -> Notice | None:
    """Return the warning about a certificate that ends at a time, as it is due at another time; None before `WARN_DAYS`."""
    left = end - at
    if left >= timedelta(days=WARN_DAYS):
        return None
    when = f"ends in {left / timedelta(days=1):.1f} days" if left > timedelta() else "has ended"
    text = f"{path} {when}, on {end:%Y-%m-%d} at {end:%H:%M} UTC, and links close then: `rti-mpc certs renew`, and restart this process"
    return Notice(Severity.WARNING, "certificate_ends", text)


def now() -> datetime:
    """Return the present time, by the wall clock, as certificates are checked."""
    return datetime.now(UTC)


def ends(path: Path) -> datetime:
    """
    Return when the first certificate of a PEM file ends.

    Raises:
        ConfigError: The file cannot be read, or is no certificate.
    """
    import ssl  # which few processes need, after all have started

    text = read_text_file(path, "a certificate, PEM")
    try:
        fields = _content(_content(ssl.PEM_cert_to_DER_cert(_first(text)), 0), 0)  # of the signed part
        place = _after(fields, 0) if fields[0] == EXPLICIT_VERSION else 0
        for _ in ("serial number", "algorithm", "issuer"):
            place = _after(fields, place)
        validity = _content(fields, place)
        place = _after(validity, 0)  # of the end, after the begin
        written = _content(validity, place).decode("ascii")
        if validity[place] == UTC_TIME:
            written = ("20" if int(written[:2]) < 50 else "19") + written
        return datetime.strptime(written, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
    except (ValueError, IndexError) as error:
        raise ConfigError(f"{path}: must be a certificate, PEM, got: {error}") from error


def _first(text: str) -> str:
    """Return the first certificate of a PEM file, which may hold a chain and remarks."""
    begin, end = "-----BEGIN CERTIFICATE-----", "-----END CERTIFICATE-----"
    if not 0 <= text.find(begin) < text.rfind(end):
        raise ValueError(f"no lines {begin} and {end}")
    return text[text.index(begin) : text.index(end) + len(end)]


def _span(der: bytes, place: int) -> tuple[int, int]:
    """Return where the content of the DER element at a place begins and ends."""
    length, begin = der[place + 1], place + 2
    if length & 0x80:
        begin += length & 0x7F
        length = int.from_bytes(der[place + 2 : begin], "big")
    return begin, begin + length


def _content(der: bytes, place: int) -> bytes:
    begin, end = _span(der, place)
    return der[begin:end]


def _after(der: bytes, place: int) -> int:
    return _span(der, place)[1]
