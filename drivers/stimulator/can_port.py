"""The CAN stimulator behind a python-can bus: the thin part between the codec and the wire.

It keeps account of which commands are answered, whether each answer says what was asked, and which are overdue.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final

import can

from drivers.stimulator import can_codec
from drivers.stimulator.bus import read_frame, silence_hint, write_frame
from drivers.stimulator.can_codec import Alive, Charge, Fault, Frame, Message, Result, Status, fault_text
from drivers.stimulator.e2e import COUNTS, NUMBERS, carried, command_number
from drivers.stimulator.port import SessionUsed, StimulatorLost
from fes import limits
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

REMEMBERED: Final = 128  # commands: more than are sent until one is overdue, 36 with 8 channels at 100 Hz
ANSWER_WITHIN_MS: Final = 45  # two command periods and some: the next command, 20 ms later, is the one retry
HEARTBEAT_WITHIN_MS: Final = 350  # NODE_ALIVE comes every 100 ms
POLL_AT_MOST: Final = 128  # frames per poll: a flooded bus must not hold the control loop
COUNTERS: Final = COUNTS
OPEN_AGAIN_AFTER_ALIVES: Final = 3  # without our session in them: SESSION_OPEN was lost, or refused
_SESSION_GONE: Final = "the stimulator has not our session open (it restarted, or another controller took it)"
_HALF_STEPS: Final = (("current_ma", 0.25, "mA"), ("pulse_width_us", 0.5, "µs"), ("frequency_hz", 0.5, "Hz"))


class CommandAnswers:
    """Commands sent and not yet answered. An answer settles its channel's older ones: what they asked for is past.

    ``in_real_time``: whether ``t_ns`` is the time on the wall; lateness means nothing otherwise, nothing is overdue.
    """

    def __init__(self, *, in_real_time: bool) -> None:
        self._in_real_time = in_real_time
        self._waiting: deque[tuple[int, StimCommand, int]] = deque(maxlen=REMEMBERED)
        self._heartbeat_ns: int | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def sent(self, number: int, command: StimCommand, written_ns: int | None = None) -> None:
        """The session's command of this number went out, at ``written_ns``; None: at its own time.

        The device cannot answer before the bytes are on their way, and a loop that was held up between deciding and
        writing has taken that time itself.
        """
        self._waiting.append((number, command, command.t_ns if written_ns is None else written_ns))

    def settle(self, number: int, status: Status) -> str:
        """Take in an answer to the command of this number; how what is delivered differs from it, "" when it does not.

        An answer to nothing that waits (the end of a lease, a repetition) is held against nothing.
        """
        for position in range(len(self._waiting) - 1, -1, -1):
            asked, command, _ = self._waiting[position]
            if asked == number and command.channel == status.channel:
                for entry in list(self._waiting)[: position + 1]:
                    if entry[1].channel == status.channel:
                        self._waiting.remove(entry)
                return _difference(command, status)
        return ""

    def heartbeat(self, t_ns: int) -> None:
        """The node's heartbeat came."""
        self._heartbeat_ns = t_ns

    def overdue(self, t_ns: int) -> StimCommand | None:
        """The oldest command that waits longer than it may; all that wait are then forgotten, to be reported once.

        One lost answer is none yet: the next command, 20 to 30 ms later, is the retry, and its answer settles both.
        """
        if self._in_real_time and self._waiting and t_ns - self._waiting[0][2] > ANSWER_WITHIN_MS * 1_000_000:
            command = self._waiting[0][1]
            self._waiting.clear()
            return command
        return None

    def silent(self, t_ns: int) -> bool:
        """Whether the heartbeat has stopped; reported once for every 350 ms of silence."""
        if not self._in_real_time or self._heartbeat_ns is None:
            return False
        silent = t_ns - self._heartbeat_ns > HEARTBEAT_WITHIN_MS * 1_000_000
        self._heartbeat_ns = t_ns if silent else self._heartbeat_ns
        return silent


