"""HASOMED P24 and RehaMove3 by ScienceMode4, in low level and in mid level.

Low level: every pulse is a command of its own, and none comes without one. When the controller dies, the last pulse it
asked for is the last one delivered. The device queues up to ten pulses; at most two of a channel are ever unanswered,
so that none is delivered late.

Mid level: the device repeats the pulses by itself until it gets another command. It stops by itself no sooner than
**2 s** after the last update or question. That is as long as a whole stance: a controller that dies in mid-swing leaves
the muscle stimulated through it. So a session must accept this in its settings (``accept_watchdog_s = 2.0``); low level
has no such tail. What the host can do, it does: questions go out only as part of a command, and *off* goes out at once.
"""

import math
from typing import ClassVar, Final

from drivers.stimulator.port import Awaited, Pulse, PulseTrain
from drivers.stimulator.sciencemode import sciencemode4_codec as codec
from drivers.stimulator.sciencemode.framing import Packet
from drivers.stimulator.sciencemode.port import Opening, ScienceModePort
from drivers.stimulator.sciencemode.sciencemode4_codec import Code, Result, Train
from drivers.stimulator.serial_line import Line
from fes.signals import StimCommand

ASK_EVERY_NS: Final = 250_000_000
LEVEL_NAMES: Final = ("not initialised", "low level", "mid level", "mid level, running")
LOW_LEVEL: Final = 1
WATCHDOG_S: Final = 2.0
_CHANNEL_ERRORS: Final = (Result.OK, Result.ELECTRODE, Result.PULSE_TIMEOUT, Result.LOW_CURRENT)


class _P24(ScienceModePort):
    """What both levels share; ``channels`` is 8 for the P24, 4 for the RehaMove3.

    The port owns ``line``; ``session_id`` is for the log only, the device has no sessions.
    """

    current_step_ma: ClassVar[float] = codec.CURRENT_STEP_MA
    numbers: ClassVar[int] = codec.NUMBERS
    identifiers: ClassVar[int] = 0x4000_0000
    initialisation: ClassVar[tuple[Code, bytes]]

    def __init__(self, line: Line, session_id: int, channels: int) -> None:
        super().__init__(line, codec.Decoder(), codec.encode, session_id)
        self._channels = channels
        self._asked_ns: int | None = None

    def _greet(self, opening: Opening) -> str:
        answer = self._request(opening, *self.initialisation)
        if answer is None:
            return (
                "no stimulator answered. Is it switched on, is this the right port, is it a P24 or RehaMove3? Answers "
                "that are garbled speak for a wrong baud rate."
            )
        if answer.data[:1] != b"\0":
            return f"the stimulator refused to start: {codec.result_text(answer.data[0] if answer.data else 1)}"
        return ""

    def _points(self, command: StimCommand) -> codec.Points:
        if not 0 <= command.channel < self._channels:
            raise ValueError(f"channel {command.channel}; this stimulator has 0 to {self._channels - 1}")
        return codec.biphasic(command.current_ma, command.pulse_width_us)

    def _question_due(self, t_ns: int) -> bool:
        """Whether the device is to be asked for its state with this command; remembers it if so."""
        due = self._asked_ns is None or t_ns - self._asked_ns >= ASK_EVERY_NS
        self._asked_ns = t_ns if due else self._asked_ns
        return due

    def _unasked(self, t_ns: int, packet: Packet) -> bool:
        if packet.command not in (Code.GENERAL_ERROR, Code.UNKNOWN_COMMAND):
            return False
        self.report_error(t_ns, codec.result_text(_result(packet)))
        return True

    def _count_result(self, packet: Packet, fault: str) -> tuple[int, str]:
        """The answer's result, and what is wrong with it: its turn, else what the result says."""
        result = _result(packet)
        if result:
            self._count_rejected()
        return result, fault or codec.result_text(result)


def _result(packet: Packet) -> int:
    return packet.data[0] if packet.data else int(Result.TRANSFER)


def _level(command: StimCommand, counter: int, points: codec.Points, frequency_hz: float) -> Pulse:
    """What of a command the device delivers: current and width in its steps."""
    current_ma, width_us = points[0].steps * codec.CURRENT_STEP_MA, float(points[0].width_us)
    return Pulse(command.channel, counter, True, current_ma, width_us, frequency_hz)


class LowLevelStimulator(_P24):
    """Port (:mod:`drivers.stimulator.port`) for ScienceMode4 low level."""

    one_pulse_per_command: ClassVar[bool] = True
    initialisation: ClassVar[tuple[Code, bytes]] = (Code.LOW_INIT, b"\0")  # no measuring, the standard high voltage
    greetings: ClassVar[frozenset[int]] = frozenset((_P24.identifiers + Code.LOW_INIT,))

    def __init__(self, line: Line, session_id: int, channels: int = codec.CHANNELS) -> None:
        super().__init__(line, session_id, channels)
        self._trains = tuple(PulseTrain() for _ in range(channels))

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        packets: list[Packet] = []
        if command.on:
            packets = self._pulse(command, counter)
        elif 0 <= command.channel < len(self._trains):
            self._trains[command.channel].off()
        if self._question_due(command.t_ns):
            packets.append(self._expect(Packet(self._next_number(), Code.STIM_STATUS), command.t_ns))
        return packets

    def _pulse(self, command: StimCommand, counter: int) -> list[Packet]:
        channel = command.channel
        points = self._points(command)
        if not math.isfinite(command.frequency_hz):
            raise ValueError(f"frequency_hz = {command.frequency_hz!r} must be a finite number")
        if not points or not self._trains[channel].due(command.t_ns, command.frequency_hz):
            return []
        if why := self._answers.room(channel, command.t_ns):
            self._withheld(command, counter, why)
            return []
        packet = codec.low_pulse(self._next_number(), channel, points)
        return [self._expect(packet, command.t_ns, (_level(command, counter, points, command.frequency_hz),))]

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result, fault = self._count_result(packet, fault)
        if packet.command == Code.STIM_STATUS + 1:
            level = packet.data[1] if len(packet.data) > 1 else 0
            if not fault and level != LOW_LEVEL:
                name = LEVEL_NAMES[level] if level < len(LEVEL_NAMES) else f"in state {level}"
                self._restarted(t_ns, f"the stimulator is {name} though we had it in low level: it restarted")
            else:
                self._alive(t_ns, fault)
            return
        for pulse in awaited.pulses:
            if not fault and len(packet.data) > 1:
                connector, within = divmod(packet.data[1], 16)
                named = within + codec.CHANNELS_PER_CONNECTOR * connector
                fault = f"the answer names channel {named}" if named != pulse.channel else ""
            self._confirm(t_ns, pulse, fault, pulses=1)
        if result == Result.NOT_INITIALISED:
            self._restarted(t_ns, codec.result_text(result))


