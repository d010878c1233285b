"""A sensor's own clock, mapped to the host's: offset and drift from the least delayed samples.

A sample arrives late by what the line, the driver and a busy host add, never early. So of all ``arrival − stamp`` the
least are right, and the clocks' relation is the line that lies under all of them and closest to them: the edge of the
lower convex hull under the middle of the window (Moon, Skelly & Towsley 1999, "Estimation and removal of clock skew
from network delay measurements"). Causal, no clock of its own, the same numbers live and in replay.

Where all samples may be late, as by radio, the least delayed one proves nothing. There the device is asked for its
time: what it answers was its time after the question, so no sample was measured before ``stamp + (asked - answer)``.
:class:`BoundedClock` maps to that earliest moment.
"""

from collections import deque
from typing import Final

from fes.signals import NS_PER_S

WINDOW_BINS: Final = 60
BIN_NS: Final = NS_PER_S
DRIFT_FROM_BINS: Final = 10  # a shorter window says nothing about drift that its delays could not have made up
MAX_SLEW: Final = 200e-6  # of the mapped stamps against the device's, once settled
MAX_DRIFT: Final = 300e-6
SETTLE_NS: Final = 2 * NS_PER_S  # a new mapping begins with one sample's delay in it: until then it may hurry
SETTLE_SLEW: Final = 0.5
AHEAD_NS: Final = 20_000_000  # stamps this far beyond their arrival show that the mapping was wrong
SET_AHEAD_NS: Final = 60_000_000  # so far beyond, three times in a row: the clock was set
SET_SAMPLES: Final = 3
JUMP_NS: Final = NS_PER_S
LATE_NS: Final = NS_PER_S // 2
LATE_BINS: Final = 5

_Point = tuple[float, float]  # device time since the mapping began, s; arrival − stamp beyond the first one's, ns


