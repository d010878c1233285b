"""Others on the CAN bus: a stop button, and a rogue that sees every frame and sends what no controller would."""

import itertools
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from random import Random
from typing import Final

import can

from drivers.stimulator.bus import open_bus
from drivers.stimulator.can_codec import COMMAND_ID, Command, Frame, FrameRejected, decode
from fes.config import Bus

PERIOD_S: Final = 0.02
FRAMES_PER_S: Final = 3000  # as many of 8 bytes as a bus of 500 kbit/s carries, with some to spare for the others
BURST: Final = 15


class StopButton(AbstractContextManager["StopButton"]):
    """A stop button: bit 0 of a frame of one byte, every 20 ms and at once when it is pressed; a context manager."""

    def __init__(self, settings: Bus, identifier: int, pressed: bool = False) -> None:
        self._bus = open_bus(settings, frozenset((identifier,)))
        self._identifier = identifier
        self._pressed = pressed
        self._task = self._bus.send_periodic(self._frame(), PERIOD_S)

    def press(self, pressed: bool = True) -> None:
        """Press it, or let it go. can.CanError: the bus does not take it."""
        self._pressed = pressed
        self._task.stop()
        self._bus.send(self._frame(), timeout=0)
        self._task = self._bus.send_periodic(self._frame(), PERIOD_S)

    def close(self) -> None:
        """Fall silent."""
        self._task.stop()
        self._bus.shutdown()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _frame(self) -> can.Message:
        return can.Message(arbitration_id=self._identifier, data=bytes((self._pressed,)), is_extended_id=False)


def flipped(frame: Frame) -> Iterator[Frame]:
    """The frame with every one of its 64 bits, and every two of them, inverted: 2,080 frames."""
    identifier, data = frame
    number, size = int.from_bytes(data, "big"), 8 * len(data)
    for count in (1, 2):
        for bits in itertools.combinations(range(size), count):
            mask = sum(1 << bit for bit in bits)
            yield identifier, (number ^ mask).to_bytes(len(data), "big")


def random_frames(count: int, seed: int, identifiers: tuple[int, ...] = ()) -> Iterator[Frame]:
    """Frames of 8 random bytes; of these identifiers, or of any."""
    random = Random(seed)
    for _ in range(count):
        identifier = random.choice(identifiers) if identifiers else random.randrange(0x800)
        yield identifier, random.randbytes(8)


def asks_for_current(frame: Frame) -> bool:
    """Whether this is an intact command that switches a channel on."""
    identifier, data = frame
    try:
        message = decode(identifier, data) if identifier == COMMAND_ID else None
    except FrameRejected:
        return False
    return isinstance(message, Command) and message.on


class Rogue(AbstractContextManager["Rogue"]):
    """An open bus; a context manager."""

    def __init__(self, settings: Bus) -> None:
        self._bus = open_bus(settings, frozenset(range(0x800)))

    def __exit__(self, *_: object) -> None:
        self._bus.shutdown()

    def receive(self, seconds: float, *, first_only: bool = False) -> list[Frame]:
        """Everything on the bus for this long, or up to the first frame."""
        frames: list[Frame] = []
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            try:
                message = self._bus.recv(timeout=left_s)
            except (can.CanError, OSError):
                continue
            if message is not None and not message.is_error_frame:
                frames.append((message.arbitration_id, bytes(message.data)))
                if first_only:
                    break
        return frames

    def on_commands(self, seconds: float) -> list[Frame]:
        """The controller's commands of this time that ask for current."""
        return [frame for frame in self.receive(seconds) if asks_for_current(frame)]

    def send(self, frames: Iterable[Frame], per_s: float = FRAMES_PER_S) -> int:
        """Send them at this rate; returns how many got out."""
        sent, begin_s = 0, time.monotonic()
        for number, (identifier, data) in enumerate(frames):
            if number % BURST == 0:
                time.sleep(max(0.0, begin_s + number / per_s - time.monotonic()))
            message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
            try:
                self._bus.send(message, timeout=0)
            except (can.CanError, OSError):
                continue
            sent += 1
        return sent
