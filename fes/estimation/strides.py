"""From one foot's history to stride results: where a stride begins and ends, and what its numbers are.

Negård et al. (2005) integrate "from the beginning to the end of every step" and note that the foot is never wholly at
rest. Here the ends are the quietest tenths of a second of the stances around the swing, not the instants at which rest
happened to be detected, and the velocity there is that of a foot turning about its ground contact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fes.config import FootGeometry
from fes.estimation import stride_solution as solution
from fes.estimation.clearance import FootPath, foot_path
from fes.estimation.rotation import rotate_all
from fes.estimation.stride_ends import REST_RADPS, quietest
from fes.estimation.stride_time import stride_time_ns
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult
from statemachine.phases import Phase, PhaseChange

STANCE_SEARCH_S = 1.0  # of a long stance only the second next to the swing is searched
STOPPED_SEARCH_S = 0.5  # of a stance that lasts longer than that the first half: a belt that stops carries the foot
STANCE_LEAD_S = 0.03  # rest is known this late (the guards' rest_hold_s)
SENSOR_HEIGHT_M = 0.065  # of an instep sensor above the ground contact, where the session does not say
TRAJECTORY_POINTS = 101
DURATION_S = (0.4, 5.0)
LONGEST_GAP_S = 0.04


@dataclass(frozen=True, slots=True)
class StrideSettings:
    """How strides of one foot are integrated.

    ``sensor_height_m``: height of the sensor above the ground contact; the end velocity is ``w × height``.
    ``equal_height``: off on stairs and slopes. ``forward`` and ``up``: unit vectors towards the toe and up, foot flat,
    in the sensor frame (3,). ``method``: "most_likely" weighs all errors, "constrained" is Negård et al.'s, corrected,
    which is also used where the foot has no true rest (then the stride's ``reason`` says so; it stays valid unless the
    foot turns faster than ``NO_REST_RADPS`` at its quietest).
    """

    forward: FloatArray
    up: FloatArray
    sensor_height_m: float = SENSOR_HEIGHT_M
    equal_height: bool = True
    geometry: FootGeometry | None = None
    method: Literal["most_likely", "constrained"] = "most_likely"
    watch: Callable[[FootPath], None] | None = None  # is shown the path of every valid stride


class StrideMaker:
    """Follows the phases of one foot and closes a stride when the stance after its swing is over, or a second old."""

    def __init__(self, foot: str, settings: StrideSettings) -> None:
        self.foot = foot
        self.due_ns: int | None = None  # the stride under way is closed at this time at the latest
        self._settings = settings
        self._number = 0
        self._before_ns: int | None = None  # the end of the stride before
        self._start_ns: int | None = None
        self._stance_ns = 0
        self._times: dict[Phase, int] = {}

    def restart(self, t_ns: int) -> None:
        """Data were lost: forget the stride under way; stance from now on."""
        self.due_ns = None
        self._before_ns = self._start_ns = None
        self._stance_ns = t_ns
        self._times = {}

    def on_phase(self, change: PhaseChange) -> None:
        """Note a phase change (after :meth:`leave_stance` for T1)."""
        if change.destination is Phase.STANCE:
            self._stance_ns = change.t_ns
            if Phase.SWING in self._times:
                self._times[Phase.STANCE] = change.t_ns
                self.due_ns = change.t_ns + int(STANCE_SEARCH_S * NS_PER_S)
            else:  # the heel was lifted and put back: no stride
                self._times = {}
        else:
            self._times[change.destination] = change.t_ns

    def leave_stance(
        self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, quaternion: FloatArray
    ) -> StrideResult | None:
        """T1: close the stride that this stance ended, and begin the next at the stance's quietest instant.

        History up to now: ``t_ns`` (N,); ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s, free of bias; ``quaternion``
        (N, 4).
        """
        result = self.close(t_ns, acc, gyr, quaternion) if self.due_ns is not None else None
        now = int(t_ns[-1])
        earliest = max(self._stance_ns - int(STANCE_LEAD_S * NS_PER_S), now - int(STANCE_SEARCH_S * NS_PER_S))
        self._start_ns = int(t_ns[quietest(t_ns, gyr, earliest, now)])
        self._times = {}
        return result

    def close(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, quaternion: FloatArray) -> StrideResult | None:
        """Solve the stride that ended with this stance; arguments as for :meth:`leave_stance`."""
        times, self._times, self.due_ns = self._times, {}, None
        start_ns, self._start_ns = self._start_ns, None
        if start_ns is None or Phase.STANCE not in times:
            return None
        earliest = self._stance_ns - int(STANCE_LEAD_S * NS_PER_S)
        still_standing = t_ns[-1] - self._stance_ns >= STANCE_SEARCH_S * NS_PER_S
        search_s = STOPPED_SEARCH_S if still_standing else STANCE_SEARCH_S
        latest = min(int(t_ns[-1]), self._stance_ns + int(search_s * NS_PER_S))
        last = quietest(t_ns, gyr, earliest, latest)
        first = int(np.searchsorted(t_ns, start_ns))
        self._number += 1
        if first >= last or t_ns[first] != start_ns:
            return _unusable(self.foot, self._number, start_ns, int(t_ns[last]), times, "longer than the history kept")
        solved = solve_stride(
            self.foot, self._number, times, first, last, t_ns, acc, gyr, quaternion[first], self._settings,
            self._before_ns,
        )  # fmt: skip
        self._before_ns = solved.t_end_ns
        return solved


def solve_stride(
    foot: str,
    number: int,
    times: dict[Phase, int],
    first: int,
    last: int,
    t_ns: IntArray,
    acc: FloatArray,
    gyr: FloatArray,
    start_quaternion: FloatArray,
    settings: StrideSettings,
    before_ns: int | None = None,
) -> StrideResult:
    """Integrate the samples ``first`` … ``last`` of a history into a stride's numbers.

    ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s free of bias; ``start_quaternion`` (4,) the orientation at ``first``;
    ``times`` the entries into the phases; ``before_ns`` where the stride before ended, for the speed. Source: Negård
    et al. (2005), Eq. (14)–(20), see ``fes.estimation.stride`` (method "constrained"), weighed as in
    ``fes.estimation.likely`` (method "most_likely").
    """
    t = t_ns[first : last + 1]
    n = last + 1 - first
    start_ns, end_ns = int(t[0]), int(t[-1])
    duration_s = 1e-9 * (end_ns - start_ns)
    if n < 10 or not DURATION_S[0] <= duration_s <= DURATION_S[1]:
        return _unusable(foot, number, start_ns, end_ns, times, f"lasts {duration_s:.2f} s")
    each_ns = t[1:] - t[:-1]
    gap_s = 1e-9 * int(each_ns.max())
    if gap_s > LONGEST_GAP_S and gap_s > 3.5e-9 * float(np.median(each_ns)):
        return _unusable(foot, number, start_ns, end_ns, times, f"samples missing for {1e3 * gap_s:.0f} ms")
    quaternion, position, numbers = np.empty((n, 4)), np.empty((n, 3)), np.empty(solution.NUMBERS)
    shape = np.empty((TRAJECTORY_POINTS, 4))
    fx, fy, fz = settings.forward.tolist()
    came_of_it = solution.solve_span(
        t_ns, acc, gyr, first, last, start_quaternion, fx, fy, fz, settings.sensor_height_m,
        settings.method == "constrained", settings.equal_height, quaternion, position, shape, numbers,
    )  # fmt: skip
    tilt, unrest_radps, length, highest, turn, gained = numbers.tolist()
    if came_of_it != solution.SOLVED:
        reason = {
            solution.NO_SOLUTION: "the constraints cannot be met",
            solution.TILTED: f"the orientation is {math.degrees(tilt):.0f}° off at its end",
            solution.NO_LENGTH: f"{length:.2f} m is no stride length",
            solution.NO_REST: f"the foot never rests: {unrest_radps:.1f} rad/s at its quietest",
        }[came_of_it]
        return _unusable(foot, number, start_ns, end_ns, times, reason)
    toe_clearance, heel_clearance = _toe_and_heel(t, times, quaternion, position, settings)
    if settings.watch is not None:
        swing = times.get(Phase.SWING), times.get(Phase.LOADING_RESPONSE) or times.get(Phase.STANCE)
        settings.watch(foot_path(number, t, quaternion, position, settings.forward, settings.up, *swing))
    return StrideResult(
        foot=foot,
        number=number,
        t_start_ns=start_ns,
        t_end_ns=end_ns,
        stride_length_m=length,
        clearance_m=highest,
        height_gained_m=gained,
        turn_rad=turn,
        speed_mps=length * NS_PER_S / stride_time_ns(start_ns, end_ns, before_ns),
        t_pre_swing_ns=times.get(Phase.PRE_SWING),
        t_swing_ns=times.get(Phase.SWING),
        t_loading_response_ns=times.get(Phase.LOADING_RESPONSE),
        t_stance_ns=times.get(Phase.STANCE),
        toe_clearance_m=toe_clearance,
        heel_clearance_m=heel_clearance,
        trajectory_m=np.ascontiguousarray(shape[:, :3]),
        pitch_rad=shape[:, 3].copy(),
        reason=f"no true rest: {unrest_radps:.1f} rad/s at its quietest" if unrest_radps > REST_RADPS else "",
    )


def _toe_and_heel(
    t_ns: IntArray,
    times: dict[Phase, int],
    quaternion: FloatArray,
    position: FloatArray,
    settings: StrideSettings,
) -> tuple[float, float]:
    """Least height of the toe in mid-swing and greatest of the heel, above the starting stance (m); NaN if unknown.

    Mid-swing is the middle of the time from foot off to contact: the toe leaves the ground and, after its first peak,
    passes low once more before it rises for the contact.
    """
    geometry = settings.geometry
    if geometry is None:
        return math.nan, math.nan
    forward, upward = (rotate_all(quaternion, axis)[:, 2] for axis in (settings.forward, settings.up))
    toe = position[:, 2] + geometry.toe_forward_m * forward + geometry.toe_up_m * upward
    heel = position[:, 2] + geometry.heel_forward_m * forward + geometry.heel_up_m * upward
    begin = times.get(Phase.SWING)
    end = times.get(Phase.LOADING_RESPONSE) or times.get(Phase.STANCE)
    heel_clearance = float((heel - heel[0]).max())
    if begin is None or end is None:
        return math.nan, heel_clearance
    i, j = np.searchsorted(t_ns, (begin + 0.25 * (end - begin), begin + 0.8 * (end - begin)))
    return (float((toe - toe[0])[i:j].min()) if j > i else math.nan), heel_clearance


def _unusable(foot: str, number: int, start_ns: int, end_ns: int, times: dict[Phase, int], reason: str) -> StrideResult:
    return StrideResult(
        foot=foot,
        number=number,
        t_start_ns=start_ns,
        t_end_ns=end_ns,
        stride_length_m=math.nan,
        clearance_m=math.nan,
        height_gained_m=math.nan,
        turn_rad=math.nan,
        speed_mps=math.nan,
        t_pre_swing_ns=times.get(Phase.PRE_SWING),
        t_swing_ns=times.get(Phase.SWING),
        t_loading_response_ns=times.get(Phase.LOADING_RESPONSE),
        t_stance_ns=times.get(Phase.STANCE),
        valid=False,
        reason=reason,
    )
