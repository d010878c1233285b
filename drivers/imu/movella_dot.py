"""A Movella DOT over Bluetooth LE, by bleak (extra ``ble``).

The settings' ``port`` is its address (all have the same name); where it is a line (``/dev/…``), values come over that,
as a simulated radio sends them. Option: ``find_s`` (10), how long it is looked for.

It cannot be asked for its time. What is known: it took its first sample after it was told to begin. So samples are
dated from there on, at the earliest moment that they can have been measured, as of every sensor by radio; but this one
answer grows old, and the samples with it by 12 ms a minute, until the session's limit lets no more of them pass.

The codec does no I/O. From "Movella DOT BLE Service Specification", XD0506P revision C, July 2023, whose revision of
2020 is in adamkewley/xdc, and "Xsens DOT User Manual", XD0502P, 4.2.5 (the stamp). Everything is least significant
byte first. Of all payloads only *rate quantities* (20 with, 21 without magnetometer) and *custom mode 5* (26, with a
quaternion) carry the measured acceleration; the others have free acceleration, from which gravity was taken, or
increments. Here it is 21: stamp in µs (32 bits, from when it was switched on), acceleration in m/s² and rate in °/s as
float32; what stands behind its 28 bytes is 0. In real time it has 60 Hz at most; 120 Hz are for its own storage.

Not said: how it can be asked for its time; whether it keeps what it cannot send, and how much; how exact its clock is;
which status goes with this payload (clipping is not told in it).
"""

import math
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from drivers.imu.ble import connect
from drivers.imu.line import ByteLine, LineOpener
from drivers.imu.port import ImuLost, OneSensorPort, StampClock
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample, Vector3

INFO, DEVICE_CONTROL, MEASUREMENT, MEDIUM_PAYLOAD = 0x1001, 0x1002, 0x2001, 0x2003  # characteristics
RATES_HZ: Final = (60, 30)  # the lower ones are of no use here
START, STOP = b"\1\1\x15", b"\1\0\x15"  # values of MEASUREMENT: of what, whether it runs, payload 21
_INFO: Final = struct.Struct("<6s3B7xIQ6s")  # address, firmware, its date, radio's firmware, serial number, model
_CONTROL: Final = struct.Struct("<B23xH6x")  # which fields count, output rate
_OUTPUT_RATE: Final = 1 << 4
_PAYLOAD: Final = struct.Struct("<I3f3f")


def uuid(characteristic: int) -> str:
    """In full."""
    return f"1517{characteristic:04x}-4947-11e9-8646-d663bd873d93"


def is_measuring(value: bytes) -> bool:
    """Of what is read there."""
    return value[1:2] == b"\1"


def output_rate(rate_hz: int) -> bytes:
    """The value that sets the output rate and nothing else."""
    return _CONTROL.pack(_OUTPUT_RATE, rate_hz)


def set_rate_hz(value: bytes) -> int:
    """Of what is read there. struct.error: it is no such value."""
    return int(_CONTROL.unpack(value)[1])


def identity(value: bytes) -> tuple[str, str]:
    """Serial number, as it is printed, and firmware. struct.error: it is no such value."""
    _, major, minor, revision, _, serial, _ = _INFO.unpack(value)
    return f"{serial:X}", f"{major}.{minor}.{revision}"


def sample(payload: bytes) -> tuple[int, Vector3, Vector3]:
    """Of one notification the stamp in µs, which wraps, acceleration in m/s² and rate in rad/s.

    struct.error: it is too short for rate quantities.
    """
    t_us, ax, ay, az, p, q, r = _PAYLOAD.unpack_from(payload)
    return t_us, (ax, ay, az), (math.radians(p), math.radians(q), math.radians(r))


QUIET_S: Final = 0.5  # without a sample of an earlier measurement: then no more of them is on its way
STOPS_S: Final = 3.0


