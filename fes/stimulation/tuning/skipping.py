"""Which strides teach nothing, and why: the tuner must not learn from a stumble's, a turn's or a pause's."""

from __future__ import annotations

import math
from collections import deque
from statistics import median
from typing import Final

from fes.config import Tuning
from fes.signals import NS_PER_S, StrideResult

STOP_S: Final = 0.8  # between the end of a stride and the beginning of the next: a stop
SPEED_CHANGE: Final = 0.25
CHARGE_SHARE: Final = 0.6  # of the usual charge: the rest of the pulses were refused, or lost
REMEMBERED: Final = 5
SHORTEST_SWING: Final = 0.16  # of the stride; a third is usual, a quarter is a very slow walk's
BELOW_GROUND_M: Final = -0.015  # no toe is there
NO_CHARGE: Final = "no stimulation was delivered in it"


def jolted(stride: StrideResult) -> str:
    """Why the stride's contact cannot be true; "" when it can.

    A foot that stimulation jerks up jolts the sensor, which looks like initial contact early in the swing; all that is
    measured from contact on is then wrong.
    """
    swing_ns, contact_ns = stride.t_swing_ns, stride.t_loading_response_ns
    if swing_ns is not None and contact_ns is not None:
        share = (contact_ns - swing_ns) / max(stride.t_end_ns - stride.t_start_ns, 1)
        if share < SHORTEST_SWING:
            return f"contact was seen {1e-6 * (contact_ns - swing_ns):.0f} ms after foot off, too soon to be true"
    if math.isfinite(stride.toe_clearance_m) and stride.toe_clearance_m < BELOW_GROUND_M:
        return f"the toe would have been {-1e3 * stride.toe_clearance_m:.0f} mm below the ground"
    return ""


class StrideFilter:
    """Looks at every stride of one channel's foot, in order."""

    def __init__(self, tuning: Tuning, min_stride_length_m: float) -> None:
        self._tuning = tuning
        self._min_length_m = min_stride_length_m
        self._end_ns: int | None = None
        self._changed_ns: int | None = None
        self._speeds: deque[float] = deque(maxlen=REMEMBERED)
        self._charges: deque[float] = deque(maxlen=REMEMBERED)

    def operator_changed(self, t_ns: int) -> None:
        """A person changed the intensity, or stopped or started stimulation."""
        self._changed_ns = t_ns

    def why_skip(self, stride: StrideResult, charge_uc: float, drive: float) -> str:
        """Why this stride teaches nothing; "" when it does.

        Args:
            stride: the newest.
            charge_uc: delivered in it.
            drive: under which it was walked; scales the charge to be expected.
        """
        end_ns, self._end_ns = self._end_ns, stride.t_end_ns
        if not stride.valid:
            return f"the stride is not usable ({stride.reason})"
        if not all(
            map(math.isfinite, (stride.speed_mps, stride.stride_length_m, stride.turn_rad, stride.height_gained_m))
        ):
            return "the stride's own numbers are none"
        if end_ns is not None and stride.t_end_ns <= end_ns:
            return "it is no newer than the stride before"
        usual_mps = median(self._speeds) if self._speeds else stride.speed_mps
        self._speeds.append(stride.speed_mps)
        if end_ns is None or stride.t_start_ns - end_ns > STOP_S * NS_PER_S:
            self._speeds.clear()
            return "it is the first stride after standing"
        if stride.stride_length_m < self._min_length_m:
            return f"a stride of {100 * stride.stride_length_m:.0f} cm is no walking"
        if abs(stride.turn_rad) > math.radians(self._tuning.max_turn_deg):
            return f"the foot turned by {abs(math.degrees(stride.turn_rad)):.0f}°"
        if abs(stride.height_gained_m) > self._tuning.max_height_gained_m:
            return f"the foot went {100 * stride.height_gained_m:+.0f} cm up: a stair or a slope"
        if abs(stride.speed_mps - usual_mps) > SPEED_CHANGE * usual_mps:
            return f"the speed changed from {usual_mps:.1f} to {stride.speed_mps:.1f} m/s"
        if self._changed_ns is not None and self._changed_ns >= stride.t_start_ns:
            return "a person changed the stimulation meanwhile"
        return self._charge(stride, charge_uc, drive)

    def _charge(self, stride: StrideResult, charge_uc: float, drive: float) -> str:
        if charge_uc <= 0.0 or drive <= 0.0:
            return NO_CHARGE
        duration_s = (stride.t_end_ns - stride.t_start_ns) / NS_PER_S
        relative = charge_uc / (drive * duration_s)
        usual = median(self._charges) if self._charges else relative
        self._charges.append(relative)
        if relative < CHARGE_SHARE * usual:
            return f"only {relative / usual:.0%} of the usual pulses were delivered"
        return ""
