"""The line between controller and simulated node, as a process of its own: ``python -m drivers.simulated.can_link``.

Frames of controllers pass from the front to the back, all others from the back to the front; so two buses, or a serial
CAN adapter (slcan) and a bus, become one that can be cut. Faults are JSON lines on stdin, each confirmed: ``cut`` (1:
nothing passes; 0: again), ``bus_off`` (1: nothing passes either, and the controller's side says what an adapter says
then), ``unplug`` (1: the adapter's serial line is gone; 0: it is there again), ``clog`` (1: the adapter takes nothing
more from the controller, and its buffer is full; 0: it does again), ``reorder`` (so many of the controller's next
frames change places with the one after).

The simulated adapter is of the Lawicel type: text lines ended by CR. ``S6`` bit rate, ``O`` open, ``C`` close,
``tIIILDD…`` a frame with an 11-bit identifier (``T`` with 29 bits); it answers CR, or BEL to what it does not know.
"""

import argparse
import contextlib
import select
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import can

from drivers.simulated import lines
from drivers.simulated.lines import STDIN, CommandReader, PtyEnd
from drivers.stimulator.bus import BusError, bus_off_frame, open_bus
from drivers.stimulator.can_codec import CONTROLLER_IDS
from fes.config import Bus

FRAMES_AT_ONCE: Final = 64
REFUSED: Final = b"\a"
LONGEST_LINE: Final = 64


class BusFront:
    """The controller's side: a bus; its cable cannot be pulled, only cut."""

    def __init__(self, settings: Bus) -> None:
        self.port = ""
        self._bus = open_bus(settings, CONTROLLER_IDS)

    def descriptors(self) -> list[int]:
        """To wait for."""
        return [self._bus.fileno()]

    def read(self) -> list[can.Message]:
        """What the controller sent."""
        return waiting_frames(self._bus)

    def write(self, message: can.Message) -> None:
        """Towards the controller, at once or never."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.send(message, timeout=0)

    def plug(self, plugged: bool) -> None:
        """Not possible: ValueError."""
        raise ValueError("a bus has no cable to pull; use cut")

    def clog(self, clogged: bool) -> None:
        """Not possible: ValueError."""
        raise ValueError("a bus has no adapter whose buffer could be full")

    def bus_off(self, off: bool) -> None:
        """What SocketCAN hands on: an error frame of the class bus-off."""
        if off:
            self.write(bus_off_frame())


class SlcanFront:
    """The controller's side: a serial CAN adapter behind a pseudo-terminal whose name is always found at ``link``."""

    def __init__(self, link: Path) -> None:
        self.port = str(link)
        self._link = link
        self._end: PtyEnd | None = None
        self._decoder = SlcanDecoder()
        self._bus_off = False
        self.plug(True)

    def descriptors(self) -> list[int]:
        """The line's, while there is one."""
        return [] if self._end is None else self._end.descriptors()

    def read(self) -> list[can.Message]:
        """Frames among what the controller wrote."""
        if self._end is None:
            return []
        frames = self._decoder.feed(self._end.read())
        if self._bus_off and frames:
            self._end.write(REFUSED * len(frames))
            return []
        return frames

    def write(self, message: can.Message) -> None:
        """As text, when the channel is open."""
        if self._end is not None and self._decoder.open:
            self._end.write(encode_frame(message))

    def plug(self, plugged: bool) -> None:
        """Pull the cable, or put it back under another name behind the same link."""
        if self._end is not None:
            self._end.unplug()
            self._end = None
        self._link.unlink(missing_ok=True)
        self._decoder = SlcanDecoder()
        if plugged:
            self._end = PtyEnd()
            self._link.symlink_to(self._end.port)

    def clog(self, clogged: bool) -> None:
        """Read nothing more from the serial line, or go on."""
        if self._end is not None:
            self._end.clog(clogged)

    def bus_off(self, off: bool) -> None:
        """Refuse every frame with BEL: all that such an adapter says unasked."""
        self._bus_off = off


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
            elif self.open and (frame := _decode_frame(line)) is not None:
                frames.append(frame)
        return frames


def _decode_frame(line: bytes) -> can.Message | None:
    if not (digits := {b"t": 3, b"T": 8}.get(line[:1])):
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


def waiting_frames(bus: can.BusABC) -> list[can.Message]:
    """Frames that have arrived, at most 64."""
    frames: list[can.Message] = []
    with contextlib.suppress(can.CanError, OSError):
        while len(frames) < FRAMES_AT_ONCE and (message := bus.recv(timeout=0.0)) is not None:
            frames.append(message)
    return frames


@dataclass(eq=False)
class LinkLoop:
    """Both sides and the faults: one wait per turn."""

    front: BusFront | SlcanFront
    back: can.BusABC
    wake: int

    def __post_init__(self) -> None:
        self._cut = False
        self._reorder = 0
        self._held: can.Message | None = None
        self._commands = CommandReader(lines.fault_commands(self._inject))

    def turn(self) -> bool:
        """Wait, and pass on what has come; False after a signal or the end of stdin."""
        back = self.back.fileno()
        ready, _, _ = select.select([self.wake, STDIN, back, *self.front.descriptors()], [], [], 1.0)
        if self.wake in ready or (STDIN in ready and not self._commands.read()):
            return False
        if any(descriptor in ready for descriptor in self.front.descriptors()):
            for message in self.front.read():
                if message.arbitration_id in CONTROLLER_IDS and not self._cut:
                    self._pass_on(message)
        if back in ready:
            for message in waiting_frames(self.back):
                if message.arbitration_id not in CONTROLLER_IDS and not self._cut:
                    self.front.write(message)
        return True

    def _pass_on(self, message: can.Message) -> None:
        """To the back; a frame that is held comes after this one."""
        if self._held is None and self._reorder > 0:
            self._reorder -= 1
            self._held = message
            return
        for each in filter(None, (message, self._held)):
            with contextlib.suppress(can.CanError, OSError):
                self.back.send(each, timeout=0)
        self._held = None

    def _inject(self, name: str, value: float) -> None:
        if name == "cut":
            self._cut = bool(value)
        elif name == "bus_off":
            self._cut = bool(value)
            self.front.bus_off(self._cut)
        elif name == "unplug":
            self.front.plug(not value)
        elif name == "clog":
            self.front.clog(bool(value))
        elif name == "reorder":
            self._reorder = int(value)
        else:
            raise ValueError(f"fault {name!r} is not known; one of cut, bus_off, unplug, clog, reorder")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the line until a signal or the end of stdin; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="can_link", description="A line between two CAN buses that can be cut.")
    parser.add_argument("--back", required=True, help="the node's bus, as JSON")
    parser.add_argument("--front", help="the controller's bus, as JSON")
    parser.add_argument("--slcan", type=Path, help="instead of it: a serial CAN adapter, found at this path")
    options = parser.parse_args(arguments)
    if (options.front is None) == (options.slcan is None):
        parser.error("give either --front or --slcan")
    stop = lines.stop_signals()
    front: BusFront | SlcanFront
    try:
        back = open_bus(Bus.model_validate_json(options.back), frozenset(range(0x800)))
        front = SlcanFront(options.slcan) if options.slcan else BusFront(Bus.model_validate_json(options.front or "{}"))
    except (BusError, OSError, ValueError) as error:
        print(f"can_link: {error}", file=sys.stderr)
        return 2
    lines.publish_ready(port=front.port, real_time=lines.become_real_time())
    try:
        loop = LinkLoop(front, back, stop.fileno())
        while loop.turn():
            pass
    finally:
        back.shutdown()
        if options.slcan:
            front.plug(False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
