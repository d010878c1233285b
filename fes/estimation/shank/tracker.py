"""One shank from samples to phase changes and strides: its own features, the foot's machine and guards.

The same interface as :class:`fes.estimation.foot.tracker.FootTracker`. The phases mean the same: pre-swing begins when
the ankle lifts, swing at foot-off, loading response at contact, stance when the shank turns slowly over a still ankle.

Source of the strides: Wu, Wang and Pottie, "A Non-ZUPT Gait Reconstruction Method for Ankle Sensors". In mid-stance the
shank turns about a point near the ankle, and the velocity is reset to ``v = w × r`` (5). Departures from the print:

- The reset meets the velocity at both ends of a stride, with the smallest artificial accelerometer bias that does so
  (``fes.estimation.strides.integration``), and equal height on level ground.
- It is met on average over the fine window, not at its middle: the gyroscope wobbles on the soft tissue there. That
  makes the strides of ``stroke_treadmill`` 2.4 % longer.
- The arm points up the shank (``fes.estimation.shank.lever_arm``); a centimetre of it is 0.65 %.

On 24 sides of ``stroke_treadmill`` speed over belt is 1.002 ± 0.026 (mean and SD). Known limits: the one patient at
1.6 m/s comes out 2.5–5.5 % short; a toe walker's arm is longer by the height of the ankle. Clearance here is the rise
of the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Vec, fill, handed
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.shank import features
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.motion import FINE_WINDOW_PER_STRIDE, FINE_WINDOW_S, StrideSpan, from_rest, levelled
from fes.estimation.strides.integration import integrate
from fes.estimation.strides.segmentation import LONGEST_STAND_S, STOPPED
from fes.estimation.tracking.phase_features import enter_phase
from fes.estimation.tracking.tracker import (
    FULL,
    KEPT,
    NEVER_NS,
    SILENCE,
    HistoryArrays,
    Outcome,
    Samples,
    Tracker,
    as_samples,
    live_type,
    pack_sample,
    until_due,
)
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult, Vector3
from statemachine.phases import Phase, PhaseChange, Transition

TRAJECTORY_POINTS = 101
ROUNDS = 2
DURATION_S = (0.4, 5.0)
LONGEST_GAP_S = 0.04
LONGEST_STRIDE_M = 3.0


@dataclass(frozen=True, slots=True)
class ShankIntegrationSettings:
    """How strides of one shank are integrated.

    Attributes:
        up: unit vector along the shank, upward, sensor frame (3,).
        left: unit mediolateral axis to the person's left, sensor frame (3,).
        arm: from the centre of rotation to the sensor, in m, sensor frame (3,); None resets to zero (ZUPT), which is
            there to be compared with.
        incline: what the ground rises per horizontal distance; NaN for stairs and unknown slopes.
    """

    up: FloatArray
    left: FloatArray
    arm: FloatArray | None
    incline: float = 0.0

    @staticmethod
    def for_calibration(calibration: ShankCalibration, *, incline: float | None = None) -> ShankIntegrationSettings:
        """The settings that a calibration leads to; ``incline`` overrules what it says of the ground."""
        up, left, arm = (np.array(v) for v in (calibration.up, calibration.left, calibration.arm.arm_m))
        known = 0.0 if calibration.level else math.nan
        return ShankIntegrationSettings(up, left, arm, known if incline is None else incline)


def solve_shank_stride(
    sensor: str, number: int, span: StrideSpan, t_ns: IntArray, acc: FloatArray, gyr: FloatArray,
    settings: ShankIntegrationSettings,
) -> StrideResult:  # fmt: skip
    """Integrate one stride; ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s free of bias."""
    first, last, lead = span.first, span.last, span.half

    def unusable(reason: str) -> StrideResult:
        return StrideResult(sensor, number, int(t[0]), int(t[-1]), valid=False, reason=reason)

    t = np.ascontiguousarray(t_ns[first : last + 1])
    duration_s = 1e-9 * float(t[-1] - t[0])
    gaps = np.diff(t_ns[first - lead : last + lead + 1])
    gap_s = 1e-9 * float(gaps.max())
    if not DURATION_S[0] <= duration_s <= DURATION_S[1]:
        return unusable(f"lasts {duration_s:.2f} s")
    if gap_s > max(LONGEST_GAP_S, 3.5e-9 * float(np.median(gaps))):
        return unusable(f"samples missing for {1e3 * gap_s:.0f} ms")
    if not span.quiet:
        return unusable("the shank does not turn slowly at any time of its stance")
    start, end = np.zeros(3), np.zeros(3)
    for _ in range(ROUNDS):  # the change of velocity tilts the mean force, and the tilt turns the velocities
        around = levelled(t_ns, acc, gyr, (first, last), lead, end - start)
        start, end = _end_velocities(t_ns, acc, gyr, span, around, settings.arm)
    quaternion = np.ascontiguousarray(around[lead : len(around) - lead])
    n = len(t)
    velocity, position, gamma = np.empty((n, 3)), np.empty((n, 3)), np.empty((2, 3))
    force = acc[first : last + 1]
    solved = integrate(t, force, quaternion, start, end, settings.incline, velocity, position, gamma)
    length = float(np.hypot(position[-1, 0], position[-1, 1]))
    if not solved:
        return unusable("the constraints cannot be met")
    if not length <= LONGEST_STRIDE_M:
        return unusable(f"{length:.2f} m is no stride length")
    forward = rotate_all(quaternion, np.cross(settings.left, settings.up))
    direction = position[-1, :2] / length if length > 0.05 else forward[0, :2] / np.hypot(*forward[0, :2])
    across = np.array([-direction[1], direction[0]])
    walking = np.column_stack((position[:, :2] @ direction, position[:, :2] @ across, position[:, 2]))
    pitch = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
    heading = np.arctan2(forward[[0, -1], 1], forward[[0, -1], 0])
    turn = (heading[1] - heading[0] + math.pi) % (2.0 * math.pi) - math.pi
    at = np.linspace(t[0], t[-1], TRAJECTORY_POINTS)
    return StrideResult(
        sensor, number, int(t[0]), int(t[-1]), length, clearance_m=float(position[:, 2].max()),
        height_gained_m=float(position[-1, 2]), turn_rad=float(turn), speed_mps=length / duration_s,
        trajectory_m=np.column_stack([np.interp(at, t, walking[:, k]) for k in range(3)]),
        pitch_rad=np.interp(at, t, pitch - pitch[0]),
    )  # fmt: skip


def _end_velocities(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, span: StrideSpan, quaternions: FloatArray, arm: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Velocity in the world (3,) at the first and the last sample: Eq. (5), met on average over each fine window.

    ``quaternions`` are of the samples ``first − half`` … ``last + half``.
    """
    if arm is None:
        return np.zeros(3), np.zeros(3)
    lead, part = span.half, slice(span.first - span.half, span.last + span.half + 1)
    raw, _ = from_rest(t_ns[part], acc[part], quaternions)
    turning = rotate_all(quaternions, np.cross(gyr[part], arm))
    start, end = (
        raw[at] + (turning - raw)[at - lead : at + lead + 1].mean(axis=0) for at in (lead, len(raw) - 1 - lead)
    )
    return start, end


