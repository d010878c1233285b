"""What the live loop asks of devices; the commands hand them in, so that the loop knows no driver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from fes.signals import Event, StimAlive, StimCommand, StimStatus, Vector3, WireFrame


class RawSample(Protocol):
    """One sample as a device gave it: ``t_device_ns`` by its own clock."""

    @property
    def sensor(self) -> str:
        """Where it is worn."""

    @property
    def t_host_ns(self) -> int:
        """When it was read."""

    @property
    def t_device_ns(self) -> int:
        """By the sensor's own clock."""

    @property
    def acc_mps2(self) -> Vector3:
        """Specific force."""

    @property
    def gyr_radps(self) -> Vector3:
        """Angular rate."""


class Imu(Protocol):
    """One line to one or more sensors; see ``drivers.imu``."""

    @property
    def sensors(self) -> Sequence[str]:
        """Which sensors it brings."""

    def fileno(self) -> int | None:
        """A descriptor that becomes readable with new samples; None where there is none."""

    def read(self, t_ns: int) -> Sequence[RawSample]:
        """All that has come; never waits."""

    def reopen(self) -> None:
        """Let go of the line and open it again; may wait, so it is called in a thread of its own."""

    def close(self) -> None:
        """Release the line."""


class StimulatorLine(Protocol):
    """An open stimulator; see ``drivers.stimulator.port``."""

    @property
    def heard(self) -> bytes:
        """What the last ``poll`` read, where the bytes that go out depend on that: it belongs in the log."""

    def send(self, command: StimCommand) -> WireFrame:
        """Write at once."""

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived."""

    def close(self) -> None:
        """Release the line."""


class Input(Protocol):
    """Anything else that can make something happen: keys, control messages, a stop file, a switch."""

    def fileno(self) -> int | None:
        """A descriptor to wait on; None: it is asked every turn."""

    def read_events(self, t_ns: int) -> list[Event]:
        """What it makes happen now; never waits, never raises."""
