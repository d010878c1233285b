"""The report: one HTML file with all of a session in it, that opens anywhere without a network.

For a click in its signals, which tells what the guards saw, the session's trackers run again over the log's samples;
stimulation and gate are not asked. Kept are the samples at which a phase changed, and between them an even grid that is
coarser the longer the session is, so that a report's size is bounded.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from markupsafe import Markup

from fes.analysis.ground_path import GroundPath
from fes.analysis.parameters.gait import GaitParameters
from fes.config import ConfigError, Session
from fes.control.replay import settings_of
from fes.estimation.sensor_choice import Calibration, phase_sensors, tracker_of
from fes.live.status import with_remedy
from fes.report.figures import strides
from fes.report.figures.strides import ground_figures, space_figure, swing_figures
from fes.report.figures.timeseries import channel_color, chart_data, latency_figure, stimulation_figures, tuning_figures
from fes.report.findings import front_page
from fes.report.gait import foot_curves, gait_of_strides
from fes.report.html import asset, css_text, embed, rendered, write_page_file
from fes.report.parameter_table import (
    hemiparetic_section,
    key_numbers,
    parameter_rows,
    parameter_slugs,
    scales_in_words,
    terms,
    walk_rows,
)
from fes.report.quality import LATCHED, describe_flags
from fes.report.stimulation import ChannelInfo
from fes.report.summary import ReportData, summarise_session
from fes.report.tables import path_mark
from fes.report.text import local_time, plain, readable
from fes.signals import NS_PER_S, FloatArray, IntArray, OperatorAction, StrideResult
from fes.stimulation.walking import WalkingJudge
from fes.walk_record import Finding, SampleArrays, WalkRecord
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE
from statemachine.terms import FLAG, Term, Terms, Undecided, terms_of

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.walk import HemipareticWalk

FINEST_NS: Final = NS_PER_S // 50  # between two kept samples
MOST_ROWS: Final = 20_000  # of the grid, all feet together; as many phase changes may come on top


@dataclass(frozen=True)
class GuardTrace:
    """One foot: ``t_ns`` (N,) arrival of the kept samples, ``phase`` (N,) before each, ``fired`` (N,) the transition.

    ``features`` (N, F) are what the guards saw, in the order of ``Features``, SI units. ``thresholds``: from which row
    on which hold. ``walking``: from which row on the judge says what. ``same``: whether the phases are the log's own.
    """

    foot: str
    sensor: str
    t_ns: IntArray
    phase: IntArray
    fired: IntArray
    features: FloatArray
    thresholds: list[tuple[int, Thresholds]]
    walking: list[tuple[int, str]]
    same: bool


def guard_traces(record: WalkRecord) -> list[GuardTrace]:
    """Of each foot whose phases the session's guards told; none where the record is no session of this version."""
    try:
        session, calibrations, _ = settings_of(record.header, Path())
        sensors = phase_sensors(calibrations)
        own = {foot: record.samples[name] for foot, name in sensors.items() if name in record.samples}
        if session.exercise is not None or not own:
            return []
        return [_trace(foot, session, calibrations[sensors[foot]], record, len(own)) for foot in own]
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError):
        return []  # of another version, or an analysis


