"""An Xsens MTi on a serial line: configures it, then turns its bytes into samples.

Options: ``baudrate`` (115200), ``configure`` (true: set the outputs and their rate; false: only listen).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from drivers.imu.line import ByteLine
from drivers.imu.port import (
    ImuLost,
    LineCounts,
    LossCounter,
    Ranges,
    RawSample,
    SensorDevice,
    StampClock,
    flag_option,
    whole_option,
)
from drivers.imu.xbus_codec import (
    ERRORS,
    TIME_FINE_TICK_NS,
    Mid,
    XbusDecoder,
    XbusMessage,
    XbusRejected,
    Xdi,
    configured_rates,
    decode_measurement,
    encode,
    output_configuration,
)
from fes.signals import NS_PER_S

ANSWER_S: Final = 0.5
TRIES: Final = 3
SAMPLE_BYTES: Final = 54  # with counter, time, acceleration, rate of turn and status as float32


class XbusImu:
    """:class:`~drivers.imu.port.ImuPort` for one MTi.

    Raises:
        ValueError: the rate does not fit the baud rate, is not whole, or an option is not what it must be.
        ImuLost: no such line, or no MTi answers on it.
    """

    def __init__(self, device: SensorDevice, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._device = device
        self._clock_ns = clock_ns
        self._baudrate = whole_option(device, "baudrate", 115200, 1)
        self._configures = flag_option(device, "configure", True)
        if self._configures and device.rate_hz != round(device.rate_hz):
            raise ValueError(
                f"{device.sensor}: rate_hz = {device.rate_hz:g} must be whole: an MTi takes no other rates"
            )
        self._needs = device.rate_hz * SAMPLE_BYTES * 10
        if self._needs > self._baudrate:
            raise ValueError(
                f"{device.sensor}: {device.rate_hz:g} Hz need {self._needs:.0f} baud, options.baudrate is "
                f"{self._baudrate}; set the sensor and this option to a higher one"
            )
        self.sensors: tuple[str, ...] = (device.sensor,)
        self.counts = {device.sensor: LineCounts()}
        self._ranges = Ranges(device)
        self._open()

    def _open(self) -> None:
        counts = self.counts[self._device.sensor]
        self._decoder = XbusDecoder()
        self._seen_bad, self._seen_skipped = 0, 0
        self._stamps = StampClock(32, TIME_FINE_TICK_NS)
        self._losses = LossCounter(counts, self._device.rate_hz, 16)
        self._line = ByteLine(self._device.sensor, self._device.port, self._baudrate)
        if self._configures:
            try:
                self._configure()
            except ImuLost:
                self._line.close()
                raise

    def _configure(self) -> None:
        rate = round(self._device.rate_hz)
        self._ask(Mid.GO_TO_CONFIG, b"", Mid.GO_TO_CONFIG_ACK)
        answer = self._ask(Mid.SET_OUTPUT, output_configuration(rate), Mid.SET_OUTPUT_ACK)
        try:
            rates = configured_rates(answer)
        except XbusRejected as error:
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
            self._line.write(encode(mid, data))
            deadline_ns = self._clock_ns() + int(ANSWER_S * NS_PER_S)
            while (left_ns := deadline_ns - self._clock_ns()) > 0:
                self._line.wait(left_ns / NS_PER_S)
                for message in self._decoder.feed(self._line.read()):
                    if message.mid == wanted:
                        return message.data
                    if message.mid == Mid.ERROR:
                        code = message.data[0] if message.data else 0
                        said = ERRORS.get(code, "unknown error")
                        raise ImuLost(f"{self._line.name}: refuses {mid.name}: {said} (0x{code:02x})")
        raise ImuLost(
            f"{self._line.name}: no Xsens sensor answers. Is it one, and does options.baudrate match its own?"
        )

    def fileno(self) -> int:
        """The line's descriptor."""
        return self._line.fileno()

    def read(self, t_ns: int) -> list[RawSample]:
        """All measurements that have arrived."""
        messages = self._decoder.feed(self._line.read())
        counts = self.counts[self._device.sensor]
        samples = [sample for message in messages if (sample := self._sample(t_ns, message, counts)) is not None]
        counts.bad_frames += self._decoder.bad_frames - self._seen_bad
        counts.bytes_skipped += self._decoder.bytes_skipped - self._seen_skipped
        self._seen_bad, self._seen_skipped = self._decoder.bad_frames, self._decoder.bytes_skipped
        return samples

    def _sample(self, t_ns: int, message: XbusMessage, counts: LineCounts) -> RawSample | None:
        if message.mid != Mid.MT_DATA2:
            # not even WakeUp is answered: that would send a sensor that restarted to configuration
            return None
        try:
            found = decode_measurement(message.data)
        except XbusRejected:
            counts.bad_frames += 1
            return None
        if found.time_fine is None or found.acc_mps2 is None or found.gyr_radps is None:
            counts.bad_frames += 1
            return None
        counts.clipped += found.clipped
        stamp_ns = self._stamps.time_ns(found.time_fine)
        self._losses.note(stamp_ns, found.counter)
        sample = RawSample(self._device.sensor, t_ns, stamp_ns, found.acc_mps2, found.gyr_radps)
        return self._ranges.judged(sample, counts)

    def reopen(self) -> None:
        """Open the line again and configure the sensor anew."""
        self.close()
        self._open()

    def close(self) -> None:
        """Release the line."""
        self._line.close()