STANCE_SEARCH_S = 1.0  # of a long stance only the second next to the swing is searched
MARGIN_NS = NS_PER_S  # before a stride: more than half of any fine window
USUAL_STRIDE_S = 1.2  # before one has been seen
QUIET_LEANS = 1.5  # a stance is quiet when its rate is at most this many times the level of rest
MOST_LEAN_CHANGE_RAD = math.radians(30)  # leaning otherwise, a leg was put elsewhere; sound strides: up to 27°
PUT_ELSEWHERE = "the shank leans {0:.0f}° otherwise than at its start: a leg moved, not a stride"


class ShankStrideMaker:
    """Follows the phases of one shank and closes a stride when the stance after its swing is over, or a second old."""

    def __init__(self, calibration: ShankCalibration, *, incline: float | None = None) -> None:
        """``incline`` overrules what the calibration says of the ground."""
        self.sensor = calibration.sensor
        self.due_ns: int | None = None
        self._settings = ShankIntegrationSettings.for_calibration(calibration, incline=incline)
        self._next_settings = self._settings
        self._quiet_radps = QUIET_LEANS * calibration.levels.rest_lean_radps
        self._rate_hz = calibration.rate_hz
        self._number = 0
        self._start_ns: int | None = None
        self._stance_ns = 0
        self._stride_s = USUAL_STRIDE_S
        self._times: dict[Phase, int] = {}

    @property
    def since_ns(self) -> int:
        """Of the history only what is newer is asked for: the stride and the stances around it."""
        return (self._stance_ns if self._start_ns is None else min(self._start_ns, self._stance_ns)) - MARGIN_NS

    def restart(self, t_ns: int) -> None:
        """Data were lost: forget the stride under way; stance from now on."""
        self.due_ns, self._start_ns, self._stance_ns, self._times = None, None, t_ns, {}

    def set_incline(self, incline: float) -> None:
        """What the ground rises per horizontal distance (NaN: nobody knows), from the next T1 on."""
        self._next_settings = replace(self._settings, incline=incline)

    def on_phase(self, change: PhaseChange) -> None:
        """Note a phase change (after :meth:`leave_stance` for T1)."""
        if change.destination is not Phase.STANCE:
            self._times[change.destination] = change.t_ns
            return
        self._stance_ns = change.t_ns
        if Phase.SWING in self._times:
            self._times[Phase.STANCE] = change.t_ns
            self.due_ns = change.t_ns + int(STANCE_SEARCH_S * NS_PER_S)
        else:  # the heel was lifted and put back: no stride
            self._times = {}

    def leave_stance(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, trace: FloatArray) -> StrideResult | None:
        """T1: close the stride that this stance ended; the next begins there, or, of a leg that stopped, at the
        quietest instant of the last second.
        """
        result = self.close(t_ns, acc, gyr, trace) if self.due_ns is not None else None
        self._settings = self._next_settings  # here alone, so that one stride knows one ground
        stopped_ns = NS_PER_S * min(STOPPED * self._stride_s, LONGEST_STAND_S)
        if self._start_ns is None or t_ns[-1] - self._start_ns > stopped_ns:
            earliest = max(self._stance_ns, int(t_ns[-1]) - int(STANCE_SEARCH_S * NS_PER_S))
            self._start_ns = int(t_ns[self._quietest(t_ns, gyr, earliest)])
        self._times = {}
        return result

    def close(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, trace: FloatArray) -> StrideResult | None:
        """Solve the stride that ended with this stance.

        History up to now: ``t_ns`` (N,); ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s, free of bias; ``trace`` (N, 4)
        of the core.
        """
        times, self._times, self.due_ns = self._times, {}, None
        start_ns, self._start_ns = self._start_ns, None
        if start_ns is None or Phase.STANCE not in times:
            return None
        half = self._half()
        last = self._quietest(t_ns, gyr, self._stance_ns)
        self._start_ns = int(t_ns[last])
        first = int(np.searchsorted(t_ns, start_ns))
        self._number += 1
        if first < half or first >= last or last + half >= len(t_ns) or t_ns[first] != start_ns:
            return None  # the first stride after a start or a silence has no stance before it
        self._stride_s = min(max(1e-9 * float(t_ns[last] - start_ns), 0.5), 3.0)
        lean = np.abs(trace[:, 0])
        quiet = all(float(lean[k - half : k + half + 1].mean()) <= self._quiet_radps for k in (first, last))
        span = StrideSpan(first, int(np.searchsorted(t_ns, times[Phase.SWING])), last, half, quiet)
        result = solve_shank_stride(self.sensor, self._number, span, t_ns, acc, gyr, self._settings)
        changed: dict[str, Any] = {f"t_{phase.name.lower()}_ns": times.get(phase) for phase in Phase}
        if result.valid and abs(change := float(result.pitch_rad[-1])) > MOST_LEAN_CHANGE_RAD:
            # moved while its owner sits, whatever way its ankle goes
            changed |= {"valid": False, "reason": PUT_ELSEWHERE.format(abs(math.degrees(change)))}
        return replace(result, **changed)

    def _half(self) -> int:
        """Half the width of the fine windows, in samples."""
        return max(round(0.5 * self._rate_hz * min(FINE_WINDOW_S, FINE_WINDOW_PER_STRIDE * self._stride_s)), 1)

    def _quietest(self, t_ns: IntArray, gyr: FloatArray, earliest_ns: int) -> int:
        """Index of the middle of the fine window with the least gyroscope energy since a time, as far as it is over."""
        half = self._half()
        begin = max(int(np.searchsorted(t_ns, earliest_ns)), half)
        latest = len(t_ns) - 1 - half
        if latest <= begin:
            return max(min(begin, latest), 0)
        part = gyr[begin - half : latest + half + 1]
        energy = np.cumsum(np.concatenate(([0.0], np.einsum("ij,ij->i", part, part))))
        window = 2 * half + 1
        return int(begin + np.argmin(energy[window:] - energy[:-window]))


