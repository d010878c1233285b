"""The simulated device's end of a line of bytes: a pseudo-terminal of its own, a TCP port, or UDP datagrams."""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from typing import Protocol


class DeviceEnd(Protocol):
    """Bytes in and out; whoever is at the other end may come and go."""

    port: str  # what the host opens

    def descriptors(self) -> list[int]:
        """To wait for."""

    def read(self) -> bytes:
        """What has arrived."""

    def write(self, data: bytes) -> None:
        """Out, or lost when nobody takes it."""

    def unplug(self) -> None:
        """The cable is pulled, for good."""


class SendingEnd:
    """Base of an end that only sends."""

    def descriptors(self) -> list[int]:
        """Nothing is listened to."""
        return []

    def read(self) -> bytes:
        """Nothing."""
        return b""


class PtyEnd:
    """A pseudo-terminal; the host opens its other end like a serial port."""

    def __init__(self) -> None:
        # the other end stays open here as well, so that a host that leaves is not the end of the line
        self._own, self._other = os.openpty()
        tty.setraw(self._other)
        os.set_blocking(self._own, False)
        self.port = os.ttyname(self._other)
        self._plugged = True
        self._clogged = False

    def descriptors(self) -> list[int]:
        """Our end, while there is a cable and it is read."""
        return [self._own] if self._plugged and not self._clogged else []

    def read(self) -> bytes:
        """At most 4096 bytes."""
        with contextlib.suppress(OSError):
            if self._plugged:
                return os.read(self._own, 4096)
        return b""

    def write(self, data: bytes) -> None:
        """A host that does not read loses the bytes."""
        with contextlib.suppress(OSError):
            if self._plugged and data:
                os.write(self._own, data)

    def clog(self, clogged: bool) -> None:
        """Take nothing more, with the host's buffer full at once; or throw away what is in it, and go on."""
        if not self._plugged or clogged == self._clogged:
            return
        self._clogged = clogged
        with contextlib.suppress(OSError):  # the end of each loop
            if clogged:
                os.set_blocking(self._other, False)
                while os.write(self._other, bytes(1024)):
                    pass
            while not clogged and os.read(self._own, 4096):
                pass

    def unplug(self) -> None:
        """The host's end reads as gone from now on."""
        if self._plugged:
            self._plugged = False
            os.close(self._other)
            os.close(self._own)


class TcpEnd:
    """A TCP port on this machine, for one host at a time; ``socket://127.0.0.1:PORT`` opens it."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self._host: socket.socket | None = None
        self._plugged = True
        self.port = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def descriptors(self) -> list[int]:
        """Listener and host."""
        if not self._plugged:
            return []
        return [self._listener.fileno()] + ([] if self._host is None else [self._host.fileno()])

    def read(self) -> bytes:
        """Lets a newcomer in; at most 4096 bytes."""
        if not self._plugged:
            return b""
        with contextlib.suppress(OSError):
            newcomer, _ = self._listener.accept()
            newcomer.setblocking(False)
            newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._leave()
            self._host = newcomer
        if self._host is None:
            return b""
        try:
            data = self._host.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._leave()
        return data

    def write(self, data: bytes) -> None:
        """A host that does not read loses the bytes."""
        with contextlib.suppress(OSError):
            if self._host is not None and data:
                self._host.send(data)

    def unplug(self) -> None:
        """Nobody can connect any more."""
        self._leave()
        self._listener.close()
        self._plugged = False

    def _leave(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


class UdpEnd(SendingEnd):
    """Datagrams to a port on this machine, which the host opens as ``udp://127.0.0.1:PORT``; it says nothing back.

    As on a real network nobody notices that the other end is gone: unplugged, there is silence.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))  # first, so that the host's port below is another one
        self._socket.setblocking(False)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._host: tuple[str, int] = probe.getsockname()
        self.port = f"udp://127.0.0.1:{self._host[1]}"

    def write(self, data: bytes) -> None:
        """One datagram, lost when nobody listens."""
        with contextlib.suppress(OSError):
            if data:
                self._socket.sendto(data, self._host)

    def unplug(self) -> None:
        """Nothing is sent any more."""
        self._socket.close()
