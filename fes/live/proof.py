"""Arming after a sensor's fault is a test: a tap on the sensor has to be seen when it happens. No clock, no I/O.

How late samples come is known against the least delayed one since a line was opened. A sensor that is opened again with
all its data late by the same time looks prompt; so does one that came back frozen, before it is moved. A person can
tell: they tap the sensor and press the key in the same moment, and both are stamped by the host's clock.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Final

from fes.limits import MAX_DATA_AGE_MS
from fes.session_log import Note
from fes.signals import G_MPS2, NS_PER_S, ImuSample

STILL_NS: Final = NS_PER_S  # before a tap: who taps again and again cannot meet a delay by chance
TAP_RADPS: Final = 0.5  # standing sways by less than 0.15
TAP_MPS2: Final = 3.0  # from gravity; a sensor that reads it off by 0.5 cannot be armed
MOST_STEP_NS: Final = 40_000_000  # between two samples; what a longer gap hides was perhaps no rest
LATE_NS: Final = MAX_DATA_AGE_MS * 1_000_000  # a tap may be seen after the key; by radio as late as data may be
EARLY_NS: Final = 100_000_000  # or before it: the other hand, and the page's way, take so long; a judgement
ASKED: Final = "then tap it"  # the words by which a program knows that it is asked for
WAITS_NS: Final = 2 * NS_PER_S  # for a tap that comes late, to say how late


class Proof:
    """What the sensors in ``doubted``, the gate's own set, have to show; each that has is taken out of it.

    ``late_ns``: by sensor by radio, how late a tap of it may be seen.
    """

    def __init__(
        self, doubted: set[str], note: Callable[[Note], None], late_ns: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        self._doubted, self._note, self._late_ns = doubted, note, late_ns
        self._seen_ns: dict[str, int] = {}
        self._moved_ns: dict[str, int] = {}
        self._taps: dict[str, int] = {}
        self._key_ns: int | None = None

    def wanted(self) -> str:
        """What a person has to do before arming; "" when nothing."""
        if not self._doubted:
            return ""
        first = sorted(self._doubted)[0]
        return f"{first} had a fault: keep it still for a second, {ASKED} and press arm in the same moment"

    def press(self, t_ns: int) -> None:
        """The key, at the moment of the tap."""
        self._key_ns = t_ns

    def observe(self, sample: ImuSample) -> str:
        """Take in a sample; in words what came of the last key, once that is known."""
        sensor, t_ns = sample.sensor, sample.t_ns
        if sensor not in self._doubted:
            return ""
        known, self._seen_ns[sensor] = self._seen_ns.get(sensor), t_ns
        (x, y, z), (p, q, r) = sample.acc_mps2, sample.gyr_radps
        still = p * p + q * q + r * r < TAP_RADPS**2 and abs((x * x + y * y + z * z) ** 0.5 - G_MPS2) < TAP_MPS2
        if known is None or t_ns - known > self._late_ns.get(sensor, MOST_STEP_NS):
            self._moved_ns[sensor] = t_ns
            self._taps.pop(sensor, None)
        elif not still:
            if t_ns - self._moved_ns[sensor] >= STILL_NS:
                self._taps[sensor] = t_ns
            self._moved_ns[sensor] = t_ns
        return self._judge(sensor, t_ns)

    def _judge(self, sensor: str, t_ns: int) -> str:
        if self._key_ns is None:
            return ""
        late_ns = self._taps.get(sensor, -WAITS_NS) - self._key_ns
        most_ns = self._late_ns.get(sensor, LATE_NS)
        if -EARLY_NS <= late_ns <= most_ns:
            self._doubted.discard(sensor)
            self._key_ns = None
            self._note(Note(t_ns, "info", "session", f"{sensor}: a tap seen {late_ns / 1e6:+.0f} ms from the key"))
            return self.wanted() or f"{sensor}: the tap was seen; stand still, then arm"
        if late_ns > most_ns:
            self._key_ns = None
            said = f"{sensor}: a tap seen {late_ns / 1e6:.0f} ms after the key: its data come late, or you tapped late"
        elif t_ns - self._key_ns > WAITS_NS:
            self._key_ns = None
            said = f"no tap of {sensor} was seen with the key; {self.wanted()}"
        else:
            return ""
        self._note(Note(t_ns, "warning", "session", said))
        return said