def _difference(command: StimCommand, status: Status) -> str:
    if status.result:  # it says itself that it did not do as commanded, and why
        return ""
    if status.on != command.on:
        return f"commanded {'on' if command.on else 'off'}, delivered {'on' if status.on else 'off'}"
    if not command.on:
        return ""
    wrong = [
        f"{name.rsplit('_', 1)[0].replace('_', ' ')} commanded {wanted:g} {unit}, delivered {got:g} {unit}"
        for name, half_step, unit in _HALF_STEPS
        if abs((got := getattr(status, name)) - (wanted := getattr(command, name))) > half_step + 1e-6
    ]
    return ", ".join(wrong)


@dataclass(slots=True)
class CommandEncoder:
    """Gives a session's commands their numbers; the same commands give the same bytes, bus or no bus."""

    session_id: int
    number: int = 0
    begun_ns: int = 0

    @property
    def counter(self) -> int:
        """What the answer to the next command will carry."""
        return self.number % COUNTERS

    def encode(self, command: StimCommand) -> Frame:
        """The command's frame; the number advances only when the command can be encoded."""
        begun_ns = self.begun_ns if self.number else command.t_ns
        frame = can_codec.encode_command(command, self.number, self.session_id, begun_ns)
        self.begun_ns = begun_ns
        self.number += 1
        return frame

    def is_recent(self, session_id: int) -> bool:
        """Whether an answer with this identifier is to one of the newest commands: as opened, or as they carried it."""
        oldest = max(0, self.number - COUNTERS)
        recent = (carried(self.session_id, number)[0] for number in (self.number, oldest))
        return session_id == self.session_id or session_id in recent


@dataclass(frozen=True, slots=True)
class Handshake:
    """What opening a session put on the wire and heard from the node, for the log."""

    boot_id: int
    frames: tuple[WireFrame, ...]
    alive: tuple[StimAlive, ...]