@jit
def _advance(live: Vec, history: HistoryArrays, begin: int, due_ns: int) -> tuple[int, int]:
    """Advance over the history's rows from ``begin`` on, at most to the first at ``due_ns``; where it stopped, and
    which transition fired there (0: none)."""
    t_ns, acc, gyr, trace = history
    end = until_due(t_ns, begin, live[0].counters.filled, due_ns)
    return features.advance(live[0].core, t_ns, acc, gyr, begin, end, trace)


class ShankTracker(Tracker):
    """Phases and strides of one shank; deterministic, no clock, no I/O."""

    def __init__(
        self, calibration: ShankCalibration, *, incline: float | None = None, swing_at_reversal: bool = False
    ) -> None:
        live = np.zeros(1, live_type(features.CORE))
        self._live = handed(live)
        thresholds = calibration.levels.thresholds(swing_at_reversal=swing_at_reversal)
        super().__init__(calibration.sensor, calibration.rate_hz, live)
        fill(self._core, parameters=calibration.parameters(), thresholds=thresholds)
        self._acc_bias, self._gyr_bias = np.array(calibration.acc_bias_mps2), np.array(calibration.gyr_bias_radps)
        self._strides = ShankStrideMaker(calibration, incline=incline)

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias (3,), as calibrated."""
        return self._gyr_bias

    def set_incline(self, incline: float) -> None:
        """As :meth:`Tracker.set_incline`, whatever the calibration says of the ground."""
        self._strides.set_incline(incline)

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """Take one sample in; see :meth:`Tracker.step`."""
        pack_sample(self._bytes, 0, t_ns, *acc_mps2, *gyr_radps)
        return self._track(Samples(self._sample["t_ns"], self._sample["acc"], self._sample["gyr"]))

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; see :meth:`Tracker.advance`."""
        return self._track(as_samples(t_ns, acc_mps2, gyr_radps))

    def _track(self, samples: Samples) -> list[Outcome]:
        outcomes: list[Outcome] = []
        begin, became, at = 0, FULL, self._history.filled
        while became != KEPT:
            begin, became = self._history.store(samples, begin)
            while at < self._history.filled:
                at = self._follow(at, outcomes)
            if became == SILENCE:
                at, t_ns = 0, int(samples.t_ns[begin])
                outcomes += self._restart(t_ns)
                self._strides.restart(t_ns)
                features.start(self._core[0], t_ns, *(samples.acc[begin] - self._acc_bias).tolist())
            elif became == FULL:
                self._history.forget_half()
                at = self._history.filled
        return outcomes

    def _follow(self, at: int, outcomes: list[Outcome]) -> int:
        """Advance to the next thing that Python must handle; how many rows are gone through then."""
        strides, arrays = self._strides, self._history.arrays
        due_ns = strides.due_ns
        at, number = _advance(self._live, arrays, at, NEVER_NS if due_ns is None else due_ns)
        now_ns, result = int(arrays.t_ns[at - 1]), None
        if number:
            change = self._fire(number)
            enter_phase(self._core[0], change.destination.value)
            if change.transition is Transition.T1:
                result = strides.leave_stance(*self._newest(at))
            strides.on_phase(change)
            outcomes += [change] if result is None else [result, change]
            due_ns = strides.due_ns
        if due_ns is not None and now_ns >= due_ns:
            result = strides.close(*self._newest(at))
            outcomes += [] if result is None else [result]
        return int(at)

    def _newest(self, at: int) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """The history that the stride maker asks for, of the rows gone through, freed of bias."""
        t_ns, acc, gyr, trace = self._history.arrays
        rows = slice(int(np.searchsorted(t_ns[:at], self._strides.since_ns)), at)
        return t_ns[rows], acc[rows] - self._acc_bias, gyr[rows] - self._gyr_bias, trace[rows]
