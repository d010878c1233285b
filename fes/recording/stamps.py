"""Single time stamps that are wrong among right ones, and the usual interval of a sensor's stamps."""

from collections.abc import Callable
from typing import Final

import numpy as np

from fes.estimation.numerics.ranks import median
from fes.recording.tracks import RecordingError
from fes.signals import NS_PER_S, IntArray

MAX_BACKWARD_SHARE = 0.05
MAX_BACKWARD_JUMP_NS = NS_PER_S
GAP_INTERVALS: Final = 1.5  # usual intervals: from there on a sample is missing
_BUNCH: Final = 8  # stamps that may come in a bunch, as radios and Android bring them
_ONE_BETWEEN: Final = (1.5, 4.5)  # usual intervals from neighbour to neighbour: the sample belongs between them
FAR_INTERVALS: Final = 5.0  # more than jitter and swapped packets; what is nearer is counted as backward or irregular


def usual_interval_ns(stamps_ns: IntArray) -> float:
    """The usual interval of (N,) increasing stamps, whatever bunches they come in; N is 2 or more."""
    over = min(_BUNCH, stamps_ns.size - 1)
    return float(np.median(stamps_ns[over:] - stamps_ns[:-over])) / over


def repaired(stamps_ns: IntArray, *, doubled: bool = False) -> tuple[IntArray, int]:
    """Put single wrong stamps of (N,) between their neighbours; the same array where none is wrong, and how many.

    A stamp is wrong that is more than ``FAR_INTERVALS`` from where its neighbours say, where these are so far apart
    that a sample is due between them. The first and the last, which have one neighbour, are wrong where they are
    further off than all others lie apart: a stall of seconds before the last sample is none. Two samples in the wrong
    order and a clock that jumps for good are none either. What is off by less is left as a live session has it.

    Args:
        stamps_ns: as the file has them.
        doubled: the stamp of the sample before is wrong too, where a sample is due.
    """
    steps = stamps_ns[1:] - stamps_ns[:-1]
    if stamps_ns.size < 4:
        return stamps_ns, 0
    rest_ns = int(np.abs(stamps_ns[-2] - stamps_ns[1]))
    if steps.min() > 0 and max(steps[0], steps[-1]) <= rest_ns:
        return stamps_ns, 0
    forward = steps[steps > 0]
    if not forward.size:
        return stamps_ns, 0
    usual_ns = median(forward)
    before, at, after = stamps_ns[:-2], stamps_ns[1:-1], stamps_ns[2:]
    apart, due = after - before, before + (after - before) // 2
    wrong = (np.abs(at - due) > FAR_INTERVALS * usual_ns) | (doubled & (at == before))
    wrong &= (apart >= _ONE_BETWEEN[0] * usual_ns) & (apart <= _ONE_BETWEEN[1] * usual_ns)
    out = stamps_ns.copy()
    out[1:-1][wrong] = due[wrong]
    count = int(np.count_nonzero(wrong))
    for end, neighbour, next_one in ((0, 1, 2), (-1, -2, -3)):
        step = int(out[neighbour] - out[next_one])
        follows = 0 < abs(step) <= _ONE_BETWEEN[0] * usual_ns and (step < 0) == (end == 0)
        if follows and abs(int(out[end]) - int(out[neighbour]) - step) > rest_ns:
            out[end] = out[neighbour] + step
            count += 1
    return (out, count) if count else (stamps_ns, 0)


def refuse_wild_clock(steps: IntArray, backward: IntArray, where: str, place: Callable[[int], str]) -> None:
    """Refuse steps (N - 1,) of a clock of which those at ``backward`` (K,), one or more, go back too far or too often.

    Raises:
        RecordingError: they do; ``place`` tells where a stamp stands in the file.
    """
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
