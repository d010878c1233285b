"""A line of bytes to a device: serial port, pseudo-terminal, or ``socket://host:port``; never waits once it is open.

pyserial opens and sets it up. Reading and writing go straight to the descriptor: with a write timeout of 0, pyserial
spins until the kernel's buffer takes the bytes, and a control loop must not. FTDI adapters hold back received bytes for
16 ms unless their latency timer is set to 1 ms; :func:`latency_hint` says so.

Room for what arrives while this program is held up; what finds none is lost, and nobody tells.

A socket's usual room on Linux is 212,992 bytes, of which each datagram takes 832, however short: 256 CAN frames by
multicast. Two sensors send 1600 frames a second, so a program held up for 0.16 s loses samples.
"""

import os
import select
import socket
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

import serial

from drivers.stimulator.port import StimulatorLost

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


LATENCY_TIMER_MS: Final = 1
_EMPTY_LOOKS: Final = 8  # in a row, then a look at whether the other end is gone: 80 ms in a loop without any sample
_HINT: Final = "Check cable and power; then start a new session."
_OPEN_HINT: Final = (
    "Is the device plugged in and switched on, is no other program using it, and may this user open it (Linux: group "
    "dialout)?"
)


class Line(Protocol):
    """Bytes out and in; an end that is gone raises :class:`~drivers.stimulator.port.StimulatorLost`."""

    @property
    def name(self) -> str:
        """As messages name it."""

    def write(self, data: bytes) -> None:
        """Hand over all bytes at once, or raise."""

    def read(self) -> bytes:
        """What has arrived, b"" for nothing."""

    def wait(self, timeout_s: float) -> None:
        """Until something has arrived or the time is over; only ever used while opening a session."""

    def fileno(self) -> int:
        """For ``select``."""

    def close(self) -> None:
        """Release it; may be called twice."""


@dataclass(frozen=True, slots=True)
class LineSettings:
    """How bytes travel. ``parity`` is N, E or O."""

    baudrate: int
    parity: str = "N"
    stop_bits: int = 1
    rtscts: bool = False


SCIENCEMODE4: Final = LineSettings(3_000_000, stop_bits=2, rtscts=True)
SCIENCEMODE2: Final = LineSettings(460_800, parity="E")


class Waiting:
    """Whether something waits to be read on what pyserial opened, asked without waiting for the kernel.

    To read or poll a terminal in which nothing waits, Linux first lets the worker thread finish that moves bytes into
    it (``tty_buffer_flush_work``). That worker has an ordinary priority: on a busy machine a loop under SCHED_FIFO was
    held up by it for 40 to 110 ms. To ask for the number of bytes waits for nobody. It does not tell of an end that is
    gone, so after eight times in a row the answer is unknown once, and the caller reads.
    """

    def __init__(self, line: object) -> None:
        self._line = line if isinstance(line, serial.Serial) and os.isatty(line.fileno()) else None
        self._empty = 0

    def nothing(self) -> bool:
        """True: there is nothing to read. False: there is, or that is not known."""
        if self._line is None:
            return False
        try:
            count = self._line.in_waiting
        except (OSError, TypeError):  # hung up, or closed: to read it says so
            return False
        self._empty = 0 if count or self._empty >= _EMPTY_LOOKS else self._empty + 1
        return self._empty > 0


