"""What keeps the tuning safe: bounds, and the most that may change with one stride.

The tuner keeps to these; the gate, which knows nothing of tuning, has the last word all the same.
"""

from dataclasses import replace
from typing import Final

from fes.config import Bounds, Channel, Tuning
from fes.stimulation.envelope import BurstParameters

QUANTUM_MA: Final = 0.5  # the devices' step: less would be a change on paper only
QUANTUM_US: Final = 1.0
QUANTUM_S: Final = 0.005
SPENT: Final = 0.99  # of the intensity's bound: from there on there is nothing left to give


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


def at_least(wanted: BurstParameters, least: BurstParameters) -> BurstParameters:
    """``wanted``, nowhere weaker than ``least``."""
    widths = tuple(max(pair) for pair in zip(wanted.widths_us, least.widths_us, strict=True))
    return replace(wanted, current_ma=max(wanted.current_ma, least.current_ma), widths_us=widths)


def between(one: BurstParameters, other: BurstParameters, share: float) -> BurstParameters:
    """``share`` of the way from the one to the other, number by number."""

    def mixed(a: float, b: float) -> float:
        return (1.0 - share) * a + share * b

    return BurstParameters(
        mixed(one.current_ma, other.current_ma),
        mixed(one.start_delay_s, other.start_delay_s),
        mixed(one.extension_s, other.extension_s),
        tuple(mixed(a, b) for a, b in zip(one.widths_us, other.widths_us, strict=True)),
    )


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


def spent(parameters: BurstParameters, tuning: Tuning) -> bool:
    """Whether the intensity's upper bound is in use where the burst is strongest; without bounds it is."""
    if tuning.bounds is None:
        return True
    if tuning.method == "run_to_run":
        return parameters.current_ma >= SPENT * tuning.bounds.current_ma.high
    return max(parameters.widths_us) >= SPENT * tuning.bounds.pulse_width_us.high


def _step(before: float, wanted: float, most: float, quantum: float, bounds: Bounds) -> float:
    """``wanted`` on the grid of ``quantum`` (or of ``most``, where that is finer), no further than ``most`` away."""
    change = min(max(wanted - before, -most), most)
    grid = min(quantum, most)
    # towards `before`, so that no rounding goes beyond; a value off the grid stays off it
    steps = int(abs(change) / grid + 1e-9)
    after = before + (grid if change > 0.0 else -grid) * steps
    after = min(max(round(after, 6), bounds.low), bounds.high)
    return after if abs(after - before) <= most + 1e-9 else before


def outside(level: float) -> float:
    """How far a level lies outside the band, in bands."""
    return max(0.0, -level, level - 1.0)
