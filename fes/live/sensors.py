"""The sensors' lines as the loop sees them: samples in the host's time, losses as events, lines opened again.

Opening a lost device again without holding up the loop: in a thread of its own, later each time it fails.

The last second of each sensor: is it alive, at its rate, at rest, upright? Asked before arming. Pure.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Final, Generic, TypeVar

import numpy as np

from fes.config import ImuDevice
from fes.estimation.sensor_choice import Calibration
from fes.live.ports import Imu, SensorClock
from fes.signals import G_MPS2, NS_PER_S, Event, FloatArray, ImuSample, SystemFault

Port = TypeVar("Port")

FIRST_PAUSE_NS: Final = 250_000_000
LONGEST_PAUSE_NS: Final = 4_000_000_000


class Reopening(Generic[Port]):
    """Attempts at opening something, one at a time, with pauses that double from 0.25 s up to 4 s."""

    def __init__(self, opener: Callable[[], Port], t_ns: int) -> None:
        self._opener = opener
        self._pause_ns = FIRST_PAUSE_NS
        self._next_ns = t_ns + FIRST_PAUSE_NS
        self._thread: threading.Thread | None = None
        self._opened: list[Port] = []
        self.why_not = ""

    def poll(self, t_ns: int) -> Port | None:
        """Begin or collect an attempt; what was opened, once."""
        if self._thread is not None:
            if self._thread.is_alive():
                return None
            self._thread = None
            if self._opened:
                return self._opened.pop()
            self._next_ns = t_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        if t_ns >= self._next_ns:
            self._thread = threading.Thread(target=self._attempt, daemon=True)
            self._thread.start()
        return None

    def _attempt(self) -> None:
        try:
            self._opened.append(self._opener())
        except Exception as error:  # whatever a driver raises, the next attempt comes later
            self.why_not = str(error)


SPAN_NS: Final = NS_PER_S
ALIVE_NS: Final = 40_000_000
RATE_TOLERANCE: Final = 0.1  # of the nominal rate; beyond it the settings are wrong or samples are lost
STILL_RADPS: Final = 0.15  # standing sways less than this; a stance in walking does not last a second
GRAVITY_TOLERANCE_MPS2: Final = 0.5
ZERO_TOLERANCE_MPS2: Final = 0.06  # of gravity at rest; what is left after a calibration on the spot is below 0.01
HEIGHT_BY_ZERO_M: Final = 0.11  # by m/s²: a swing's height against the accelerometer's zero, from virtual patients
TILT_TOLERANCE_RAD: Final = np.deg2rad(25.0)  # a foot on a slope or with raised toes is no remounted sensor


class SensorMonitor:
    """A ring of one sensor's newest samples.

    Args:
        device: its settings.
        calibration: how it sits, where it is calibrated; only then can its direction be judged.
    """

    def __init__(self, device: ImuDevice, calibration: Calibration | None) -> None:
        self.device = device
        self._calibration = calibration
        self._size = max(int(1.5 * device.rate_hz * SPAN_NS / NS_PER_S), 8)
        self._t_ns = np.zeros(self._size, np.int64)
        self._values: FloatArray = np.zeros((self._size, 6))
        self.count = 0
        self.newest_ns: int | None = None

    def note(self, sample: ImuSample) -> None:
        """Take in a sample."""
        at = self.count % self._size
        self._t_ns[at] = self.newest_ns = sample.t_ns
        self._values[at, :3] = sample.acc_mps2
        self._values[at, 3:] = sample.gyr_radps
        self.count += 1

    def rate_hz(self, t_ns: int) -> float:
        """Samples that came within the last second."""
        return float(len(self._recent(t_ns, SPAN_NS)))

    def age_ms(self, t_ns: int) -> float:
        """Of the newest sample; infinite before the first."""
        return float("inf") if self.newest_ns is None else (t_ns - self.newest_ns) / 1e6

    def not_alive(self, t_ns: int) -> str:
        """Why it does not count as alive at the right rate; "" when it does."""
        name, nominal_hz = self.device.sensor, self.device.rate_hz
        if self.newest_ns is None:
            return f"{name}: nothing has come; is it switched on?"
        if t_ns - self.newest_ns > ALIVE_NS:
            return f"{name}: silent for {self.age_ms(t_ns):.0f} ms"
        rate_hz = self.rate_hz(t_ns)
        if abs(rate_hz - nominal_hz) > RATE_TOLERANCE * nominal_hz:
            return f"{name}: {rate_hz:.0f} samples in the last second, {nominal_hz:.0f} are expected (rate_hz)"
        return ""

    def not_at_rest(self, t_ns: int, span_ns: int = SPAN_NS) -> str:
        """Why it does not count as at rest for ``span_ns``; "" when it does."""
        values = self._recent(t_ns, span_ns)
        if len(values) < 3:
            return f"{self.device.sensor}: too few samples to tell whether it rests"
        sway_radps = float(np.abs(values[:, 3:] - np.median(values[:, 3:], axis=0)).max())
        if not sway_radps <= STILL_RADPS:
            return f"{self.device.sensor}: moves ({sway_radps:.2f} rad/s); stand still for a second"
        return ""

    def not_upright(self, t_ns: int) -> str:
        """Why gravity is not what and where it was at calibration; "" when it is, or nothing is known of it."""
        force = self._force_mps2(t_ns)
        if force is None or self._calibration is None:
            return ""
        size = float(np.linalg.norm(force))
        if not abs(size - G_MPS2) <= GRAVITY_TOLERANCE_MPS2:
            return f"{self.device.sensor}: reads {size:.2f} m/s² at rest instead of 9.81; is its unit or range right?"
        tilt_rad = float(np.arccos(np.clip(force @ np.array(self._calibration.up) / size, -1.0, 1.0)))
        if tilt_rad > TILT_TOLERANCE_RAD:
            return (
                f"{self.device.sensor}: tilted by {np.rad2deg(tilt_rad):.0f}° against its calibration; put the foot "
                f"flat, or calibrate again if the sensor was moved"
            )
        return ""

    def zero_moved(self, t_ns: int) -> str:
        """Why heights cannot be trusted to the centimetre, asked at rest; "" when they can, or nothing is known.

        Gravity is read through the accelerometer's calibrated zero. What has come to it since, by temperature or
        because the calibration is another day's, goes into the double integration of each step.
        """
        force = self._force_mps2(t_ns)
        if force is None:
            return ""
        off = float(np.linalg.norm(force)) - G_MPS2
        if abs(off) <= ZERO_TOLERANCE_MPS2:
            return ""
        return (
            f"{self.device.sensor}: reads {G_MPS2 + off:.2f} m/s² at rest instead of 9.81, so its heights may be wrong "
            f"by some {abs(off) * HEIGHT_BY_ZERO_M * 1e3:.0f} mm; calibrate again"
        )

    def _force_mps2(self, t_ns: int) -> FloatArray | None:
        """Median of the last second (3,), less the calibrated zero; None where nothing is known of it."""
        values = self._recent(t_ns, SPAN_NS)
        if self._calibration is None or not len(values):
            return None
        force: FloatArray = np.median(values[:, :3], axis=0) - np.array(self._calibration.acc_bias_mps2)
        return force

    def _recent(self, t_ns: int, span_ns: int) -> FloatArray:
        kept = min(self.count, self._size)
        return self._values[:kept][self._t_ns[:kept] > t_ns - span_ns]


STUCK_NS: Final = 1_000_000_000  # a line, or a needed sensor on it, that was alive and is silent so long: opened again


class SensorStream:
    """One line: its port while it is open, attempts at opening it again while it is not.

    Args:
        port: open.
        clock: makes a fresh clock; a device that was away may have restarted its own.
        lost: the exception that says that the line is gone.
        needed: sensors whose loss must stop the stimulation.
    """

    def __init__(
        self,
        port: Imu,
        clock: Callable[[], SensorClock],
        lost: type[Exception],
        needed: frozenset[str],
    ) -> None:
        self.sensors = tuple(port.sensors)
        self.port: Imu | None = port
        self._held = port
        self._clock = clock
        self._lost = lost
        self.needed = needed & set(self.sensors)
        self._clocks = {sensor: clock() for sensor in self.sensors}
        self._newest_ns: int | None = None
        self._newest_of: dict[str, int] = {}  # by sensor, of those heard since the line was opened
        self._attempts: Reopening[Imu] | None = None
        self.losses = 0
        self.why_lost = ""  # while it is lost

    def fileno(self) -> int | None:
        """Readable with samples; None while the line is lost, or where there is nothing to wait on."""
        return None if self.port is None else self.port.fileno()

    @property
    def must_be_polled(self) -> bool:
        """Whether the line is open and has nothing to wait on."""
        return self.port is not None and self.port.fileno() is None

    def discard(self, t_ns: int) -> Iterator[Event]:
        """Let go of what has queued up; its arrival says nothing of when it was, so no clock may see it."""
        self._newest_ns = None  # nor is the time that nobody listened a silence
        self._newest_of.clear()
        try:
            while self.port is not None and self.port.read(t_ns):
                pass
        except self._lost as error:
            yield from self._lose(t_ns, str(error))

    def read(self, t_ns: int, clock_ns: Callable[[], int] | None = None) -> Iterator[Event]:
        """Samples since the last call, or the fault that the line is gone.

        With ``clock_ns`` a sample counts as arrived when the reading was over: taken for earlier than it was, even
        once, it would seem the least delayed of all, and all others old for a minute.
        """
        if self.port is None:
            return
        try:
            raw = self.port.read(t_ns)
        except self._lost as error:
            yield from self._lose(t_ns, str(error))
            return
        took_ns = 0 if clock_ns is None or not raw else max(clock_ns() - t_ns, 0)
        for sample in raw:
            self._newest_ns = self._newest_of[sample.sensor] = t_ns
            clock = self._clocks[sample.sensor]
            resets = clock.resets
            t_sensor_ns = clock.map(sample.t_host_ns + took_ns, sample.t_device_ns)
            if clock.resets != resets and sample.sensor in self.needed:
                # set, restarted, or all of it late for seconds: the new mapping cannot tell which, and would call late
                # samples fresh; on a line that is opened anew nothing is queued
                yield from self._lose(t_ns, f"the clock of {sample.sensor} jumped, or all that it sends comes late")
                return
            yield ImuSample(t_ns + took_ns, sample.sensor, t_sensor_ns, sample.acc_mps2, sample.gyr_radps)

    def tend(self, t_ns: int) -> Iterator[Event]:
        """Notice that a line says nothing any more; go on opening a lost one."""
        if self.port is not None:
            if self._newest_ns is not None and t_ns - self._newest_ns >= STUCK_NS:
                yield from self._lose(t_ns, "nothing has come for a second")
            else:  # in stance nobody asks the gate for anything: it would not notice before the next burst
                for sensor in self.needed:
                    if t_ns - self._newest_of.get(sensor, t_ns) >= STUCK_NS:
                        yield from self._lose(t_ns, f"nothing has come from {sensor} for a second")
                        return
            return
        if self._attempts is not None and (port := self._attempts.poll(t_ns)) is not None:
            self.port, self._attempts, self._newest_ns, self.why_lost = port, None, None, ""
            self._newest_of.clear()
            self._clocks = {sensor: self._clock() for sensor in self.sensors}

    def close(self) -> None:
        """Release the line."""
        self.port = None
        self._held.close()

    def _lose(self, t_ns: int, why: str) -> Iterator[Event]:
        self.port = None
        self.losses += 1
        self._attempts = Reopening(self._again, t_ns)
        self.why_lost = f"{', '.join(self.sensors)}: sensor lost: {why}"[:200]
        if self.needed:
            yield SystemFault(t_ns, f"{', '.join(sorted(self.needed))}: sensor lost: {why}"[:200])

    def _again(self) -> Imu:
        self._held.reopen()
        return self._held
