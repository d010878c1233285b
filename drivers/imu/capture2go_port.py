"""A SensorStim Capture2Go on its USB line: configures it, then turns its packages into samples.

It sends one sample a package (packed ones would wait for eight), without magnetometer, at 200, 100, 50 or 25 Hz.
Options: ``baudrate`` (115200; a USB line has none, the setting is for adapters), ``sync`` ("none", "sender",
"receiver": whose clock it follows by radio) and ``sync_id``, a number that sender and receivers share and nobody else
nearby has.

Over Bluetooth LE (by bleak, extra ``ble``) the settings' ``port`` is the sensor's name (``IMU_`` and its serial
number) or its address; where it is a line (``/dev/…``), values come over that, as a simulated radio sends them.
Samples are kept first in, first out: bad reception makes them late, not missing. How late is known by asking the sensor
for its time (CmdGetStatus) again and again: what it answers was its
time after the question. It sends no status unasked, so that each is an answer. Options: ``sync`` and ``sync_id`` as by
cable, ``find_s`` (10): how long it is looked for, ``packed`` (false): eight samples a package, for less load on the
radio; at 100 Hz the oldest is 70 ms old by then.
"""

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, Final

from drivers.imu import capture2go_codec as c2g
from drivers.imu.ble import Connection, connect
from drivers.imu.capture2go_codec import Flags, Header, Package, SensorState, SyncMode
from drivers.imu.line import BAUDRATE, ByteLine, LineOpener
from drivers.imu.port import NOT_A_NUMBER, ImuLost, OneSensorPort, flag_option, text_option, whole_option
from drivers.stimulator.serial_line import Line
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

ANSWER_S: Final = 0.5
TRIES: Final = 3
STATUS_EVERY_S: Final = 1
LOW_BATTERY_PERCENT: Final = 15
RATES_HZ: Final = (200, 100, 50, 25)
SYNC: Final = {"none": SyncMode.NONE, "sender": SyncMode.SENDER, "receiver": SyncMode.RECEIVER}


