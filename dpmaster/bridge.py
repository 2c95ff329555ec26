# SPDX-License-Identifier: MIT
"""A converter on the network as a port of this computer: ``socket://HOST:PORT`` and ``rfc2217://HOST:PORT`` joined to a pty.

pyserial speaks to the converter, a program opens the pty like any port. What a network adds to every answer the port has to be
told as its allowance: `calibration` measures it. Only for a master that is alone on its bus; no ring waits for a network.
"""

from __future__ import annotations

import os
import pty
import select
import socket
import threading
import tty
from types import TracebackType
from urllib.parse import urlsplit

import serial

from dpmaster._arguments import whole
from dpmaster.errors import ConfigurationError, PortError

__all__ = ["Bridge"]

SCHEMES = ("socket", "rfc2217")
SLICE = 0.1  # s between two looks whether the end is wanted
CHUNK = 512
GONE = 4  # s without a sign of the converter


def _is_url(url: object) -> bool:
    try:
        parts = urlsplit(url) if isinstance(url, str) else None
        return parts is not None and parts.scheme in SCHEMES and bool(parts.hostname and parts.port)
    except ValueError:  # no port has such a number
        return False


def _set_up(link: socket.socket) -> None:
    """No telegram waits until the converter has acknowledged the one before: 40 ms (RFC 896, RFC 1122). One without power
    closes no connection: it is given up when it acknowledges nothing, asked or not."""
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in ((socket.TCP_NODELAY, 1), (socket.TCP_USER_TIMEOUT, GONE * 1000),
                          (socket.TCP_KEEPIDLE, GONE), (socket.TCP_KEEPINTVL, 1), (socket.TCP_KEEPCNT, GONE)):
        link.setsockopt(socket.IPPROTO_TCP, option, value)


class Bridge:
    """A pty that is joined to `url` until close(). `baudrate` in bit/s, which an RFC 2217 server is told, together with even
    parity; behind ``socket://`` the converter is set up by its own means. Raises PortError when nobody answers there.
    """

    def __init__(self, url: str, baudrate: int = 500_000) -> None:
        if not _is_url(url):
            raise ConfigurationError(f"url {url!r}: socket://HOST:PORT, or rfc2217://HOST:PORT where the converter speaks that")
        whole("baudrate", baudrate, 1, 12_000_000)
        self.url = url
        try:
            bound = GONE if urlsplit(url).scheme == "socket" else None  # pyserial's RFC 2217 has one of its own, 5 s
            self._line = serial.serial_for_url(url, do_not_open=True, baudrate=baudrate, parity=serial.PARITY_EVEN,
                                               timeout=SLICE, write_timeout=bound)
            self._line.open()
            self._link: socket.socket = self._line._socket  # type: ignore[attr-defined]
            _set_up(self._link)
        except (serial.SerialException, OSError, ValueError) as error:
            raise PortError(f"{url}: {error}; is the converter on, and free?", path=url) from None
        self._pty, self._near = pty.openpty()  # its near end stays open here, so that a client's end is no hang-up
        tty.setraw(self._near)
        os.set_blocking(self._pty, False)
        self.path = os.ttyname(self._near)
        self._failure: Exception | None = None
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=self._run, args=(pump,), name="dpmaster-bridge", daemon=True)
                         for pump in (self._inward, self._outward)]
        for thread in self._threads:
            thread.start()

    def _run(self, pump: object) -> None:
        try:
            while not self._ended.is_set():
                pump()  # type: ignore[operator]
        except (serial.SerialException, OSError) as failure:
            if not self._ended.is_set():
                self._failure = failure
                self._ended.set()

    def _inward(self) -> None:
        octets = self._line.read(1)
        if octets:
            while len(octets) < CHUNK and self._line.in_waiting:  # a socket:// has 1 waiting when it has any
                octets += self._line.read(self._line.in_waiting)
            try:
                os.write(self._pty, octets)
            except BlockingIOError:  # nobody reads the pty: a wire waits for nobody
                pass

    def _outward(self) -> None:
        if select.select([self._pty], [], [], SLICE)[0]:
            self._line.write(os.read(self._pty, CHUNK))

    def check(self) -> None:
        """Raise PortError when the converter has gone."""
        if self._failure is not None:
            raise PortError(f"{self.url}: {self._failure}; is the converter still on?", path=self.url) from self._failure

    def close(self) -> None:
        """Idempotent; the pty hangs up. It takes some seconds where the converter has stopped to listen."""
        self._ended.set()
        for thread in self._threads:
            thread.join()
        self._threads = []
        if self._pty >= 0:
            self._line.close()
            self._link.close()  # pyserial leaves one open that the other end has closed
            os.close(self._pty)
            os.close(self._near)
            self._pty = -1

    def __enter__(self) -> Bridge:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
