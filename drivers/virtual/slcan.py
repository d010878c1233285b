"""The serial line of a Lawicel-type CAN adapter (slcan): text lines ended by CR, for the simulated adapter.

``S6`` bit rate, ``O`` open, ``C`` close, ``tIIILDD…`` a frame with an 11-bit identifier (``T`` with 29 bits); the
adapter answers CR, or BEL to what it does not know.
"""

from __future__ import annotations

from typing import Final

import can

LONGEST_LINE: Final = 64


def encode_frame(message: can.Message) -> bytes:
    """A classical data frame as the adapter writes it."""
    head = f"T{message.arbitration_id:08X}" if message.is_extended_id else f"t{message.arbitration_id:03X}"
    return f"{head}{len(message.data)}{bytes(message.data).hex().upper()}\r".encode("ascii")


class SlcanDecoder:
    """Bytes from the host in, frames out; ``open`` while the host has the channel open."""

    def __init__(self) -> None:
        self.open = False
        self._line = bytearray()

    def feed(self, data: bytes) -> list[can.Message]:
        """The frames that these bytes complete; what is no line of this protocol is passed over."""
        frames: list[can.Message] = []
        for byte in data:
            if byte != 0x0D:
                if len(self._line) < LONGEST_LINE:
                    self._line.append(byte)
                continue
            line = bytes(self._line)
            self._line.clear()
            if line in (b"O", b"C"):
                self.open = line == b"O"
            elif self.open and (frame := _frame(line)) is not None:
                frames.append(frame)
        return frames


def _frame(line: bytes) -> can.Message | None:
    digits = {b"t": 3, b"T": 8}.get(line[:1])
    if digits is None:
        return None
    try:
        identifier = int(line[1 : 1 + digits], 16)
        length = int(line[1 + digits : 2 + digits])
        data = bytes.fromhex(line[2 + digits :].decode("ascii"))
        if length != len(data) or length > 8:
            return None
        return can.Message(arbitration_id=identifier, is_extended_id=digits == 8, data=data, check=True)
    except ValueError:
        return None
