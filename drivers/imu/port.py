"""What the loop asks of every inertial sensor, and what the ports share: ranges, options, counters and stamps."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

from fes.config import ImuDevice
from fes.signals import G_MPS2, NS_PER_S, RawSample, Vector3

AXES: Final = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")  # as options name them
BEYOND_RANGE: Final = 1.05  # a sensor's own calibration may stretch its full scale a little, not more
NOT_A_NUMBER: Final = (math.nan, math.nan, math.nan)


class ImuLost(RuntimeError):
    """The sensor's line broke or cannot be opened: unplugged, closed, refused; the message says what to check."""


@dataclass(slots=True)
class LineCounts:
    """What came over one sensor's line, and what was wrong with it.

    ``missing`` by the device's own counter (or stamps); ``doubled`` samples with the stamp of the one before;
    ``backward`` stamps that went back; ``bad_frames`` failed a structural check (checksum, length, incomplete group);
    ``bad_values`` were NaN or beyond what the sensor can measure, and are passed on as NaN; ``clipped`` by the device's
    own flag; so are ``time_gaps``, and ``unsound``, whose processing in the device failed (passed on as NaN);
    ``bytes_skipped`` belonged to no frame.
    """

    samples: int = 0
    missing: int = 0
    doubled: int = 0
    backward: int = 0
    bad_frames: int = 0
    bad_values: int = 0
    clipped: int = 0
    time_gaps: int = 0
    unsound: int = 0
    bytes_skipped: int = 0


class ImuPort(ABC):
    """One line with one sensor or several. Only opening waits; nothing here reads a clock.

    ``serials``: by sensor, the serial number of the device there, where it tells one; ``firmwares``: so its firmware.
    """

    sensors: tuple[str, ...]
    serials: Mapping[str, str] = MappingProxyType({})
    firmwares: Mapping[str, str] = MappingProxyType({})
    counts: dict[str, LineCounts]

    @property
    def notices(self) -> Sequence[str]:
        """What the devices say of themselves that a person should know; most say nothing."""
        return ()

    @abstractmethod
    def fileno(self) -> int | None:
        """Readable when something waits; None: read at every tick."""

    @abstractmethod
    def read(self, t_ns: int) -> list[RawSample]:
        """Everything that has arrived, stamped ``t_ns``; never waits.

        Raises:
            ImuLost: the line broke; :meth:`reopen` may mend it.
        """

    def clock_answers(self) -> Sequence[tuple[str, int, int]]:
        """Of sensors by radio, since the last call: when each was asked for its time (host, ns), what it said (ns)."""
        return ()

    def reopen(self) -> None:
        """Let go of the line and open it again; ImuLost: it is still gone."""
        self.close()
        self._open()

    @abstractmethod
    def close(self) -> None:
        """Release the line; may be called twice."""

    @abstractmethod
    def _open(self) -> None:
        """Open the line, with all that is counted from its beginning anew."""


class Ranges:
    """What a sensor can physically deliver."""

    def __init__(self, device: ImuDevice) -> None:
        self._acc_mps2 = device.acc_range_g * G_MPS2 * BEYOND_RANGE
        self._gyr_radps = math.radians(device.gyr_range_dps) * BEYOND_RANGE

    def judged(self, sample: RawSample, counts: LineCounts) -> RawSample:
        """The sample, counted; all NaN when a value cannot come from this sensor, so that the gate refuses it."""
        counts.samples += 1
        within = ((sample.acc_mps2, self._acc_mps2), (sample.gyr_radps, self._gyr_radps))
        if all(abs(value) <= most for values, most in within for value in values):  # a comparison with NaN is False
            return sample
        counts.bad_values += 1
        return replace(sample, acc_mps2=NOT_A_NUMBER, gyr_radps=NOT_A_NUMBER)


class OneSensorPort(ImuPort):
    """Base of an :class:`ImuPort` for one sensor: opened when it is made, counted and judged by its settings."""

    def __init__(self, device: ImuDevice) -> None:
        self._device = device
        self._counts = LineCounts()
        self._ranges = Ranges(device)
        self.sensors: tuple[str, ...] = (device.sensor,)
        self.counts: dict[str, LineCounts] = {device.sensor: self._counts}
        self._open()

    def _expect_samples(self, counter_bits: int = 0) -> None:
        self._losses = LossCounter(self._counts, self._device.rate_hz, counter_bits)

    def _sample(self, t_ns: int, stamp_ns: int, acc: Vector3, gyr: Vector3, counter: int | None = None) -> RawSample:
        self._losses.note(stamp_ns, counter)
        return self._ranges.judged(RawSample(self._device.sensor, t_ns, stamp_ns, acc, gyr), self._counts)


