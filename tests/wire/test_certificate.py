# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rti_mpc.errors import ConfigError
from rti_mpc.wire.certificate import ends

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
