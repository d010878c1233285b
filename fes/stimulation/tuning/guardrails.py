"""What keeps the tuning safe: bounds, the most that may change with one stride, and when things have got worse.

The tuner keeps to these; the gate, which knows nothing of tuning, has the last word all the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median
from typing import Final

from fes.config import Bounds, Tuning
from fes.stimulation.parameters import BurstParameters
from fes.stimulation.tuning.response import LAST, Response

QUANTUM_MA: Final = 0.5  # the devices' step: less would be a change on paper only
QUANTUM_US: Final = 1.0
QUANTUM_S: Final = 0.005
TRIAL_DRIVE: Final = 0.08  # a change of drive this large must have done good, or at least no harm
WORSE: Final = 0.3  # of the band
WORSE_SDS: Final = 1.5


def limited(before: BurstParameters, wanted: BurstParameters, tuning: Tuning) -> BurstParameters:
    """What may become of ``before`` with one stride on the way to ``wanted``: quantised, limited, within the bounds."""
    bounds = tuning.bounds
    if bounds is None:
        return before
    return BurstParameters(
        _step(before.current_ma, wanted.current_ma, tuning.max_change_ma, QUANTUM_MA, bounds.current_ma),
        _step(before.start_delay_s, wanted.start_delay_s, tuning.max_change_s, QUANTUM_S, bounds.start_delay_s),
        _step(before.extension_s, wanted.extension_s, tuning.max_change_s, QUANTUM_S, bounds.extension_s),
        tuple(
            _step(was, width, tuning.max_change_us, QUANTUM_US, bounds.pulse_width_us)
            for was, width in zip(before.widths_us, wanted.widths_us, strict=True)
        ),
    )


def _step(before: float, wanted: float, most: float, quantum: float, bounds: Bounds) -> float:
    """``wanted`` on the grid of ``quantum`` (or of ``most``, where that is finer), no further than ``most`` away."""
    change = min(max(wanted - before, -most), most)
    grid = min(quantum, most)
    # towards `before`, so that no rounding goes beyond; a value off the grid stays off it
    steps = int(abs(change) / grid + 1e-9)
    after = before + (grid if change > 0.0 else -grid) * steps
    after = min(max(round(after, 6), bounds.low), bounds.high)
    return after if abs(after - before) <= most + 1e-9 else before


@dataclass(frozen=True, slots=True)
class Trial:
    """Where a run of changes in one direction began: the settings, their drive, and the level under them."""

    parameters: BurstParameters
    drive: float
    level: float
    strides: int = 0


def got_worse(trial: Trial, drive: float, response: Response) -> bool:
    """Whether the last strides lie clearly further from the band than those before the trial, and changed enough."""
    if trial.strides < LAST or abs(drive - trial.drive) < TRIAL_DRIVE:
        return False
    now = median(response.last_levels(LAST))
    return outside(now) > outside(trial.level) + max(WORSE, WORSE_SDS * response.noise)


def outside(level: float) -> float:
    """How far a level lies outside the band, in bands."""
    return max(0.0, -level, level - 1.0)
