"""What ScienceMode2 and ScienceMode4 share: byte stuffing, and finding intact frames in a stream of bytes.

A frame is ``F0``, header fields of which every byte is stuffed, a body in which only ``F0``, ``0F`` and ``81`` are,
``0F``. Stuffing: ``b`` → ``81, b^55``. The CRC covers the stuffed body. A header byte may read ``F0`` or ``0F`` after
its ``81``, so frames are found by position and length, not by looking for the next ``0F``.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final

START: Final = 0xF0
STOP: Final = 0x0F
STUFF: Final = 0x81
KEY: Final = 0x55
_SPECIAL: Final = frozenset((START, STOP, STUFF))


class FrameRejected(ValueError):
    """Bytes that are no frame of this protocol; the message says why."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One message: its running number, its command, its data without stuffing."""

    number: int
    command: int
    data: bytes = b""


def stuff(data: bytes) -> bytes:
    """The bytes as a body carries them."""
    return b"".join(bytes((STUFF, byte ^ KEY)) if byte in _SPECIAL else bytes((byte,)) for byte in data)


def frame(header: bytes, body: bytes) -> bytes:
    """All of a frame; the header is still to be stuffed, the body is stuffed."""
    return bytes((START,)) + b"".join(bytes((STUFF, byte ^ KEY)) for byte in header) + body + bytes((STOP,))


def unstuff(body: bytes) -> bytes:
    """The inverse of :func:`stuff`, and no more than that.

    FrameRejected: a byte that must be stuffed is not, one that must not be is, or the last is cut off.
    """
    out = bytearray()
    stuffed = False
    for byte in body:
        if stuffed:
            if byte ^ KEY not in _SPECIAL:
                raise FrameRejected(f"0x{byte ^ KEY:02x} is stuffed without need")
            out.append(byte ^ KEY)
            stuffed = False
        elif byte == STUFF:
            stuffed = True
        elif byte in _SPECIAL:
            raise FrameRejected(f"0x{byte:02x} within a frame")
        else:
            out.append(byte)
    if stuffed:
        raise FrameRejected("the frame ends within a stuffed byte")
    return bytes(out)


class FrameDecoder(ABC):
    """Bytes in, intact packets out. Whatever comes, it holds at most ``max_length`` bytes and finds the next frame.

    ``rejected`` counts beginnings of frames that turned out to be none; ``noise`` counts bytes outside of frames.
    """

    HEADER_FIELDS: int  # stuffed header bytes after F0
    MAX_LENGTH: int  # of a frame, unless another is given

    def __init__(self, max_length: int | None = None) -> None:
        self.max_length = max_length or self.MAX_LENGTH
        self.rejected = 0
        self.noise = 0
        self._buffer = bytearray()

    @property
    def pending(self) -> bytes:
        """What was fed and is in no packet yet."""
        return bytes(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """All packets that are complete with these bytes."""
        packets: list[Packet] = []
        for offset in range(0, len(data), self.max_length):
            self._buffer += data[offset : offset + self.max_length]
            while (found := self._next()) is not None:
                packets.append(found)
        return packets

    @abstractmethod
    def _length(self, header: bytes) -> int:
        """Length of the whole frame by its unstuffed header. FrameRejected: it cannot be that."""

    @abstractmethod
    def _packet(self, header: bytes, body: bytes) -> Packet:
        """The packet of a complete frame; ``body`` is still stuffed. FrameRejected: wrong CRC or content."""

    def _next(self) -> Packet | None:
        while True:
            start = self._buffer.find(START)
            skipped = len(self._buffer) if start < 0 else start
            self.noise += skipped
            del self._buffer[:skipped]
            if not self._buffer:
                return None
            try:
                return self._first_packet()
            except FrameRejected:
                self.rejected += 1
                del self._buffer[0]

    def _first_packet(self) -> Packet | None:
        """The packet at the buffer's beginning, taken out of it; None when more bytes are needed."""
        end = 1 + 2 * self.HEADER_FIELDS
        head = self._buffer[1:end]
        if any(byte != STUFF for byte in head[::2]):
            raise FrameRejected("a header field is not stuffed")
        if len(head) < end - 1:
            return None
        header = bytes(byte ^ KEY for byte in head[1::2])
        length = self._length(header)
        if not end + 1 < length <= self.max_length:
            raise FrameRejected(f"a length of {length} bytes")
        body = bytes(self._buffer[end : length - 1])
        if STOP in body or START in body:  # at once: a wrong length must not hold up the frame that follows
            raise FrameRejected("the frame ends before its length")
        if len(self._buffer) < length:
            return None
        if self._buffer[length - 1] != STOP:
            raise FrameRejected("no stop byte where the frame must end")
        packet = self._packet(header, body)
        del self._buffer[:length]
        return packet

    @staticmethod
    def _content(body: bytes) -> bytes:
        """The body without stuffing. FrameRejected: it is wrongly stuffed, or too short for number and command."""
        content = unstuff(body)
        if len(content) < 2:
            raise FrameRejected("no number and command")
        return content
