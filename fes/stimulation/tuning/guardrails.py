"""What keeps the tuning safe: bounds, the most that may change with one stride, and when things have got worse.

The tuner keeps to these; the gate, which knows nothing of tuning, has the last word all the same.
"""

from dataclasses import dataclass, replace
from statistics import median
from typing import Final

from fes.config import Bounds, Channel, Tuning
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.demand import LAST, Response

QUANTUM_MA: Final = 0.5  # the devices' step: less would be a change on paper only
QUANTUM_US: Final = 1.0
QUANTUM_S: Final = 0.005
TRIAL_DRIVE: Final = 0.08  # a change of drive this large must have done good, or at least no harm
WORSE: Final = 0.3  # of the band
WORSE_SDS: Final = 1.5
PROVED: Final = 6  # strides


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


def at_most(wanted: BurstParameters, most: BurstParameters) -> BurstParameters:
    """``wanted``, nowhere stronger than ``most``."""
    widths = tuple(min(pair) for pair in zip(wanted.widths_us, most.widths_us, strict=True))
    return replace(wanted, current_ma=min(wanted.current_ma, most.current_ma), widths_us=widths)


def strongest_drive(channel: Channel, tuning: Tuning) -> float:
    """The drive at the upper bound of what the method moves; 1 without bounds."""
    if tuning.bounds is None:
        return 1.0
    if tuning.method == "run_to_run":
        return tuning.bounds.current_ma.high / channel.current_ma
    return tuning.bounds.pulse_width_us.high / channel.pulse_width_us


def drive_of(parameters: BurstParameters, own: BurstParameters) -> float:
    """Stimulation relative to the session's own settings, at full intensity."""
    return parameters.current_ma / own.current_ma * parameters.mean_width_us / own.mean_width_us


def peak_of(parameters: BurstParameters, own: BurstParameters) -> float:
    """As :func:`drive_of`, where the burst is strongest."""
    return parameters.current_ma / own.current_ma * max(parameters.widths_us) / max(own.widths_us)


def share_used(parameters: BurstParameters, tuning: Tuning) -> float:
    """Share of the intensity's upper bound that is in use where the burst is strongest; 1 without bounds."""
    if tuning.bounds is None:
        return 1.0
    if tuning.method == "run_to_run":
        return parameters.current_ma / tuning.bounds.current_ma.high
    return max(parameters.widths_us) / tuning.bounds.pulse_width_us.high


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
    """Where a run of changes in one direction began: the settings, their drive, and the level under them.

    ``strides`` have been walked since it began, ``unchanged`` of them since its last change.
    """

    parameters: BurstParameters
    drive: float
    level: float
    strides: int = 0
    unchanged: int = 0


class HarmMonitor:
    """Finds out whether changes do harm. Changes in one direction are one trial, until it is proved harmless.

    ``inverted`` is whether this foot answers the other way round, as far as is known.
    """

    def __init__(self) -> None:
        self._trial: Trial | None = None
        self._harmed: float | None = None  # the level that was rolled back
        self.inverted = False

    def forget(self) -> None:
        """No trial is under way."""
        self._trial = self._harmed = None

    def changed(self, before: BurstParameters, drive: float, error: float, response: Response) -> None:
        """A change was made, up (``error`` > 0) or down; the first in another direction begins a new trial."""
        trial = self._trial
        if trial is None or (drive - trial.drive) * error < 0.0:
            self._trial = Trial(before, drive, response.level_at(drive))
        else:
            self._trial = replace(trial, unchanged=0)

    def stride(self, drive: float, response: Response) -> BurstParameters | None:
        """A valid stride was walked; the settings to go back to when the trial turns out to do harm, else None.

        A trial whose last change was followed by ``PROVED`` strides that lie no further from the band is over: what
        comes later is the muscle, the electrode or the person, not the change.
        """
        if self._trial is None:
            return None
        trial = replace(self._trial, strides=self._trial.strides + 1, unchanged=self._trial.unchanged + 1)
        self._trial = trial
        now = outside(median(response.last_levels(LAST)))
        if trial.strides < LAST:
            return None
        worse = now - outside(trial.level) > max(WORSE, WORSE_SDS * response.noise)
        if worse and abs(drive - trial.drive) >= TRIAL_DRIVE:
            # too little although more made it worse: next time less is tried, and the other way round
            self.inverted = not self.inverted and (drive > trial.drive) == (trial.level < 0.5)
            self._trial, self._harmed = None, now
            return trial.parameters
        if trial.unchanged >= PROVED and now <= outside(trial.level):
            self._trial = None
        return None

    def returned(self, response: Response) -> None:
        """Back at the old settings for some strides: if that was no better, the change had done no harm."""
        if self._harmed is not None and outside(median(response.last_levels(LAST))) > self._harmed - 0.5 * WORSE:
            self.inverted = False
        self._harmed = None


def outside(level: float) -> float:
    """How far a level lies outside the band, in bands."""
    return max(0.0, -level, level - 1.0)