class SerialLine:
    """:class:`Line` over a descriptor that pyserial opened, or over any other that is given to it.

    ``owner`` closes the descriptor, where there is one. ``lost`` is raised when the line is gone; its message ends with
    ``hint``. ``read_at_most`` bytes are read at once.
    """

    def __init__(
        self,
        name: str,
        descriptor: int,
        owner: serial.SerialBase | socket.socket | None = None,
        lost: type[RuntimeError] = StimulatorLost,
        hint: str = _HINT,
        read_at_most: int = 4096,
    ) -> None:
        self.name = name
        self._owner = owner
        self._descriptor = descriptor
        self._lost, self._hint, self._read_at_most = lost, hint, read_at_most
        self._closed = False
        os.set_blocking(descriptor, False)
        self._waiting = Waiting(owner)

    def write(self, data: bytes) -> None:
        """Hand all of it to the system now.

        StimulatorLost: the line is gone, or took less than all: the device drops the torn frame.
        """
        try:
            written = os.write(self._descriptor, data)
        except BlockingIOError:
            written = 0
        except (OSError, ValueError) as error:
            raise self._lost(f"{self.name}: did not take a command: {error}. {self._hint}") from error
        if written != len(data):
            raise self._lost(
                f"{self.name}: took {written} of {len(data)} bytes, the rest would have to wait. Does the device "
                f"read, and is the flow control right? {self._hint}"
            )

    def read(self) -> bytes:
        """What has arrived, at most 4096 bytes (``read_at_most``). StimulatorLost: the line is gone."""
        if self._waiting.nothing():
            return b""
        data = self._read_once()
        # a terminal without bytes may read as empty; one that select calls readable, and that is then still empty, has
        # lost its other end (without the second look, bytes that come just between the two would be taken for that)
        if data == b"" and select.select([self._descriptor], [], [], 0)[0]:
            data = self._read_once()
            if data == b"":
                raise self._lost(f"{self.name}: the other end is gone. {self._hint}")
        return data or b""

    def _read_once(self) -> bytes | None:
        """Bytes; none when it reads as empty, None when the system says that there are none yet."""
        try:
            return os.read(self._descriptor, self._read_at_most)
        except BlockingIOError:
            return None
        except (OSError, ValueError) as error:
            raise self._lost(f"{self.name}: cannot be read: {error}. {self._hint}") from error

    def wait(self, timeout_s: float) -> None:
        """Until readable, at most ``timeout_s``."""
        try:
            select.select([self._descriptor], [], [], max(timeout_s, 0.0))
        except (OSError, ValueError) as error:
            raise self._lost(f"{self.name}: cannot be waited for: {error}. {self._hint}") from error

    def fileno(self) -> int:
        """The descriptor."""
        return self._descriptor

    def close(self) -> None:
        """Close it; sends nothing."""
        if not self._closed:
            self._closed = True
            os.close(self._descriptor) if self._owner is None else self._owner.close()


def open_line(port: str, settings: LineSettings) -> SerialLine:
    """The line named ``port``: ``/dev/ttyUSB0``, a pseudo-terminal, or ``socket://host:port``. Nobody else may open it.

    StimulatorLost: no such port, no permission, in use, or no descriptor behind it; the message says what to do.
    """
    options: dict[str, object] = {} if "://" in port else {"exclusive": True, "rtscts": settings.rtscts}
    # a pseudo-terminal has no parity, and the system refuses settings of which none can be had
    pseudo_terminal = "://" not in port and Path(port).resolve().parent == Path("/dev/pts")
    options |= {"parity": "N" if pseudo_terminal else settings.parity, "stopbits": settings.stop_bits}
    try:
        owner = serial.serial_for_url(port, baudrate=settings.baudrate, timeout=0, write_timeout=0, **options)
        return SerialLine(port, owner.fileno(), owner)
    except Exception as error:  # SerialException, OSError, ValueError, termios.error: each call has its own
        raise StimulatorLost(f"stimulator.port = {port!r} cannot be opened: {error}. {_OPEN_HINT}") from error


def latency_hint(port: str, devices: Path = Path("/sys/bus/usb-serial/devices")) -> str:
    """What to do about an FTDI adapter's latency timer; "" when it is right, or there is none."""
    timer = devices / Path(port).name / "latency_timer"
    try:
        latency_ms = int(timer.read_text())
    except (OSError, ValueError):
        return ""
    if latency_ms <= LATENCY_TIMER_MS:
        return ""
    return f"{port}: the adapter holds answers back for {latency_ms} ms; as root: echo {LATENCY_TIMER_MS} > {timer}"
