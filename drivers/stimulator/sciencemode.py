"""What the ScienceMode ports have in common: a line, a decoder, numbered messages, and answers that are owed.

What ScienceMode2 and ScienceMode4 share: byte stuffing, and finding intact frames in a stream of bytes.

A frame is ``F0``, header fields of which every byte is stuffed, a body in which only ``F0``, ``0F`` and ``81`` are,
``0F``. Stuffing: ``b`` → ``81, b^55``. The CRC covers the stuffed body. A header byte may read ``F0`` or ``0F`` after
its ``81``, so frames are found by position and length, not by looking for the next ``0F``.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Final

from drivers.stimulator.can_port import COUNTERS, Handshake
from drivers.stimulator.port import ANSWER_WITHIN_NS, Answers, Awaited, Pulse, StimulatorLost
from drivers.stimulator.serial_line import Line
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

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


ASK_AGAIN_NS: Final = 250_000_000
REJECTED_MOST: Final = 255
NOTHING_SENT: Final = 0x6000_0000  # identifier of a frame without data: this command put nothing on the wire
NO_ANSWER: Final = f"no answer within {ANSWER_WITHIN_NS // 1_000_000} ms"


@dataclass(frozen=True, slots=True)
class Opening:
    """A handshake under way: the time that it is stamped with, its deadline by ``clock_ns``, what it has written."""

    t_ns: int
    deadline_ns: int
    clock_ns: Callable[[], int]
    frames: list[WireFrame] = field(default_factory=list)


class ScienceModePort(ABC):
    """Base of the ports (:mod:`drivers.stimulator.port`) on a ScienceMode line, which it then owns.

    Every command takes one count (modulo 16), whether it put bytes on the wire or not; a :class:`StimStatus` carries
    the count of the command that it answers. A :class:`WireFrame` holds all bytes that a command put on the wire,
    under :attr:`identifiers` plus the command of the first message; none: :data:`NOTHING_SENT`. All keep-alives are
    part of :meth:`send`: a controller that hangs sends none. A device that restarted is first reported by a
    :class:`StimAlive`, and is lost from then on: only a new handshake brings it back.

    What goes out depends on the commands, on the handshake, on when :meth:`poll` was called and on what it
    :attr:`heard` then, and on nothing else: another port given the same (:meth:`resume`) sends the same bytes.
    """

    one_pulse_per_command: ClassVar[bool]
    current_step_ma: ClassVar[float]
    numbers: ClassVar[int]
    identifiers: ClassVar[int]  # added to a command's number in the log: beyond every CAN identifier, never 0
    greetings: ClassVar[frozenset[int]]  # identifiers of frames that only a handshake puts on the wire

    def __init__(self, line: Line, decoder: FrameDecoder, encode: Callable[[Packet], bytes], session_id: int) -> None:
        self.session_id = session_id
        self._line = line
        self._decoder = decoder
        self._encode = encode
        self._answers = Answers()
        self._counter = 0
        self._number = 0
        self._boot_id = 1
        self._rejected = 0
        self._events: list[StimStatus | StimAlive] = []
        self._refusals: list[tuple[Pulse, str]] = []
        self._sent_ns: int | None = None
        self._ended = ""
        self._end_reported = False
        self._carried = b""
        self.heard = b""

    @property
    def outstanding(self) -> int:
        """Messages sent and not yet answered."""
        return len(self._answers)

    @property
    def foreign(self) -> int:
        """Bytes and beginnings of frames that were none."""
        return self._decoder.noise + self._decoder.rejected

    def open(self, t_ns: int, timeout_s: float = 4.0, clock_ns: Callable[[], int] = time.monotonic_ns) -> Handshake:
        """Bring the device to where it takes commands. Waits at most ``timeout_s`` by ``clock_ns``.

        StimulatorLost: nobody answered, or the device refused; the message says what to check.
        """
        opening = Opening(t_ns, clock_ns() + int(timeout_s * NS_PER_S), clock_ns)
        while self._line.read():  # what lies there is another session's
            pass
        if why := self._greet(opening):
            raise StimulatorLost(f"{self._line.name}: {why}")
        self._sent_ns = None
        self._carried = self._decoder.pending
        return Handshake(self._boot_id, tuple(opening.frames), (StimAlive(t_ns, self._boot_id, 0),))

    def resume(self, frames: Sequence[WireFrame]) -> None:
        """Be as after an :meth:`open` that put ``frames`` on the wire: for replays, with nobody at the other end."""
        packets = self._decoder.feed(b"".join(frame.data for frame in frames[-1:]))
        if packets:
            self._number = (packets[-1].number + 1) % self.numbers

    def send(self, command: StimCommand) -> WireFrame:
        """What this command is on the wire, written now.

        Raises:
            StimulatorLost: the line did not take it, or the device has restarted.
            ValueError: the command cannot be expressed on this device; nothing was sent.
        """
        self._need_session()
        packets = self._packets_for(command, self._counter)
        self._counter = (self._counter + 1) % COUNTERS
        if not packets:
            return WireFrame(command.t_ns, NOTHING_SENT, b"")
        data = b"".join(self._encode(packet) for packet in packets)
        self._line.write(data)
        self._sent_ns = command.t_ns
        return WireFrame(command.t_ns, self.identifiers + packets[0].command, data)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """All that has arrived, and what should have, stamped ``t_ns``; :attr:`heard` is then what it came as.

        StimulatorLost: the line broke, or the device has restarted and the last call said so.
        """
        self._need_session()
        for refused, why in self._refusals:
            self._confirm(t_ns, refused, why, pulses=0)
        self._refusals.clear()
        data = self._line.read()
        self.heard, self._carried = self._carried + data, b""
        for packet in self._decoder.feed(data):
            if not self._unasked(t_ns, packet):
                found, fault = self._answers.settle(packet.number, packet.command)
                if found is None:
                    self._alive(t_ns, fault)
                else:
                    self._answered(t_ns, packet, found, fault)
        for awaited in self._answers.overdue(t_ns):
            if not awaited.pulses:
                self._alive(t_ns, NO_ANSWER)
            for pulse in awaited.pulses:
                self._confirm(t_ns, pulse, NO_ANSWER, pulses=0)
        events, self._events = self._events, []
        self._end_reported = bool(self._ended)
        return events

    def fileno(self) -> int:
        """The line's descriptor, for ``select``."""
        return self._line.fileno()

    def close(self) -> None:
        """Release the line; sends nothing."""
        self._line.close()

    def report_error(self, t_ns: int, fault: str) -> None:
        """The device spoke of an error unasked; the next :meth:`poll` says so."""
        self._count_rejected()
        self._alive(t_ns, fault)

    # --- what each device does its own way ---------------------------------------------------------------

    @abstractmethod
    def _greet(self, opening: Opening) -> str:
        """The handshake; "" when the device takes commands now, else why not."""

    @abstractmethod
    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        """What to write for this command, already expected by ``_answers``; raises ValueError before any change."""

    @abstractmethod
    def _unasked(self, t_ns: int, packet: Packet) -> bool:
        """Deal with a message that is no answer; False when it is one."""

    @abstractmethod
    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        """Deal with an answer; ``fault`` says what is wrong with its turn."""

    # --- for them to use ---------------------------------------------------------------------------------

    def _next_number(self) -> int:
        number = self._number
        self._number = (number + 1) % self.numbers
        return number

    def _expect(self, packet: Packet, t_ns: int, pulses: tuple[Pulse, ...] = ()) -> Packet:
        self._answers.expect(Awaited(packet.number, packet.command + 1, t_ns, pulses))
        return packet

    def _withheld(self, command: StimCommand, counter: int, why: str) -> None:
        self._refusals.append((Pulse(command.channel, counter, False), why))

    def _confirm(self, t_ns: int, pulse: Pulse, fault: str, *, pulses: int) -> None:
        """Report what an answer says of one channel; at a fault nothing counts as delivered."""
        if fault:
            pulse, pulses = Pulse(pulse.channel, pulse.counter, False), 0
        charge_uc = pulses * pulse.current_ma * pulse.pulse_width_us * 1e-3
        levels = (pulse.current_ma, pulse.pulse_width_us, pulse.frequency_hz)
        self._events.append(StimStatus(t_ns, pulse.channel, pulse.counter, pulse.on, *levels, pulses, charge_uc, fault))

    def _alive(self, t_ns: int, fault: str = "") -> None:
        self._events.append(StimAlive(t_ns, self._boot_id, self._rejected, fault))

    def _count_rejected(self) -> None:
        self._rejected = min(self._rejected + 1, REJECTED_MOST)

    def _need_session(self) -> None:
        if self._end_reported:
            raise StimulatorLost(f"{self._line.name}: {self._ended}; its session must be opened again")

    def _restarted(self, t_ns: int, fault: str) -> None:
        self._ended = fault
        self._boot_id += 1
        self._alive(t_ns, fault)

    def _write(self, opening: Opening, packet: Packet) -> None:
        """Handshake only: put a message on the wire, and note it for the log."""
        data = self._encode(packet)
        self._line.write(data)
        opening.frames.append(WireFrame(opening.t_ns, self.identifiers + packet.command, data))

    def _request(self, opening: Opening, command: int, data: bytes) -> Packet | None:
        """Handshake only: send a message, again every 250 ms under a new number, until its answer comes."""
        while opening.clock_ns() < opening.deadline_ns:
            packet = Packet(self._next_number(), command, data)
            self._write(opening, packet)
            for answer in self._packets_until(opening, opening.clock_ns() + ASK_AGAIN_NS):
                if (answer.number, answer.command) == (packet.number, packet.command + 1):
                    return answer
        return None

    def _packets_until(self, opening: Opening, end_ns: int) -> Iterator[Packet]:
        """Handshake only: packets as they come, until this time or the deadline."""
        while (left_ns := min(end_ns, opening.deadline_ns) - opening.clock_ns()) > 0:
            self._line.wait(left_ns / NS_PER_S)
            yield from self._decoder.feed(self._line.read())
