"""A campaign against real devices: only faults of the host's side, the stimulator watched on its bus.

The stimulator must be on CAN: a second receiver on the same bus hears what it itself says it delivers, independent of
the controller. On a serial line nobody else can listen; there an oscilloscope at the electrodes must be the judge.
"""

from __future__ import annotations

import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from drivers.simulated.bus_guests import Rogue
from drivers.simulated.record import RecordEntry
from drivers.stimulator.can_codec import STATUS_ID, FrameRejected, Result, Status, decode
from fes.config import ConfigError, Session, load_session
from fes.hil.scenarios import SCENARIOS, Needs, Scenario

WITHOUT_DEVICES: Final = ("imu_", "stamp", "clock", "stale", "commands", "random", "phase", "dose", "view", "page")
_ENDED_BY: Final = {Result.LEASE_EXPIRED: "lease_expired", Result.ON_TIME: "on_time"}


def host_side_scenarios() -> list[Scenario]:
    """The rows that need no simulated device."""
    return [
        scenario
        for scenario in SCENARIOS
        if Needs.SIMULATED not in scenario.needs and not scenario.name.startswith(WITHOUT_DEVICES)
    ]


def hardware_session(path: Path) -> Session:
    """The settings, if a campaign can judge them.

    Raises:
        ConfigError: they cannot be used, or nobody but the controller can hear the stimulator.
    """
    session = load_session(path)
    if session.stimulator.device != "can":
        raise ConfigError(
            f"{path}: stimulator.device = {session.stimulator.device!r}: nobody but the controller hears it, so "
            f"its end of the line cannot be judged. Use a stimulator on CAN, or an oscilloscope at a dummy load"
        )
    if not session.channels:
        raise ConfigError(f"{path}: channels are missing; there is nothing to stimulate")
    return session


@dataclass(frozen=True, slots=True)
class Hardware:
    """Real devices as a campaign's bench."""

    folder: Path
    path: Path
    calibration: Path
    intensity: float
    witness: BusWitness

    def session_file(self, number: int, variant: str) -> Path:
        """The one that there is."""
        return self.path

    def new_entries(self) -> list[RecordEntry]:
        """What the stimulator said on the bus since the last call."""
        return self.witness.new_entries()

    def processes(self) -> list[int]:
        """None: devices keep their own time."""
        return []


@dataclass(slots=True)
class BusWitness:
    """Collects the stimulator's status frames in a thread, stamped when they came, as entries of a record."""

    rogue: Rogue
    _entries: list[RecordEntry] = field(default_factory=list)
    _read: int = 0
    _on: set[int] = field(default_factory=set)
    _over: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def start(self, stack: ExitStack) -> None:
        """Listen until the stack closes."""
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        stack.callback(self.stop)

    def stop(self) -> None:
        """Listen no more."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(2.0)

    def new_entries(self) -> list[RecordEntry]:
        """What was heard since the last call."""
        before, self._read = self._read, len(self._entries)
        return self._entries[before : self._read]

    def note(self, t_ns: int, identifier: int, data: bytes) -> None:
        """A frame was heard."""
        if identifier != STATUS_ID:
            return
        try:
            message = decode(identifier, data)
        except FrameRejected:
            return
        if not isinstance(message, Status):
            return
        if message.on:
            event = "level" if message.channel in self._on else "on"
            self._on.add(message.channel)
        elif message.channel in self._on:
            self._on.discard(message.channel)
            event = _ENDED_BY.get(message.result, "off")
        else:
            return
        levels = (message.current_ma, message.pulse_width_us, message.frequency_hz)
        self._entries.append(RecordEntry(t_ns, event, message.channel, *levels, t_ns, 0, t_ns))

    def _listen(self) -> None:
        while not self._over.is_set():
            for identifier, data in self.rogue.receive(0.02, first_only=True):
                self.note(time.monotonic_ns(), identifier, data)