class Capture2GoPort(OneSensorPort):
    """What is the same over every line: the opening, the flags, what the sensor says of itself.

    Raises:
        ValueError: a rate or range that the sensor has not, or an option that is not what it must be.
        ImuLost: no such line, or no Capture2Go answers on it.
    """

    status_every_s = STATUS_EVERY_S
    mode_field = "fullFixedMode"
    decoder: type[c2g.Capture2GoDecoder | c2g.NotificationDecoder] = c2g.Capture2GoDecoder
    _line: Line | Connection
    _is_open = False
    kinds: tuple[str, ...] = ("FULL_FIXED", "FULL_6D_FIXED")  # of packages with samples

    def __init__(self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._clock_ns = clock_ns
        self._rate_hz = round(device.rate_hz)
        if device.rate_hz not in RATES_HZ:
            rates = ", ".join(map(str, RATES_HZ))
            raise ValueError(f"{device.sensor}: rate_hz = {device.rate_hz:g}: a Capture2Go has {rates}")
        if device.acc_range_g > c2g.ACC_RANGE_G or device.gyr_range_dps > c2g.GYR_RANGE_DPS:
            has = f"acc_range_g = {c2g.ACC_RANGE_G:g} and gyr_range_dps = {c2g.GYR_RANGE_DPS:g}"
            raise ValueError(f"{device.sensor}: a Capture2Go measures no more than {has}")
        sync = text_option(device, "sync", "none")
        if sync not in SYNC:
            raise ValueError(f"{device.sensor}: options.sync = {sync!r} must be one of {', '.join(SYNC)}")
        self._sync = SYNC[sync]
        self._sync_id = whole_option(device, "sync_id", 0, 0)
        if bool(self._sync_id) != bool(self._sync):
            raise ValueError(f"{device.sensor}: options.sync and options.sync_id (not 0) need each other")
        self._wanted = frozenset(Header[f"DATA_{kind}_{self._rate_hz}HZ"] for kind in self.kinds)
        super().__init__(device)

    @abstractmethod
    def _connected(self) -> Line | Connection:
        """The line, opened."""

    @abstractmethod
    def _send(self, package: bytes) -> None:
        """Hand over one package now. ImuLost: the line broke."""

    @abstractmethod
    def _receive(self) -> list[Package]:
        """What has come; never waits. ImuLost: the line broke."""

    @property
    def notices(self) -> list[str]:
        """Battery, clock, and what its flags have said since it was first opened."""
        name, status, counts = self._device.sensor, self._status, self._counts
        battery = status.get("battery", c2g.CHARGING)
        alone = self._sync == SyncMode.RECEIVER and not status.get("synchronized", True)
        said = {
            f"{name}: its battery is below {LOW_BATTERY_PERCENT} %": battery < LOW_BATTERY_PERCENT,
            f"{name}: hears no clock of its sender; its stamps drift from the others'": alone,
            f"{name}: its flags tell of gaps in its stamps": counts.time_gaps > 0,
            f"{name}: its flags tell that its processing failed; those samples count as faulty": counts.unsound > 0,
        }
        return [text for text, holds in said.items() if holds]

    # --- opening ----------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._decoder = self.decoder(self._counts)
        self._line = self._connected()
        try:
            self._begin()
        except (ImuLost, ValueError):
            self._line.close()
            raise
        self._is_open = True

    def _begin(self) -> None:
        """Over an open line: who is there, its clock, its outputs, its start. ImuLost: it refuses or is silent."""
        self._status: dict[str, Any] = {}
        self._expect_samples()
        info = self._ask(Header.CMD_GET_DEVICE_INFO, {}, Header.DATA_DEVICE_INFO)
        self.serials = {self._device.sensor: info["serial"].decode("ascii", "replace")}
        self.firmwares = {self._device.sensor: info["firmwareVersion"].rstrip(b"\0").decode("ascii", "replace")}
        state = self._ask(Header.CMD_GET_STATUS, {}, Header.DATA_STATUS)["sensorState"]
        if state == SensorState.RECORDING:
            raise ImuLost(f"{self._line.name}: records to its own storage; end that recording first")
        if state == SensorState.STREAMING:
            stop = Header.CMD_STOP_STREAMING_AND_CLEAR_BUFFER  # what has queued up there is of no use any more
            self._ask(stop, {}, Header.ACK_STOP_STREAMING_AND_CLEAR_BUFFER)
        if self._sync != SyncMode.RECEIVER:  # a receiver takes its sender's
            # the host's monotonic clock: set again while others go on, it jumps by no more than it had drifted
            self._ask(Header.CMD_SET_ABSOLUTE_TIME, {"newTimestamp": self._clock_ns()}, Header.DATA_ABSOLUTE_TIME)
        mode: dict[str, c2g.Value] = {
            self.mode_field: c2g.SAMPLING_MODES[self._rate_hz],
            "statusMode": self.status_every_s,
            "syncMode": int(self._sync),
            "syncId": self._sync_id,
            "disableMagData": True,
        }
        given = self._ask(Header.CMD_SET_MEASUREMENT_MODE, mode, Header.DATA_MEASUREMENT_MODE)
        if other := sorted(name for name, value in mode.items() if given[name] != value):
            raise ImuLost(f"{self._line.name}: does not take {', '.join(other)} as asked for")
        self._ask(Header.CMD_START_STREAMING, {}, Header.ACK_START_STREAMING)

    def _ask(self, command: Header, fields: Mapping[str, c2g.Value], wanted: Header) -> dict[str, Any]:
        """The fields of the answer. ImuLost: an error comes back, or nothing."""
        for _ in range(TRIES):
            self._send(c2g.pack(command, fields))
            deadline_ns = self._clock_ns() + int(ANSWER_S * NS_PER_S)
            while (left_ns := deadline_ns - self._clock_ns()) > 0:
                self._line.wait(left_ns / NS_PER_S)
                for package in self._receive():
                    if package.header == Header.ERROR and (said := c2g.unpack(package))["command"] == command:
                        code = said["errorCode"]
                        why = c2g.ERRORS.get(code, "unknown error")
                        raise ImuLost(f"{self._line.name}: refuses {command.name}: {why} (0x{code:02x})")
                    if package.header == wanted:
                        return c2g.unpack(package)
        raise ImuLost(f"{self._line.name}: no Capture2Go answers to {command.name}. Is it one, and switched on?")

    def fileno(self) -> int:
        """The line's descriptor."""
        return self._line.fileno()

    def close(self) -> None:
        """Stop it and release the line; one that is gone takes no leave."""
        if self._is_open:
            self._is_open = False
            with suppress(ImuLost):
                self._send(c2g.pack(Header.CMD_STOP_STREAMING))
            self._line.close()

    # --- samples ----------------------------------------------------------------------------------------

    def read(self, t_ns: int) -> list[RawSample]:
        """All samples that have come; those whose processing failed without values, so that the gate refuses them."""
        found: list[RawSample] = []
        for package in self._receive():
            if package.header in self._wanted:
                found += [self._converted(t_ns, sample) for sample in c2g.samples(package)]
            elif package.header == Header.DATA_STATUS:
                self._status = c2g.unpack(package)
                if self._status["sensorState"] != SensorState.STREAMING:
                    raise ImuLost(f"{self._line.name}: has stopped streaming by itself")
        return found

    def _converted(self, t_ns: int, sample: c2g.Sample) -> RawSample:
        flags, counts = sample.flags, self._counts
        counts.clipped += bool(flags & (Flags.ACC_CLIPPING | Flags.GYR_CLIPPING))
        counts.time_gaps += bool(flags & Flags.TIME_GAP)
        if flags & Flags.PROCESSING_ISSUE:
            counts.unsound += 1
            return self._sample(t_ns, sample.t_ns, NOT_A_NUMBER, NOT_A_NUMBER)
        return self._sample(t_ns, sample.t_ns, sample.acc_mps2, sample.gyr_radps)


class Capture2GoImu(Capture2GoPort):
    """:class:`~drivers.imu.port.ImuPort` for one Capture2Go on its USB line."""

    _line: Line

    def __init__(
        self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns, opener: LineOpener = ByteLine
    ) -> None:
        self._opener = opener
        super().__init__(device, clock_ns)

    def _connected(self) -> Line:
        baudrate = whole_option(self._device, "baudrate", BAUDRATE, 1)
        return self._opener(self._device.sensor, self._device.port, baudrate)

    def _send(self, package: bytes) -> None:
        self._line.write(package)

    def _receive(self) -> list[Package]:
        return self._decoder.feed(self._line.read())


# --- A SensorStim Capture2Go over Bluetooth LE, by bleak (extra ``ble``) ------------------------------------


SERVICE: Final = "80030001-e629-4c98-9324-aa7fc0c66de7"
TO_SENSOR: Final = "80030002-e629-4c98-9324-aa7fc0c66de7"
FROM_SENSOR: Final = "80030003-e629-4c98-9324-aa7fc0c66de7"
FIRST_NS: Final = 2 * NS_PER_S  # in which the sensor is asked more often …
FIRST_PAUSE_NS: Final = NS_PER_S // 10  # … since of some twenty ways there one is short
PAUSE_NS: Final = NS_PER_S
UNANSWERED_NS: Final = 10 * NS_PER_S  # so late is no answer: what lies in the radio so long has stopped the session


class Capture2GoRadio(Capture2GoPort):
    """:class:`~drivers.imu.port.ImuPort` for one Capture2Go by radio, which is asked for its time."""

    status_every_s = 0
    decoder = c2g.NotificationDecoder
    _line: Connection

    def __init__(self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        if flag_option(device, "packed", False):
            self.mode_field, self.kinds = "fullPackedMode", ("FULL_PACKED", "FULL_6D_PACKED")
        super().__init__(device, clock_ns)

    def _connected(self) -> Connection:
        return connect(self._device, FROM_SENSOR, [SERVICE])

    def _send(self, package: bytes) -> None:
        self._line.write(TO_SENSOR, package)

    def _receive(self) -> list[Package]:
        return [package for heard in self._line.notifications() for package in self._decoder.feed(heard)]

    def _begin(self) -> None:
        self._told: list[tuple[str, int, int]] = []
        self._asked_ns: int | None = None  # the oldest question whose answer has not come
        self._sent_ns = self._began_ns = 0
        super()._begin()

    def read(self, t_ns: int) -> list[RawSample]:
        """As of every port; and it asks what is to be asked."""
        before = self._status
        found = super().read(t_ns)
        if self._asked_ns is not None and self._status is not before:
            self._told.append((self._device.sensor, self._asked_ns, self._status["timestamp"]))
            self._asked_ns = None
        self._began_ns = self._began_ns or t_ns
        pause_ns = FIRST_PAUSE_NS if t_ns - self._began_ns < FIRST_NS else PAUSE_NS
        if t_ns - self._sent_ns > (pause_ns if self._asked_ns is None else UNANSWERED_NS):
            # counted from before it is sent: whatever it waits for on its way, the bound stays true
            self._asked_ns = t_ns if self._asked_ns is None else self._asked_ns
            self._sent_ns = t_ns
            self._line.write_soon(TO_SENSOR, c2g.pack(Header.CMD_GET_STATUS))
        return found

    def clock_answers(self) -> list[tuple[str, int, int]]:
        """See the base."""
        told, self._told = self._told, []
        return told