class MovellaDotImu(OneSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one Movella DOT.

    Raises:
        ValueError: a rate that the sensor has not.
        ImuLost: it is not there, or does not do as it is told.
    """

    def __init__(
        self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns, opener: LineOpener = ByteLine
    ) -> None:
        if device.rate_hz not in RATES_HZ:
            rates = " and ".join(map(str, RATES_HZ))
            raise ValueError(f"{device.sensor}: rate_hz = {device.rate_hz:g}: a Movella DOT has {rates} by radio")
        self._clock_ns, self._opener = clock_ns, opener
        super().__init__(device)

    @property
    def notices(self) -> list[str]:
        """That its clock is known from its start only."""
        name = self._device.sensor
        return [f"{name}: cannot be asked for its time; after some minutes its samples count as too old: begin anew"]

    def _open(self) -> None:
        self._expect_samples()
        self._stamps = StampClock(32, 1000.0)
        self._answers: list[tuple[str, int, int]] = []
        self._connection = connect(self._device, uuid(MEDIUM_PAYLOAD), opener=self._opener)
        try:
            self._begin()
        except (ImuLost, struct.error) as error:
            self._connection.close()
            if isinstance(error, ImuLost):
                raise
            raise ImuLost(f"{self._connection.name}: is no Movella DOT, or of another firmware ({error})") from error

    def _begin(self) -> None:
        """Who is there, its rate, its start. struct.error: what it answers is nothing of a DOT's."""
        name, rate_hz = self._device.sensor, round(self._device.rate_hz)
        serial, firmware = identity(self._value(INFO))
        self.serials, self.firmwares = {name: serial}, {name: firmware}
        if is_measuring(self._value(MEASUREMENT)):
            self._set(MEASUREMENT, STOP)
            self._until_quiet()
        self._set(DEVICE_CONTROL, output_rate(rate_hz))
        if (found := set_rate_hz(self._value(DEVICE_CONTROL))) != rate_hz:
            raise ImuLost(
                f"{name}: keeps to {found} Hz instead of {rate_hz}; if it is synchronised, switch it off and on"
            )
        self._connection.notifications()
        self._started_ns: int | None = self._clock_ns()
        self._set(MEASUREMENT, START)

    def _value(self, characteristic: int) -> bytes:
        return self._connection.read(uuid(characteristic))

    def _set(self, characteristic: int, value: bytes) -> None:
        self._connection.write(uuid(characteristic), value)

    def _until_quiet(self) -> None:
        """What an earlier measurement has on its way would be taken for the first sample of the next."""
        heard_ns = begin_ns = self._clock_ns()
        while (now_ns := self._clock_ns()) - heard_ns < QUIET_S * NS_PER_S:
            if now_ns - begin_ns > STOPS_S * NS_PER_S:
                raise ImuLost(f"{self._device.sensor}: goes on measuring, though it was told to stop")
            self._connection.wait(QUIET_S)
            heard_ns = self._clock_ns() if self._connection.notifications() else heard_ns

    def read(self, t_ns: int) -> list[RawSample]:
        """All samples that have come."""
        found: list[RawSample] = []
        for payload in self._connection.notifications():
            try:
                t_us, acc_mps2, gyr_radps = sample(payload)
            except struct.error:
                self._counts.bad_frames += 1
                continue
            stamp_ns = self._stamps.time_ns(t_us)
            if self._started_ns is not None:
                # by a period earlier: the first may have been under way
                began_ns = self._started_ns - round(NS_PER_S / self._device.rate_hz)
                self._answers.append((self._device.sensor, began_ns, stamp_ns))
                self._started_ns = None
            found.append(self._sample(t_ns, stamp_ns, acc_mps2, gyr_radps))
        return found

    def clock_answers(self) -> list[tuple[str, int, int]]:
        """See the base: one, with the first sample."""
        answers, self._answers = self._answers, []
        return answers

    def fileno(self) -> int:
        """The connection's descriptor."""
        return self._connection.fileno()

    def close(self) -> None:
        """Let it stop, and leave; one that is gone is not waited for."""
        if self._connection.is_open:
            with suppress(ImuLost):
                self._set(MEASUREMENT, STOP)
            self._connection.close()
