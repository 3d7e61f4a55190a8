# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import re
import socket
from pathlib import Path
from typing import Any

import pytest

from rti_mpc.contract.message import Reference
from rti_mpc.errors import ConfigError
from rti_mpc.wire.bus import Bus
from rti_mpc.wire.keys import Keys
from rti_mpc.wire.layout import MAX_PAYLOAD_BYTES
from rti_mpc.wire.session import RENDEZVOUS_ENDPOINT, BusSettings, zenoh_config

SHIPPED = Path(__file__).parents[2] / "deploy" / "zenoh"
ROBOT = "tcp/127.0.0.1:17447"


def value(settings: BusSettings, name: str) -> Any:
    return json.loads(zenoh_config(settings).get_json(name))


@pytest.mark.parametrize("settings", [BusSettings(), *(BusSettings(config=SHIPPED / f"{mode}.json5") for mode in ("peer", "client", "router"))])
def test_multicast_is_off_hangs_are_noticed_soon_and_no_message_is_larger_than_a_reference(settings: BusSettings) -> None:
    assert value(settings, "scouting/multicast/enabled") is False
    assert value(settings, "transport/link/tx/lease") == 2000
    assert value(settings, "transport/link/rx/max_message_size") == MAX_PAYLOAD_BYTES[Reference] + 4096


@pytest.mark.parametrize("mode", ["peer", "client", "router"])
def test_shipped_configurations_say_what_the_settings_would(mode: str) -> None:
    for name in ("mode", "listen/endpoints", "connect/endpoints", "connect/timeout_ms"):
        if (mode, name) != ("router", "connect/timeout_ms"):
            assert value(BusSettings(config=SHIPPED / f"{mode}.json5"), name) == value(BusSettings(mode=mode), name)


def test_a_peer_listens_on_loopback_and_connects_to_the_rendezvous() -> None:
    assert value(BusSettings(), "listen/endpoints") == ["tcp/127.0.0.1:0"]
    assert value(BusSettings(), "connect/endpoints") == [RENDEZVOUS_ENDPOINT]


def test_nobody_connects_to_himself() -> None:
    assert value(BusSettings(listen=(RENDEZVOUS_ENDPOINT,)), "connect/endpoints") == []
    assert value(BusSettings(listen=(RENDEZVOUS_ENDPOINT.replace("127.0.0.1", "0.0.0.0"),)), "connect/endpoints") == [], "not from any address"
    assert value(BusSettings(mode="router"), "connect/endpoints") == []
    assert value(BusSettings(mode="router", listen=("tcp/0.0.0.0:7447",)), "connect/endpoints") == []


def test_given_settings_win_over_the_file_and_the_file_over_defaults(tmp_path: Path) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text('{mode: "client", connect: {endpoints: ["tcp/10.0.0.1:7447"]}, transport: {link: {tx: {lease: 700}}}}')
    assert value(BusSettings(config=path), "mode") == "client"
    assert value(BusSettings(config=path), "connect/endpoints") == ["tcp/10.0.0.1:7447"]
    assert value(BusSettings(config=path), "transport/link/tx/lease") == 700
    assert value(BusSettings(config=path, connect=(ROBOT,)), "connect/endpoints") == [ROBOT]
    assert value(BusSettings(config=path, mode="router"), "mode") == "router"
    assert value(BusSettings(config=path, cfg=("transport/link/tx/lease:900",)), "transport/link/tx/lease") == 900


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        (BusSettings(mode="peeer"), "mode"),
        (BusSettings(cfg=("no/such/key:1",)), "no/such/key"),
        (BusSettings(cfg=("transport/link/tx/lease:soon",)), "transport/link/tx/lease"),
        (BusSettings(cfg=("transport/link/tx/lease",)), "must be KEY:VALUE, such as transport/link/tx/lease:1000, got 'transport/link/tx/lease'"),
        (BusSettings(config=Path("missing.json5")), "missing.json5"),
    ],
)
def test_what_zenoh_refuses_is_named(settings: BusSettings, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        zenoh_config(settings)


@pytest.mark.parametrize("listen", ["carrier/pigeon", "tcp/192.0.2.1:7447"])
def test_endpoint_that_cannot_be_listened_on_is_refused_by_its_name(listen: str) -> None:
    """Zenoh says what is wrong, and not where."""
    with pytest.raises(ConfigError, match=rf"bus: endpoints must be valid, and no other process listen there, got {listen} \("):
        Bus.join(BusSettings(listen=(listen,), connect=()), Keys())


def test_an_endpoint_already_taken_is_refused() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(ConfigError, match=re.escape(f"got tcp/{address} ({address}: Address already in use (os error 98))")):
            Bus.join(BusSettings(listen=(f"tcp/{address}",), connect=()), Keys())


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1", "127.0.0.1:7447", "tcp/", "tls/robot.local", "tcp/127.0.0.1:65536", "tls/robot.local:74470", ""]
)
def test_endpoint_that_is_none_is_refused_with_one_that_would_be(endpoint: str) -> None:
    """Zenoh would try to reach it for ever."""
    for settings in (BusSettings(connect=(endpoint,)), BusSettings(listen=(endpoint,))):
        with pytest.raises(ConfigError, match=re.escape(f"such as {RENDEZVOUS_ENDPOINT}, got {endpoint!r}")):
            zenoh_config(settings)


@pytest.mark.parametrize(
    "endpoint",
    [
        RENDEZVOUS_ENDPOINT,
        "tcp/[::1]:7447",
        "tls/robot.local:7447#iface=eth0",
        "unixsock-stream//run/zenoh.sock",
        "serial//dev/tty0",
        "tcp/127.0.0.1:65535",
    ],
)
def test_endpoints_of_every_kind_are_taken(endpoint: str) -> None:
    assert value(BusSettings(connect=(endpoint,)), "connect/endpoints") == [endpoint]


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("foo:1", "foo must be what Zenoh takes, got: unknown key"),
        ("connect/endpoints:tcp/127.0.0.1:1", "got: expected array, boolean, null, number, object, or string, at line 1, column 1"),
        ("mode:5", "got: invalid type: integer `5`, expected either 'router', 'peer' or 'client'"),
    ],
)
def test_setting_that_zenoh_refuses_is_told_in_its_words_without_its_own_values(setting: str, told: str) -> None:
    with pytest.raises(ConfigError) as refused:
        zenoh_config(BusSettings(cfg=(setting,)))
    assert str(refused.value).endswith(told)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{connect: {endpoint: ["tcp/127.0.0.1:1"]}}', "got: unknown field `endpoint`, expected one of `timeout_ms`, `endpoints`, "),
        ('{mode: "client", ', "got: expected identifier or string, at line 1, column "),
    ],
)
def test_file_that_zenoh_refuses_is_told_with_the_place(text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "zenoh.json5").write_text(text)
    with pytest.raises(ConfigError) as refused:
        zenoh_config(BusSettings(config=tmp_path / "zenoh.json5"))
    assert told in str(refused.value)
    assert "Message" not in str(refused.value)
