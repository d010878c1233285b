"""A stimulator port with nothing behind it: the bytes that would have gone out, for replays without a device."""

from __future__ import annotations

from drivers.stimulator import can_codec
from drivers.stimulator.can_port import CommandEncoder
from fes.signals import StimAlive, StimCommand, StimStatus, WireFrame


class ByteSink:
    """Encodes exactly as :class:`~drivers.stimulator.can_port.CanStimulator` does and sends nothing."""

    outstanding = 0

    def __init__(self, session_id: int) -> None:
        self.session_id = session_id
        self._encoder = CommandEncoder(session_id)

    def open(self, t_ns: int, boot_id: int) -> WireFrame:
        """The SESSION_OPEN that a node with this boot id would have got."""
        identifier, data = can_codec.encode_open(boot_id, self.session_id)
        return WireFrame(t_ns, identifier, data)

    def send(self, command: StimCommand) -> WireFrame:
        """The command's frame.

        Raises:
            ValueError: a value does not fit its field.
        """
        identifier, data = self._encoder.encode(command)
        return WireFrame(command.t_ns, identifier, data)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Nothing ever arrives."""
        return []

    def close(self) -> None:
        """Nothing to release."""
