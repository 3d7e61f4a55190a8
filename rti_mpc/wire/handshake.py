# SPDX-License-Identifier: Apache-2.0
"""
Reason for which an endpoint does not answer, from a connection of our own to it, as far as the handshake of TLS.

Zenoh tells a client only that no router was reached in time. The system and TLS say why.
Nothing is sent beyond the handshake.
"""

from __future__ import annotations

import re
import socket
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import ssl

TIMEOUT_S = 1.0  # for a connection, for its handshake, and for what the other side then objects
DEADLINE_S = 3.0  # for all endpoints together
ADDRESS = re.compile(r"(?P<protocol>[a-z]+)/(?:\[(?P<v6>[^]]+)\]|(?P<host>[^:]+)):(?P<port>\d+)")

# What OpenSSL calls it, as a pattern: what it means here. Errors about the router's certificate are those of our verification.
ROUTERS = {
    "expired": "the router's certificate has ended: see `rti-mpc certs renew`",
    "not yet valid": "the router's certificate is not valid yet: a clock is wrong, here or where it was issued",
    "issuer|self.signed|signature": "the router's certificate is of another authority than {authority}",
    "mismatch": "the router's certificate is not for this address: issue it with this one as --router",
    "purpose": "what listens there has no certificate of a router",
}
# Alerts are the router's verdict on our certificate.
OURS = {
    "CERTIFICATE_EXPIRED": "the router refuses {certificate}, which has ended: see `rti-mpc certs renew`",
    "UNKNOWN_CA|DECRYPT_ERROR|BAD_CERTIFICATE": "the router refuses {certificate}, which is of another authority than its own",
    "CERTIFICATE_REQUIRED|HANDSHAKE_FAILURE": "the router wants a certificate, and got none: see --tls",
    "ALERT": "the router refuses {certificate}, with the alert {reason}",
}
NO_TLS = "what listens there does not speak TLS"
MUTE = "what listens there does not answer"


def obstacles(endpoints: Iterable[str], *files: Path | None) -> dict[str, str]:
    """Return why no router answers, by endpoint, see `obstacle`; nothing of endpoints that take longer than `DEADLINE_S`, such as a name server."""
    found: dict[str, str] = {}

    def look(endpoint: str) -> None:
        found[endpoint] = obstacle(endpoint, *files)

    threads = [Thread(target=look, args=(endpoint,), daemon=True) for endpoint in dict.fromkeys(endpoints)]
    deadline_s = time.monotonic() + DEADLINE_S
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, deadline_s - time.monotonic()))
    return dict(found)


def obstacle(endpoint: str, authority: Path | None = None, certificate: Path | None = None, key: Path | None = None) -> str:
    """
    Return why a router at an endpoint does not answer; empty for protocols that are not tried.

    Args:
        endpoint: Endpoint of Zenoh, over TCP or TLS.
        authority: Certificate of the authority by which a router is known, PEM; None: any router will do.
        certificate: Certificate of this process, PEM, if it has one.
        key: Its private key.
    """
    match = ADDRESS.match(endpoint)
    if match is None or match["protocol"] not in ("tcp", "tls"):
        return ""
    host, tls = match["v6"] or match["host"], match["protocol"] == "tls"
    try:
        context = client(authority, certificate, key) if tls and authority is not None else stranger()
    except OSError as error:
        files = ", ".join(str(path) for path in (authority, certificate, key) if path is not None)  # the error does not say which
        return f"the certificates of this process cannot be used, {files}: {error}"
    try:
        link = socket.create_connection((host, int(match["port"])), TIMEOUT_S)
    except (socket.gaierror, UnicodeError):  # the latter of one that no name can be, such as with a part of more than 63 characters
        return "this host does not know that name"
    except ConnectionRefusedError:
        return "no process listens there, or the address is wrong"
    except TimeoutError:
        return "nothing answers there: the address is wrong, or a firewall is closed"
    except OSError as error:
        return str(error.strerror).lower()
    verdict = shake(link, host, context)
    if tls:
        return _refusal(verdict, {"authority": authority, "certificate": certificate})
    return MUTE if _plain(verdict) else "what listens there speaks TLS: see --tls"


def openness(host: str, port: int) -> str:
    """Return how a listener is open to everybody, in words; empty if it wants a certificate, or does not listen."""
    try:
        error = shake(socket.create_connection((host, port), TIMEOUT_S), host, stranger())
    except OSError:
        return ""
    return "without TLS" if _plain(error) else "with TLS, but for processes without a certificate, too" if error is None else ""


def client(authority: Path, certificate: Path | None, key: Path | None) -> ssl.SSLContext:
    """
    Context of TLS of a process that knows routers by their authority.

    Raises:
        OSError: A file cannot be read, or is none of TLS.
    """
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(authority)
    if certificate is not None:
        context.load_cert_chain(certificate, key, password="")  # an empty one: otherwise OpenSSL asks for it at the terminal
    return context


def stranger() -> ssl.SSLContext:
    """Context of TLS of a process that has no certificate and takes any."""
    import ssl

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def shake(link: socket.socket, host: str, context: ssl.SSLContext) -> OSError | None:
    """Shake hands over a connection, and close it; return the error with which one side refuses, None if both are content."""
    try:
        with link, context.wrap_socket(link, server_hostname=host) as secured:
            with suppress(TimeoutError):  # it is content: it waits for more of us
                secured.recv(1)  # a router that refuses our certificate says so after the handshake
        return None
    except OSError as error:
        return error


def _plain(error: OSError | None) -> bool:
    """Whether what answered does not speak TLS."""
    return error is not None and "ALERT" not in (getattr(error, "reason", None) or "")


def _refusal(error: OSError | None, words: dict[str, object]) -> str:
    """Return what the error of a handshake means."""
    import ssl

    if error is None:
        return MUTE
    if isinstance(error, ssl.SSLCertVerificationError):
        return _first(ROUTERS, error.verify_message, words) or f"the router's certificate is not taken: {error.verify_message}"
    return NO_TLS if _plain(error) else _first(OURS, str(getattr(error, "reason", "")), words)


def _first(meanings: dict[str, str], what: str, words: dict[str, object]) -> str:
    """Return the meaning of the first pattern that is found; empty if none is."""
    return next((meaning.format(reason=what, **words) for pattern, meaning in meanings.items() if re.search(pattern, what)), "")
