"""A WitMotion sensor with the standard protocol on a serial line.

Options: ``baudrate`` (115200; many are shipped with 9600), ``configure`` (true: what it sends, how often and through
which low-pass is set, and stored in it, where it is not so already; false: only listens, and it must send its time).
Without its time a sample cannot be told from a late one: it is not used. Its gyroscope reads exactly 0 at rest: below
0.3 °/s for 0.5 s by the protocol's registers 6F and 6E, which are left as they are.
"""

import math
import time
from collections.abc import Callable
from typing import Final

from drivers.imu import witmotion_codec as wit
from drivers.imu.line import ByteLine, LineOpener, LineSensorPort
from drivers.imu.port import ImuLost, flag_option, whole_option
from fes.config import ImuDevice
from fes.signals import G_MPS2, NS_PER_S, RawSample

ANSWER_S: Final = 0.5
PAUSE_S: Final = 0.2  # between commands, as the protocol asks for
TRIES: Final = 3
SAMPLE_BYTES: Final = 3 * wit.FRAME_BYTES


class WitmotionImu(LineSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one WitMotion sensor.

    Raises:
        ValueError: a rate that it has not or that does not fit the baud rate, or an option is not what it must be.
        ImuLost: no such line, or no such sensor answers on it.
    """

    def __init__(
        self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns, opener: LineOpener = ByteLine
    ) -> None:
        self._clock_ns = clock_ns
        self._baudrate = whole_option(device, "baudrate", 115200, 1)
        self._configures = flag_option(device, "configure", True)
        given = f"{device.sensor}: rate_hz = {device.rate_hz:g}"
        if device.rate_hz not in wit.OUTPUT_RATES:
            raise ValueError(f"{given}: a WitMotion sensor has {', '.join(map(str, wit.OUTPUT_RATES))}")
        if (needs := device.rate_hz * SAMPLE_BYTES * 10) > self._baudrate:
            raise ValueError(f"{given} needs {needs:.0f} baud, options.baudrate is {self._baudrate}; set both higher")
        super().__init__(device, opener)

    def _open(self) -> None:
        self._decoder = wit.WitmotionDecoder()
        self._expect_samples()
        self._line = self._opener(self._device.sensor, self._device.port, self._baudrate)
        try:
            if self._configures:
                self._configure()
        except ImuLost:
            self._line.close()
            raise
        self._decoder.counts = self._counts  # what came before it was set up says nothing of it

    def _configure(self) -> None:
        rate_hz = round(self._device.rate_hz)
        wanted = {
            wit.OUTPUTS: wit.TIME_FORCE_RATE,
            wit.OUTPUT_RATE: wit.OUTPUT_RATES[rate_hz],
            wit.BANDWIDTH: wit.BANDWIDTHS[rate_hz],
        }
        if self._set_up() == wanted:
            return
        commands = (wit.write(register, value) for register, value in wanted.items())
        for command in (wit.UNLOCK, *commands, wit.write(wit.SAVE, 0)):
            self._line.write(command)
            self._pass(PAUSE_S)
        if (found := self._set_up()) != wanted:
            raise ImuLost(f"{self._line.name}: asked for registers {wanted}, it has {found}: is it of another kind?")

    def _set_up(self) -> dict[int, int]:
        """What it sends, how often and filtered how, by register."""
        outputs, rate, *_ = self._ask(wit.OUTPUTS)
        bandwidth, gyr_range, *_ = self._ask(wit.BANDWIDTH)
        if gyr_range != wit.RANGE_2000_DPS:
            raise ImuLost(f"{self._line.name}: its gyroscope is not set to 2000 °/s (register 20: {gyr_range})")
        return {wit.OUTPUTS: outputs, wit.OUTPUT_RATE: rate, wit.BANDWIDTH: bandwidth}

    def _ask(self, register: int) -> tuple[int, ...]:
        for attempt in range(TRIES):
            self._line.write(wit.read(register))
            if values := self._pass(ANSWER_S, answered=True):
                if attempt:
                    self._pass(ANSWER_S)  # an answer to an earlier question must not be one to the next
                return values
        raise ImuLost(f"{self._line.name}: no WitMotion sensor answers. Is it one, and is options.baudrate its own?")

    def _pass(self, seconds: float, *, answered: bool = False) -> tuple[int, ...]:
        """Let so much time pass, or until it has ``answered``; the registers in its answer."""
        values: tuple[int, ...] = ()
        deadline_ns = self._clock_ns() + int(seconds * NS_PER_S)
        while (left_ns := deadline_ns - self._clock_ns()) > 0 and not (answered and values):
            self._line.wait(left_ns / NS_PER_S)
            for message in self._decoder.feed(self._line.read()):
                values = message.values if isinstance(message, wit.Registers) else values
        return values

    def read(self, t_ns: int) -> list[RawSample]:
        """All samples that have arrived, by the sensor's own clock."""
        found: list[RawSample] = []
        for message in self._decoder.feed(self._line.read()):
            if isinstance(message, wit.Sample):
                ax, ay, az = message.acc_g
                p, q, r = message.gyr_dps
                force = ax * G_MPS2, ay * G_MPS2, az * G_MPS2
                rate = math.radians(p), math.radians(q), math.radians(r)
                found.append(self._sample(t_ns, message.t_ms * 1_000_000, force, rate))
        return found
