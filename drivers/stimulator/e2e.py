"""End-to-end protection of a CAN frame, in the manner of AUTOSAR E2E profile 2.

Byte 0 holds a CRC-8H2F (polynomial 0x2F, initial value 0xFF, final xor 0xFF, not reflected; check value of
``123456789`` is 0xDF), computed over data bytes 1 to 7 in order and then over the CAN identifier as two bytes, the
high byte first (AUTOSAR appends one byte from a list of data IDs instead). Over these 72 bits and the CRC the Hamming
distance is 4: any one, two or three flipped bits are seen, and so is a frame that arrives under another identifier.
The low half of byte 1 holds the 4-bit counter.

Source: AUTOSAR, Specification of SW-C End-to-End Communication Protection Library, profile 2; Specification of CRC
Routines, ``Crc_CalculateCRC8H2F``.
"""

from __future__ import annotations

from typing import Final

FRAME_LENGTH: Final = 8
_POLYNOMIAL: Final = 0x2F


def _table() -> bytes:
    rows = bytearray()
    for start in range(256):
        crc = start
        for _ in range(8):
            crc = ((crc << 1) ^ _POLYNOMIAL if crc & 0x80 else crc << 1) & 0xFF
        rows.append(crc)
    return bytes(rows)


_TABLE: Final = _table()


def crc8h2f(data: bytes) -> int:
    """CRC-8H2F of any bytes, 0–255."""
    crc = 0xFF
    for byte in data:
        crc = _TABLE[crc ^ byte]
    return crc ^ 0xFF


def frame_crc(identifier: int, data: bytes) -> int:
    """What byte 0 of the frame must hold; ``data`` is the whole frame, its byte 0 is not looked at."""
    return crc8h2f(bytes(data[1:]) + identifier.to_bytes(2, "big"))


def protect(identifier: int, data: bytes) -> bytes:
    """The frame with its CRC in byte 0."""
    return bytes((frame_crc(identifier, data),)) + bytes(data[1:])


def is_intact(identifier: int, data: bytes) -> bool:
    """Whether the frame is 8 bytes long and its CRC fits its content and its identifier."""
    return len(data) == FRAME_LENGTH and data[0] == frame_crc(identifier, data)


def counter_step(previous: int, counter: int) -> int:
    """How many counts ``counter`` is ahead of ``previous``, modulo 16 (0: the same frame again)."""
    return (counter - previous) % 16
