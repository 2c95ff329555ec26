# SPDX-License-Identifier: MIT
"""Converters on the network: a pty joined to socket:// and rfc2217://, here both on the loopback."""

from __future__ import annotations

import os
import select
import socket
import threading
from collections.abc import Iterator

import pytest
import serial
from leftovers import nothing_left_behind
from serial import rfc2217

from dpmaster import ConfigurationError, Master, PortError
from dpmaster.bridge import Bridge
from dpmaster.drives import YaskawaV7
from dpmaster.emulator import Segment
from dpmaster.emulator.cards import SIP1

pytestmark = pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")  # pyserial's own


class WithoutModemLines(serial.Serial):
    """A pty has none, and an RFC 2217 server asks for them."""

    cts = dsr = ri = cd = False

    def _update_rts_state(self) -> None: ...
    def _update_dtr_state(self) -> None: ...

    def _reconfigure_port(self, force_update: bool = False) -> None:
        """Nor has it parity; its line is raw already."""


class Converter:
    """A box with a network socket and a serial line, as a program: one client, octets each way; with `telnet` RFC 2217."""

    def __init__(self, path: str, telnet: bool = False) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = self.server.getsockname()[1]
        self.line = WithoutModemLines(path, timeout=0)
        self.telnet = telnet
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        try:
            client, _ = self.server.accept()
        except OSError:
            return
        with client:
            self.relay(client)

    def relay(self, client: socket.socket) -> None:
        class Out:
            def write(self, octets: bytes) -> None:
                client.sendall(octets)

        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        manager = rfc2217.PortManager(self.line, Out()) if self.telnet else None
        while True:
            ready, _, _ = select.select([client, self.line.fileno()], [], [])
            if client in ready:
                octets = client.recv(512)
                if not octets:
                    return
                self.line.write(b"".join(manager.filter(octets)) if manager else octets)
            if self.line.fileno() in ready:
                octets = self.line.read(512)
                client.sendall(b"".join(manager.escape(octets)) if manager else octets)

    def close(self) -> None:
        self.server.shutdown(socket.SHUT_RDWR)
        self.server.close()
        self.thread.join(10)
        self.line.close()


@pytest.fixture(params=["socket", "rfc2217"])
def url(request: pytest.FixtureRequest) -> Iterator[str]:
    """A converter whose line is a wire with an SI-P1 on it."""
    with Segment(ports=1, cards=1) as wire:
        wire.attach(SIP1(address=5))
        converter = Converter(wire.port(), telnet=request.param == "rfc2217")
        yield f"{request.param}://127.0.0.1:{converter.port}"
        converter.close()


def test_a_master_drives_through_a_converter(url: str) -> None:
    with Bridge(url) as bridge:
        with Master(bridge.path, allowance=0.3) as master:
            drive = master.add(YaskawaV7(address=5, watchdog=5.0))
            master.operate(timeout=20)
            assert drive.read_parameter("n003") == 3  # devices page: commissioned, n003 = 3
        bridge.check()


def test_no_telegram_waits_for_the_acknowledgement_of_the_one_before(url: str) -> None:
    """RFC 896 (Nagle) against RFC 1122 (delayed acknowledgement): 40 ms for every answer behind a token."""
    with Bridge(url) as bridge:
        assert bridge._line._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_converter_without_power_is_noticed(url: str) -> None:
    """Tcp(7): unacknowledged data for TCP_USER_TIMEOUT, or TCP_KEEPCNT probes without an answer, end a connection."""
    with Bridge(url) as bridge:
        link = bridge._line._socket
        assert link.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert link.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 4000
        found = [link.getsockopt(socket.IPPROTO_TCP, name)
                 for name in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT)]
        assert found == [4, 1, 4]


def test_a_converter_that_takes_no_more_ends_the_bridge(monkeypatch: pytest.MonkeyPatch) -> None:
    """And does not keep it from being closed."""
    monkeypatch.setattr("dpmaster.bridge.GONE", 1)
    with socket.create_server(("127.0.0.1", 0)) as server, Bridge(f"socket://127.0.0.1:{server.getsockname()[1]}") as bridge:
        far, _ = server.accept()
        near = os.open(bridge.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        while bridge._failure is None:
            if select.select([], [near], [], 0.1)[1]:
                os.write(near, bytes(4096))
        with pytest.raises(PortError, match=r"is the converter still on\?"):
            bridge.check()
        os.close(near)
        far.close()


def test_a_bridge_leaves_nothing_behind(url: str) -> None:
    with nothing_left_behind():
        bridge = Bridge(url)
        bridge.close()
        bridge.close()


def test_nobody_there_is_one_clear_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(PortError, match=rf"socket://127.0.0.1:{port}: .*is the converter on, and free\?"):
        Bridge(f"socket://127.0.0.1:{port}")


@pytest.mark.parametrize("wrong", ["/dev/ttyS0", "tcp://x:1", "socket://x", "socket://x:99999", "socket://:5", 5])
def test_what_is_no_url_is_refused(wrong: object) -> None:
    with pytest.raises(ConfigurationError, match="socket://HOST:PORT"):
        Bridge(wrong)  # type: ignore[arg-type]
