"""Which strides teach nothing: a stumble, a turn, a stair, a pause, another speed, pulses that did not come."""

import math
from collections import deque
from statistics import median
from typing import Final

from fes.config import Tuning
from fes.signals import NS_PER_S, StrideResult
from fes.stimulation.ground import GroundWatch

STOP_S: Final = 0.8  # between the end of a stride and the beginning of the next: a stop
SPEED_CHANGE, LEAST_SPEED_CHANGE_MPS = 0.25, 0.1  # of the usual speed, and at least
CHARGE_SHARE: Final = 0.6  # of the usual charge: the rest of the pulses were refused, or lost
REMEMBERED: Final = 5
SHORTEST_SWING: Final = 0.16  # of the stride; a third is usual, a quarter is a very slow walk's
BELOW_GROUND_M: Final = -0.015  # no toe is there
JOLTED: Final = "cannot be true"
NO_CHARGE: Final = "no stimulation was delivered in it"


def jolted(stride: StrideResult) -> str:
    """Why the stride's contact cannot be true, as when stimulation jerks the foot; "" when it can."""
    swing_ns, contact_ns = stride.t_swing_ns, stride.t_loading_response_ns
    if swing_ns is not None and contact_ns is not None:
        share = (contact_ns - swing_ns) / max(stride.t_end_ns - stride.t_start_ns, 1)
        if share < SHORTEST_SWING:
            return f"contact {1e-6 * (contact_ns - swing_ns):.0f} ms after foot off {JOLTED}"
    if math.isfinite(stride.toe_clearance_m) and stride.toe_clearance_m < BELOW_GROUND_M:
        return f"a toe {-1e3 * stride.toe_clearance_m:.0f} mm below the ground {JOLTED}"
    return ""


class StrideFilter:
    """Judges every stride of one channel's foot, in order."""

    def __init__(self, tuning: Tuning, min_stride_length_m: float, *, free_ground: bool = False) -> None:
        self._tuning = tuning
        self._ground = GroundWatch(most_m=tuning.max_height_gained_m, free=free_ground)
        self._min_length_m = min_stride_length_m
        self._end_ns: int | None = None
        self._changed_ns: int | None = None
        self._ground_changed_ns: int | None = None
        self._speeds: deque[float] = deque(maxlen=REMEMBERED)
        self._other_mps: float | None = None  # of the stride before, where it was walked at another speed
        self._charges: deque[float] = deque(maxlen=REMEMBERED)

    def operator_changed(self, t_ns: int) -> None:
        """A person changed the stimulation."""
        self._changed_ns = t_ns

    def ground_changed(self, t_ns: int, *, free: bool) -> None:
        """A person said what is walked on from now on."""
        self._ground_changed_ns = t_ns
        self._ground.forget(free=free)

    def why_skip(self, stride: StrideResult, charge_uc: float, drive: float) -> str:
        """Why this newest stride teaches nothing; "" when it does.

        ``charge_uc`` was delivered in it; ``drive``, under which it was walked, scales the charge to be expected.
        """
        end_ns, self._end_ns = self._end_ns, stride.t_end_ns
        if not stride.valid:
            return f"the stride is not usable ({stride.reason})"
        numbers = (stride.speed_mps, stride.stride_length_m, stride.turn_rad, stride.height_gained_m)
        if not all(map(math.isfinite, numbers)):
            return "the stride's own numbers are none"
        if end_ns is not None and stride.t_end_ns <= end_ns:
            return "it is no newer than the stride before"
        usual_mps = median(self._speeds) if self._speeds else stride.speed_mps
        before_mps, self._other_mps = self._other_mps, None
        self._speeds.append(stride.speed_mps)
        if end_ns is None or stride.t_start_ns - end_ns > STOP_S * NS_PER_S:
            self._speeds.clear()
            return "it is the first stride after standing"
        if stride.stride_length_m < self._min_length_m:
            return f"a stride of {100 * stride.stride_length_m:.0f} cm is no walking"
        if abs(stride.turn_rad) > math.radians(self._tuning.max_turn_deg):
            return f"the foot turned by {abs(math.degrees(stride.turn_rad)):.0f}°"
        if self._ground_changed_ns is not None and self._ground_changed_ns >= stride.t_start_ns:
            return "a person changed the ground meanwhile"  # before its rise would count as a stair's, or as usual
        if uneven := self._ground.unusual(stride):
            return uneven
        if self._changed_ns is not None and self._changed_ns >= stride.t_start_ns:
            return "a person changed the stimulation meanwhile"
        if _other_speed(stride.speed_mps, usual_mps):
            if before_mps is None or _other_speed(stride.speed_mps, before_mps):
                self._other_mps = stride.speed_mps
                return f"the speed changed from {usual_mps:.1f} to {stride.speed_mps:.1f} m/s"
            self._speeds.clear()  # two in a row: this is the speed now
            self._speeds.append(stride.speed_mps)
        if charge_uc <= 0.0 or drive <= 0.0:
            return NO_CHARGE
        relative = charge_uc / (drive * ((stride.t_end_ns - stride.t_start_ns) / NS_PER_S))
        usual = median(self._charges) if self._charges else relative
        self._charges.append(relative)
        if relative < CHARGE_SHARE * usual:
            return f"only {relative / usual:.0%} of the usual pulses were delivered"
        return jolted(stride)


def _other_speed(speed_mps: float, usual_mps: float) -> bool:
    return abs(speed_mps - usual_mps) > max(SPEED_CHANGE * usual_mps, LEAST_SPEED_CHANGE_MPS)
