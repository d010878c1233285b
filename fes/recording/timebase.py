"""Time stamps → arrival times, rate and what was irregular; a clock nobody can follow is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fes.estimation.ranks import median
from fes.recording.tracks import RecordingError
from fes.recording.units import TIME_UNITS_NS
from fes.signals import NS_PER_S, IntArray

MAX_BACKWARD_SHARE = 0.05
MAX_BACKWARD_JUMP_NS = NS_PER_S
MIN_DURATION_S = 1.0
RATE_TOLERANCE = 0.02
PLAUSIBLE_RATES_HZ = (10.0, 20_000.0)


@dataclass(frozen=True)
class Timing:
    """What the stamps say: the rate, and counts as in :class:`fes.recording.TrackQuality`."""

    rate_hz: float
    missing: int
    doubled: int
    backward: int
    irregular: int


def stamps_from_rate(rows: int, rate_hz: float, first: int = 0) -> IntArray:
    """Return (rows,) times in ns of samples at an even rate, the ``first`` after the recording's beginning."""
    stamps: IntArray = np.rint(np.arange(first, first + rows) * (NS_PER_S / rate_hz)).astype(np.int64)
    return stamps


def judge_stamps(
    stamps_ns: IntArray, stated_hz: float | None, where: str, place: Callable[[int], str], unit: str
) -> Timing:
    """Return what (N,) stamps say; ``place`` tells where a stamp stands in the file.

    Missing samples are counted on the sorted stamps, so that two swapped samples are backward, not missing.

    Raises:
        RecordingError: too few, not advancing, too often or too far backward, an impossible rate, or another rate
            than the stated one.
    """
    if stamps_ns.size < 2:
        raise RecordingError(f"{where}: has {stamps_ns.size} sample; a recording needs at least {MIN_DURATION_S:g} s")
    steps: IntArray = np.diff(stamps_ns)
    shortest, longest = int(steps.min()), int(steps.max())
    forward = steps if shortest > 0 else steps[steps > 0]
    backward = np.flatnonzero(steps < 0) if shortest < 0 else steps[:0]
    if forward.size == 0:
        raise RecordingError(f"{where}: its time never advances; check time_column")
    if backward.size:
        _refuse_wild_clock(steps, backward, where, place)
    usual_ns = median(forward) if shortest < longest else float(shortest)  # stamps made from a rate are often even
    _refuse_impossible_rate(NS_PER_S / usual_ns, where, unit)
    if stated_hz is not None:
        _refuse_other_rate(stamps_ns, usual_ns, stated_hz, where)
        usual_ns = NS_PER_S / stated_hz
    if 0.5 * usual_ns <= shortest and longest <= 1.5 * usual_ns:  # the usual case: nothing to count
        return Timing(stated_hz or NS_PER_S / usual_ns, 0, 0, 0, 0)
    gaps = steps
    if backward.size:
        ordered = np.sort(stamps_ns)
        gaps = ordered[1:] - ordered[:-1]
    missing = int(np.sum(np.rint(gaps[gaps > 1.5 * usual_ns] / usual_ns) - 1))
    irregular = int(np.count_nonzero(np.abs(steps - usual_ns) > 0.5 * usual_ns))
    doubled = int(np.count_nonzero(steps == 0))
    return Timing(stated_hz or NS_PER_S / usual_ns, missing, doubled, int(backward.size), irregular)


def _refuse_wild_clock(steps: IntArray, backward: IntArray, where: str, place: Callable[[int], str]) -> None:
    furthest = int(backward[np.argmin(steps[backward])])
    back_s = -float(steps[furthest]) / NS_PER_S
    if back_s > MAX_BACKWARD_JUMP_NS / NS_PER_S:
        raise RecordingError(
            f"{where}: {place(furthest + 1)}: the clock jumps back {back_s:.3f} s. "
            f"If two recordings follow each other there, split the file; if the clock restarted, correct its times."
        )
    if backward.size > MAX_BACKWARD_SHARE * steps.size:
        raise RecordingError(
            f"{where}: time goes backward {backward.size} times in {steps.size + 1} samples, first at "
            f"{place(int(backward[0]) + 1)}; at most {MAX_BACKWARD_SHARE:.0%} can be handled. "
            f"Sort the rows by time, or leave time_column out and state rate_hz."
        )


def _refuse_impossible_rate(rate_hz: float, where: str, unit: str) -> None:
    lowest, highest = PLAUSIBLE_RATES_HZ
    if lowest <= rate_hz <= highest:
        return
    ns = TIME_UNITS_NS.get(unit, NS_PER_S)
    fitting = [other for other, size in TIME_UNITS_NS.items() if 40.0 <= rate_hz * ns / size <= 2500.0]
    hint = f'; its numbers look like {fitting[0]}: say time_unit = "{fitting[0]}"' if fitting else ""
    raise RecordingError(
        f'{where}: with time_unit = "{unit}" it would come at {rate_hz:.4g} Hz, outside {lowest:g} to '
        f"{highest:g} Hz{hint}"
    )


def _refuse_other_rate(stamps_ns: IntArray, usual_ns: float, stated_hz: float, where: str) -> None:
    """A stated rate must fit the usual interval or, where stamps bunch, the mean one."""
    found = [NS_PER_S / usual_ns]
    if abs(found[0] / stated_hz - 1.0) <= RATE_TOLERANCE:
        return
    found.append((stamps_ns.size - 1) * NS_PER_S / float(stamps_ns.max() - stamps_ns.min()))
    if abs(found[1] / stated_hz - 1.0) <= RATE_TOLERANCE:
        return
    raise RecordingError(
        f"{where}: rate_hz = {stated_hz:g}, but its time column runs at {found[0]:.4g} Hz (usual interval; "
        f"{found[1]:.4g} Hz on average). Correct rate_hz, time_unit, or leave rate_hz out."
    )