def not_accepted(accept_watchdog_s: float) -> str:
    """ "" when the session accepts the device's watchdog, else what it must know."""
    if accept_watchdog_s >= WATCHDOG_S:
        return ""
    return (
        f"in mid level the stimulator goes on for up to {WATCHDOG_S:g} s after the controller has died. Use "
        f'device = "p24_low_level", or accept it with stimulator.options.accept_watchdog_s = {WATCHDOG_S:g}'
    )


class MidLevelStimulator(_P24):
    """Port (:mod:`drivers.stimulator.port`) for ScienceMode4 mid level.

    The device counts no pulses, so its :class:`StimStatus` carry none. Ramps are the plan's; the device's are not used.

    Raises:
        ValueError: ``accept_watchdog_s`` is less than the device's watchdog.
    """

    one_pulse_per_command: ClassVar[bool] = False
    initialisation: ClassVar[tuple[Code, bytes]] = (Code.MID_INIT, b"\x01")  # stop on all errors
    greetings: ClassVar[frozenset[int]] = frozenset((_P24.identifiers + Code.MID_INIT,))

    def __init__(
        self, line: Line, session_id: int, channels: int = codec.CHANNELS, *, accept_watchdog_s: float
    ) -> None:
        if why := not_accepted(accept_watchdog_s):
            raise ValueError(why)
        super().__init__(line, session_id, channels)
        self._trains: dict[int, Train] = {}
        self._levels: dict[int, Pulse] = {}
        self._must_stop = False

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        train: Train | None = None
        if command.on and (points := self._points(command)):
            train = Train(points, codec.period_steps(command.frequency_hz))
        packets: list[Packet] = []
        if self._must_stop:
            self._must_stop = False
            packets.append(self._expect(Packet(self._next_number(), Code.MID_STOP), command.t_ns))
        if train != self._trains.get(command.channel):
            packets += self._update(command, counter, train)
        if self._question_due(command.t_ns):
            active = tuple(self._levels[channel] for channel in sorted(self._trains))
            packets.append(self._expect(codec.mid_current_data(self._next_number()), command.t_ns, active))
        return packets

    def _update(self, command: StimCommand, counter: int, train: Train | None) -> list[Packet]:
        channel = command.channel
        if train is not None and (why := self._answers.room(channel, command.t_ns)):  # off always goes out
            self._withheld(command, counter, why)
            return []
        level = Pulse(channel, counter, False)
        if train is None:
            del self._trains[channel]
        else:
            self._trains[channel] = train
            level = _level(command, counter, train.points, 1000.0 / (train.period_steps * codec.PERIOD_STEP_MS))
        self._levels[channel] = level
        return [self._expect(codec.mid_update(self._next_number(), self._trains), command.t_ns, (level,))]

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result, fault = self._count_result(packet, fault)
        if result == Result.NOT_INITIALISED:
            self._restarted(t_ns, fault)
        if packet.command == Code.MID_CURRENT_DATA + 1:
            self._states(t_ns, packet.data, {pulse.channel: pulse for pulse in awaited.pulses}, fault)
        elif not awaited.pulses:
            self._alive(t_ns, fault)
        for pulse in awaited.pulses if packet.command == Code.MID_UPDATE + 1 else ():
            self._confirm(t_ns, pulse, fault, pulses=0)

    def _states(self, t_ns: int, data: bytes, expected: dict[int, Pulse], fault: str) -> None:
        """The channels as the device sees them, held against what was commanded when it was asked."""
        if not fault and len(data) < 7:
            fault = f"the stimulator's channel states are cut off after {len(data)} bytes"
        self._alive(t_ns, fault)
        if fault and len(data) < 7:
            return
        for channel in range(codec.CHANNELS):
            code = data[3 + channel // 2] >> 4 * (channel % 2) & 0x0F
            active = bool(data[2] >> channel & 1)
            what = codec.result_text(_CHANNEL_ERRORS[code]) if code < len(_CHANNEL_ERRORS) else f"channel error {code}"
            if not what and active and channel not in expected:
                what = "the stimulator goes on though it was told to be off; it will be told to stop"
                self._must_stop = True
            elif not what and not active and channel in expected:
                what = "the stimulator stopped by itself"
            if what:
                counter = expected[channel].counter if channel in expected else 0
                self._confirm(t_ns, Pulse(channel, counter, False), what, pulses=0)
