"""Timing as pages: a recording's events over its signals, delays as histograms, worst cases; and many in a list."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from fes.evaluation.timing.judgement import RecordingTiming
from fes.evaluation.timing.marks import Spread, TimingRow
from fes.report.figures.strides import PHASE_COLORS
from fes.report.figures.svg import Figure, Plot
from fes.report.figures.timeseries import chart_data
from fes.report.html import asset, embed, rendered, write_page_file
from fes.report.summary import summarise_session
from fes.report.text import number, readable
from fes.signals import NS_PER_S, FloatArray

NOW_COLOR, TRUE_COLOR, BEFORE_COLOR, FAILED_COLOR = "#1b1f24", "#1a7f37", "#8250df", "#b3261e"
BINS: Final = 31
WORST_OF_A_KIND: Final = 3
WORST_CASES: Final = 40
_REMEDY: Final = "Choose another --out."


@dataclass(frozen=True, slots=True)
class WorstCase:
    """One event to look at: when (s from the recording's start), whose, and what is odd about it."""

    t_s: float
    name: str
    text: str
    failed: bool


def write_timing_pages(outcomes: Sequence[RecordingTiming], folder: Path, names: tuple[str, str]) -> Path:
    """Write a page for each recording and, of several, one that lists them; the page to open first.

    ``names``: what is checked, and what it is held against.

    ReportError: one cannot be written.
    """
    pages = {each.name: folder / (re.sub(r"[^\w.-]+", "_", each.name) + ".html") for each in outcomes}
    worst = {each.name: worst_cases(each) for each in outcomes}
    for each in outcomes:
        write_page_file(render_timing(each, names, worst[each.name]), pages[each.name], _REMEDY)
    if len(outcomes) == 1:
        return pages[outcomes[0].name]
    rows = [
        {
            "name": each.name,
            "page": pages[each.name].name,
            **totals(each),
            "p99": number(each.latency.p99_ms, 2),
            "failures": [_sentence(failure.who, failure.what, failure.text) for failure in each.failures],
            "worst": worst[each.name][:3],
        }
        for each in outcomes
    ]
    index = folder / "index.html"
    failed, judged = sum(bool(each.failures) for each in outcomes), any(each.judged for each in outcomes)
    text = rendered("timing_list.html.j2", title="Timing", rows=rows, failed=failed, judged=judged)
    write_page_file(text, index, _REMEDY)
    return index


def totals(timing: RecordingTiming) -> dict[str, int]:
    """How many of the baseline's events were found, missed, extra and moved; without a baseline, of the truth's."""
    rows = timing.own or timing.true
    counts = {"events": "pairs_ns", "missed": "missed_ns", "extra": "extra_ns"}
    found = {name: sum(len(getattr(row, times)) for row in rows) for name, times in counts.items()}
    return found | {"moved": sum(row.moved for row in rows)}


def row_numbers(timing: RecordingTiming, row: TimingRow, against: str) -> tuple[list[int], list[float]]:
    """Counts and milliseconds of a row: against the "truth" bias, SD, its limits and those before; against the
    "baseline" mean, SD, the worst and the tolerance."""
    now, error_ms = row.spread, row.error_ms
    counts = [now.expected, now.missed, now.extra]
    if against == "truth":
        was = _before(timing, row)
        before = [was.bias_ms, was.lower_ms, was.upper_ms] if was else [float("nan")] * 3
        return counts, [now.bias_ms, now.sd_ms, now.lower_ms, now.upper_ms, *before]
    worst_ms = float(error_ms[np.abs(error_ms).argmax()]) if len(error_ms) else float("nan")
    return [*counts, row.moved], [now.bias_ms, now.sd_ms, worst_ms, row.tolerance_ms]


def _before(timing: RecordingTiming, row: TimingRow) -> Spread | None:
    return next((each for each in timing.before if (each.who, each.what) == (row.who, row.what)), None)


def _sentence(who: str, what: str, text: str) -> str:
    return f"{readable(who)} {what}: {text}".strip()


def worst_cases(timing: RecordingTiming) -> list[WorstCase]:
    """Events to look at first: missed, extra, moved; then those that lie furthest from their kind's bias."""
    origin_ns = timing.measured.span_ns[0]
    failed = {(failure.against, failure.who, failure.what) for failure in timing.failures}
    found: list[tuple[bool, float, WorstCase]] = []

    def add(row: TimingRow, against: str, t_ns: int, weight: float, text: str) -> None:
        bad = (against, row.who, row.what) in failed
        case = WorstCase((t_ns - origin_ns) / NS_PER_S, f"{readable(row.who)} {row.what}", text, bad)
        found.append((not bad, -weight, case))

    for against, rows in (("baseline", timing.own), ("truth", timing.true)):
        for row in rows:
            for t_ns in row.missed_ns.tolist():
                add(row, against, t_ns, 1e6, f"missed, against the {against}")
            for t_ns in row.extra_ns.tolist():
                add(row, against, t_ns, 1e6, f"extra, against the {against}")
            error_ms = row.error_ms
            middle_ms = float(error_ms.mean()) if against == "truth" and len(error_ms) else 0.0
            off_ms = np.abs(error_ms - middle_ms)
            for k in np.argsort(-off_ms)[:WORST_OF_A_KIND].tolist():
                if off_ms[k] > 0.0:
                    usual = f", usually {middle_ms:+.1f}" if against == "truth" else ""
                    text = f"{error_ms[k]:+.1f} ms against the {against}{usual}"
                    add(row, against, int(row.pairs_ns[k, 1]), float(off_ms[k]), text)
    found.sort(key=lambda each: (each[0], each[1], each[2].t_s))
    return [case for _, _, case in found[:WORST_CASES]]


def render_timing(timing: RecordingTiming, names: tuple[str, str], worst: Sequence[WorstCase]) -> str:
    """One recording's page as self-contained HTML text; the same outcome always gives the same bytes."""
    data = chart_data(summarise_session(timing.measured.record))
    moments = _moments(timing)
    for foot in data["feet"]:
        foot["moments"] = moments.get(foot["name"], [])
    data["current"]["moments"] = [each for who, own in moments.items() if who.startswith("channel") for each in own]
    if worst:
        data["opening_s"] = max(0.0, worst[0].t_s - 2.0)
    lines = [(names[0], NOW_COLOR)]
    lines += [(timing.truth, TRUE_COLOR)] if timing.true else []
    lines += [(f"{names[1]}, where it differs", BEFORE_COLOR)] if timing.own else []
    return rendered(
        "timing.html.j2",
        title=f"{timing.name} – timing",
        t=timing,
        names=names,
        failures=[(_sentence(f.who, f.what, f.text), f.against) for f in timing.failures],
        true_rows=[_cells(timing, row, "truth") for row in timing.true],
        own_rows=[_cells(timing, row, "baseline") for row in timing.own],
        worst=worst,
        lines=lines,
        phase_colors=PHASE_COLORS,
        figures=[*_delays(timing, names), *_shifts(timing, names), *_latency(timing)],
        data=Markup(embed(data | {"spaces": []})),
        style=Markup("".join(map(asset, ("uPlot.min.css", "report.css", "report_page.css")))),
        script=Markup(asset("report.js")),
        uplot=Markup(f"/*\n{asset('uPlot.LICENSE')}*/\n{asset('uPlot.iife.min.js')}"),
    )


def _moments(timing: RecordingTiming) -> dict[str, list[dict[str, Any]]]:
    """By foot or channel: what was found, what is true and what was before, for the signals' plots."""
    origin_ns = timing.measured.span_ns[0]
    out: dict[str, list[dict[str, Any]]] = {}

    def add(who: str, what: str, times_ns: Sequence[int], color: str, row: int) -> None:
        name = what if not who.startswith("channel") else f"{who.removeprefix('channel ')} {what}"
        mine = out.setdefault(who if who.startswith("channel") else readable(who), [])
        mine += [{"t_s": (t - origin_ns) / NS_PER_S, "name": name, "color": color, "row": row} for t in times_ns]

    for mark in timing.measured.marks:
        add(mark.who, mark.what, [mark.t_ns], NOW_COLOR, 0)
    for rows, color, at in ((timing.true, TRUE_COLOR, 1), (timing.own, BEFORE_COLOR, 2)):
        for row in rows:
            moved = row.pairs_ns[:, 0] if at == 1 else row.pairs_ns[row.pairs_ns[:, 0] != row.pairs_ns[:, 1], 0]
            add(row.who, row.what, [*moved.tolist(), *row.missed_ns.tolist()], color, at)
    return out


def _cells(timing: RecordingTiming, row: TimingRow, against: str) -> dict[str, Any]:
    counts, values = row_numbers(timing, row, against)
    unsigned = (1, 3) if against == "baseline" else (1,)  # the SD, the tolerance
    failed = any((f.against, f.who, f.what) == ("truth", row.who, row.what) for f in timing.failures)
    return {
        "name": f"{readable(row.who)} {row.what}",
        "counts": counts,
        "values": [number(value, 1, "" if k in unsigned else "+") for k, value in enumerate(values)],
        "failed": failed if against == "truth" else any(counts[1:]),
    }


def _delays(timing: RecordingTiming, names: tuple[str, str]) -> list[Figure]:
    figures = []
    for row in timing.true:
        if not len(row.pairs_ns):
            continue
        now = row.spread
        was = _before(timing, row)
        levels = [(now.bias_ms, NOW_COLOR, "bias"), (now.lower_ms, FAILED_COLOR, ""), (now.upper_ms, FAILED_COLOR, "")]
        levels += [(was.bias_ms, BEFORE_COLOR, names[1])] if was else []
        caption = f"{len(row.pairs_ns)} pairs, {now.missed} missed, {now.extra} extra. Red: 95 % limits."
        figures.append(_histogram(f"{readable(row.who)} {row.what}", row.error_ms, levels, "found − true, ms", caption))
    return figures


def _shifts(timing: RecordingTiming, names: tuple[str, str]) -> list[Figure]:
    figures = []
    for row in timing.own:
        if len(row.pairs_ns) and np.any(row.error_ms != 0.0):
            levels = [(sign * row.tolerance_ms, FAILED_COLOR, "") for sign in (-1, 1) if np.isfinite(row.tolerance_ms)]
            caption = f"{row.moved} of {len(row.pairs_ns)} moved by more than the tolerance (red)."
            title = f"{readable(row.who)} {row.what}: {names[0]} − {names[1]}"
            figures.append(_histogram(title, row.error_ms, levels, "difference, ms", caption))
    return figures


def _latency(timing: RecordingTiming) -> list[Figure]:
    ms = 1e-6 * timing.measured.latency_ns.astype(np.float64)
    if not len(ms):
        return []
    late = timing.latency
    levels = [(late.p99_ms, NOW_COLOR, "p99"), (late.p99_before_ms, BEFORE_COLOR, "p99 before")]
    caption = f"{late.steps} decisions; at most {late.max_ms:.2f} ms, which may lie outside the plot."
    return [_histogram("Decisions", ms[ms <= max(2.0 * late.p99_ms, late.p50_ms)], levels, "latency, ms", caption)]


def _histogram(
    title: str, values: FloatArray, levels: Sequence[tuple[float, str, str]], x_label: str, caption: str
) -> Figure:
    ends = np.array([*values.tolist(), *(level for level, _, _ in levels if np.isfinite(level))])
    low, high = float(ends.min()), float(ends.max())
    air = 0.05 * (high - low) or 1.0
    edges = np.linspace(low - air, high + air, BINS + 1)
    counts, _ = np.histogram(values, edges)
    x_range = float(edges[0]), float(edges[-1])
    plot = Plot(f"{title}: histogram", x_label, "how many", x_range, (0.0, max(1.08 * float(counts.max()), 1.0)), 220)
    middles, wide = 0.5 * (edges[1:] + edges[:-1]), float(edges[1] - edges[0])
    plot.bars(middles, np.zeros(BINS), counts.astype(np.float64), 0.9 * wide, "#57606a")
    for at, color, name in levels:
        plot.upright(at, color, name)
    return plot.figure(title, caption)
