"""A stimulator that speaks CANopen: values by SDO, one SYNC for each pulse, so that losing SYNC is silence.

Modelled on what is public of an implanted stimulator (COSMIIC PG4: SDO, heartbeat, SYNC as the pulse trigger; 100
kbit/s). Which object holds what is not standardised: the settings say so. Plain frames on purpose: the ``canopen``
package waits for SDO answers and works in threads, and a control loop does neither. Not tried on a real device.

SYNC makes every channel deliver what it holds. So it only goes out when every channel's *confirmed* values are at most
what was commanded; values travel one at a time, a step behind. A rise lags by a step; after a fall the next pulse waits
until the lower value is confirmed. Channels that are on together pulse together, at the lowest of their frequencies.

The few CANopen frames that a stimulator needs, and where the settings say that its values are; no I/O.

Source: CiA 301: expedited SDO download, SYNC, NMT start, heartbeat.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import can

from drivers.stimulator.bus import LINE_HINT, read_frame, write_frame
from drivers.stimulator.can_port import COUNTERS, POLL_AT_MOST, Handshake
from drivers.stimulator.port import ANSWER_WITHIN_NS, PulseTrain, StimulatorLost
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

NMT_ID: Final = 0x000
SYNC_ID: Final = 0x080
BOOT_UP: Final = 0  # the heartbeat's state in a node's first message after its start
OPERATIONAL: Final = 5
_DOWNLOAD: Final = {1: 0x2F, 2: 0x2B, 4: 0x23}  # expedited, size given
_DOWNLOADED: Final = 0x60
_ABORTED: Final = 0x80
_START: Final = 0x01


@dataclass(frozen=True, slots=True)
class Sdo:
    """A value for one entry of the node's object dictionary."""

    index: int
    subindex: int
    value: int
    size: int


@dataclass(frozen=True, slots=True)
class CanOpenSettings:
    """Where things are in this device's object dictionary, and in which steps.

    Channel ``n`` is subindex ``n + 1``. ``value_bytes`` is 1, 2 or 4. ``max_current_ma`` and ``max_width_us`` are the
    device's own limits.
    """

    node_id: int
    current_index: int
    width_index: int
    current_step_ma: float
    width_step_us: float
    max_current_ma: float
    max_width_us: float
    value_bytes: int = 1
    heartbeat_ms: int = 500

    def __post_init__(self) -> None:
        entries = (0x2000, 0x9FFF)
        whole = {"node_id": (1, 127), "current_index": entries, "width_index": entries, "heartbeat_ms": (10, 10_000)}
        for name, (least, most) in whole.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ValueError(f"{name} = {value!r} must be a whole number from {least} to {most}")
        if isinstance(self.value_bytes, (bool, float)) or self.value_bytes not in _DOWNLOAD:
            raise ValueError(f"value_bytes = {self.value_bytes!r} must be 1, 2 or 4")
        for name in ("current_step_ma", "width_step_us", "max_current_ma", "max_width_us"):
            value = getattr(self, name)
            if isinstance(value, (bool, str)) or not math.isfinite(value) or not value > 0:
                raise ValueError(f"{name} = {value!r} must be a number above 0")
        if self.current_index == self.width_index:
            raise ValueError(f"current_index and width_index are both 0x{self.width_index:04x}")

    @classmethod
    def from_options(cls, options: Mapping[str, Any]) -> CanOpenSettings:
        """From a session's options. ValueError: one is missing, unknown or out of range; the message names it."""
        try:
            return cls(**options)
        except TypeError as error:
            raise ValueError(str(error).replace("CanOpenSettings.__init__() ", "")) from None

    @property
    def heartbeat_id(self) -> int:
        """Identifier of the node's heartbeat."""
        return 0x700 + self.node_id

    @property
    def answer_id(self) -> int:
        """Identifier of the node's SDO answers."""
        return 0x580 + self.node_id

    def steps(self, current_ma: float, pulse_width_us: float) -> list[int]:
        """Current and width in the device's steps, rounded down.

        ValueError: not finite, negative, or over the device's limits or what its entries hold.
        """
        out: list[int] = []
        current = ("current_ma", current_ma, self.current_step_ma, self.max_current_ma)
        width = ("pulse_width_us", pulse_width_us, self.width_step_us, self.max_width_us)
        for name, value, step, most in (current, width):
            if not math.isfinite(value) or not 0 <= value <= most:
                raise ValueError(f"{name} = {value!r}; this stimulator takes 0 to {most:g}")
            steps = math.floor(value / step)
            if steps >= 1 << 8 * self.value_bytes:
                raise ValueError(f"{name} = {value!r} does not fit an entry of {self.value_bytes} bytes")
            out.append(steps)
        return out

    def sdo(self, what: int, channel: int, value: int) -> Sdo:
        """The entry for a channel's current (0) or width (1)."""
        return Sdo((self.current_index, self.width_index)[what], channel + 1, value, self.value_bytes)

    def answers(self, sdo: Sdo, message: can.Message) -> bool:
        """Whether this is the node's answer to that download, good or bad."""
        if message.arbitration_id != self.answer_id or len(message.data) != 8:
            return False
        command, index, subindex = struct.unpack_from("<BHB", message.data)
        return command in (_DOWNLOADED, _ABORTED) and (index, subindex) == (sdo.index, sdo.subindex)

    @staticmethod
    def refusal(message: can.Message) -> str:
        """Why the node refused; "" when it did not."""
        if message.data[0] != _ABORTED:
            return ""
        _, index, subindex, code = struct.unpack("<BHBI", bytes(message.data))
        return f"refused object 0x{index:04x}:{subindex} (SDO abort 0x{code:08x})"


