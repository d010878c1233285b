"""How the patients of ``benchmarks/tuning.py`` end on other days, in a line each and in a table of all."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from scipy.stats import wilcoxon
from tuning_table import LAST, TUNED

FIXED = "foot switch"
TWO, ONE = 2 / LAST, 1 / LAST


def day_line(one: dict[str, Any]) -> str:
    """One patient: share of the last strides in the band (and of all with the heel first), mean over the days.

    p is how likely a tuned walk ends so often below the fixed one of the same day by chance (Wilcoxon's signed ranks).
    """
    cells = [_shares(one, FIXED)]
    for method in TUNED:
        differ = _differ(one, method)
        p = float(wilcoxon(differ, alternative="less").pvalue) if any(differ) else 1.0
        fewer, more = sum(d <= -2 for d in differ), sum(d >= 2 for d in differ)
        cells.append(f"{_shares(one, method)}, two strides or more below / above on {fewer} / {more} days, p {p:.3f}")
    return f"| {one['seed']} | " + " | ".join(cells) + " |"


def days_table(every: Sequence[dict[str, Any]]) -> str:
    """All of them: the mean, and how many end better or worse than with fixed timing on the mean of their days."""
    days = len(every[0]["ends"][FIXED])
    lines = [
        f"| {len(every)} patients, {days} days each | fixed timing | " + " | ".join(TUNED) + " |",
        "|---" * (2 + len(TUNED)) + "|",
        _row("in the band at the end", [_all(every, "ends", method) for method in (FIXED, *TUNED)]),
        _row("heel first", [_all(every, "heels", method) for method in (FIXED, *TUNED)]),
    ]
    for least, what in ((TWO, "two strides of twenty"), (ONE, "one stride of twenty")):
        for sign, which in ((-1, "worse"), (1, "better")):
            found = [[one for one in every if sign * _gain(one, method) >= least - 1e-9] for method in TUNED]
            counts = [f"{len(some)}{_seeds(some) if sign < 0 else ''}" for some in found]
            lines.append(_row(f"{which} by {what} or more", ["", *counts]))
    return "\n".join(lines)


def _row(name: str, cells: list[str]) -> str:
    return f"| {name} | " + " | ".join(cells) + " |"


def _all(every: Sequence[dict[str, Any]], what: str, method: str) -> str:
    return f"{fmean(fmean(one[what][method]) for one in every):.1%}"


def _gain(one: dict[str, Any], method: str) -> float:
    return fmean(one["ends"][method]) - fmean(one["ends"][FIXED])


def _differ(one: dict[str, Any], method: str) -> list[int]:
    """Strides at the end in the band more than with fixed timing, by day."""
    return [round(LAST * (tuned - fixed)) for tuned, fixed in zip(one["ends"][method], one["ends"][FIXED], strict=True)]


def _shares(one: dict[str, Any], method: str) -> str:
    return f"{fmean(one['ends'][method]):.1%} ({fmean(one['heels'][method]):.0%})"


def _seeds(some: Sequence[dict[str, Any]]) -> str:
    return f" (seed {', '.join(str(one['seed']) for one in some)})" if some else ""
