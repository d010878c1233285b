"""python-can's bus for serial CAN adapters (slcan), so that neither reading nor writing ever waits.

As python-can has it, a write of no time-out spins until the adapter takes the bytes, each write then waits for the last
of them to be on the line, and a read takes a system call for each byte and waits a millisecond for one more. All of
that would be the control loop's time.
"""

from __future__ import annotations

import os
import select
from contextlib import suppress
from typing import Any, Final

import can
from can.interfaces.slcan import slcanBus

TAKES_NONE: Final = "the adapter takes no frames"
_READ_AT_MOST: Final = 4096
_ENDS: Final = (b"\r", b"\a")  # of a line; the bell says that a command was refused


class PromptSlcanBus(slcanBus):
    """As :class:`can.interfaces.slcan.slcanBus`; lines that are no frames are passed over, whatever they hold.

    Raises:
        can.CanOperationError: from ``send`` when the adapter does not take a frame whole at once, from ``recv`` when it
            is gone.
    """

    def __init__(self, channel: str, timeout: float = 0.0, **options: Any) -> None:
        super().__init__(channel, timeout=timeout, **options)
        self.channel_info = f"serial CAN adapter on {channel}"
        self.serialPortOrig.write_timeout = 0  # or the first frame would set the port up anew

    def _write(self, string: str) -> None:
        data = string.encode() + self.LINE_TERMINATOR
        try:
            os.set_blocking(self._descriptor, False)
            written = os.write(self._descriptor, data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error.strerror}") from error
        if written != len(data):
            # what it did take is half a line, which the next opening ends
            raise can.CanOperationError(f"{TAKES_NONE}: it took {written} of {len(data)} bytes, nobody waits for it")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while (line := self._read(timeout)) is not None:
            timeout = 0.0
            self._queue.put_nowait(line)
            with suppress(ValueError, IndexError):  # garbled
                message, filtered = super()._recv_internal(0.0)
                if message is not None:
                    return message, filtered
        return None, False

    def _read(self, timeout: float | None) -> str | None:
        """The next line; None when none is complete within ``timeout``."""
        while (line := self._line()) is None:
            try:
                if not select.select([self._descriptor], [], [], timeout)[0]:
                    return None
                data = os.read(self._descriptor, _READ_AT_MOST)
            except BlockingIOError:
                continue
            except (OSError, ValueError) as error:
                raise can.CanOperationError(f"the adapter cannot be read: {error}") from error
            if not data:
                raise can.CanOperationError("the adapter is gone")
            self._buffer += data
        return line

    def _line(self) -> str | None:
        ends = [at for at in (self._buffer.find(end) for end in _ENDS) if at >= 0]
        if not ends:
            return None
        line = self._buffer[: min(ends) + 1]
        del self._buffer[: min(ends) + 1]
        return line.decode("latin-1")

    @property
    def _descriptor(self) -> int:
        return int(self.serialPortOrig.fileno())

    def shutdown(self) -> None:
        """Close the channel, if the adapter still takes that, and release the port."""
        with suppress(can.CanError, OSError):
            super().shutdown()
        self.serialPortOrig.close()
