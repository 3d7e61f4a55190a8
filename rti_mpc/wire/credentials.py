# SPDX-License-Identifier: Apache-2.0
"""
Files of TLS of this process, checked before it joins the bus.

Zenoh tells a client only that no router was reached, and so a process with a wrong file
would wait for ever. What this host can know is whether the files are what they should be,
and belong together. Whether the other side takes them, `rti_mpc.wire.handshake` says. A
certificate that is not valid yet is no error here: a robot may get its clock later.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from rti_mpc.errors import ConfigError
from rti_mpc.wire.certificate import ends, now

if TYPE_CHECKING:
    import ssl

OF_ANOTHER = frozenset(("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH", "NO_CERTIFICATE_ASSIGNED"))  # OpenSSL's reasons to refuse a key
NO_KEY = frozenset(("NO_START_LINE", "PEM_LIB", "BAD_DECRYPT", "UNSUPPORTED", "BAD_END_LINE", "BAD_BASE64_DECODE", None))
HANDSHAKE_TURNS = 4  # of each side, more than any handshake of TLS has
FOREIGN = frozenset((2, 7, 18, 19, 20, 21))  # verdicts of OpenSSL, X509_V_ERR_...: no issuer that is known, or a signature of somebody else


def check(authority: Path | None, certificate: Path | None, key: Path | None, *, bundled: bool = True) -> None:
    """
    Check the files of TLS of a process, each None if it has none.

    Args:
        authority: Certificate of the authority, PEM.
        certificate: Certificate of this process, PEM, and those between it and the authority.
        key: Its private key, PEM.
        bundled: Whether they are of a folder of `rti-mpc certs`, in which one authority issues all; elsewhere, routers may have one of their own.

    Raises:
        ConfigError: A file is not what it should be, the certificate has ended or is of another authority, or the key of another certificate.
    """
    for path in (authority, certificate):
        if path is not None:
            _check_certificate(path)
    if certificate is None or key is None:
        return
    if (end := ends(certificate)) <= now():
        until = f"{end:%Y-%m-%d} at {end:%H:%M} UTC"
        raise ConfigError(f"tls: {certificate} must be a certificate that is valid, it has ended on {until}: `rti-mpc certs renew`")
    _check_key(certificate, key)
    if bundled and authority is not None and any(_foreign(authority, certificate, key, listens=listens) for listens in (False, True)):
        raise ConfigError(f"tls: {certificate} must be issued by the authority of {authority}, got one of another authority")


def _check_certificate(path: Path) -> None:
    import ssl  # which few processes need

    ends(path)  # names a file that cannot be read, or is no certificate
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(path)
    except ssl.SSLError as error:
        raise ConfigError(f"{path}: must be a certificate, PEM, got one that is damaged") from error


def _check_key(certificate: Path, key: Path) -> None:
    import ssl

    try:
        key.read_bytes()
    except OSError as error:
        raise ConfigError(f"tls: {key} must be a private key, PEM, that can be read: {error.strerror}") from None
    try:
        _context(ssl.PROTOCOL_TLS_CLIENT, certificate, key)
    except ssl.SSLError as error:
        if error.reason in OF_ANOTHER:
            raise ConfigError(f"tls: {key} must be the private key of {certificate}, got that of another certificate") from None
        if error.reason in NO_KEY:
            raise ConfigError(f"tls: {key} must be a private key, PEM, without a password, got a file of something else") from None
        raise ConfigError(f"tls: {certificate} with {key} must be what OpenSSL takes, it says {error.reason}") from None


def _foreign(authority: Path, certificate: Path, key: Path, *, listens: bool) -> bool:
    """Whether a process that knows the authority alone would take the certificate for one of another: by a handshake with itself, in memory."""
    import ssl

    client, server = (_context(protocol, certificate, key) for protocol in (ssl.PROTOCOL_TLS_CLIENT, ssl.PROTOCOL_TLS_SERVER))
    asks = client if listens else server
    asks.verify_mode = ssl.CERT_REQUIRED
    asks.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN  # Zenoh trusts whatever is named as the authority
    asks.load_verify_locations(authority)
    towards_client, towards_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    sides = client.wrap_bio(towards_client, towards_server), server.wrap_bio(towards_server, towards_client, server_side=True)
    try:
        for side in HANDSHAKE_TURNS * sides:
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                continue
    except ssl.SSLCertVerificationError as error:
        return error.verify_code in FOREIGN
    except ssl.SSLError:  # nothing that says whose it is
        return False
    return False


def _context(protocol: int, certificate: Path, key: Path) -> ssl.SSLContext:
    """Context of TLS of a process that shows its certificate, and asks for none."""
    import ssl

    context = ssl.SSLContext(protocol)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.load_cert_chain(certificate, key, password="")  # an empty one: otherwise OpenSSL asks for it at the terminal
    return context
