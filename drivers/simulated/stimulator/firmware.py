"""The simulated CAN stimulator's firmware: frames and time in, frames and pulses out; no I/O, no clock.

It trusts nobody: every command must be intact, of the open session, and numbered 1 to 3 after the last one (one count
over all channels that carries into the session identifier, see ``e2e``: up to two lost frames are forgiven, a repeated
or older frame never acts). Five wrong counts in a row close the session. A command over the node's own limits, or one
that comes later than the session's validity allows, turns its channel off. It boots with everything off and no
session. A session opens only for its own boot id and under an identifier that no executed command has carried since
boot, and ends where its count would carry into one: no number acts twice, so a capture played back later does nothing.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import Final

from drivers.simulated.record import Pulse, RecordEntry
from drivers.stimulator import can_codec
from drivers.stimulator.can_codec import NO_SESSION, Alive, Charge, Command, Fault, Frame, Result, SessionOpen, Status
from drivers.stimulator.e2e import COUNTS, carried, command_number
from fes.signals import NS_PER_S

MAX_ON_NS: Final = 3 * NS_PER_S  # the node's own limit on continuous stimulation
NS_PER_MS: Final = 1_000_000
NEVER: Final = 2**63 - 1
CHANNELS: Final = 8
MAX_CURRENT_MA: Final = 130.0
MAX_PULSE_WIDTH_US: Final = 500.0
MAX_FREQUENCY_HZ: Final = 100.0
MAX_VALIDITY_MS: Final = 60
MAX_COUNTER_STEP: Final = 3
MAX_WRONG_COUNTERS: Final = 5
ALIVE_PERIOD_NS: Final = 100_000_000
ISSUED_TICK_NS: Final = can_codec.ISSUED_STEP_MS * NS_PER_MS
SILENCE_NS: Final = 200 * NS_PER_MS  # without a command; the time of issue comes round after 256 ms
MOST_DRIFT_PPM: Final = 600  # of the controller's clock, which NTP may slew by 500, against the node's
SETTLED_NS: Final = 128 * NS_PER_MS  # by then a controller has noticed that answers do not come, and commands off
SENT_UNHEARD: Final = 64  # numbers that a session may have sent beyond the last one that was heard
_NOTHING: Final = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class NodeFaults:
    """Faults by name; a value below 0 (or 0 for ``drop``) means that the node is sound.

    ``electrode``: this channel's output stage refuses every on command. ``weak``: this channel delivers half of the
    current. ``drop``: every so-manieth STIM_STATUS is lost. ``reboot`` / ``mute``: so many seconds after its start
    the node restarts with another boot id / sends nothing any more.
    """

    electrode: float = -1
    weak: float = -1
    drop: float = 0
    reboot: float = -1.0
    mute: float = -1.0


def parse_faults(text: str) -> NodeFaults:
    """``"electrode=2,reboot=1.5"`` → faults; "" → none.

    ValueError: an unknown name or a value that is no number as this fault needs it.
    """
    values, names = dict(parse_fault_values(text)), ", ".join(NodeFaults.__dataclass_fields__)
    for name, value in values.items():
        if name not in NodeFaults.__dataclass_fields__:
            raise ValueError(f"fault '{name}={value:g}' is not known; write NAME=NUMBER with one of: {names}")
        if name in ("electrode", "weak", "drop") and not value.is_integer():
            raise ValueError(f"fault {name!r}: {value!r} is no whole number")
    return NodeFaults(**values)


def parse_fault_values(text: str) -> list[tuple[str, float]]:
    """``"electrode=2,delay=0.2"`` → names and values; "" → none. ValueError: not of that form."""
    faults: list[tuple[str, float]] = []
    for item in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = item.partition("=")
        try:
            faults.append((name, float(value if equals else "")))
        except ValueError:
            raise ValueError(f"fault {item!r}: write NAME=NUMBER") from None
    return faults


class OutputChannel:
    """One output stage: silent until :meth:`drive`, and again when the lease or the on-time ends.

    Times are the node's own clock. ``levels``: current in mA, pulse width in µs, frequency in Hz, as delivered now.
    ``pulses`` and ``charge_steps`` (0.5 nC, one phase) run since the last :meth:`reset`. ``blocked`` after the
    on-time limit: only an off command releases it.
    """

    def __init__(self) -> None:
        self.made: deque[tuple[int, float, float]] = deque(maxlen=64)  # newest pulses: time, mA, µs; for who takes them
        self.reset()

    def reset(self) -> None:
        """Off, and all counts at zero."""
        self.on = False
        self.blocked = False
        self.must_be_off = False  # nobody knows how late what asks for current is
        self.levels = _NOTHING
        self.answers = 0, NO_SESSION  # count and identifier of the last command accepted
        self.accepted_ns = 0
        self.lease_end_ns = NEVER
        self.on_end_ns = NEVER
        self.last_pulse_ns = -NEVER
        self.next_pulse_ns = NEVER
        self.pulses = 0
        self.charge_steps = 0

    def drive(self, t_ns: int, levels: tuple[float, float, float], validity_ms: int) -> None:
        """Deliver these levels until ``validity_ms`` from now, unless told again before."""
        if not self.on:
            self.on = True
            self.on_end_ns = t_ns + MAX_ON_NS
        self.levels = levels
        self.accepted_ns = t_ns
        self.lease_end_ns = t_ns + validity_ms * NS_PER_MS
        self.next_pulse_ns = max(t_ns, self.last_pulse_ns + self._period_ns()) if levels[2] > 0 else NEVER

    def silence(self) -> None:
        """Off now; the counts stay."""
        self.on = False
        self.levels = _NOTHING
        self.lease_end_ns = self.on_end_ns = self.next_pulse_ns = NEVER

    def next_deadline_ns(self) -> int:
        """When it next has something to do by itself."""
        return min(self.next_pulse_ns, self.lease_end_ns, self.on_end_ns)

    def advance(self, t_ns: int) -> Result | None:
        """Make the pulses due by now; why it fell silent by itself, None when it did not."""
        end_ns = min(self.lease_end_ns, self.on_end_ns)
        while self.next_pulse_ns <= t_ns and self.next_pulse_ns < end_ns:
            self.pulses += 1
            current_ma, width_us, _ = self.levels
            steps = round(current_ma / can_codec.CURRENT_STEP_MA) * round(width_us / can_codec.PULSE_WIDTH_STEP_US)
            self.charge_steps += steps
            self.last_pulse_ns = self.next_pulse_ns
            self.made.append((self.last_pulse_ns, current_ma, width_us))
            self.next_pulse_ns += self._period_ns()
        if end_ns > t_ns:
            return None
        reason = Result.LEASE_EXPIRED if self.lease_end_ns <= self.on_end_ns else Result.ON_TIME
        self.blocked = reason is Result.ON_TIME
        self.silence()
        return reason

    def _period_ns(self) -> int:
        return int(NS_PER_S / self.levels[2])


class IssueClock:
    """How late a command comes, by its time of issue against the least delayed one's.

    That time comes round after 256 ms, so it is followed from command to command; after a silence it begins anew, and
    is ``settled`` 128 ms of commands later: those before may have been decided when the controller had not noticed yet.
    """

    def __init__(self) -> None:
        self._issued_ms: int | None = None
        self._issued_ns = self._arrived_ns = self._least_ns = 0

    def lost(self, t_ns: int) -> bool:
        """Whether the last command is too long ago to say when this one was issued."""
        return self._issued_ms is not None and t_ns - self._arrived_ns >= SILENCE_NS

    def age_ns(self, t_ns: int, issued_ms: int) -> int:
        """Take in an accepted command that comes now; 0 for the first one, and the first after a silence."""
        elapsed_ns = t_ns - self._arrived_ns
        if self._issued_ms is None or self.lost(t_ns):
            self._issued_ns = SETTLED_NS if self._issued_ms is None else 0
            self._least_ns = t_ns - self._issued_ns
        else:
            steps = (issued_ms - self._issued_ms) // can_codec.ISSUED_STEP_MS % can_codec.ISSUED_STEPS
            self._issued_ns += steps * ISSUED_TICK_NS
            drifted_ns = self._least_ns + elapsed_ns * MOST_DRIFT_PPM // 1_000_000
            self._least_ns = min(drifted_ns, t_ns - self._issued_ns)
        self._issued_ms, self._arrived_ns = issued_ms, t_ns
        return t_ns - self._issued_ns - self._least_ns

    @property
    def settled(self) -> bool:
        """Whether the newest command was decided so long after a silence that the controller knew of it."""
        return self._issued_ns >= SETTLED_NS


class StimulatorNode:
    """Call :meth:`receive` for every frame and :meth:`advance` at every deadline; both return what to send."""

    def __init__(self, boot_id: int, t_ns: int, faults: NodeFaults | None = None) -> None:
        self.faults = faults or NodeFaults()
        self.channels = tuple(OutputChannel() for _ in range(CHANNELS))
        self._record: list[RecordEntry] = []
        self._statuses = 0
        self._mute_ns = t_ns + int(self.faults.mute * NS_PER_S) if self.faults.mute >= 0 else NEVER
        self._reboot_ns = t_ns + int(self.faults.reboot * NS_PER_S) if self.faults.reboot >= 0 else NEVER
        self._boot(t_ns, boot_id)

    def receive(self, t_ns: int, identifier: int, data: bytes) -> list[Frame]:
        """Act on one frame from the bus; frames that no controller sends are passed over."""
        frames = self._pass_time(t_ns)
        if identifier in can_codec.CONTROLLER_IDS:
            try:
                message = can_codec.decode(identifier, data)
            except can_codec.FrameRejected as error:
                self._refuse(t_ns, -1, str(error))
            else:
                if isinstance(message, Command):
                    frames += self._command(t_ns, message)
                elif isinstance(message, SessionOpen):
                    frames += self._open(t_ns, message)
        return self._frames_out(t_ns, frames)

    def advance(self, t_ns: int) -> list[Frame]:
        """Do all that is due by ``t_ns``: pulses, ends of leases, the heartbeat."""
        return self._frames_out(t_ns, self._pass_time(t_ns))

    def next_deadline_ns(self) -> int:
        """When :meth:`advance` must be called again at the latest."""
        return min(self._next_alive_ns, self._reboot_ns, *(channel.next_deadline_ns() for channel in self.channels))

    def power_off(self, t_ns: int) -> None:
        """Silence every channel; nothing is sent."""
        for number in range(CHANNELS):
            self._off(t_ns, number, "off")

    def set_fault(self, t_ns: int, name: str, value: float) -> None:
        """Bring a fault of :class:`NodeFaults` about while the node runs; ``reboot`` after ``value`` seconds.

        ValueError: no such fault.
        """
        if name == "reboot":
            self._reboot_ns = t_ns + int(value * NS_PER_S)
        elif name in ("electrode", "weak"):
            self.faults = replace(self.faults, **{name: int(value)})
            if name == "electrode" and value < 0:
                self.flags &= ~Fault.OUTPUT
        else:
            raise ValueError(f"fault {name!r} is not known; one of electrode, weak, reboot")

    def take_record(self) -> list[RecordEntry]:
        """What happened since the last call."""
        entries, self._record = self._record, []
        return entries

    def take_pulses(self) -> list[Pulse]:
        """The pulses since the last call, but no more than the newest 64 of each channel."""
        pulses = [Pulse(t_ns, n, *levels) for n, channel in enumerate(self.channels) for t_ns, *levels in channel.made]
        for channel in self.channels:
            channel.made.clear()
        return pulses

    def _boot(self, t_ns: int, boot_id: int) -> None:
        self.boot_id = boot_id
        self.session_id = NO_SESSION
        self.rejected = 0
        self.flags = Fault.NONE
        self._used_ids: set[int] = set()
        self._number = -1
        self._validity_ms = 0
        self._clock = IssueClock()
        self._carried_id = NO_SESSION
        self._commanded = False
        self._wrong_counters = 0
        self._alive_counter = 0
        self._next_alive_ns = t_ns
        for channel in self.channels:
            channel.reset()
        self._note(t_ns, "boot", detail=f"boot id {boot_id}")

    def _pass_time(self, t_ns: int) -> list[Frame]:
        frames: list[Frame] = []
        for number, channel in enumerate(self.channels):
            reason = channel.advance(t_ns)
            if reason is not None:
                self._note(t_ns, "lease_expired" if reason is Result.LEASE_EXPIRED else "on_time", number)
                frames += self._status(number, *channel.answers, reason)
        if self._reboot_ns <= t_ns:
            self._reboot_ns = NEVER
            self._boot(t_ns, (self.boot_id + 1) % 2**16)
        if self._next_alive_ns <= t_ns:
            frames.append(self._alive())
            self._next_alive_ns = max(self._next_alive_ns + ALIVE_PERIOD_NS, t_ns)
        return frames

    def _open(self, t_ns: int, request: SessionOpen) -> list[Frame]:
        if request.version != can_codec.PROTOCOL_VERSION:
            self.flags |= Fault.VERSION
            self._refuse(t_ns, -1, f"session: protocol version {request.version}")
        elif request.boot_id != self.boot_id:
            self._refuse(t_ns, -1, f"session: boot id {request.boot_id}")
        elif request.session_id == self.session_id and not self._commanded:
            pass  # asked twice because our answer was late or lost; there is nothing to reset yet
        elif not 0 < request.validity_ms <= MAX_VALIDITY_MS:
            self.flags |= Fault.VALIDITY
            self._refuse(t_ns, -1, f"session: validity {request.validity_ms} ms")
        elif request.session_id == NO_SESSION or request.session_id in self._used_ids:
            self.flags |= Fault.SESSION_USED
            self._refuse(t_ns, -1, f"session: identifier {request.session_id} used before")
        else:
            for number in range(CHANNELS):
                self._off(t_ns, number, "off")
                self.channels[number].reset()
            self._retire()
            self.session_id, self._validity_ms, self._clock = request.session_id, request.validity_ms, IssueClock()
            self._used_ids.add(request.session_id)
            self.flags = Fault.NONE
            self._number, self._carried_id, self._wrong_counters = -1, request.session_id, 0
            self._commanded = False
            self._note(t_ns, "session", detail=f"session {request.session_id}")
        return [self._alive()]

    def _command(self, t_ns: int, command: Command) -> list[Frame]:
        channel = self.channels[command.channel]
        number = command_number(self.session_id, command.session_id, command.counter)
        result = self._judge(t_ns, command, number, channel)
        frames: list[Frame] = []
        if result in (Result.BAD_SESSION, Result.BAD_COUNTER, Result.FAULTED):
            self._wrong_counters += result is Result.BAD_COUNTER
            if result is Result.BAD_COUNTER and self._wrong_counters >= MAX_WRONG_COUNTERS:
                frames = self._close(t_ns, Fault.COUNTER)
        elif command.session_id != self._carried_id and command.session_id in self._used_ids:
            result = Result.FAULTED
            frames = self._close(t_ns, Fault.SESSION_USED)
        else:
            self._number, self._wrong_counters = number, 0
            self._carried_id = command.session_id
            self._used_ids.add(command.session_id)
            self._commanded = True
            channel.answers = command.counter, command.session_id
            if result is Result.OK and command.on:
                self._on(t_ns, command)
            else:
                self._off(t_ns, command.channel, "off")
        if result is Result.OK:
            channel.blocked = channel.blocked and command.on
            channel.must_be_off = channel.must_be_off and (command.on or not self._clock.settled)
        else:
            self._refuse(t_ns, command.channel, result.name.lower())
        return frames + self._status(command.channel, command.counter, command.session_id, result)

    def _judge(self, t_ns: int, command: Command, number: int, channel: OutputChannel) -> Result:
        if self.flags & Fault.COUNTER:
            return Result.FAULTED
        if NO_SESSION in (self.session_id, command.session_id):
            return Result.BAD_SESSION
        if abs(number // COUNTS - self._number // COUNTS) > 1:  # not the identifier expected, nor one next to it
            return Result.BAD_SESSION
        if not 1 <= number - self._number <= MAX_COUNTER_STEP:
            return Result.BAD_COUNTER
        if self._clock.lost(t_ns):
            for each in self.channels:
                each.must_be_off = True
        age_ns = self._clock.age_ns(t_ns, command.issued_ms)
        if not command.on:
            return Result.OK  # whatever else it says: off is never refused
        if (
            command.current_ma > MAX_CURRENT_MA
            or command.pulse_width_us > MAX_PULSE_WIDTH_US
            or command.frequency_hz > MAX_FREQUENCY_HZ
        ):
            return Result.OVER_LIMIT
        if late := age_ns > self._validity_ms * NS_PER_MS:
            self.flags |= Fault.LATE  # until a new session: where it was the clock that jumped, it is wrong for good
        if channel.must_be_off or late:
            return Result.STALE
        if channel.blocked:
            return Result.ON_TIME
        if command.channel == self.faults.electrode:
            self.flags |= Fault.OUTPUT
            return Result.OUTPUT_FAULT
        return Result.OK

    def _on(self, t_ns: int, command: Command) -> None:
        channel = self.channels[command.channel]
        before = channel.levels if channel.on else None
        current_ma = command.current_ma
        if command.channel == self.faults.weak:
            current_ma = current_ma // (2 * can_codec.CURRENT_STEP_MA) * can_codec.CURRENT_STEP_MA
        channel.drive(t_ns, (current_ma, command.pulse_width_us, command.frequency_hz), self._validity_ms)
        channel.advance(t_ns)
        if channel.levels != before:
            self._note(t_ns, "on" if before is None else "level", command.channel)

    def _off(self, t_ns: int, number: int, event: str) -> None:
        if self.channels[number].on:
            self.channels[number].silence()
            self._note(t_ns, event, number)

    def _close(self, t_ns: int, why: Fault) -> list[Frame]:
        frames: list[Frame] = []
        self.flags |= why
        for number, channel in enumerate(self.channels):
            if channel.on:
                self._off(t_ns, number, "fault")
                frames += self._status(number, *channel.answers, Result.FAULTED)
        self._retire()
        self.session_id = NO_SESSION
        return frames

    def _retire(self) -> None:
        """No later session may carry what this one's last commands may, should they turn up after all."""
        if self.session_id != NO_SESSION:
            self._used_ids.add(carried(self.session_id, self._number + SENT_UNHEARD)[0])

    def _refuse(self, t_ns: int, number: int, why: str) -> None:
        self.rejected = min(self.rejected + 1, 255)
        self._note(t_ns, "refused", number, why)

    def _note(self, t_ns: int, event: str, number: int = -1, detail: str = "") -> None:
        entry = RecordEntry(t_ns, event, detail=detail)
        if number >= 0:
            channel = self.channels[number]
            counts = (channel.accepted_ns, channel.pulses, max(channel.last_pulse_ns, 0))
            entry = RecordEntry(t_ns, event, number, *channel.levels, *counts, detail)
        self._record.append(entry)

    def _status(self, number: int, counter: int, session_id: int, result: Result) -> list[Frame]:
        channel = self.channels[number]
        pulses = channel.pulses % can_codec.PULSES_TOTAL
        charge_steps = channel.charge_steps % can_codec.CHARGE_TOTAL_STEPS
        return [
            can_codec.encode(Charge(counter % 2**can_codec.COUNTER_LOW, session_id, number, pulses, charge_steps)),
            can_codec.encode(Status(counter, session_id, number, channel.on, *channel.levels, result)),
        ]

    def _alive(self) -> Frame:
        counter, version = self._alive_counter, can_codec.PROTOCOL_VERSION
        self._alive_counter = (counter + 1) % 16
        alive = Alive(counter, version, self.boot_id, self.session_id, self.rejected, int(self.flags))
        return can_codec.encode(alive)

    def _frames_out(self, t_ns: int, frames: list[Frame]) -> list[Frame]:
        """What of ``frames`` reaches the bus: all of it, unless a fault was asked for."""
        if t_ns >= self._mute_ns:
            return []
        kept: list[Frame] = []
        for frame in frames:
            self._statuses += frame[0] == can_codec.STATUS_ID
            if not self.faults.drop or frame[0] != can_codec.STATUS_ID or self._statuses % self.faults.drop:
                kept.append(frame)
        return kept