class SensorClock:
    """Maps one device's stamps; give it every sample in the order of arrival.

    The mapped stamps' increments are the device's own, but for a slow correction of at most 200 ppm; in a new mapping's
    first 2 s, and when a stamp lies over 20 ms beyond its own arrival, corrections may go faster (never backward). A
    stamp that goes back by more than 1 s, or forward by 1 s more than the host's clock, is a device that restarted or
    had its clock set: the mapping begins anew, counted in :attr:`resets`. So does one whose samples have all been
    over 0.5 s late for 5 s, and one whose stamps are over 60 ms beyond their arrival three times in a row: one or two
    such stamps are slips, mapped to the stamp before. Stamps that go back by less are mapped as they are.
    """

    def __init__(self) -> None:
        self.resets = 0
        self._started = False
        self._mapped_ns = self._base_ns = 0
        self._origin_ns = self._newest_ns = 0
        self._out_ns = self._slope = self._level = 0.0
        self._bins: deque[_Point] = deque(maxlen=WINDOW_BINS)
        self._bin, self._late, self._ahead = 0, 0, 0
        self._least: _Point = (0.0, 0.0)

    @property
    def offset_ns(self) -> int:
        """What is added to the device's stamp now."""
        return self._base_ns + round(self._out_ns) if self._started else 0

    def map(self, t_host_ns: int, t_device_ns: int) -> int:
        """The stamp on the host's time base, ns.

        Args:
            t_host_ns: when the sample arrived, never decreasing.
            t_device_ns: the device's stamp, unwrapped.
        """
        if not self._started:
            return self._begin(t_host_ns, t_device_ns)
        step_ns = t_device_ns - self._newest_ns
        excess_ns = float(t_host_ns - t_device_ns - self._base_ns)
        time_s = (t_device_ns - self._origin_ns) / NS_PER_S
        ahead_ns = self._target(time_s) - excess_ns
        slipped = ahead_ns > SET_AHEAD_NS and time_s * NS_PER_S > SETTLE_NS
        self._ahead = self._ahead + 1 if slipped else 0
        if step_ns < -JUMP_NS or ahead_ns > JUMP_NS or self._late >= LATE_BINS or self._ahead >= SET_SAMPLES:
            self.resets += 1
            return self._begin(t_host_ns, t_device_ns)
        if slipped:
            return self._mapped_ns  # as one that says nothing new: the estimator passes over it, the gate counts it
        self._keep_least(time_s, excess_ns)
        if step_ns > 0:
            self._newest_ns = t_device_ns
            self._follow(time_s, step_ns, excess_ns)
        mapped_ns = t_device_ns + self.offset_ns
        if step_ns >= 0:
            mapped_ns = self._mapped_ns = max(mapped_ns, self._mapped_ns)  # rounding
        return mapped_ns

    def _begin(self, t_host_ns: int, t_device_ns: int) -> int:
        forward = self._started and t_device_ns >= self._newest_ns
        mapped_ns = max(t_host_ns, self._mapped_ns) if forward else t_host_ns
        self._started = True
        self._origin_ns = self._newest_ns = t_device_ns
        self._base_ns = mapped_ns - t_device_ns
        self._out_ns = self._slope = self._level = 0.0
        self._bins.clear()
        self._bin, self._least = 0, (0.0, float(t_host_ns - mapped_ns))
        self._late = self._ahead = 0
        self._mapped_ns = mapped_ns
        return mapped_ns

    def _target(self, time_s: float) -> float:
        line = self._level + self._slope * time_s * NS_PER_S
        return min(line, self._least[1]) if not self._bins else line

    def _keep_least(self, time_s: float, excess_ns: float) -> None:
        """Keep the least delayed sample of every second; at a second's end draw the line anew."""
        number = int(time_s * NS_PER_S // BIN_NS)
        if number <= self._bin:
            if excess_ns < self._least[1]:
                self._least = (time_s, excess_ns)
            return
        late = bool(self._bins) and self._least[1] > self._target(self._least[0]) + LATE_NS
        self._late = self._late + 1 if late else 0
        self._bins.append(self._least)
        self._level, self._slope = line_under(list(self._bins))
        self._bin, self._least = number, (time_s, excess_ns)

    def _follow(self, time_s: float, step_ns: int, excess_ns: float) -> None:
        # a sample under the line was delayed less than any in the window
        target_ns = min(self._target(time_s), self._least[1] if self._least[0] == time_s else excess_ns)
        wrong_ns = target_ns - self._out_ns
        settling = time_s * NS_PER_S < SETTLE_NS or wrong_ns < -AHEAD_NS
        most_ns = (SETTLE_SLEW if settling else MAX_SLEW) * step_ns
        self._out_ns += min(max(wrong_ns, -most_ns), most_ns)


class BoundedClock:
    """Maps the stamps of a device that has been asked for its time: to when, at the earliest, each was measured.

    A bound grows old by the most that the clocks may drift apart; the best of all is followed by at most twice that
    rate, in the first 2 s faster. A stamp that lies beyond its own arrival, and one that goes back by more than 1 s, is
    of a clock that was set, restarted or drifts by more: counted in :attr:`resets`, and all begins anew.
    """

    def __init__(self) -> None:
        self.resets = 0
        self._known: tuple[int, int] | None = None  # the best bound of host - device, and the device's time of it
        self._out_ns: float | None = None
        self._began_ns = self._newest_ns = 0

    def asked(self, t_host_ns: int, t_device_ns: int) -> None:
        """The device's clock showed this after, and not before, this time of the host's."""
        offset_ns = t_host_ns - t_device_ns
        if self._known is None or offset_ns > self._bound_ns(t_device_ns):
            self._known = offset_ns, t_device_ns

    def map(self, t_host_ns: int, t_device_ns: int) -> int | None:
        """When it was measured at the earliest, by the host's clock, ns; None as long as nothing is known of that.

        Args:
            t_host_ns: when the sample arrived, never decreasing.
            t_device_ns: the device's stamp.
        """
        if self._known is None:
            return None
        bound_ns = self._bound_ns(t_device_ns)
        if self._out_ns is None:
            self._out_ns, self._began_ns, self._newest_ns = bound_ns, t_device_ns, t_device_ns
        step_ns = t_device_ns - self._newest_ns
        if t_device_ns + bound_ns > t_host_ns + AHEAD_NS or step_ns < -JUMP_NS:
            self.resets += 1
            self._known = self._out_ns = None
            return None
        if step_ns > 0:
            settling = t_device_ns - self._began_ns < SETTLE_NS
            most_ns = (SETTLE_SLEW if settling else 2.0 * MAX_SLEW) * step_ns
            self._out_ns += min(max(bound_ns - self._out_ns, -most_ns), most_ns)
            self._newest_ns = t_device_ns
        return t_device_ns + round(self._out_ns)

    def _bound_ns(self, t_device_ns: int) -> float:
        offset_ns, at_ns = self._known or (0, 0)
        return offset_ns - MAX_SLEW * abs(t_device_ns - at_ns)


def line_under(points: list[_Point]) -> tuple[float, float]:
    """Level (ns at time 0) and slope (ns per ns) of the line under all points that is closest to them in sum.

    With fewer than 10 points the slope is 0: what a short window shows as drift may be delay.

    Args:
        points: (time in s, value in ns) in the order of time, at least one.
    """
    lowest = min(value for _, value in points)
    if len(points) < DRIFT_FROM_BINS:
        return lowest, 0.0
    hull: list[_Point] = []
    for point in points:
        while len(hull) >= 2 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    middle = sum(time for time, _ in points) / len(points)
    edge = next((k for k in range(1, len(hull)) if hull[k][0] >= middle), len(hull) - 1)
    (t0, v0), (t1, v1) = hull[edge - 1], hull[edge]
    slope = min(max((v1 - v0) / ((t1 - t0) * NS_PER_S), -MAX_DRIFT), MAX_DRIFT)
    level = min(value - slope * time * NS_PER_S for time, value in points)
    return level, slope


def _turns_right(a: _Point, b: _Point, c: _Point) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
