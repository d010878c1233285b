"""An Xsens MTi on a serial line: configures it, then turns its bytes into samples.

Options: ``baudrate`` (115200), ``configure`` (true: set the outputs and their rate; false: only listen).
"""

import time
from collections.abc import Callable
from typing import Final

from drivers.imu import xbus_codec as xbus
from drivers.imu.line import ByteLine, LineOpener, LineSensorPort
from drivers.imu.port import ImuLost, StampClock, flag_option, whole_option
from drivers.imu.xbus_codec import Mid, Xdi
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

ANSWER_S: Final = 0.5
TRIES: Final = 3
SAMPLE_BYTES: Final = 54  # with counter, time, acceleration, rate of turn and status as float32


class XbusImu(LineSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one MTi.

    Raises:
        ValueError: the rate does not fit the baud rate, is not whole, or an option is not what it must be.
        ImuLost: no such line, or no MTi answers on it.
    """

    def __init__(
        self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns, opener: LineOpener = ByteLine
    ) -> None:
        self._clock_ns = clock_ns
        self._baudrate = whole_option(device, "baudrate", 115200, 1)
        self._configures = flag_option(device, "configure", True)
        if self._configures and device.rate_hz != round(device.rate_hz):
            given = f"{device.sensor}: rate_hz = {device.rate_hz:g}"
            raise ValueError(f"{given} must be whole: an MTi takes no other rates")
        needs = device.rate_hz * SAMPLE_BYTES * 10
        if needs > self._baudrate:
            raise ValueError(
                f"{device.sensor}: {device.rate_hz:g} Hz need {needs:.0f} baud, options.baudrate is {self._baudrate}; "
                "set the sensor and this option to a higher one"
            )
        super().__init__(device, opener)

    def _open(self) -> None:
        self._decoder = xbus.XbusDecoder(self._counts)
        self._stamps = StampClock(32, xbus.TIME_FINE_TICK_NS)
        self._expect_samples(counter_bits=16)
        self._line = self._opener(self._device.sensor, self._device.port, self._baudrate)
        try:
            if self._configures:
                self._configure()
        except ImuLost:
            self._line.close()
            raise

    def _configure(self) -> None:
        rate = round(self._device.rate_hz)
        self._ask(Mid.GO_TO_CONFIG, b"", Mid.GO_TO_CONFIG_ACK)
        self.serials = {self._device.sensor: self._ask(Mid.REQ_DID, b"", Mid.DEVICE_ID).hex().upper()}
        answer = self._ask(Mid.SET_OUTPUT, xbus.output_configuration(rate), Mid.SET_OUTPUT_ACK)
        try:
            rates = xbus.configured_rates(answer)
        except xbus.XbusRejected as error:
            raise ImuLost(f"{self._line.name}: {error}") from error
        for xdi in (Xdi.ACCELERATION, Xdi.RATE_OF_TURN):
            if rates.get(xdi) != rate:
                raise ImuLost(
                    f"{self._line.name}: asked for {xdi.name} at {rate} Hz, it gives {rates.get(xdi)} Hz; set rate_hz "
                    "to a rate that this sensor has"
                )
        self._ask(Mid.GO_TO_MEASUREMENT, b"", Mid.GO_TO_MEASUREMENT_ACK)

    def _ask(self, mid: Mid, data: bytes, wanted: Mid) -> bytes:
        for _ in range(TRIES):
            self._line.write(xbus.encode(mid, data))
            deadline_ns = self._clock_ns() + int(ANSWER_S * NS_PER_S)
            while (left_ns := deadline_ns - self._clock_ns()) > 0:
                self._line.wait(left_ns / NS_PER_S)
                for message in self._decoder.feed(self._line.read()):
                    if message.mid == wanted:
                        return message.data
                    if message.mid == Mid.ERROR:
                        code = message.data[0] if message.data else 0
                        said = xbus.ERRORS.get(code, "unknown error")
                        raise ImuLost(f"{self._line.name}: refuses {mid.name}: {said} (0x{code:02x})")
        why = "no Xsens sensor answers. Is it one, and does options.baudrate match its own?"
        raise ImuLost(f"{self._line.name}: {why}")

    def read(self, t_ns: int) -> list[RawSample]:
        """All measurements that have arrived."""
        samples: list[RawSample] = []
        for message in self._decoder.feed(self._line.read()):
            if message.mid != Mid.MT_DATA2:
                # not even WakeUp is answered: that would send a sensor that restarted to configuration
                continue
            try:
                found = xbus.decode_measurement(message.data)
            except xbus.XbusRejected:
                found = xbus.Measurement()
            if found.time_fine is None or found.acc_mps2 is None or found.gyr_radps is None:
                self._counts.bad_frames += 1
                continue
            self._counts.clipped += found.clipped
            stamp_ns = self._stamps.time_ns(found.time_fine)
            samples.append(self._sample(t_ns, stamp_ns, found.acc_mps2, found.gyr_radps, found.counter))
        return samples
