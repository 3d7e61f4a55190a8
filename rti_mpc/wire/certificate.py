# SPDX-License-Identifier: Apache-2.0
"""
End of a certificate's life, read without a package for cryptography.

Making certificates takes one (the extra ``certs``), but a robot only has to know when
its own ends. The date is at a fixed place of the certificate (RFC 5280, 4.1).
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from rti_mpc.errors import ConfigError
from rti_mpc.text_file import read_text_file

WARN_DAYS = 30.0  # before its end, from which on a certificate is to be renewed
EXPLICIT_VERSION = 0xA0  # tag that precedes the serial number in every certificate but those of version 1
UTC_TIME = 0x17  # tag of a time with two digits for the year, which RFC 5280 takes to be 1950 to 2049


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
