"""Are two labelled feet each other's? Watched in the first strides, armed or not: of a session, and after whatever may
have been used to put sensors on again. No clock, no I/O.
"""

from collections import deque
from collections.abc import Mapping
from typing import Final

import numpy as np

from fes.calibration.side_detection import stride_signs, tell_sides
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.signals import (
    FOOT_SENSORS,
    NS_PER_S,
    Event,
    FloatArray,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StrideResult,
    SystemFault,
)

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
