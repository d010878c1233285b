"""A device's counters and stamps: unwrapped to integers that do not run over, and what they say about losses."""

from __future__ import annotations

from drivers.imu.port import LineCounts
from fes.signals import NS_PER_S


class Unwrapper:
    """A counter of so many bits → one that goes on; the shorter way round is taken to be the true one."""

    def __init__(self, bits: int) -> None:
        self._modulus = 1 << bits
        self._value: int | None = None

    def unwrap(self, raw: int) -> int:
        """The counter's value without wraps; starts at ``raw``. Small steps back stay steps back."""
        if self._value is None:
            self._value = raw
        else:
            step = (raw - self._value) % self._modulus
            self._value += step - self._modulus if step >= self._modulus // 2 else step
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
        if stamp_ns < last_ns:
            self._counts.backward += 1
            return
        if stamp_ns == last_ns:
            self._counts.doubled += 1
            return
        if counter is not None and last is not None and self._modulus:
            step = (counter - last) % self._modulus
            if 1 < step < self._modulus // 2:
                self._counts.missing += step - 1
        else:
            missing = round((stamp_ns - last_ns) / self._period_ns) - 1
            if 0 < missing < 60 * NS_PER_S / self._period_ns:  # more is a clock that was set
                self._counts.missing += missing