def _trace(foot: str, session: Session, calibration: Calibration, record: WalkRecord, feet: int) -> GuardTrace:
    tracker, judge = tracker_of(session, calibration), WalkingJudge(session.stimulation)
    samples = record.samples[tracker.foot]
    own = [change for change in record.phases if change.foot == tracker.foot]
    ends = _kept(samples, np.array([change.t_ns for change in own], np.int64), MOST_ROWS // feet)
    changes: list[tuple[int, int]] = []
    rows = np.zeros((len(ends), len(Features._fields)))
    phase, fired = np.zeros(len(ends), np.int64), np.zeros(len(ends), np.int64)
    thresholds: list[tuple[int, Thresholds]] = []
    walking: list[tuple[int, str]] = []
    begin = 0
    times, acc, gyr = samples.t_sensor_ns, samples.acc_mps2, samples.gyr_radps
    for row, kept in enumerate(ends.tolist()):
        block = slice(begin, kept)
        outcomes = tracker.advance(times[block], acc[block], gyr[block]) if kept > begin else []
        begin, phase[row] = kept + 1, int(tracker.phase)
        # by itself: what a guard saw is kept of single steps
        for outcome in outcomes + tracker.step(int(times[kept]), tuple(acc[kept].tolist()), tuple(gyr[kept].tolist())):
            if isinstance(outcome, StrideResult):
                judge.on_stride(outcome)
                continue
            judge.on_phase(outcome)
            changes.append((outcome.t_ns, int(outcome.transition)))
            if outcome.t_ns == times[kept]:
                phase[row], fired[row] = int(outcome.source), int(outcome.transition)
        judge.on_time(int(times[kept]))
        rows[row], limits = tracker.seen()
        if not thresholds or thresholds[-1][1] != limits:
            thresholds.append((row, limits))
        if not walking or walking[-1][1] != judge.describe():
            walking.append((row, judge.describe()))
    same = changes == [(change.t_ns, int(change.transition)) for change in own]
    return GuardTrace(foot, tracker.foot, samples.t_ns[ends], phase, fired, rows, thresholds, walking, same)


def _kept(samples: SampleArrays, changes_ns: IntArray, most: int) -> IntArray:
    """Indices (N,) of the samples to keep, in order: those of phase changes (by the sensor's stamps), and a grid."""
    t_ns = samples.t_ns
    step_ns = max(FINEST_NS, int(t_ns[-1] - t_ns[0]) // most + 1)
    # the first sample of each cell of the grid
    grid = np.flatnonzero(np.diff((t_ns - t_ns[0]) // step_ns, prepend=-1))
    fired = np.flatnonzero(np.isin(samples.t_sensor_ns, changes_ns))[:MOST_ROWS]
    return np.union1d(grid, fired)


MOST_SPANS: Final = 5000  # of one channel's refusals


def moment_data(data: ReportData) -> dict[str, Any]:
    """Plain values for the script; ``feet`` is empty where the session's guards cannot be asked again."""
    origin_ns = data.origin_ns
    traces: list[GuardTrace] = []
    if data.record.header.get("calibration") and data.settings is not None:
        traces = guard_traces(data.record)
    numbers, nothing = count(), Features._make([0.0] * len(Features._fields))
    return {
        "guards": [
            {
                "name": row.transition.name,
                "from": readable(row.source.name.lower()),
                "terms": _plain(terms_of(row.guard, nothing, Thresholds()), numbers),
            }
            for row in TABLE
        ]
        if traces
        else [],
        "transitions": [each.name for each in Transition],
        "phases": [readable(phase.name.lower()) for phase in Phase],
        "feet": {readable(trace.sensor): _foot(trace, origin_ns) for trace in traces},
        "gate": [[round((t_ns - origin_ns) / NS_PER_S, 4), text] for t_ns, text in _gate(data.record, origin_ns)],
        "intensity": [
            [round((act.t_ns - origin_ns) / NS_PER_S, 4), act.value]
            for act in data.record.acts
            if act.action is OperatorAction.SET_INTENSITY
        ],
        "channels": {info.name: _channel(info, data) for info in data.channels},
    }


def _plain(terms: Term | Terms, numbers: Iterator[int]) -> dict[str, Any]:
    """What of the terms is the same at every sample; each comparison has its number."""
    if isinstance(terms, Terms):
        return {"every": terms.every, "parts": [_plain(part, numbers) for part in terms.parts]}
    unit = "" if terms.unit in (FLAG, "–") else terms.unit
    return {"number": next(numbers), "what": terms.what, "sign": terms.sign, "unit": unit, "flag": terms.unit == FLAG}


def _foot(trace: GuardTrace, origin_ns: int) -> dict[str, Any]:
    """A foot's kept samples, packed: of each comparison what was seen, the limit, of what that is, and whether it held.

    The comparisons' ``columns`` (seen of all, then limits of all) are indices into ``values``, of which each has a
    number a sample, or, where that says the same, a number each time that thresholds change. ``holds`` has a bit for
    each comparison. ``limit_is``: from which row on, what differs from before.
    """
    begins, samples = [row for row, _ in trace.thresholds], len(trace.t_ns)
    lasting = np.diff([*begins, samples])
    limits = np.repeat(np.array([each for _, each in trace.thresholds], dtype=float).T, lasting, axis=1)
    blocks, limit_is, before = [], [], list[str]()
    for row, end, compared in _compared(trace.features.T, limits, 0, samples):
        kinds = [term.seen for term in compared], [term.limit for term in compared], [term.holds for term in compared]
        blocks.append(np.array([np.broadcast_to(each, end - row) for kind in kinds for each in kind]))
        now = [term.limit_is for term in compared]
        limit_is.append([row, {k: words for k, words in enumerate(now) if [words] != before[k : k + 1]}])
        before = now
    each = np.concatenate(blocks, axis=1).astype("<f4")
    values: dict[bytes, int] = {}
    columns = []
    for column in each[: 2 * len(before)]:
        few = column[begins]
        same = np.array_equal(np.repeat(few, lasting), column)
        columns.append(values.setdefault((few if same else column).tobytes(), len(values)))
    return {
        "foot": readable(trace.foot),
        "t_s": _packed((trace.t_ns - origin_ns) / NS_PER_S, "<f8"),
        "phase": _packed(trace.phase, "<i1"),
        "fired": _packed(trace.fired, "<i1"),
        "columns": columns,
        "values": [base64.b64encode(value).decode("ascii") for value in values],
        "holds": _packed(np.packbits(each[2 * len(before) :].astype(bool), axis=0, bitorder="little").T, "u1"),
        "begins": begins,
        "limit_is": [each for each in limit_is if each[1]],
        "walking": trace.walking,
        "same": trace.same,
    }


def _compared(features: FloatArray, limits: FloatArray, begin: int, end: int) -> Iterator[tuple[int, int, list[Term]]]:
    """All comparisons over stretches of the samples (F, N), thresholds (L, N), in which they are of the same things."""
    x, p = Features(*features[:, begin:end]), Thresholds(*limits[:, begin:end])
    try:
        yield begin, end, [term for row in TABLE for term in terms_of(row.guard, x, p).each()]
    except Undecided:
        middle = (begin + end) // 2
        yield from _compared(features, limits, begin, middle)
        yield from _compared(features, limits, middle, end)


def _packed(values: Any, kind: str) -> str:
    return base64.b64encode(np.asarray(values).astype(kind).tobytes()).decode("ascii")


def _gate(record: WalkRecord, origin_ns: int) -> list[tuple[int, str]]:
    """From when on the gate was how, in the words of ``fes explain``."""
    acts = [
        (act.t_ns, act.action is OperatorAction.ARM)
        for act in record.acts
        if act.action in (OperatorAction.ARM, OperatorAction.DISARM)
    ]
    refused = [(command.t_ns, command.refused) for command in record.commands if command.refused[:9] == "not armed"]
    at = [t_ns for t_ns, _ in refused]
    states = [(-(2**62), "The gate was not armed.")]
    for t_ns, arms in acts:
        # arming that was refused shows in what the gate said next
        after = int(np.searchsorted(at, t_ns))
        later = next((other for other, _ in acts if other > t_ns), 2**62)
        failed = arms and after < len(at) and at[after] < later and refused[after][1]
        told = with_remedy(f"The gate was {failed}") if failed else "The gate was armed."
        states.append((t_ns, told if arms else "The gate was not armed."))
    for note in record.notes:
        if note.text.startswith(LATCHED):
            fault = note.text.removeprefix(LATCHED)
            since_s = (note.t_ns - origin_ns) / NS_PER_S
            states.append((note.t_ns, with_remedy(f"The gate was latched since {since_s:.3f} s: {fault}")))
    return sorted(states, key=lambda each: each[0])


def _channel(info: ChannelInfo, data: ReportData) -> dict[str, Any]:
    """When the channel is stimulated, and where the gate refused it: from when to when, why, and what to do."""
    spans: list[list[Any]] = []
    for command in data.record.commands:
        if command.channel != info.number:
            continue
        t_s = round((command.t_ns - data.origin_ns) / NS_PER_S, 4)
        if spans and spans[-1][1] is None:
            if spans[-1][2] == command.refused:
                continue
            spans[-1][1] = t_s
        if command.refused and len(spans) < MOST_SPANS:
            spans.append([t_s, None, command.refused, with_remedy(command.refused)])
    return {
        "foot": readable(info.foot),
        "sensor": readable(info.phase_sensor),
        "phases": [int(phase) for phase in info.phases],
        "window": f"{readable(info.start_phase)} … {readable(info.stop_phase)}",
        "refused": spans,
    }


LONG_TABLE_ROWS = 200  # on paper a longer table stops here
STYLES = ("uPlot.min.css", "report.css", "report_page.css")
SCRIPTS = ("folds.js", "moments.js", "report.js", "terms.js", "space.js")


def write_report(
    record: WalkRecord,
    path: Path,
    *,
    data: ReportData | None = None,
    paths: Mapping[str, GroundPath] | None = None,
    gait: GaitParameters | None = None,
    hemiparetic: HemipareticWalk | None = None,
) -> None:
    """Write the report of a session as one self-contained HTML file, replacing an older one.

    ``data``: its numbers, if already worked out. ``paths``: where each foot went over the ground, if that was worked
    out. ``gait``: its parameters from the samples; else they are worked out from the strides. ``hemiparetic``: what was
    found of the walk as a hemiparetic one. The same record always gives the same bytes.

    ReportError: the file cannot be written.
    """
    text = render_report(record, data=data, paths=paths, gait=gait, hemiparetic=hemiparetic)
    write_page_file(text, path, "Choose a place that can be written to.")


def render_report(
    record: WalkRecord,
    *,
    data: ReportData | None = None,
    paths: Mapping[str, GroundPath] | None = None,
    gait: GaitParameters | None = None,
    hemiparetic: HemipareticWalk | None = None,
) -> str:
    """The report of a session as HTML text; arguments as of :func:`write_report`."""
    data = data or summarise_session(record)
    summary = data.summary
    measured = gait if gait is not None else gait_of_strides(record.strides, summary.belt_speed_mps)
    sensors, flags = data.sensors, data.flags
    curves = foot_curves(record.strides, measured, list(data.timelines))
    described = describe_flags(flags.get((foot, number), ()) for foot, one in curves.items() for number in one.numbers)
    care = f" With care: {described}." if described else ""
    over_stride, butterflies = strides.curve_figures(curves, care), strides.butterfly_figures(curves, care)
    space = space_figure(curves)
    section: dict[str, Any] = {}
    more: list[Finding] = []
    if hemiparetic is not None:
        section = hemiparetic_section(hemiparetic)
        told = f"{section['heading']}. See under Hemiparetic walk how the signs agree; it is no diagnosis."
        more = [Finding("info", told)]
    windows = section.get("space")
    spaces = [figure for figure in (space, windows) if figure is not None]
    named = " – ".join(part[:60] for part in (summary.name, summary.subject, local_time(summary.created)) if part)
    running_head = f"@page {{ @top-left {{ content: {css_text(named)}; }} }}\n"
    parts = {key: value for key, value in record.header.items() if isinstance(value, (dict, list)) and value}
    return rendered(
        "report.html.j2",
        s=summary,
        title=f"{summary.name} – gait and stimulation",
        front=front_page(summary, more),
        front_figures=over_stride[:2],
        gait=measured,
        from_samples=gait is not None,
        compared=next((f"{both.first} over {both.second}" for both in measured.sides.values()), ""),
        common_scales=scales_in_words(measured),
        cards=key_numbers(summary, measured),
        walk_rows=walk_rows(measured),
        parameter_rows=parameter_rows(measured, flags),
        hemiparetic=section,
        flags=flags,
        flags_described=describe_flags(flags.values()),
        sensors=sensors,
        terms=terms(),
        parameter_slugs=parameter_slugs(),
        stride_figures=[*over_stride, *butterflies, *([space.figure] if space else [])],
        window_figures=[windows.figure] if windows else [],
        ground_figures=ground_figures(data, paths or {}),
        each_figures=strides.stride_figures(data, flags),
        phase_figures=strides.phase_figures(data, flags),
        stimulation_figures=stimulation_figures(data),
        swing_figures=swing_figures(data),
        tuning_figures=tuning_figures(data),
        latency_figure=[figure for figure in [latency_figure(data)] if figure],
        phase_colors=strides.PHASE_COLORS,
        foot_color=strides.foot_color,
        channel_color=channel_color,
        path_mark=path_mark,
        long_table=len(summary.strides) > LONG_TABLE_ROWS,
        run_summary=_indented(summary.run_summary),
        header_parts=[(readable(str(key)), _indented(plain(value))) for key, value in parts.items()],
        data=Markup(
            embed(
                chart_data(data, sensors) | {"spaces": [one.to_data() for one in spaces], "moments": moment_data(data)}
            )
        ),
        style=Markup("".join(map(asset, STYLES)) + running_head),
        script=Markup("".join(map(asset, SCRIPTS))),
        uplot=Markup(f"/*\n{asset('uPlot.LICENSE')}*/\n{asset('uPlot.iife.min.js')}"),
    )


def _indented(value: object) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False)
