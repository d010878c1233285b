"""Are the data behind a decision fresh, and a sensor's time stamps in order?

Judged on the host's clock and on the sensor's own. Of a sensor by radio the stamp is when it was measured, at the
earliest, by the host's clock (:class:`fes.control.clock_sync.BoundedClock`): its age is no matter of the least delayed
sample, which may be late as well. Its connection fails now and then: what is too old then ends a burst, and is a fault
once it has gone on for ``MAX_SILENCE_NS``.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from fes.signals import NS_PER_S, ImuSample

WINDOW_NS: Final = NS_PER_S
MOST_SHARE: Final = 0.05
LEAST_SLIPS: Final = 3  # so that a window that has only begun does not condemn a single one
LEAST_JUMP_NS: Final = 35_000_000  # a stamp further ahead of the time waited than this, and than half of that time
MAX_SAME_MS: Final = 60  # of bit-identical samples
SLIPS_BELIEVED: Final = 3  # in a row: a stamp far off is a slip, three of them are a clock that was set
MAX_SILENCE_NS: Final = 250_000_000  # what comes after one may be late by all of it, whatever its stamps say
MAX_CLOCK_DRIFT_PPM: Final = 200  # of a sensor's clock against the host's; a crystal keeps within 100


@dataclass(slots=True)
class _SensorStamps:
    t_ns: int
    t_sensor_ns: int
    slips: deque[int] = field(default_factory=deque)  # arrival times of the slips within the window
    samples: deque[int] = field(default_factory=deque)  # arrival times of all samples within the window


class Stamps:
    """Counts stamps that are doubled, out of order, or ahead of the time that has passed, sensor by sensor.

    Single slips are counted, too many within a second are a fault. A gap is no slip: what was lost on the way shows in
    the data's age. ``by_radio``: samples come in bunches, so that stamps go ahead of the time waited; none may lie
    ahead of its own arrival.
    """

    def __init__(self, by_radio: frozenset[str] = frozenset()) -> None:
        self._by_radio = by_radio
        self._sensors: dict[str, _SensorStamps] = {}

    def fault(self, sample: ImuSample) -> str:
        """Take in a sample; says so when more than 5 % of the last second's stamps were out of order."""
        known = self._sensors.get(sample.sensor)
        if known is None:
            self._sensors[sample.sensor] = _SensorStamps(sample.t_ns, sample.t_sensor_ns)
            return ""
        t_ns, samples, slips = sample.t_ns, known.samples, known.slips
        step_ns, waited_ns = sample.t_sensor_ns - known.t_sensor_ns, t_ns - known.t_ns
        known.t_ns, known.t_sensor_ns = t_ns, sample.t_sensor_ns
        samples.append(t_ns)
        if sample.sensor in self._by_radio:
            ahead_ns, waited_ns = sample.t_sensor_ns - t_ns, 0
        else:
            ahead_ns = step_ns - waited_ns
        if step_ns <= 0 or (ahead_ns > LEAST_JUMP_NS and ahead_ns > waited_ns // 2):
            slips.append(t_ns)
        while t_ns - samples[0] > WINDOW_NS:  # at the latest it ends at this sample
            samples.popleft()
        while slips and t_ns - slips[0] > WINDOW_NS:
            slips.popleft()
        if len(slips) < LEAST_SLIPS or len(slips) <= MOST_SHARE * len(samples):
            return ""
        share = f"{len(slips)} of {len(samples)} within a second"
        return f"{sample.sensor}'s time stamps are out of order: {share}"


@dataclass(slots=True)
class _Sensor:
    """``offset_ns`` is the least arrival − stamp seen, the mapping of the least delayed sample.

    It may creep up with the clocks' drift, or an hour of honest drift would look like a delay. ``changed_ns`` is when
    the values last differed from those before: a sensor that repeats itself arrives on time and says nothing.
    ``begun_ns`` is when the mapping began, ``slips`` how many of the newest samples in a row do not fit it.
    """

    t_ns: int
    t_sensor_ns: int
    offset_ns: int
    finite: bool
    values: tuple[float, ...]
    changed_ns: int
    begun_ns: int
    slips: int = 0


class Freshness:
    """What each sensor sent last, and when.

    A queue drained late delivers old data that have only just arrived; the sensor's own stamps give it away.

    Args:
        max_age_ns: how old the newest sample may be, on either clock.
        by_radio: sensors whose stamps are times of the host's clock, each with an age of its own.
    """

    def __init__(self, max_age_ns: int, by_radio: Mapping[str, int] | None = None) -> None:
        self._max_age_ns = max_age_ns
        self._by_radio = by_radio or {}
        self._sensors: dict[str, _Sensor] = {}

    def note(self, sample: ImuSample) -> str:
        """Take in a sample; returns what is wrong with it, "" when nothing is."""
        t_ns, t_sensor_ns, values = sample.t_ns, sample.t_sensor_ns, sample.acc_mps2 + sample.gyr_radps
        finite = math.isfinite(sum(values)) or all(map(math.isfinite, values))  # finite ones may have a sum that is not
        max_age_ns = self._by_radio.get(sample.sensor)
        # of a radio's stamps it is known
        offset_ns = t_ns - t_sensor_ns if max_age_ns is None else min(t_ns - t_sensor_ns, 0)
        max_age_ns = self._max_age_ns if max_age_ns is None else max_age_ns
        fault = "" if finite else f"non-finite sample from {sample.sensor}"
        known = self._sensors.get(sample.sensor)
        if known is None:
            self._sensors[sample.sensor] = _Sensor(t_ns, t_sensor_ns, offset_ns, finite, values, t_ns, t_ns)
            return fault
        back_ns = known.t_sensor_ns - t_sensor_ns
        # sent later than it could have been, were it the least delayed of all; in the first second that is still learnt
        ahead_ns = known.offset_ns - offset_ns if t_ns - known.begun_ns > NS_PER_S else 0
        if back_ns > max_age_ns or ahead_ns > max_age_ns:
            known.slips += 1
            if known.slips == SLIPS_BELIEVED:
                # the sensor restarted or its clock was set: its mapping starts anew
                self._sensors[sample.sensor] = _Sensor(t_ns, t_sensor_ns, offset_ns, finite, values, t_ns, t_ns)
                where = f"back by {back_ns / 1e6:.0f}" if back_ns > 0 else f"ahead by {ahead_ns / 1e6:.0f}"
                return fault or f"{sample.sensor}'s clock went {where} ms"
        else:
            known.slips = 0
            drift_ns = max(t_ns - known.t_ns, 0) * MAX_CLOCK_DRIFT_PPM // 1_000_000
            known.offset_ns = min(offset_ns, known.offset_ns + drift_ns)
            if t_sensor_ns > known.t_sensor_ns:
                known.t_sensor_ns = t_sensor_ns
        known.t_ns, known.finite = t_ns, finite
        if values != known.values:
            known.values, known.changed_ns = values, t_ns
            return fault
        return fault or self._frozen(sample.sensor, known)

    def silence(self, sample: ImuSample) -> str:
        """Says so when nothing had come from this sensor for long; to be asked before :meth:`note`."""
        known = self._sensors.get(sample.sensor)
        silent_ns = sample.t_ns - known.t_ns if known else 0
        if silent_ns <= MAX_SILENCE_NS:
            return ""
        return f"{sample.sensor} was silent for {silent_ns / 1e6:.0f} ms: what comes now may be late"

    def reason_not_ready(self, sensor: str, t_ns: int) -> str:
        """Why this sensor's data are no ground for stimulating at ``t_ns``; "" when they are."""
        known = self._sensors.get(sensor)
        if known is None:
            return f"no data from {sensor}"
        if not known.finite:
            return f"non-finite sample from {sensor}"
        arrival_ns = t_ns - known.t_ns
        if arrival_ns < 0:
            return f"{sensor} data are dated {-arrival_ns / 1e6:.3g} ms ahead"
        age_ns = t_ns - known.t_sensor_ns - known.offset_ns
        max_age_ns = self._by_radio.get(sensor, self._max_age_ns)
        if arrival_ns <= max_age_ns and age_ns <= max_age_ns:
            return self._frozen(sensor, known)
        limit = f"limit {max_age_ns / 1e6:.0f} ms"
        if arrival_ns > max_age_ns:
            return f"{sensor} data {math.ceil(arrival_ns / 1e6)} ms old, {limit}"
        if sensor in self._by_radio:
            return f"{sensor} data {math.ceil(age_ns / 1e6)} ms old: they come late, its radio is behind; {limit}"
        return f"{sensor} data {math.ceil(age_ns / 1e6)} ms old by the sensor's own clock, {limit}"

    def lags(self, sensor: str, t_ns: int) -> str:
        """Says so when a sensor by radio is behind, but not for so long that it is a fault."""
        known = self._sensors.get(sensor)
        if sensor not in self._by_radio or known is None or not known.finite or known.t_ns > t_ns:
            return ""
        age_ns = t_ns - known.t_sensor_ns - known.offset_ns
        return self.reason_not_ready(sensor, t_ns) if self._by_radio[sensor] < age_ns <= MAX_SILENCE_NS else ""

    @staticmethod
    def _frozen(sensor: str, known: _Sensor) -> str:
        """No living sensor repeats all six values: its noise moves one of them within a few samples, at rest too."""
        same_ns = known.t_ns - known.changed_ns
        if same_ns < MAX_SAME_MS * 1_000_000:
            return ""
        return f"{sensor} is frozen: the same values for {same_ns / 1e6:.0f} ms, limit {MAX_SAME_MS} ms"
