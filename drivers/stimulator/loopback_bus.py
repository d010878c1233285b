"""CAN frames between processes of this machine when it has no network at all.

python-can's ``udp_multicast`` joins its group on whatever interface the default route names, so without a route it
cannot be opened. This bus joins on the loopback interface instead: nothing leaves the machine, nothing enters.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import sys
from typing import Any, Final

import can

GROUP: Final = "239.74.163.2"
DEFAULT_PORT: Final = 43113
_HOST: Final = "127.0.0.1"
_FRAME: Final = struct.Struct("!IB8s")  # identifier with SocketCAN's extended flag, length, data padded with zeros
_EXTENDED: Final = 0x8000_0000
_IP_MULTICAST_ALL: Final = 49  # linux/in.h: 0 = only groups that this very socket joined


class LoopbackBus(can.BusABC):
    """Classical data frames over multicast on 127.0.0.1; every bus on the same group and port hears every frame.

    As with python-can's multicast, a bus hears its own frames too.

    Raises:
        OSError: the group is no multicast address, or the port is out of range or not ours to use.
    """

    def __init__(self, channel: str = GROUP, port: int = DEFAULT_PORT, **kwargs: Any) -> None:
        self.channel_info = f"loopback {channel} port {port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if isinstance(port, bool) or not isinstance(port, int):
                raise ValueError("the port must be a whole number")
            self._address = (channel, port)
            membership = socket.inet_aton(channel) + socket.inet_aton(_HOST)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind(self._address)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(_HOST))
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            if sys.platform == "linux":
                self._socket.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            self._socket.setblocking(False)
            super().__init__(channel=channel, **kwargs)
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise OSError(errno.EINVAL, f"channel {channel!r}, port {port!r}: {error}") from error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put the frame out at once.

        Raises:
            can.CanOperationError: no classical data frame, or the system's buffer is full.
        """
        if msg.is_fd or msg.is_remote_frame or msg.is_error_frame or len(msg.data) > 8:
            raise can.CanOperationError("the loopback bus carries classical data frames only")
        identifier = msg.arbitration_id | (_EXTENDED if msg.is_extended_id else 0)
        try:
            self._socket.sendto(_FRAME.pack(identifier, len(msg.data), bytes(msg.data)), self._address)
        except OSError as error:
            raise can.CanOperationError(f"cannot send: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            ready, _, _ = select.select([self._socket], [], [], timeout)
            if not ready:
                return None, False
            datagram = self._socket.recv(64)
        except OSError as error:
            raise can.CanOperationError(f"cannot receive: {error.strerror}", error.errno) from error
        if len(datagram) != _FRAME.size or datagram[4] > 8:
            raise can.CanOperationError(f"a datagram of {len(datagram)} bytes is no CAN frame")
        identifier, length, data = _FRAME.unpack(datagram)
        return can.Message(
            arbitration_id=identifier & ~_EXTENDED,
            is_extended_id=bool(identifier & _EXTENDED),
            data=data[:length],
        ), False

    def fileno(self) -> int:
        """The socket, for ``select``."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Close the socket; may be called twice."""
        super().shutdown()
        self._socket.close()