def text_option(device: ImuDevice, name: str, default: str) -> str:
    """A setting of ``options`` that is text."""
    return str(device.options.get(name, default))


def seconds_option(device: ImuDevice, name: str, default: float) -> float:
    """A setting of ``options`` that is a time in s. ValueError: it is no number above 0."""
    value = device.options.get(name, default)
    if isinstance(value, (str, bool)) or not math.isfinite(value) or value <= 0:
        raise ValueError(f"{device.sensor}: options.{name} = {value!r} must be a number of seconds above 0")
    return value


def whole_option(device: ImuDevice, name: str, default: int, least: int) -> int:
    """A setting of ``options`` that counts something. ValueError: it is no whole number, or less than ``least``."""
    value = device.options.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{device.sensor}: options.{name} = {value!r} must be a whole number of at least {least}")
    return value


def flag_option(device: ImuDevice, name: str, default: bool) -> bool:
    """A setting of ``options`` that is true or false. ValueError: anything else, the text ``"false"`` too."""
    value = device.options.get(name, default)
    if not isinstance(value, bool):
        raise ValueError(f"{device.sensor}: options.{name} = {value!r} must be true or false")
    return value


class Unwrapper:
    """A counter of so many bits → one that goes on; the shorter way round is taken to be the true one."""

    def __init__(self, bits: int) -> None:
        self._modulus = 1 << bits
        self._value: int | None = None

    def unwrap(self, raw: int) -> int:
        """The counter's value without wraps; starts at ``raw``. Small steps back stay steps back."""
        before = raw if self._value is None else self._value
        step = (raw - before) % self._modulus
        self._value = before + (step - self._modulus if step >= self._modulus // 2 else step)
        return self._value


class StampClock:
    """A device's time stamps of ``tick_ns`` each in ``bits`` → ns. A restart (a stamp near 0) stays a step back.

    A 32-bit stamp runs over only from its top: a step back from anywhere else is a device that restarted.
    """

    def __init__(self, bits: int, tick_ns: float) -> None:
        self._modulus = 1 << bits
        self._tick_ns = tick_ns
        self._turns = 0
        self._last: int | None = None

    def time_ns(self, raw: int) -> int:
        """Device time in ns."""
        eighth = self._modulus // 8
        if self._last is not None:
            if self._last > self._modulus - eighth and raw < eighth:
                self._turns += 1
            elif self._last < eighth and raw > self._modulus - eighth and self._turns:
                self._turns -= 1  # a late one from before the turn
        self._last = raw
        return round((raw + self._turns * self._modulus) * self._tick_ns)


class LossCounter:
    """Counts gaps, doubles and steps back; by a packet counter where there is one, else by the stamps."""

    def __init__(self, counts: LineCounts, rate_hz: float, counter_bits: int = 0) -> None:
        self._counts = counts
        self._period_ns = NS_PER_S / rate_hz
        self._modulus = 1 << counter_bits if counter_bits else 0
        self._counter: int | None = None
        self._stamp_ns: int | None = None

    def note(self, stamp_ns: int, counter: int | None = None) -> None:
        """One sample has come."""
        last_ns, self._stamp_ns = self._stamp_ns, stamp_ns
        last, self._counter = self._counter, counter
        if last_ns is None:
            return
        self._counts.backward += stamp_ns < last_ns
        self._counts.doubled += stamp_ns == last_ns
        if stamp_ns <= last_ns:
            return
        if counter is not None and last is not None and self._modulus:
            step = (counter - last) % self._modulus
            if 1 < step < self._modulus // 2:
                self._counts.missing += step - 1
        else:
            missing = round((stamp_ns - last_ns) / self._period_ns) - 1
            if 0 < missing < 60 * NS_PER_S / self._period_ns:  # more is a clock that was set
                self._counts.missing += missing
