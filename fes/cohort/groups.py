"""Groups of subjects held against each other: a value a subject, ranks, effect sizes, p adjusted for their number."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np

from fes.cohort.store import Measure
from fes.signals import FloatArray

LEAST: Final = 3  # subjects of each group: with fewer no difference can be told from chance


@dataclass(frozen=True, slots=True)
class GroupDifference:
    """One measure of two groups: medians over subjects, SI; ``p`` is adjusted over all that were compared (Holm 1979).

    ``delta`` is Cliff's (1993): the share of pairs in which the first group's subject is higher, less the share in
    which it is lower; −1 to 1. p is Mann and Whitney's, two-sided.
    """

    measure: Measure
    first: str
    second: str
    counts: tuple[int, int]
    medians: tuple[float, float]
    delta: float
    p: float


def subject_values(rows: Sequence[Mapping[str, Any]], measure: str) -> dict[str, FloatArray]:
    """By group, the subjects' medians (N,) over their recordings; rows without a group or a value are left out.

    A subject who is in two groups (before and after) counts in each.
    """
    by_subject: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        if row.get("group") and row[measure] is not None:
            by_subject.setdefault((row["group"], row["subject"]), []).append(row[measure])
    groups = sorted({group for group, _ in by_subject})
    return {
        name: np.array([np.median(values) for (group, _), values in by_subject.items() if group == name])
        for name in groups
    }


def group_differences(rows: Sequence[Mapping[str, Any]], measures: Sequence[Measure]) -> list[GroupDifference]:
    """Every measure of every two groups that have :data:`LEAST` subjects each; none where there are no such groups."""
    from scipy.stats import mannwhitneyu  # takes a while to load, and most cohorts have one group

    found = []
    for measure in measures:
        groups = {name: values for name, values in subject_values(rows, measure.name).items() if len(values) >= LEAST}
        for first, second in combinations(groups, 2):
            a, b = groups[first], groups[second]
            test = mannwhitneyu(a, b, alternative="two-sided")
            delta = cliffs_delta(a, b)
            medians = float(np.median(a)), float(np.median(b))
            found.append(GroupDifference(measure, first, second, (len(a), len(b)), medians, delta, float(test.pvalue)))
    adjusted = holm(np.array([each.p for each in found]))
    return [replace(each, p=p) for each, p in zip(found, adjusted.tolist(), strict=True)]


def cliffs_delta(a: FloatArray, b: FloatArray) -> float:
    """Cliff's delta of (N,) against (M,): share of pairs with ``a`` above ``b`` less that with ``a`` below."""
    return float(np.sign(a[:, None] - b[None, :]).mean())


def holm(p: FloatArray) -> FloatArray:
    """p-values (N,) adjusted by Holm's step-down method (1979)."""
    order = np.argsort(p)
    adjusted = np.empty(len(p))
    adjusted[order] = np.minimum(np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order]), 1.0)
    return adjusted