def encode_download(node_id: int, sdo: Sdo) -> tuple[int, bytes]:
    """Identifier and data of an expedited download."""
    value = sdo.value.to_bytes(sdo.size, "little").ljust(4, b"\0")
    return 0x600 + node_id, struct.pack("<BHB", _DOWNLOAD[sdo.size], sdo.index, sdo.subindex) + value


def encode_start(node_id: int) -> tuple[int, bytes]:
    """Identifier and data of NMT start for this node."""
    return NMT_ID, bytes((_START, node_id))


CURRENT, WIDTH = 0, 1
HEARTBEATS_MISSED: Final = 3


@dataclass(slots=True)
class _ChannelState:
    """One channel: steps of current and width as commanded, and as the device confirmed them."""

    wanted: list[int] = field(default_factory=lambda: [0, 0])
    confirmed: list[int] = field(default_factory=lambda: [0, 0])
    counter: int = 0
    frequency_hz: float = 0.0


class CanOpenStimulator:
    """Port (:mod:`drivers.stimulator.port`) on an open bus, which it then owns.

    A node that restarted, or was stopped or silent for a while, is reported by a :class:`StimAlive` and is lost from
    then on: nobody knows what its entries hold now, and only :meth:`open` begins with what is known.

    In the log, identifier 0x80 is a SYNC with, as its data, the SDO that went out after it, if any; another identifier
    is an SDO alone; 0 is a command that put nothing on the bus. The device counts no pulses. ``channels`` are those of
    the session, in the order in which each control step commands them.
    """

    one_pulse_per_command: ClassVar[bool] = True
    heard: ClassVar[bytes] = b""  # its answers are not kept: a replay compares commands

    def __init__(self, bus: can.BusABC, session_id: int, channels: Sequence[int], settings: CanOpenSettings) -> None:
        self.session_id = session_id
        self.foreign = 0
        self.current_step_ma = settings.current_step_ma
        self.pulse_width_step_us = settings.width_step_us
        self._bus = bus
        self._settings = settings
        self._channels = {channel: _ChannelState() for channel in channels}
        self._last = channels[-1]
        self._train = PulseTrain()
        self._counter = 0
        self._pending: tuple[Sdo, int, int, int] | None = None  # for which channel, current or width, since when
        self._boot_id = 1
        self._beat_ns: int | None = None
        self._away = False
        self._ended = ""
        self._closed = False

    @property
    def outstanding(self) -> int:
        """SDO downloads not yet answered: 0 or 1."""
        return int(self._pending is not None)

    def open(self, t_ns: int, timeout_s: float = 4.0, clock_ns: Callable[[], int] = time.monotonic_ns) -> Handshake:
        """Wait for the heartbeat, start the node, set every current to 0 and have that confirmed.

        StimulatorLost: no heartbeat, or the node does not start or refuses; the message says what to check.
        """
        deadline_ns = clock_ns() + int(timeout_s * NS_PER_S)
        node = self._settings.node_id
        frames: list[WireFrame] = []
        todo = zeros = [self._settings.sdo(CURRENT, channel, 0) for channel in self._channels]
        asked: Sdo | None = None
        state = -1
        while (left_ns := deadline_ns - clock_ns()) > 0:
            message = read_frame(self._bus, left_ns / NS_PER_S)
            if message is None:
                continue
            if message.arbitration_id == self._settings.heartbeat_id and message.data:
                state = message.data[0] & 0x7F
                frame = encode_start(node) if state != OPERATIONAL else None
                if state == BOOT_UP:
                    todo, asked = zeros, None
            elif asked is not None and self._settings.answers(asked, message):
                if why := self._settings.refusal(message):
                    raise StimulatorLost(f"{self._bus.channel_info}: CANopen node {node} {why}")
                todo = todo[1:]
                asked, frame = None, None
                if not todo:
                    return Handshake(self._boot_id, tuple(frames), (StimAlive(t_ns, self._boot_id, 0),))
            else:
                continue
            if state == OPERATIONAL:  # also asks again at every heartbeat, should the first have been lost
                asked = todo[0]
                frame = encode_download(node, asked)
            if frame is not None:
                write_frame(self._bus, *frame)
                frames.append(WireFrame(t_ns, *frame))
        raise StimulatorLost(
            f"no CANopen node {node} was heard on {self._bus.channel_info} within {timeout_s:g} s. Is it on, is the "
            f"node number right, does it send a heartbeat? {LINE_HINT}"
            if state < 0
            else f"CANopen node {node} on {self._bus.channel_info} did not start within {timeout_s:g} s"
        )

    def send(self, command: StimCommand) -> WireFrame:
        """The SYNC, when this command makes one due, then at most one SDO.

        Raises:
            StimulatorLost: the bus did not take it, or the node has restarted.
            ValueError: the command cannot be expressed; nothing was sent.
        """
        self._need_session()
        self._want(command)
        self._counter = (self._counter + 1) % COUNTERS
        sync = command.channel == self._last and self._sync_is_due(command.t_ns)
        if sync:
            write_frame(self._bus, SYNC_ID, b"")
        frame = self._next_download(command.t_ns)
        if frame is not None:
            write_frame(self._bus, *frame)
        identifier, data = frame or (0, b"")
        return WireFrame(command.t_ns, SYNC_ID if sync else identifier, data)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """All that has arrived, at most 128 frames, and what should have, stamped ``t_ns``.

        StimulatorLost: the bus cannot be read, or the node has restarted and the last call said so.
        """
        self._need_session()
        events: list[StimStatus | StimAlive] = []
        for _ in range(POLL_AT_MOST):
            message = read_frame(self._bus, 0.0)
            if message is None:
                break
            if message.arbitration_id == self._settings.heartbeat_id and message.data:
                events.append(self._heartbeat(t_ns, message.data[0] & 0x7F))
            elif message.arbitration_id == self._settings.answer_id:
                events += self._answer(t_ns, message)
            else:
                self.foreign += 1
        if self._pending is not None and t_ns - self._pending[3] > ANSWER_WITHIN_NS:
            sdo, channel, what, _ = self._pending
            self._pending = None
            held = self._channels[channel].confirmed  # it may have arrived all the same: reckon with the larger
            held[what] = max(held[what], sdo.value)
            events.append(self._status(t_ns, channel, "no answer within 100 ms"))
        if self._beat_ns is None:
            self._beat_ns = t_ns
        elif t_ns - self._beat_ns > HEARTBEATS_MISSED * self._settings.heartbeat_ms * 1_000_000:
            self._beat_ns = t_ns
            self._away = True
            events.append(StimAlive(t_ns, self._boot_id, 0, "the stimulator's heartbeat has stopped"))
        return events

    def fileno(self) -> int:
        """The bus, for ``select``."""
        return int(self._bus.fileno())

    def close(self) -> None:
        """Shut the bus down; sends nothing."""
        if not self._closed:
            self._closed = True
            self._bus.shutdown()

    def _want(self, command: StimCommand) -> None:
        state = self._channels.get(command.channel)
        if state is None:
            if command.on:
                raise ValueError(f"channel {command.channel} is not one of this session's {sorted(self._channels)}")
            return
        if not command.on:
            state.wanted[CURRENT] = 0
        else:
            if not math.isfinite(command.frequency_hz):
                raise ValueError(f"frequency_hz = {command.frequency_hz!r} must be a finite number")
            state.wanted = self._settings.steps(command.current_ma, command.pulse_width_us)
            state.frequency_hz = command.frequency_hz
        state.counter = self._counter

    def _sync_is_due(self, t_ns: int) -> bool:
        holding = [state for state in self._channels.values() if state.confirmed[CURRENT]]
        on = [state for state in holding if state.wanted[CURRENT]]
        if not on:
            self._train.off()
            return False
        too_much = (s.confirmed[CURRENT] > s.wanted[CURRENT] or s.confirmed[WIDTH] > s.wanted[WIDTH] for s in holding)
        if self._pending is not None or any(too_much):
            return False
        return self._train.due(t_ns, min(state.frequency_hz for state in on))

    def _next_download(self, t_ns: int) -> tuple[int, bytes] | None:
        """What to set next: first what is too much, then widths, then what is too little; one at a time."""
        if self._pending is not None:
            return None
        too_much = [(c, CURRENT) for c, n in self._channels.items() if n.confirmed[CURRENT] > n.wanted[CURRENT]]
        widths = [(c, WIDTH) for c, n in self._channels.items() if n.confirmed[WIDTH] != n.wanted[WIDTH]]
        too_little = [(c, CURRENT) for c, n in self._channels.items() if n.confirmed[CURRENT] < n.wanted[CURRENT]]
        for channel, what in [*too_much, *widths, *too_little]:
            sdo = self._settings.sdo(what, channel, self._channels[channel].wanted[what])
            self._pending = (sdo, channel, what, t_ns)
            return encode_download(self._settings.node_id, sdo)
        return None

    def _answer(self, t_ns: int, message: can.Message) -> list[StimStatus | StimAlive]:
        if self._pending is None or not self._settings.answers(self._pending[0], message):
            return [StimAlive(t_ns, self._boot_id, 0, "an SDO answer to no command of ours: late, repeated or foreign")]
        sdo, channel, what, _ = self._pending
        self._pending = None
        if why := self._settings.refusal(message):
            return [self._status(t_ns, channel, f"the stimulator {why}")]
        self._channels[channel].confirmed[what] = sdo.value
        return [self._status(t_ns, channel, "")]

    def _heartbeat(self, t_ns: int, state: int) -> StimAlive:
        self._beat_ns = t_ns
        if state == BOOT_UP:
            self._boot_id += 1
            self._ended = "the stimulator restarted"
        elif state != OPERATIONAL:
            self._away = True
            return StimAlive(t_ns, self._boot_id, 0, f"the stimulator is not operational (state {state})")
        elif self._away:  # its boot-up message may be what was missed
            self._ended = self._ended or "the stimulator was away and may have restarted"
        return StimAlive(t_ns, self._boot_id, 0, self._ended)

    def _need_session(self) -> None:
        if self._ended:
            raise StimulatorLost(f"{self._bus.channel_info}: {self._ended}; its session must be opened again")

    def _status(self, t_ns: int, channel: int, fault: str) -> StimStatus:
        state = self._channels[channel]
        current, width = state.confirmed if not fault else (0, 0)
        on = bool(current) and bool(state.wanted[CURRENT])
        levels = (current * self.current_step_ma, width * self.pulse_width_step_us, state.frequency_hz)
        return StimStatus(t_ns, channel, state.counter, on, *(levels if on else (0.0, 0.0, 0.0)), fault=fault)
