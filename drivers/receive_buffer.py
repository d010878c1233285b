"""Room for what arrives while this program is held up; what finds none is lost, and nobody tells.

A socket's usual room on Linux is 212,992 bytes, of which each datagram takes 832, however short: 256 CAN frames by
multicast. Two sensors send 1600 frames a second, so a program held up for 0.16 s loses samples.
"""

import os
import socket
from contextlib import suppress
from typing import Final

RECEIVE_BYTES: Final = 1 << 20  # Linux grants twice that, where net.core.rmem_max allows it: some 2500 datagrams


def make_room(descriptor: int) -> None:
    """Ask for more room behind a socket; the system may grant less. Any other descriptor is left as it is."""
    duplicate = os.dup(descriptor)
    try:
        same = socket.socket(fileno=duplicate)
    except OSError:  # no socket
        os.close(duplicate)
        return
    with same, suppress(OSError):
        if same.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < RECEIVE_BYTES:
            same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
