"""A simulated stop button on a CAN bus: says over and over whether it is pressed, as such buttons do."""

from __future__ import annotations

from types import TracebackType
from typing import Final, Self

import can

from drivers.stimulator.bus import open_bus
from fes.config import Bus

PERIOD_S: Final = 0.02


class StopButton:
    """Bit 0 of a frame of one byte, every 20 ms and at once when it is pressed; use it as a context manager."""

    def __init__(self, settings: Bus, identifier: int) -> None:
        self._bus = open_bus(settings, frozenset((identifier,)))
        self._identifier = identifier
        self._pressed = False
        self._task = self._bus.send_periodic(self._frame(), PERIOD_S)

    def press(self, pressed: bool = True) -> None:
        """Press it, or let it go.

        Raises:
            can.CanError: the bus does not take it.
        """
        self._pressed = pressed
        self._task.stop()
        self._bus.send(self._frame(), timeout=0)
        self._task = self._bus.send_periodic(self._frame(), PERIOD_S)

    def close(self) -> None:
        """Fall silent."""
        self._task.stop()
        self._bus.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _frame(self) -> can.Message:
        return can.Message(arbitration_id=self._identifier, data=bytes((self._pressed,)), is_extended_id=False)
