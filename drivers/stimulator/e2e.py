"""End-to-end protection of a CAN frame, in the manner of AUTOSAR E2E profile 2.

Byte 0 holds a CRC-8H2F (polynomial 0x2F, initial value 0xFF, final xor 0xFF, not reflected; check value of
``123456789`` is 0xDF), computed over data bytes 1 to 7 in order and then over the CAN identifier as two bytes, the
high byte first (AUTOSAR appends one byte from a list of data IDs instead). Over these 72 bits and the CRC the Hamming
distance is 4: any one, two or three flipped bits are seen, and so is a frame that arrives under another identifier.
The low half of byte 1 holds a 4-bit counter.

The profile's four bits are not enough: with two lost frames forgiven, a frame repeated 13 to 15 frames late looks like
the next one. A command has therefore a **number** of 23 bits: 7 bits of count, and the session identifier above them. A
session's first command carries the identifier that was opened, and after every 128 commands the identifier goes up by
one (1 follows 65535). All of it is transmitted, so the CRC keeps its Hamming distance for frames of any age. Higher
bits that are counted, not sent, but put into the CRC would spend its 256 values on telling ages apart: a frame repeated
4093 frames late would pass, and so would one repeated sooner with two bits flipped.

Source: AUTOSAR, Specification of SW-C End-to-End Communication Protection Library, profile 2; Specification of CRC
Routines, ``Crc_CalculateCRC8H2F``.
"""

from functools import reduce
from typing import Final

FRAME_LENGTH: Final = 8
COUNTS: Final = 128  # values of a command's count; then the session identifier goes up by one
SESSIONS: Final = 65_535  # values of the session identifier: 1 to 65,535
NUMBERS: Final = COUNTS * SESSIONS  # commands of a session, at most


def crc8_table(polynomial: int) -> bytes:
    """The 256 steps of a CRC of 8 bits that is not reflected."""
    rows = bytearray()
    for start in range(256):
        crc = start
        for _ in range(8):
            crc = ((crc << 1) ^ polynomial if crc & 0x80 else crc << 1) & 0xFF
        rows.append(crc)
    return bytes(rows)


_TABLE: Final = crc8_table(0x2F)


def crc8h2f(data: bytes) -> int:
    """CRC-8H2F of any bytes, 0–255."""
    return reduce(lambda crc, byte: _TABLE[crc ^ byte], data, 0xFF) ^ 0xFF


def frame_crc(identifier: int, data: bytes) -> int:
    """What byte 0 of the frame must hold; ``data`` is the whole frame, its byte 0 is not looked at."""
    return crc8h2f(bytes(data[1:]) + identifier.to_bytes(2, "big"))


def protect(identifier: int, data: bytes) -> bytes:
    """The frame with its CRC in byte 0."""
    return bytes((frame_crc(identifier, data),)) + bytes(data[1:])


def is_intact(identifier: int, data: bytes) -> bool:
    """Whether the frame is 8 bytes long and its CRC fits its content and its identifier."""
    return len(data) == FRAME_LENGTH and data[0] == frame_crc(identifier, data)


def carried(session_id: int, number: int) -> tuple[int, int]:
    """The session identifier (as opened: 1–65535) and the count that a command carries; the first is number 0."""
    spans, count = divmod(number, COUNTS)
    return (session_id - 1 + spans) % SESSIONS + 1, count


def command_number(session_id: int, carried_id: int, count: int) -> int:
    """The number of a command of the session opened as ``session_id``: what :func:`carried` was given.

    Unique among ``NUMBERS``, after which the identifiers have come round.
    """
    return (carried_id - session_id) % SESSIONS * COUNTS + count
