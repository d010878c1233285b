"""Iterative learning of the pulse-width profile over the burst.

``u[k+1](t) = Q{u[k](t) + L e[k](t + d)}``: ``d`` is about the delay from pulse to movement; the swing's length varies,
so only what the last swing reached is updated (variable pass length); inside the reference band the error is 0. It
converges if ``|Q (1 - L G)| < 1``: with ``L = gain / slope`` and Q an average over neighbours (no greater than 1 at any
frequency), for a true slope G from 0 to ``2 / gain`` times the estimated one. After Seel, Werner, Raisch & Schauer,
*Control Engineering Practice* 48 (2016), with a profile of widths and a band instead of a reference curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from fes.stimulation.parameters import BIN_S
from fes.stimulation.tuning.targets import LevelTrack, interpolate

DELAY_S: Final = 0.15  # electromechanical delay 20–50 ms, rise of the activation 50 ms, and the foot's own inertia
SIDE: Final = 0.15  # weight of each neighbour in Q
MOST_AT_ONCE: Final = 1.0  # of the band: one bad moment must not move the profile further


def bin_errors(
    track: LevelTrack, burst_s: float, bins: int, aim: float, overall: float
) -> tuple[list[float], list[bool]]:
    """Error that each bin of the profile is answerable for, and whether the swing reached the bin at all.

    Args:
        track: levels over the swing.
        burst_s: when the burst began, since entry into pre-swing.
        bins: how many.
        aim: where in the band the strides should lie.
        overall: the error of the stride as a whole (run-to-run's); negative ones lower the profile evenly.

    A level below the band is missing where it was measured, ``DELAY_S`` after the pulses; pulses before mid-swing are
    answerable for its beginning, those after the last measured moment for none.
    """
    errors, reached = [0.0] * bins, [False] * bins
    for k in range(bins):
        centre_s = burst_s + (k + 0.5) * BIN_S
        if centre_s > track.end_s:
            break
        reached[k] = True
        seen_s = centre_s + DELAY_S
        level = interpolate(seen_s, track.t_s, track.level)
        short = aim - level if level < 0.0 else 0.0
        errors[k] = min(max(short, overall), MOST_AT_ONCE) if overall > 0.0 else max(overall, -MOST_AT_ONCE)
        if overall <= 0.0 and short > 0.0:
            errors[k] = 0.0  # too much on the whole, but not here
    return errors, reached


def next_profile(
    widths: Sequence[float], errors: Sequence[float], reached: Sequence[bool], base: float, gain: float, slope: float
) -> list[float]:
    """The next stride's profile in µs, before any limit or bound.

    ``base`` is the width that counts as drive 1, ``gain / slope`` the learning gain L. The smoothing Q works on the
    bins reached; beyond them the profile goes on with the width of the last, which the next, longer swing will judge.
    """
    raised = [width + base * gain / slope * error for width, error in zip(widths, errors, strict=True)]
    n = sum(reached)
    smooth = list(widths)
    for k in range(n):
        before, after = raised[max(k - 1, 0)], raised[min(k + 1, n - 1)]
        smooth[k] = SIDE * before + (1.0 - 2.0 * SIDE) * raised[k] + SIDE * after
    if n:
        smooth[n:] = [smooth[n - 1]] * (len(smooth) - n)
    return smooth
