# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import socket
import sys

import pytest

from rti_mpc_service.doctor.security import listening


@pytest.mark.skipif(sys.platform != "linux", reason="the table of sockets is Linux's")
@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_every_socket_that_listens_on_this_host_is_found_with_its_address(address: str) -> None:
    if address == "::1" and not socket.has_ipv6:
        pytest.skip("this host has no IPv6")
    with socket.create_server((address, 0), family=socket.AF_INET6 if ":" in address else socket.AF_INET) as server:
        port = server.getsockname()[1]
        assert [str(found) for found, at, _ in listening() if at == port] == [address]
