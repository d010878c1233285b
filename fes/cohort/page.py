"""Pages of a cohort: distributions, outliers, what could not be used, and one page a subject."""

import hashlib
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fes.cohort.store import RECORDINGS, STRIDES, Measure, Store
from fes.cohort.task import DONE
from fes.report.figures.strides import FOOT_COLORS, foot_color
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.html import rendered
from fes.signals import BoolArray, FloatArray

LEAST_MEMBERS: Final = 3  # subjects of each group: with fewer no difference can be told from chance


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
    """Every measure of every two groups that have :data:`LEAST_MEMBERS` subjects each; none where no groups do."""
    from scipy.stats import mannwhitneyu  # takes a while to load, and most cohorts have one group

    found = []
    for measure in measures:
        groups = {
            name: values for name, values in subject_values(rows, measure.name).items() if len(values) >= LEAST_MEMBERS
        }
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


PAGE: Final = "index.html"
OUTLIER: Final = 3.5  # robust z; Iglewicz & Hoaglin, How to Detect and Handle Outliers, 1993
MAD_TO_SD: Final = 0.6745
LEAST: Final = 5  # recordings from which on an outlier means something
BINS: Final = 40
MISSING_SHARE: Final = 0.01
SHARES: Final = (0.005, 0.995)  # of the strides that a histogram shows: a few wild ones would leave no room


MEASURES: Final = (
    Measure("stride_length_m", "Stride length", "m", digits=2),
    Measure("speed_mps", "Walking speed", "m/s", digits=2),
    Measure("stride_time_s", "Stride time", "s", digits=2),
    Measure("clearance_m", "Greatest sensor height", "cm", factor=100.0),
)
OF_RECORDINGS: Final = (  # of a walk as a whole: a stride has no such number
    Measure("cadence_per_min", "Cadence", "steps/min"),
    Measure("step_time_s", "Step time", "s", digits=2),
    Measure("swing_symmetry_percent", "Asymmetry of swing", "%"),
    Measure("step_time_symmetry_percent", "Asymmetry of step time", "%"),
    Measure("stride_time_cv_percent", "Variability of stride time", "%"),
    Measure("stride_length_cv_percent", "Variability of stride length", "%"),
)
EVERY: Final = (*MEASURES, *OF_RECORDINGS)
NAMES: Final = ("recording", "subject", "foot")
COLUMNS: Final = (*NAMES, "valid", "t_start_s", "t_end_s", "stride_length_m", "speed_mps", "clearance_m")


def write_pages(store: Store, identities: Iterable[str], rows: Sequence[dict[str, Any]] | None = None) -> str:
    """Write the cohort's page and one for each subject; where the first is.

    ``rows``: of the recordings, where they have been read already.

    OSError: they cannot be written.
    """
    wanted = set(identities)
    rows = store.table(RECORDINGS, wanted).to_pylist() if rows is None else rows
    rows = sorted(rows, key=lambda row: str(row["source"]))
    strides = _columns(store.table(STRIDES, wanted, COLUMNS))
    subjects = sorted({row["subject"] for row in rows})
    by_subject = {name: [row for row in rows if row["subject"] == name] for name in subjects}
    done = [row for row in rows if row["status"] == DONE]

    def write(
        name: str, own: Sequence[dict[str, Any]], mask: slice | BoolArray, figures: list[Figure], **more: object
    ) -> None:
        values = {"above": "", "recordings": [], "subjects": [], "outliers": [], "groups": [], **more}
        values |= {"page_of": _file, "measures": EVERY, "flags": _flags, "colors": FOOT_COLORS}
        values |= {"figures": figures, "strides": int(strides["valid"][mask].sum())}
        values["failed"] = [row for row in own if row["status"] != DONE]
        store.write(name, rendered("cohort.html.j2", "fes.cohort", **values))

    for name, own in by_subject.items():
        mask = strides["subject"] == name
        of_subject = {column: values[mask] for column, values in strides.items()}
        figures = [*_histograms(of_subject), *_strides_over_time(of_subject, own)]
        title = f"Subject {name or 'without a name'}"
        write(f"subjects/{_file(name)}", own, mask, figures, title=title, above=f"../{PAGE}", recordings=own)
    totals: dict[str, float] = {"recordings": len(rows), "used": len(done), "subjects": len(subjects)}
    totals["hours"] = sum(row["duration_s"] or 0.0 for row in done) / 3600.0
    listed: dict[str, Any] = {"groups": group_differences(done, EVERY), "outliers": _outliers(done)}
    listed["subjects"] = [_subject_row(name, own) for name, own in by_subject.items()]
    figures = [*_histograms(strides), *_spreads(done)]
    write(PAGE, rows, slice(None), figures, title="Cohort", totals=totals, **listed)
    return store.place(PAGE)


def _columns(table: pa.Table) -> dict[str, Any]:
    """Arrays of what the pages show; times of strides are worked out."""
    found = {name: np.array(table[name].to_pylist(), dtype=object) for name in NAMES}
    found |= {name: table[name].to_numpy() for name in COLUMNS if name not in NAMES}  # NaN where nothing is known
    found["valid"] = table["valid"].fill_null(False).to_numpy()
    found["stride_time_s"] = found["t_end_s"] - found["t_start_s"]
    return found


