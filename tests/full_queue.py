"""A CAN interface whose transmit queue is full, for ever: the kernel refuses every frame with ENOBUFS. Needs root."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

ADD, REMOVE, ERROR = 36, 37, 2  # RTM_NEWQDISC, RTM_DELQDISC, NLMSG_ERROR
REQUEST, ACK, CREATE, REPLACE = 0x1, 0x4, 0x400, 0x100  # NLM_F_…
ROOT = 0xFFFFFFFF  # TC_H_ROOT
KIND, OPTIONS = 1, 2  # TCA_KIND, TCA_OPTIONS


def _attribute(kind: int, value: bytes) -> bytes:
    padding = bytes(-len(value) % 4)
    return struct.pack("=HH", 4 + len(value), kind) + value + padding


def _ask(message: int, flags: int, interface: str, attributes: bytes) -> None:
    body = struct.pack("=BxHiIII", socket.AF_UNSPEC, 0, socket.if_nametoindex(interface), 0x10000, ROOT, 0) + attributes
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as netlink:
        netlink.bind((0, 0))
        netlink.send(struct.pack("=IHHII", 16 + len(body), message, flags | REQUEST | ACK, 1, 0) + body)
        answer = netlink.recv(4096)
    kind, number = struct.unpack_from("=H", answer, 4)[0], struct.unpack_from("=i", answer, 16)[0]
    if kind == ERROR and number:
        raise OSError(-number, f"{interface}: {os.strerror(-number)}", errno.errorcode.get(-number, ""))


@contextmanager
def full_queue(interface: str) -> Iterator[None]:
    """As long as it lasts, a first-in-first-out queue with room for nothing stands before the interface.

    Raises:
        OSError: the kernel does not do it.
    """
    _ask(ADD, CREATE | REPLACE, interface, _attribute(KIND, b"pfifo\0") + _attribute(OPTIONS, struct.pack("=I", 0)))
    try:
        yield
    finally:
        _ask(REMOVE, 0, interface, b"")