class CanStimulator:
    """Port (:mod:`drivers.stimulator.port`) on an open bus, which it then owns.

    Call :meth:`open` once before the first command. ``foreign`` counts frames that were not for us: other
    identifiers, other sessions, wrong CRCs, repeated heartbeats (not controllers' frames: multicast returns our own).

    Args:
        in_real_time: the times passed in are the wall's, so that a late answer and a silent heartbeat are faults. A
            node that has not our session open any more is first reported and then lost, to be opened again.
        clock_ns: the wall's clock, read when a command is written, for its answer's time counts from there; None: it
            counts from the command's own time.
        validity_ms: of every command, as the session is opened with it.
    """

    current_step_ma: ClassVar[float] = can_codec.CURRENT_STEP_MA
    heard: ClassVar[bytes] = b""  # what goes out depends on no answer

    def __init__(
        self,
        bus: can.BusABC,
        session_id: int,
        *,
        in_real_time: bool = False,
        clock_ns: Callable[[], int] | None = None,
        validity_ms: int = limits.MAX_VALIDITY_MS,
    ) -> None:
        self.session_id = session_id
        self.foreign = 0
        self._bus = bus
        self._encoder = CommandEncoder(session_id)
        self._answers = CommandAnswers(in_real_time=in_real_time)
        self._in_real_time, self._clock_ns, self._validity_ms = in_real_time, clock_ns, validity_ms
        self._answered: dict[int, int] = {}  # by channel, the number of the newest command that was
        self._session_gone = False
        self._boot_id = 0
        self._totals: dict[int, Charge] = {}
        self._delivered: dict[int, tuple[int, int]] = {}
        self._alive_counter = -1
        self._closed = False

    @property
    def outstanding(self) -> int:
        """Commands sent and not yet answered, 128 at most; an answer settles its channel's older ones."""
        return len(self._answers)

    def open(self, t_ns: int, timeout_s: float = 2.0, clock_ns: Callable[[], int] = time.monotonic_ns) -> Handshake:
        """Wait for the node's heartbeat, open the session for its boot id, wait until the heartbeat names it.

        Waits at most ``timeout_s`` by ``clock_ns``; everything sent and heard is stamped ``t_ns``. A node that
        restarts meanwhile is opened again under its new boot id.

        Raises:
            SessionUsed: the node has had commands under this session's identifier; another one may be opened.
            StimulatorLost: nobody answered, or the node did not open the session; the message says what to check.
        """
        deadline_ns = clock_ns() + int(timeout_s * NS_PER_S)
        frames: list[WireFrame] = []
        heard: list[StimAlive] = []
        asked_boot_id, alives_since = -1, 0
        last: Alive | None = None
        while (left_ns := deadline_ns - clock_ns()) > 0:
            raw = read_frame(self._bus, left_ns / NS_PER_S)
            message = None if raw is None else self._decoded(raw)
            if not isinstance(message, Alive):
                continue
            last = message
            if message.version != can_codec.PROTOCOL_VERSION:
                break
            heard.append(self._alive(message, t_ns, expect_session=False))
            if message.boot_id == asked_boot_id and message.session_id == self.session_id:
                self._alive_counter = message.counter
                return Handshake(message.boot_id, tuple(frames), tuple(heard))
            if message.boot_id == asked_boot_id and message.faults & Fault.SESSION_USED:
                raise SessionUsed(self._why_not_open(message, timeout_s))
            alives_since += 1
            if message.boot_id != asked_boot_id or alives_since >= OPEN_AGAIN_AFTER_ALIVES:
                asked_boot_id, alives_since = message.boot_id, 0
                frames.append(
                    WireFrame(
                        t_ns, *can_codec.encode_open(asked_boot_id, self.session_id, validity_ms=self._validity_ms)
                    )
                )
                write_frame(self._bus, frames[-1].identifier, frames[-1].data)
        raise StimulatorLost(self._why_not_open(last, timeout_s))

    def send(self, command: StimCommand) -> WireFrame:
        """Write the command's frame now or fail.

        Raises:
            StimulatorLost: the bus did not take it (transmit buffer full, bus off, interface gone), or the session has
                used all its numbers.
            ValueError: a value does not fit its field, or the command is to hold for less than the session's validity;
                nothing was sent.
        """
        if command.validity_ms < self._validity_ms // can_codec.VALIDITY_STEP_MS * can_codec.VALIDITY_STEP_MS:
            raise ValueError(f"validity_ms = {command.validity_ms}: the session was opened with {self._validity_ms}")
        if self._encoder.number == NUMBERS:
            raise StimulatorLost(f"{self._bus.channel_info}: the session has no numbers left for commands")
        number = self._encoder.number
        frame = WireFrame(command.t_ns, *self._encoder.encode(command))
        write_frame(self._bus, frame.identifier, frame.data)
        self._answers.sent(number, command, self._clock_ns() if self._clock_ns else None)
        return frame

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """All that has arrived from the node, at most 128 frames, stamped ``t_ns``.

        StimulatorLost: the bus cannot be read, the adapter reports bus-off, or our session is gone.
        """
        if self._session_gone and self._in_real_time:
            raise StimulatorLost(f"{self._bus.channel_info}: {_SESSION_GONE}")
        events: list[StimStatus | StimAlive] = []
        for _ in range(POLL_AT_MOST):
            raw = read_frame(self._bus, 0.0)
            if raw is None:
                break
            message = self._decoded(raw)
            if isinstance(message, Alive):
                if message.counter == self._alive_counter:
                    self.foreign += 1
                    continue
                self._alive_counter = message.counter
                events.append(self._alive(message, t_ns, expect_session=True))
            elif isinstance(message, Charge):
                self._totals[message.channel] = message
            elif isinstance(message, Status) and (status := self._status(message, t_ns)) is not None:
                events.append(status)
        if command := self._answers.overdue(t_ns):
            fault = f"no answer within {ANSWER_WITHIN_MS} ms"
            events.append(StimStatus(t_ns, command.channel, self._encoder.counter, False, 0.0, 0.0, 0.0, fault=fault))
        if self._answers.silent(t_ns):
            events.append(StimAlive(t_ns, self._boot_id, 0, f"no heartbeat for {HEARTBEAT_WITHIN_MS} ms"))
        return events

    def close(self) -> None:
        """Shut the bus down; sends nothing."""
        if not self._closed:
            self._closed = True
            with contextlib.suppress(can.CanError, OSError):  # an adapter that is gone cannot be shut down
                self._bus.shutdown()

    def _status(self, status: Status, t_ns: int) -> StimStatus | None:
        """The answer as an event; None, and counted, where one to this command or a later one came before."""
        number = command_number(self.session_id, status.session_id, status.counter)
        charge = self._totals.pop(status.channel, None)
        if status.result is Result.OK:
            if not self._answered.get(status.channel, -1) < number < self._encoder.number:
                self.foreign += 1
                return None
            self._answered[status.channel] = number
        different = self._answers.settle(number, status)
        if status.result is Result.BAD_SESSION:
            self._session_gone = True
        seen_pulses, seen_steps = self._delivered.get(status.channel, (0, 0))
        pulses, steps = seen_pulses, seen_steps
        if charge and (charge.session_id, charge.counter) == (
            status.session_id,
            status.counter % 2**can_codec.COUNTER_LOW,
        ):
            pulses, steps = charge.pulses_total, charge.charge_total_steps
        self._delivered[status.channel] = (pulses, steps)
        levels = (status.current_ma, status.pulse_width_us, status.frequency_hz)
        new_pulses = (pulses - seen_pulses) % can_codec.PULSES_TOTAL
        charge_uc = ((steps - seen_steps) % can_codec.CHARGE_TOTAL_STEPS) * can_codec.CHARGE_STEP_UC
        fault = status.result.words or different
        return StimStatus(t_ns, status.channel, status.counter, status.on, *levels, new_pulses, charge_uc, fault)

    def _alive(self, alive: Alive, t_ns: int, *, expect_session: bool) -> StimAlive:
        fault = fault_text(alive.faults)
        if expect_session and alive.session_id != self.session_id:
            self._session_gone = True
            fault = f"{_SESSION_GONE}; {fault}" if fault else _SESSION_GONE
        self._boot_id = alive.boot_id
        self._answers.heartbeat(t_ns)
        return StimAlive(t_ns, alive.boot_id, alive.rejected, fault)

    def _decoded(self, raw: can.Message) -> Message | None:
        """The node's message when it is intact and of our session; None, and counted, otherwise."""
        if raw.arbitration_id in can_codec.NODE_IDS and not raw.is_extended_id and not raw.is_remote_frame:
            try:
                message = can_codec.decode(raw.arbitration_id, bytes(raw.data))
            except can_codec.FrameRejected:
                self.foreign += 1
                return None
            if isinstance(message, Alive) or self._encoder.is_recent(message.session_id):
                return message
        if raw.arbitration_id not in can_codec.CONTROLLER_IDS:
            self.foreign += 1
        return None

    def _why_not_open(self, last: Alive | None, timeout_s: float) -> str:
        where = self._bus.channel_info
        if last is None:
            return (
                f"no stimulator was heard on {where} within {timeout_s:g} s ({self.foreign} other frames were). "
                + silence_hint(self._bus)
            )
        if last.version != can_codec.PROTOCOL_VERSION:
            return (
                f"the stimulator on {where} speaks protocol version {last.version}, this program "
                f"{can_codec.PROTOCOL_VERSION}: update the older one"
            )
        why = fault_text(last.faults) or "it named no reason; does another controller use it?"
        return (
            f"the stimulator on {where} (boot id {last.boot_id}) did not open session {self.session_id} within "
            f"{timeout_s:g} s: {why}"
        )


class ByteSink:
    """For replays without a device: encodes exactly as :class:`CanStimulator` does and sends nothing."""

    outstanding = 0

    def __init__(self, session_id: int, validity_ms: int = limits.MAX_VALIDITY_MS) -> None:
        self.session_id = session_id
        self._encoder = CommandEncoder(session_id)
        self._validity_ms = validity_ms

    def open(self, t_ns: int, boot_id: int) -> WireFrame:
        """The SESSION_OPEN that a node with this boot id would have got."""
        return WireFrame(t_ns, *can_codec.encode_open(boot_id, self.session_id, validity_ms=self._validity_ms))

    def send(self, command: StimCommand) -> WireFrame:
        """The command's frame. ValueError: a value does not fit its field."""
        return WireFrame(command.t_ns, *self._encoder.encode(command))

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Nothing ever arrives."""
        return []

    def close(self) -> None:
        """Nothing to release."""
