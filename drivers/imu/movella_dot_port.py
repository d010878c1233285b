"""A Movella DOT over Bluetooth LE, by bleak (extra ``ble``).

The settings' ``port`` is its address (all have the same name); where it is a line (``/dev/…``), values come over that,
as a simulated radio sends them. Option: ``find_s`` (10), how long it is looked for.

It cannot be asked for its time. What is known: it took its first sample after it was told to begin. So samples are
dated from there on, at the earliest moment that they can have been measured, as of every sensor by radio; but this one
answer grows old, and the samples with it by 12 ms a minute, until the session's limit lets no more of them pass.
"""

import struct
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from drivers.imu import movella_dot_codec as dot
from drivers.imu.ble import BleConnection, BridgedConnection
from drivers.imu.line import ByteLine, LineOpener
from drivers.imu.port import ImuLost, OneSensorPort, StampClock
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

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
        if device.rate_hz not in dot.RATES_HZ:
            rates = " and ".join(map(str, dot.RATES_HZ))
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
        notifies, bridged = dot.uuid(dot.MEDIUM_PAYLOAD), "/" in self._device.port
        self._connection: BleConnection | BridgedConnection = (
            BridgedConnection(self._device, notifies, self._opener)
            if bridged
            else BleConnection(self._device, notifies)
        )
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
        serial, firmware = dot.identity(self._value(dot.INFO))
        self.serials, self.firmwares = {name: serial}, {name: firmware}
        if dot.is_measuring(self._value(dot.MEASUREMENT)):
            self._set(dot.MEASUREMENT, dot.STOP)
            self._until_quiet()
        self._set(dot.DEVICE_CONTROL, dot.output_rate(rate_hz))
        if (found := dot.set_rate_hz(self._value(dot.DEVICE_CONTROL))) != rate_hz:
            raise ImuLost(
                f"{name}: keeps to {found} Hz instead of {rate_hz}; if it is synchronised, switch it off and on"
            )
        self._connection.notifications()
        self._started_ns: int | None = self._clock_ns()
        self._set(dot.MEASUREMENT, dot.START)

    def _value(self, characteristic: int) -> bytes:
        return self._connection.read(dot.uuid(characteristic))

    def _set(self, characteristic: int, value: bytes) -> None:
        self._connection.write(dot.uuid(characteristic), value)

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
                sample = dot.sample(payload)
            except struct.error:
                self._counts.bad_frames += 1
                continue
            stamp_ns = self._stamps.time_ns(sample.t_us)
            if self._started_ns is not None:
                # by a period earlier: the first may have been under way
                began_ns = self._started_ns - round(NS_PER_S / self._device.rate_hz)
                self._answers.append((self._device.sensor, began_ns, stamp_ns))
                self._started_ns = None
            found.append(self._sample(t_ns, stamp_ns, sample.acc_mps2, sample.gyr_radps))
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
                self._set(dot.MEASUREMENT, dot.STOP)
            self._connection.close()
