"""The line between controller and simulated node, as a process of its own: ``python -m drivers.simulated.can_link``.

Frames of controllers pass from the front to the back, all others from the back to the front; so two buses, or a serial
CAN adapter (slcan) and a bus, become one that can be cut. Faults are JSON lines on stdin, each confirmed: ``cut`` (1:
nothing passes; 0: again), ``bus_off`` (1: nothing passes either, and the controller's side says what an adapter says
then), ``unplug`` (1: the adapter's serial line is gone; 0: it is there again), ``clog`` (1: the adapter takes nothing
more from the controller, and its buffer is full; 0: it does again), ``reorder`` (so many of the controller's next
frames change places with the one after).
"""

from __future__ import annotations

import argparse
import contextlib
import select
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Protocol

import can

from drivers.simulated.lines import PtyEnd, SlcanDecoder, encode_frame
from drivers.simulated.process_end import STDIN, Orders, become_real_time, fault_orders, say_ready, stop_signals
from drivers.stimulator.bus import BusError, bus_off_frame, open_bus
from drivers.stimulator.can_codec import CONTROLLER_IDS
from fes.config import Bus

FRAMES_AT_ONCE: Final = 64
REFUSED: Final = b"\a"


class Front(Protocol):
    """The controller's side."""

    port: str

    def descriptors(self) -> list[int]:
        """To wait for."""
        ...

    def read(self) -> list[can.Message]:
        """What the controller sent."""
        ...

    def write(self, message: can.Message) -> None:
        """Towards the controller; lost where nobody takes it."""
        ...

    def plug(self, plugged: bool) -> None:
        """Pull the cable, or put it back."""
        ...

    def clog(self, clogged: bool) -> None:
        """Take nothing more, or go on."""
        ...

    def bus_off(self, off: bool) -> None:
        """The adapter has left the bus after too many errors, or is back."""
        ...


class BusFront:
    """A bus; its cable cannot be pulled, only cut."""

    def __init__(self, settings: Bus) -> None:
        self.port = ""
        self._bus = open_bus(settings, CONTROLLER_IDS)

    def descriptors(self) -> list[int]:
        """The bus's."""
        return [self._bus.fileno()]

    def read(self) -> list[can.Message]:
        """All that waits."""
        return waiting(self._bus)

    def write(self, message: can.Message) -> None:
        """At once or never."""
        with contextlib.suppress(can.CanError, OSError):
            self._bus.send(message, timeout=0)

    def plug(self, plugged: bool) -> None:
        """Not possible.

        Raises:
            ValueError: always.
        """
        raise ValueError("a bus has no cable to pull; use cut")

    def clog(self, clogged: bool) -> None:
        """Not possible.

        Raises:
            ValueError: always.
        """
        raise ValueError("a bus has no adapter whose buffer could be full")

    def bus_off(self, off: bool) -> None:
        """What SocketCAN hands on: an error frame of the class bus-off."""
        if off:
            self.write(bus_off_frame())


class SlcanFront:
    """A serial CAN adapter behind a pseudo-terminal; ``link`` is where its name can always be found."""

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


def waiting(bus: can.BusABC) -> list[can.Message]:
    """Frames that have arrived, at most 64."""
    found: list[can.Message] = []
    for _ in range(FRAMES_AT_ONCE):
        try:
            message = bus.recv(timeout=0.0)
        except (can.CanError, OSError):
            break
        if message is None:
            break
        found.append(message)
    return found


class LinkLoop:
    """Both sides and the faults: one wait per turn."""

    def __init__(self, front: Front, back: can.BusABC, wake: int) -> None:
        self._front = front
        self._back = back
        self._wake = wake
        self._cut = False
        self._reorder = 0
        self._held: can.Message | None = None
        self._orders = Orders(fault_orders(self._fault))

    def run(self) -> None:
        """Until a signal or the end of stdin."""
        while self._turn():
            pass

    def _turn(self) -> bool:
        front, back = self._front.descriptors(), self._back.fileno()
        ready, _, _ = select.select([self._wake, STDIN, back, *front], [], [], 1.0)
        if self._wake in ready or (STDIN in ready and not self._orders.read()):
            return False
        if any(descriptor in ready for descriptor in self._front.descriptors()):
            for message in self._front.read():
                if message.arbitration_id in CONTROLLER_IDS and not self._cut:
                    self._pass_on(message)
        if back in ready:
            for message in waiting(self._back):
                if message.arbitration_id not in CONTROLLER_IDS and not self._cut:
                    self._front.write(message)
        return True

    def _pass_on(self, message: can.Message) -> None:
        """To the back; a frame that is held comes after this one."""
        if self._held is None and self._reorder > 0:
            self._reorder -= 1
            self._held = message
            return
        for each in filter(None, (message, self._held)):
            with contextlib.suppress(can.CanError, OSError):
                self._back.send(each, timeout=0)
        self._held = None

    def _fault(self, name: str, value: float) -> None:
        if name == "cut":
            self._cut = bool(value)
        elif name == "bus_off":
            self._cut = bool(value)
            self._front.bus_off(self._cut)
        elif name == "unplug":
            self._front.plug(not value)
        elif name == "clog":
            self._front.clog(bool(value))
        elif name == "reorder":
            self._reorder = int(value)
        else:
            raise ValueError(f"fault {name!r} is not known; one of cut, bus_off, unplug, clog, reorder")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the line until told to stop; exit status 2 when the settings are wrong."""
    parser = argparse.ArgumentParser(prog="can_link", description="A line between two CAN buses that can be cut.")
    parser.add_argument("--back", required=True, help="the node's bus, as JSON")
    parser.add_argument("--front", help="the controller's bus, as JSON")
    parser.add_argument("--slcan", type=Path, help="instead of it: a serial CAN adapter, found at this path")
    options = parser.parse_args(arguments)
    if (options.front is None) == (options.slcan is None):
        parser.error("give either --front or --slcan")
    stop = stop_signals()
    try:
        back = open_bus(Bus.model_validate_json(options.back), frozenset(range(0x800)))
        front: Front = (
            SlcanFront(options.slcan) if options.slcan else BusFront(Bus.model_validate_json(options.front or "{}"))
        )
    except (BusError, OSError, ValueError) as error:
        print(f"can_link: {error}", file=sys.stderr)
        return 2
    say_ready(port=front.port, real_time=become_real_time())
    try:
        LinkLoop(front, back, stop.fileno()).run()
    finally:
        back.shutdown()
        if options.slcan:
            front.plug(False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
