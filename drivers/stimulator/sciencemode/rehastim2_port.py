"""HASOMED RehaStim2: a list of channels, one shot for each command, so that no pulse comes without one.

The device's own watchdog (1.2 s) would let a repeated list run through a whole stance; with a main interval of 0 it
repeats nothing. It needs 10 to 24 ms for a list, so all channels of a control step share one: it goes out with the last
channel's command of that step, and holds what is due of those with the very same time. A step whose last command does
not come delivers nothing.
"""

import math
from collections.abc import Sequence
from typing import ClassVar, Final

from drivers.stimulator.port import Awaited, Pulse, PulseTrain
from drivers.stimulator.sciencemode import sciencemode2_codec as codec
from drivers.stimulator.sciencemode.framing import Packet
from drivers.stimulator.sciencemode.port import Opening, ScienceModePort
from drivers.stimulator.sciencemode.sciencemode2_codec import Code
from drivers.stimulator.serial_line import Line
from fes.signals import StimCommand

KEEP_ALIVE_NS: Final = 250_000_000


class RehaStim2(ScienceModePort):
    """Port (:mod:`drivers.stimulator.port`) for ScienceMode2, which owns ``line``; ``session_id`` is for the log only.

    ``channels`` are those of the session, in the order in which each control step commands them; ValueError: none, or
    unknown ones.
    """

    one_pulse_per_command: ClassVar[bool] = True
    current_step_ma: ClassVar[float] = 1.0
    numbers: ClassVar[int] = codec.NUMBERS
    identifiers: ClassVar[int] = 0x2000_0000
    greetings: ClassVar[frozenset[int]] = frozenset((identifiers + Code.INIT_ACK, identifiers + Code.LIST_INIT))

    def __init__(self, line: Line, session_id: int, channels: Sequence[int]) -> None:
        codec.list_init(0, channels)
        super().__init__(line, codec.Decoder(), codec.encode, session_id)
        self._channels = tuple(sorted(set(channels)))
        self._last = channels[-1]
        self._trains = {channel: PulseTrain(int(codec.MIN_INTERVAL_MS * 1e6)) for channel in self._channels}
        self._due: dict[int, Pulse] = {}
        self._step_ns: int | None = None

    def _greet(self, opening: Opening) -> str:
        asked = -1
        for packet in self._packets_until(opening, opening.deadline_ns):
            if packet.command == Code.INIT:
                asked = self._next_number()
                self._write(opening, Packet(packet.number, Code.INIT_ACK, b"\0"))
                self._write(opening, codec.list_init(asked, self._channels))
            elif (packet.number, packet.command) == (asked, Code.LIST_INIT + 1):
                result = codec.signed(packet.data)
                return f"the stimulator refused the channel list: {codec.result_text(result)}" if result else ""
            elif packet.command == Code.STIMULATION_ERROR:
                return codec.error_text(codec.signed(packet.data))
        if asked >= 0:
            return "the stimulator did not answer to the channel list"
        return (
            "no RehaStim2 was heard; it announces itself every 0.5 s. Is it switched on and in ScienceMode, is this "
            "the right port, has it been left alone for 1.2 s? Bytes that are no frames speak for a wrong baud rate."
        )

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        self._note_due(command, counter)
        if command.channel == self._last and self._due:
            due = [self._due.get(channel) for channel in self._channels]
            pulses = [(int(one.pulse_width_us), int(one.current_ma)) if one else codec.NO_PULSE for one in due]
            confirmed = tuple(self._due.values())
            self._due.clear()
            return [self._expect(codec.list_start(self._next_number(), pulses), command.t_ns, confirmed)]
        if self._sent_ns is None or command.t_ns - self._sent_ns >= KEEP_ALIVE_NS:
            # asked for its mode rather than sent a watchdog message: its answer shows that it lives, too
            return [self._expect(Packet(self._next_number(), Code.GET_MODE), command.t_ns)]
        return []

    def _note_due(self, command: StimCommand, counter: int) -> None:
        """Whether this command is a pulse of the list that this step's last command will send."""
        pulse = codec.NO_PULSE
        if command.on:
            if command.channel not in self._trains:
                raise ValueError(f"channel {command.channel} is not in the stimulator's list {list(self._channels)}")
            pulse = codec.pulse(command.current_ma, command.pulse_width_us)
            if not math.isfinite(command.frequency_hz):
                raise ValueError(f"frequency_hz = {command.frequency_hz!r} must be a finite number")
        if self._step_ns != command.t_ns:
            self._due.clear()
            self._step_ns = command.t_ns
        self._due.pop(command.channel, None)
        if not command.on:
            if command.channel in self._trains:
                self._trains[command.channel].off()
        elif pulse != codec.NO_PULSE and self._trains[command.channel].due(command.t_ns, command.frequency_hz):
            if why := self._answers.room(command.channel, command.t_ns):
                self._withheld(command, counter, why)
            else:
                levels = (float(pulse[1]), float(pulse[0]), command.frequency_hz)
                self._due[command.channel] = Pulse(command.channel, counter, True, *levels)

    def _unasked(self, t_ns: int, packet: Packet) -> bool:
        if packet.command == Code.INIT:
            self._restarted(t_ns, "the stimulator restarted, or its watchdog ended our session")
        elif packet.command == Code.STIMULATION_ERROR:
            self.report_error(t_ns, codec.error_text(codec.signed(packet.data)))
        else:
            return False
        return True

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result = codec.signed(packet.data) if packet.data else -1
        if result:
            self._count_rejected()
        fault = fault or codec.result_text(result)
        if packet.command == Code.GET_MODE + 1:
            if not fault and packet.data[1:2] == b"\0":
                self._restarted(t_ns, "the stimulator has forgotten its channel list: it restarted, or was stopped")
            else:
                self._alive(t_ns, fault)
        for pulse in awaited.pulses:
            self._confirm(t_ns, pulse, fault, pulses=1)
