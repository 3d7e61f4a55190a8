# SPDX-License-Identifier: Apache-2.0
"""
Certificate authority of a robot, or of a fleet: a key and a certificate that signs the certificates of all roles.

A certificate of a process names its role and robot (`rti_mpc_service.certs.roles`). Only that
of a router may listen: the others cannot pass for one. There is no list of revoked
certificates: lives are short, and a renewal keeps the key.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rti_mpc.errors import ConfigError, reason

SKEW = timedelta(hours=1)  # by which clocks of two hosts may differ when a certificate is new


@dataclass(frozen=True)
class Authority:
    """
    Certificate and private key of an authority.

    Attributes:
        certificate: An `x509.Certificate`.
        key: Its private key.
    """

    certificate: Any
    key: Any

    @classmethod
    def make(cls, name: str, days: float, now: datetime | None = None) -> Authority:
        """Make a new authority that signs itself."""
        key = new_key()
        usage = dict.fromkeys(
            "digital_signature content_commitment key_encipherment data_encipherment key_agreement encipher_only decipher_only".split(), False
        )
        builder = (
            _begun(_subject(name), _subject(name), key.public_key(), days, now)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.KeyUsage(**usage, key_cert_sign=True, crl_sign=True), critical=True)
        )
        return cls(builder.sign(key, hashes.SHA256()), key)

    @classmethod
    def read(cls, folder: Path) -> Authority:
        """
        Read the authority that `rti-mpc certs authority` has written into a folder.

        Raises:
            ConfigError: A file is missing, or none of an authority.
        """
        try:
            certificate = x509.load_pem_x509_certificate((folder / "authority.pem").read_bytes())
            return cls(certificate, serialization.load_pem_private_key((folder / "authority.key").read_bytes(), None))
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(f"certs: --authority must be a folder with authority.pem and authority.key, got {folder}: {reason(error)}") from error

    def certify(self, name: str, public_key: Any, days: float, addresses: Iterable[str] = (), now: datetime | None = None) -> Any:
        """
        Return a certificate, never valid for longer than the authority's own.

        Args:
            name: Common name, see `rti_mpc_service.certs.roles.common_name`.
            public_key: Key of the process.
            days: Time for which it is valid.
            addresses: Names and IP addresses at which a router listens; empty: the process connects only.
            now: Begin of that time; the present if left out.
        """
        addresses = tuple(addresses)
        usage = ExtendedKeyUsageOID.SERVER_AUTH if addresses else ExtendedKeyUsageOID.CLIENT_AUTH
        builder = (
            _begun(_subject(name), self.certificate.subject, public_key, days, now, self.certificate.not_valid_after_utc)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), critical=False)
        )
        if addresses:
            builder = builder.add_extension(x509.SubjectAlternativeName([_address(text) for text in addresses]), critical=False)
        return builder.sign(self.key, hashes.SHA256())

    def renewed(self, certificate: Any, days: float) -> Any:
        """
        Return a certificate of the same name, key and addresses that is valid from now on.

        Raises:
            ConfigError: The certificate is not of this authority.
        """
        try:
            certificate.verify_directly_issued_by(self.certificate)
        except Exception as error:
            raise ConfigError("certs: a certificate is renewed by the authority that has issued it, got another one") from error
        return self.certify(name_of(certificate), certificate.public_key(), days, addresses_of(certificate))


def new_key() -> Any:
    """Return a new private key."""
    return ec.generate_private_key(ec.SECP256R1())


def pem(item: Any) -> bytes:
    """Return a certificate or a private key as PEM."""
    if isinstance(item, x509.Certificate):
        text: bytes = item.public_bytes(serialization.Encoding.PEM)
    else:
        text = item.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return text


def read_certificate(path: Path) -> Any:
    """
    Read a certificate.

    Raises:
        ConfigError: The file is none.
    """
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"certs: {path} must be a certificate, PEM: {reason(error)}") from error
    except ValueError as error:
        raise ConfigError(f"certs: {path} must be a certificate, PEM, got a file of something else") from error


def name_of(certificate: Any) -> str:
    """Return the common name."""
    return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def addresses_of(certificate: Any) -> list[str]:
    """Return names and IP addresses at which it may listen."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in names]


def days_left(certificate: Any) -> float:
    """Return the days until a certificate expires; negative once it has."""
    left: timedelta = certificate.not_valid_after_utc - datetime.now(UTC)
    return left / timedelta(days=1)


def _begun(subject: Any, issuer: Any, public_key: Any, days: float, now: datetime | None, latest: datetime | None = None) -> Any:
    now = now or datetime.now(UTC)
    end = now + timedelta(days=days)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(public_key)
    builder = builder.serial_number(x509.random_serial_number()).not_valid_before(now - SKEW).not_valid_after(min(end, latest or end))
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)


def _subject(name: str) -> Any:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _address(text: str) -> Any:
    try:
        return x509.IPAddress(ipaddress.ip_address(text))
    except ValueError:
        return x509.DNSName(text)
