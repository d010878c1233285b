"""What sensors show of themselves. No clock, no I/O.

The last second of each, asked before arming: is it alive, at its rate, at rest, upright? And are two labelled feet each
other's? That is watched in the first strides, armed or not: of a session, and after whatever may have been used to put
sensors on again.
"""

from collections import deque
from collections.abc import Mapping
from typing import Final

import numpy as np

from fes.calibration.side_detection import stride_signs, tell_sides
from fes.config import WIRELESS, ImuDevice
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.limits import RADIO
from fes.signals import (
    FOOT_SENSORS,
    G_MPS2,
    NS_PER_S,
    Event,
    FloatArray,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StrideResult,
    SystemFault,
)

SPAN_NS: Final = NS_PER_S
ZEROS_S: Final = 0.2  # of nothing but exact zeros: a dead band
ALIVE_NS: Final = 40_000_000
RATE_TOLERANCE: Final = 0.1  # of the nominal rate; beyond it the settings are wrong or samples are lost
STILL_RADPS: Final = 0.15  # standing sways less than this; a stance in walking does not last a second
GRAVITY_TOLERANCE_MPS2: Final = 0.5
ZERO_TOLERANCE_MPS2: Final = 0.06  # of gravity at rest; what is left after a calibration on the spot is below 0.01
HEIGHT_BY_ZERO_M: Final = 0.11  # by m/s²: a swing's height against the accelerometer's zero, from virtual patients
TILT_TOLERANCE_RAD: Final = np.deg2rad(25.0)  # a foot on a slope or with raised toes is no remounted sensor


def alive_ns(device: ImuDevice) -> int:
    """How long this sensor may be silent and still count as alive."""
    return RADIO.max_data_age_ms * 1_000_000 if device.device in WIRELESS else ALIVE_NS


class SensorMonitor:
    """A ring of one sensor's newest samples; only with a calibration can its direction be judged."""

    def __init__(self, device: ImuDevice, calibration: Calibration | None) -> None:
        self.device = device
        self.alive_ns = alive_ns(device)
        self._calibration = calibration
        self._size = max(int(1.5 * device.rate_hz * SPAN_NS / NS_PER_S), 8)
        self._t_ns = np.zeros(self._size, np.int64)
        self._values: FloatArray = np.zeros((self._size, 6))
        self.count = 0
        self.newest_ns: int | None = None
        self.dead_band = ""  # in words, once it has shown one
        self._zeros = 0

    def add(self, sample: ImuSample) -> None:
        """Take in a sample."""
        row = self.count % self._size
        self._t_ns[row] = self.newest_ns = sample.t_ns
        self._values[row, :3] = sample.acc_mps2
        self._values[row, 3:] = sample.gyr_radps
        self.count += 1
        self._zeros = 0 if any(sample.gyr_radps) else self._zeros + 1
        if self._zeros > self.device.rate_hz * ZEROS_S and not self.dead_band:
            self.dead_band = (
                f"{self.device.sensor}: its gyroscope reads exactly 0 at rest (a dead band); counted as rest"
            )

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
        if t_ns - self.newest_ns > self.alive_ns:
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


# --- Are two labelled feet each other's? ---


LEAST_SCORE: Final = 0.45  # to say exchanged, of a session under way (benchmarks/safety/exchanged_feet.py)
# of each foot: on 40 real pairs two strides name as many as five, and one pair wrongly, as five do
LEAST_STRIDES: Final = 2
MOST_STRIDES: Final = 20  # of each foot; whoever is not told by then is not
KEPT_S: Final = 5.0  # a stride is told of some time after its end
GAP_NS: Final = NS_PER_S  # as a lost line's: in less nobody takes a sensor off and puts another on
EXCHANGED: Final = "left and right foot move like each other: are their sensors exchanged? Put each on its own foot"

_Row = tuple[int, tuple[float, ...]]


class SideCheck:
    """What ``fes calibrate`` asks of a recording, asked of the strides as they come; an input of the live loop.

    Only two feet with sensors of their own can be told apart. ``exchanged`` stays until the session ends: sensors are
    put right with the session closed.
    """

    def __init__(self, calibrations: Mapping[str, Calibration]) -> None:
        feet = [calibrations.get(foot) for foot in FOOT_SENSORS]
        self._feet = {each.sensor: each for each in feet if isinstance(each, FootCalibration)}
        self._rows: dict[str, deque[_Row]] = {
            foot: deque(maxlen=round(KEPT_S * each.rate_hz)) for foot, each in self._feet.items()
        }
        self._newest_ns: dict[str, int] = {}
        self._restart()
        self.exchanged = ""
        self._told = False

    def _restart(self) -> None:
        self._signs: dict[str, list[FloatArray]] = {foot: [] for foot in self._feet}
        self.done = len(self._feet) < 2

    def add_event(self, event: Event) -> None:
        """Take in an event; an arming, which going on after a pause is too, and a gap of data begin the check anew."""
        again = isinstance(event, OperatorAct) and event.action is OperatorAction.ARM
        if isinstance(event, ImuSample) and event.sensor in self._feet:
            again = event.t_ns - self._newest_ns.get(event.sensor, event.t_ns) > GAP_NS
            self._newest_ns[event.sensor] = event.t_ns
        if again and not self.exchanged:
            self._restart()
        if not self.done and isinstance(event, ImuSample) and event.sensor in self._rows:
            rows = self._rows[event.sensor]
            if not rows or event.t_sensor_ns > rows[-1][0]:
                rows.append((event.t_sensor_ns, event.acc_mps2 + event.gyr_radps))

    def add_stride(self, stride: StrideResult) -> None:
        """Take in a stride of a foot's own sensor."""
        if self.done or stride.foot not in self._feet:
            return
        calibration = self._feet[stride.foot]
        rows = [row for row in self._rows[stride.foot] if stride.t_start_ns <= row[0] <= stride.t_end_ns]
        if len(rows) < 3:
            return
        values = np.array([value for _, value in rows])
        if not np.isfinite(values).all():
            return
        acc = values[:, :3] - np.array(calibration.acc_bias_mps2)
        gyr = values[:, 3:] - np.array(calibration.gyr_bias_radps)
        signs = stride_signs(np.array([t for t, _ in rows], np.int64), acc, gyr, stride, calibration.forward())
        if signs is not None:
            self._signs[stride.foot].append(signs)
            self._judge()

    def _judge(self) -> None:
        left, right = (self._signs[foot] for foot in FOOT_SENSORS)
        if min(len(left), len(right)) < LEAST_STRIDES:
            return
        verdict = tell_sides(np.median(left, axis=0), np.median(right, axis=0))
        if verdict.sure and verdict.left == 1 and verdict.score >= LEAST_SCORE:
            self.exchanged = EXCHANGED
        is_clear = bool(self.exchanged) or (verdict.sure and verdict.left == 0)
        self.done = is_clear or min(len(left), len(right)) >= MOST_STRIDES
        if self.done:
            for rows in self._rows.values():
                rows.clear()

    def fileno(self) -> int | None:
        """Nothing to wait on."""
        return None

    def read_events(self, t_ns: int) -> list[Event]:
        """The fault that the sensors are exchanged, once."""
        if not self.exchanged or self._told:
            return []
        self._told = True
        return [SystemFault(t_ns, self.exchanged)]
