"""What a sensor at its limit, or a lost sample, leaves to be guessed: compiled, causal."""

from __future__ import annotations

import math
from typing import Any

from fes.estimation.compiled import jit
from fes.estimation.orientation_settings import FORCE, RATE, SINCE_PUSH_S, SINCE_TURN_S, SLOPE, TRUSTED, BodySettings

AT_LIMIT = 0.999  # of the range


@jit
def usable_rate(memory: Any, gyr: Any, range_radps: float, dt_s: float, settings: BodySettings) -> float:
    """Fill ``memory`` at RATE with the rate to integrate (rad/s); return for how long it has been guessed (s).

    An axis at its limit goes on as it rose before, ever more slowly: ``w + dw/dt · T (1 - exp(-t/T))``, at least the
    limit and at most ``greatest_excess`` above it. A lost sample (not finite) repeats the last good rate.
    """
    guessed = False
    for j in range(3):
        if not (math.isfinite(gyr[j]) and abs(gyr[j]) < AT_LIMIT * range_radps):
            guessed = True
    t = memory[SINCE_TURN_S] + dt_s if guessed else 0.0
    memory[SINCE_TURN_S] = t
    for j in range(3):
        value, last = gyr[j], memory[TRUSTED + j]
        if not math.isfinite(value):
            memory[RATE + j] = last
        elif abs(value) < AT_LIMIT * range_radps:
            memory[SLOPE + j] = (value - last) / dt_s if memory[RATE + j] == last else 0.0
            memory[RATE + j] = value
            memory[TRUSTED + j] = value
        else:
            side = 1.0 if value > 0.0 else -1.0
            reach = settings.extrapolation_s * (1.0 - math.exp(-t / settings.extrapolation_s))
            size = side * (last + memory[SLOPE + j] * reach)
            size = min(max(size, abs(value)), (1.0 + settings.greatest_excess) * range_radps)
            memory[RATE + j] = side * size
    return t


@jit
def usable_force(memory: Any, acc: Any, range_mps2: float, dt_s: float) -> float:
    """Fill ``memory`` at FORCE with the force to integrate (m/s²); return for how long it has been guessed (s).

    At the limit the reading is the best guess there is; a lost sample repeats the last.
    """
    guessed = False
    for j in range(3):
        if math.isfinite(acc[j]):
            memory[FORCE + j] = acc[j]
            guessed = guessed or abs(acc[j]) >= AT_LIMIT * range_mps2
        else:
            guessed = True
    t = memory[SINCE_PUSH_S] + dt_s if guessed else 0.0
    memory[SINCE_PUSH_S] = t
    return t