def _histograms(strides: dict[str, Any]) -> list[Figure]:
    figures = []
    for measure in MEASURES:
        values = measure.factor * strides[measure.name]
        usable = strides["valid"] & np.isfinite(values)
        if not usable.any():
            continue
        low, high = np.quantile(values[usable], SHARES)
        edges = np.linspace(low, max(high, low + 1e-3), BINS + 1)
        width, middle = edges[1] - edges[0], (edges[:-1] + edges[1:]) / 2
        feet = sorted(set(strides["foot"][usable]))
        counts = {f: np.histogram(values[usable & (strides["foot"] == f)], edges)[0].astype(float) for f in feet}
        most = max(float(count.max()) for count in counts.values())
        plot = Plot(measure.title, measure.axis, "strides", (edges[0], edges[-1]), (0.0, 1.05 * most))
        for k, (foot, count) in enumerate(counts.items()):
            shift = (k - (len(counts) - 1) / 2) * width / len(counts)
            plot.bars(middle + shift, 0 * count, count, 0.9 * width / len(counts), foot_color(foot), foot)
        cut = int((usable & ((values < low) | (values > high))).sum())
        median = float(np.median(values[usable]))
        middle_one = f"median {median:.{measure.digits}f} {measure.unit}"
        caption = f"{int(usable.sum())} strides, {middle_one}; the outermost {cut} are not drawn."
        figures.append(plot.figure(f"{measure.title}, all valid strides", caption))
    return figures


def _spreads(rows: Sequence[dict[str, Any]]) -> list[Figure]:
    """Every recording's median, in order: where the cohort lies, and who lies apart."""
    figures = []
    for measure in EVERY:
        known = sorted((row for row in rows if row[measure.name] is not None), key=lambda row: row[measure.name])
        if len(known) < 2:
            continue
        values = measure.factor * np.array([row[measure.name] for row in known])
        x = np.arange(1.0, len(known) + 1.0)
        plot = Plot(f"{measure.title} by recording", "recording, ordered", measure.axis, padded([x]), padded([values]))
        shown = [f"{measure.text(row[measure.name])} {measure.unit}" for row in known]
        titles = [f"{row['name']} ({row['subject']}): {text}" for row, text in zip(known, shown, strict=True)]
        plot.points(x, values, "#333333", titles)
        plot.level(float(np.median(values)), "#777777")
        caption = "One point a recording: its median over valid strides. Dashed: the cohort's median."
        figures.append(plot.figure(f"{measure.title}, recording by recording", caption))
    return figures


def _strides_over_time(strides: dict[str, Any], rows: Sequence[dict[str, Any]]) -> list[Figure]:
    """A subject's strides one after the other, recordings apart by an upright line."""
    measure, x0 = MEASURES[0], 0.0
    parts: list[tuple[FloatArray, FloatArray, Any]] = []
    bounds = []
    for row in rows:
        mine = strides["valid"] & (strides["recording"] == row["recording"])
        if not mine.any():
            continue
        t_s = strides["t_start_s"][mine]
        bounds.append((x0, row["name"]))
        parts.append((x0 + t_s - t_s.min(), measure.factor * strides[measure.name][mine], strides["foot"][mine]))
        x0 = float(parts[-1][0].max()) + 5.0
    if not parts:
        return []
    y = [part[1] for part in parts]
    plot = Plot("Stride length over time", "walking time, s", "Stride length, m", (0.0, max(x0, 1.0)), padded(y))
    for t_s, length_m, feet in parts:
        for foot in sorted(set(feet)):
            own = feet == foot
            plot.points(t_s[own], length_m[own], foot_color(foot), [f"{v:.2f} m" for v in length_m[own]])
    for at, name in bounds:
        plot.upright(at, "#777777", name if len(bounds) <= 6 else "")
    return [plot.figure("Stride length, stride by stride", "Recordings one after the other.")]


def _subject_row(name: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    done = [row for row in rows if row["status"] == DONE]
    known = {m.name: [row[m.name] for row in done if row[m.name] is not None] for m in EVERY}
    medians = {measure: float(np.median(values)) if values else None for measure, values in known.items()}
    groups = ", ".join(sorted({row["group"] for row in done if row["group"]}))
    counts: dict[str, Any] = {"group": groups, "recordings": len(rows), "failed": len(rows) - len(done)}
    counts["valid_strides"] = sum(row["valid_strides"] or 0 for row in done)
    return {"name": name, "page": f"subjects/{_file(name)}", **counts, **medians}


def _outliers(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Recordings whose median lies far from the others', by median and median absolute deviation."""
    found: dict[str, list[str]] = defaultdict(list)
    for measure in EVERY:
        known = [row for row in rows if row[measure.name] is not None]
        values = np.array([row[measure.name] for row in known])
        if len(known) < LEAST:
            continue
        middle = float(np.median(values))
        mad = float(np.median(np.abs(values - middle)))
        if mad <= 0.0:
            continue
        for row, value in zip(known, values, strict=True):
            z = MAD_TO_SD * (value - middle) / mad
            if abs(z) > OUTLIER:
                what = f"{measure.title.lower()} {measure.text(value)} {measure.unit}"
                found[row["recording"]].append(f"{what} (robust z {z:+.1f})")
    return [{"row": row, "why": "; ".join(found[row["recording"]])} for row in rows if row["recording"] in found]


def _flags(row: dict[str, Any]) -> str:
    """What is to be known before this recording's numbers are used."""
    missing = (row["missing"] or 0) / (row["samples"] or 1)
    notes = [
        f"{100 * missing:.1f} % of the samples missing" if missing > MISSING_SHARE else "",
        f"{row['clipped']} samples clipped" if row["clipped"] else "",
        row["reason"] or "",
        row["findings"] or "",
        "no valid stride" if row["status"] == DONE and not row["valid_strides"] else "",
    ]
    return "; ".join(filter(None, notes))


def _file(subject: str) -> str:
    """A file name that any storage takes, different for different subjects."""
    plain = re.sub(r"[^\w-]+", "_", subject)[:60] or "subject"
    return f"{plain}-{hashlib.sha256(subject.encode()).hexdigest()[:6]}.html"
