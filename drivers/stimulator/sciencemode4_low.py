"""HASOMED P24 and RehaMove3 in low level: every pulse is a command of its own, and none comes without one.

When the controller dies, the last pulse it asked for is the last one delivered. The device queues up to ten pulses; at
most two of a channel are ever unanswered, so that none is delivered late.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, Final

from drivers.stimulator import sciencemode4_codec as codec
from drivers.stimulator.answers import Awaited, Pulse
from drivers.stimulator.pulse_train import PulseTrain
from drivers.stimulator.sciencemode4_codec import Code, Result
from drivers.stimulator.sciencemode_framing import Packet
from drivers.stimulator.sciencemode_port import ScienceModePort
from drivers.stimulator.serial_line import Line
from fes.signals import StimCommand, WireFrame

ASK_EVERY_NS: Final = 250_000_000
LEVEL_NAMES: Final = ("not initialised", "low level", "mid level", "mid level, running")
LOW_LEVEL: Final = 1


class LowLevelStimulator(ScienceModePort):
    """:class:`~drivers.stimulator.port.StimulatorPort` for ScienceMode4 low level.

    Args:
        line: to the device; the port owns it.
        session_id: for the log only, the device has no sessions.
        channels: 8 for the P24, 4 for the RehaMove3.
    """

    one_pulse_per_command: ClassVar[bool] = True
    current_step_ma: ClassVar[float] = codec.CURRENT_STEP_MA
    numbers: ClassVar[int] = codec.NUMBERS
    identifiers: ClassVar[int] = 0x4000_0000
    greetings: ClassVar[frozenset[int]] = frozenset((identifiers + Code.LOW_INIT,))

    def __init__(self, line: Line, session_id: int, channels: int = codec.CHANNELS) -> None:
        super().__init__(line, codec.Decoder(), session_id)
        self._trains = tuple(PulseTrain() for _ in range(channels))
        self._asked_ns: int | None = None

    def _greet(self, t_ns: int, deadline_ns: int, clock_ns: Callable[[], int], frames: list[WireFrame]) -> str:
        return initialise(self._ask(codec.low_init, t_ns, deadline_ns, clock_ns, frames))

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        packets: list[Packet] = []
        if command.on:
            packets = self._pulse(command, counter)
        elif 0 <= command.channel < len(self._trains):
            self._trains[command.channel].off()
        if self._asked_ns is None or command.t_ns - self._asked_ns >= ASK_EVERY_NS:
            self._asked_ns = command.t_ns
            packets.append(self._expect(Packet(self._next_number(), Code.STIM_STATUS), command.t_ns))
        return packets

    def _pulse(self, command: StimCommand, counter: int) -> list[Packet]:
        channel = command.channel
        if not 0 <= channel < len(self._trains):
            raise ValueError(f"channel {channel}; this stimulator has 0 to {len(self._trains) - 1}")
        points = codec.biphasic(command.current_ma, command.pulse_width_us)
        if not math.isfinite(command.frequency_hz):
            raise ValueError(f"frequency_hz = {command.frequency_hz!r} must be a finite number")
        if not points or not self._trains[channel].due(command.t_ns, command.frequency_hz):
            return []
        if why := self._answers.room(channel, command.t_ns):
            self._withheld(command, counter, why)
            return []
        packet = codec.low_pulse(self._next_number(), channel, points)
        current_ma, width_us = points[0].steps * codec.CURRENT_STEP_MA, float(points[0].width_us)
        pulse = Pulse(channel, counter, True, current_ma, width_us, command.frequency_hz)
        return [self._expect(packet, command.t_ns, (pulse,))]

    def _unasked(self, t_ns: int, packet: Packet) -> bool:
        return told_of_an_error(self, t_ns, packet)

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result = packet.data[0] if packet.data else int(Result.TRANSFER)
        fault = fault or codec.result_text(result)
        if result:
            self._count_rejected()
        if packet.command == Code.STIM_STATUS + 1:
            level = packet.data[1] if len(packet.data) > 1 else 0
            if not fault and level != LOW_LEVEL:
                name = LEVEL_NAMES[level] if level < len(LEVEL_NAMES) else f"in state {level}"
                self._restarted(t_ns, f"the stimulator is {name} though we had it in low level: it restarted")
            else:
                self._alive(t_ns, fault)
            return
        for pulse in awaited.pulses:
            if not fault and len(packet.data) > 1 and _named_channel(packet.data[1]) != pulse.channel:
                fault = f"the answer names channel {_named_channel(packet.data[1])}"
            self._confirm(t_ns, pulse, fault, pulses=1)
        if result == Result.NOT_INITIALISED:
            self._restarted(t_ns, codec.result_text(result))

    def _encode(self, packet: Packet) -> bytes:
        return codec.encode(packet)


def initialise(answer: Packet | None) -> str:
    """What is wrong with the answer to an initialisation; "" for nothing."""
    if answer is None:
        return (
            "no stimulator answered. Is it switched on, is this the right port, is it a P24 or RehaMove3? Answers that "
            "are garbled speak for a wrong baud rate."
        )
    if answer.data[:1] != b"\0":
        return f"the stimulator refused to start: {codec.result_text(answer.data[0] if answer.data else 1)}"
    return ""


def told_of_an_error(port: ScienceModePort, t_ns: int, packet: Packet) -> bool:
    """Whether this was one of the device's own error messages; it is then reported."""
    if packet.command not in (Code.GENERAL_ERROR, Code.UNKNOWN_COMMAND):
        return False
    port.report_error(t_ns, codec.result_text(packet.data[0] if packet.data else int(Result.TRANSFER)))
    return True


def _named_channel(byte: int) -> int:
    """Channel in the low half, connector in the high half."""
    return (byte & 0x0F) + codec.CHANNELS_PER_CONNECTOR * (byte >> 4)
