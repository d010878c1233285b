"""What the runner asks of every stimulator, whatever the line to it."""

from __future__ import annotations

from typing import Protocol

from fes.signals import StimAlive, StimCommand, StimStatus, WireFrame


class StimulatorLost(RuntimeError):
    """The stimulator cannot be reached (any more): nothing was sent, or nothing can be heard.

    What it was doing ends by itself when the last command's validity runs out.
    """


class SessionUsed(StimulatorLost):
    """The device opens no session under this identifier, for it has carried commands before; another one it may."""


class StimulatorPort(Protocol):
    """One stimulator. No method waits, none reads a clock, none repeats a command by itself."""

    def send(self, command: StimCommand) -> WireFrame:
        """Encode and write at once; returns what went out, stamped with the command's time.

        Raises:
            StimulatorLost: the line did not take the frame.
            ValueError: the command cannot be expressed on this line.
        """
        ...

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Whatever has arrived since the last call, stamped ``t_ns``.

        Raises:
            StimulatorLost: the line broke.
        """
        ...

    def close(self) -> None:
        """Release the line; may be called twice. Sends nothing."""
        ...
