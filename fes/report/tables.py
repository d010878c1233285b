"""What the terminal shows: strides, a summary of about a dozen lines, gait parameters; colour is decoration only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.padding import PaddingDimensions
from rich.table import Table
from rich.text import Text

from fes.report.findings import findings, is_only_data, verdict
from fes.report.stimulation import tuning_lines
from fes.report.strides import StrideRow, summed_up
from fes.report.summary import FootSummary, SessionSummary
from fes.report.text import Spread, capitalised, count_of, mean_sd, number, readable

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.walk import HemipareticWalk
    from fes.analysis.parameters.gait import GaitParameters


SIDES = {"left_foot": "L", "right_foot": "R", "left_shank": "L", "right_shank": "R"}
MARKS = {"good": ("✓", "green"), "info": ("·", ""), "warning": ("!", "yellow"), "alert": ("✗", "bold red")}


def path_mark(row: StrideRow) -> str:
    """How the stride went through its phases: ``4``, ``T6`` or ``part``, and ``+T5`` for heels put back before it."""
    how = "4" if row.four_phases else ("T6" if row.path.endswith("T6") else "part")
    times = row.heel_lifts_put_back
    return how + (f"+{times if times > 1 else ''}T5" if times else "")


def small_table(
    title: str,
    caption: str,
    texts: Sequence[str],
    numbers: Sequence[str] = (),
    padding: PaddingDimensions = 0,
) -> Table:
    """A table as the terminal shows them, with a legend below: columns of texts, then of numbers, by their titles."""
    left: dict[str, Any] = {"title_justify": "left", "caption_justify": "left"}
    edges: dict[str, Any] = {"box": box.SIMPLE_HEAD, "pad_edge": False, "show_edge": False}
    table = Table(title=title, caption=caption, padding=padding, **left, **edges)
    add_columns(table, *texts)
    add_columns(table, *numbers, right=True)
    return table


def add_columns(table: Table, *titles: str, right: bool = False) -> None:
    """Columns that do not wrap."""
    for title in titles:
        table.add_column(title, justify="right" if right else "left", no_wrap=True)


def stride_table(summary: SessionSummary) -> Table:
    """A row per stride and channel, at most 100 columns wide."""
    rows = summary.strides
    notes = list(dict.fromkeys(text for row in rows for text in _notes(row)))
    stimulated = any(row.stimulation for row in rows)
    seen = "off-line" if any(row.live for row in rows) else "as the phase machine saw it live"
    legend = [
        "len.: stride length; lift: greatest height of the sensor",
        f"pre to flat: how long the foot was in pre-swing, swing, loading response and flat on the ground, {seen}",
        "path: 4 = all four phases, T6 = no loading response, +T5 = heel put down again before foot off",
        *(["onset: after pre-swing began; dose: charge of one phase of all pulses"] if stimulated else []),
        *(f"note {index}: {text}" for index, text in enumerate(notes, 1)),
    ]
    measures = ("start\ns", "len.\nm", "lift\ncm", "pre\nms", "swing\nms", "load\nms", "flat\nms")
    table = small_table("Strides", escape("\n".join(legend)), ["\nfoot", "\nno."], measures)
    add_columns(table, "\npath")
    if stimulated:
        add_columns(table, "\nch", "onset\nms", "on\nms", "peak\nmA", "dose\nµC", right=True)
    if notes:
        add_columns(table, "\nnote")
    for row in rows:
        note = [" ".join(str(notes.index(text) + 1) for text in _notes(row))] if notes else []
        _add(table, row, note, stimulated)
    return table


def _notes(row: StrideRow) -> tuple[str, ...]:
    left_out = (f"left out: {row.reason or 'no reason given'}",) if not row.valid else ()
    return (*left_out, *(f"gate: {reason}" for reason in row.refused))


def _add(table: Table, row: StrideRow, note: list[str], stimulated: bool) -> None:
    gait = [
        SIDES.get(row.foot, escape(row.foot)),
        str(row.number),
        number(row.start_s, 1),
        number(row.stride_length_m, 2),
        number(row.clearance_cm, 1),
        *(number(s * 1e3, 0) for s in (row.pre_swing_s, row.swing_s, row.loading_response_s, row.stance_s)),
        path_mark(row),
    ]
    stimulation = [
        [
            *(str(i.channel), number(i.onset_after_pre_swing_ms, 0), number(i.duration_s * 1e3, 0)),
            *(number(i.peak_current_ma, 1), number(i.charge_uc, 0)),
        ]
        for i in row.stimulation
    ] or [["–"] * 5 * stimulated]
    for at, cells in enumerate(stimulation):
        first = at == 0
        style = "" if row.valid else "dim"
        notes = note if first else [""] * len(note)
        table.add_row(*(gait if first else [""] * len(gait)), *cells, *notes, style=style)


def summary_block(summary: SessionSummary) -> RenderableType:
    """The session in about a dozen lines."""
    about = ", ".join(filter(None, (summary.subject, summary.recording, summary.created)))
    lines = [Text(f"{summary.name} ({about})  {summary.duration_s:.1f} s", style="bold")]
    lines += [_foot_line(foot, summary.kind) for foot in summary.feet.values()]
    for channel in summary.channels:
        if channel.bursts:
            counted = "" if channel.charge_counted_by_device else " (estimated)"
            dose = f"peak {channel.peak_current_ma:.1f} mA, {channel.charge_uc / 1e3:.2f} mC{counted}"
            onset = f"onset {mean_sd(channel.onset_after_pre_swing_ms, 0, 'ms')}"
            times = f"{channel.bursts} bursts, {channel.on_time_s:.1f} s on"
            lines.append(Text(f"  {channel.name}: {times}, {dose}, {onset}"))
    lines += [Text(f"  {line}") for line in tuning_lines(summary.tuning, summary.dose)]
    every = findings(summary)
    level, words = verdict(every, only_data=is_only_data(summary))
    for weight, text in ((level, words), *((each.level, each.text) for each in every)):
        mark, style = MARKS[weight]
        lines.append(Text(f"{mark} {text}", style=f"bold {style}" if text == words else style))
    return Group(*lines)


CLOSING_FINDINGS = 5
MARKS_LISTED = 5


def closing_block(summary: SessionSummary) -> RenderableType:
    """What happened in a session, in about ten lines: strides, bursts, dose, what people did, what to look at."""
    lines = [Text(f"{summary.name}, {summary.duration_s:.0f} s", style="bold")]
    lines += [
        Text(
            f"  {readable(foot.foot)}: {count_of(foot.strides, 'stride')} ({foot.valid} valid), "
            f"{mean_sd(foot.stride_length_m, 2, 'm')}, {number(foot.walking_speed_mps, 2)} m/s"
        )
        for foot in summary.feet.values()
    ]
    for channel in summary.channels:
        by_hand = f" ({channel.bursts_by_hand} by hand)" if channel.bursts_by_hand else ""
        dose = f"peak {channel.peak_current_ma:.1f} mA, {channel.charge_uc / 1e3:.2f} mC"
        counted = "" if channel.charge_counted_by_device or not channel.bursts else " (estimated)"
        times = f"{count_of(channel.bursts, 'burst')}{by_hand}, {channel.on_time_s:.1f} s on"
        lines.append(Text(f"  {channel.name}: {times}" + (f", {dose}{counted}" if channel.bursts else "")))
    if summary.exercise is not None:
        lines.append(Text(f"  exercise: {summary.exercise.done} of {summary.exercise.count} bursts"))
    if done := summed_up(summary.by_hand):
        lines.append(Text(f"  by hand: {done}"))
    if summary.marks:
        told = [f"{mark.text} at {mark.time_s:.1f} s" for mark in summary.marks[:MARKS_LISTED]]
        more = [f"{len(summary.marks) - MARKS_LISTED} more"] if len(summary.marks) > MARKS_LISTED else []
        lines.append(Text(f"  marks: {', '.join([*told, *more])}"))
    every = findings(summary)
    lines += [Text(f"  {each.text}") for each in every if each.leads]
    look = [each for level in ("alert", "warning") for each in every if each.level == level]
    for finding in look[:CLOSING_FINDINGS]:
        mark, style = MARKS[finding.level]
        lines.append(Text(f"{mark} {finding.text}", style=style))
    if len(look) > CLOSING_FINDINGS:
        lines.append(Text(f"  and {len(look) - CLOSING_FINDINGS} more to look at in the report"))
    if not summary.faults:
        lines.append(
            Text(
                "✓ no fault of sensors, stimulator or software" + ("" if look else ", nothing to look at"),
                style="green",
            )
        )
    return Group(*lines)


def _foot_line(foot: FootSummary, kind: str) -> Text:
    text = f"  {readable(foot.foot)}: {foot.valid} of {count_of(foot.strides, 'stride')} valid"
    if foot.valid:
        names = {"pre-swing": "pre_swing", "swing": "swing", "loading": "loading_response", "stance": "stance"}
        times = _durations({label: getattr(foot, f"{name}_s") for label, name in names.items()})
        if foot.live:
            live = _durations({label: foot.live[f"{name}_live_s"] for label, name in names.items()})
            times = f"off-line: {times}\n    live: {live}"
        elif kind != "analysis":
            times = f"live: {times}"
        length, lift = mean_sd(foot.stride_length_m, 2, "m"), mean_sd(foot.clearance_cm, 1, "cm")
        text += f", length {length}, sensor lifted {lift}\n    {times}"
    return Text(text)


def _durations(phases: dict[str, Spread]) -> str:
    return ", ".join(f"{label} {number(s.mean, 2)} s ±{number(s.sd_percent, 0)}%" for label, s in phases.items())


def parameter_table(parameters: GaitParameters) -> Table:
    """One row per parameter: mean ± SD and CV of each foot, and the symmetry index; at most 100 columns wide."""
    from fes.analysis.parameters.definitions import DEFINITIONS
    from fes.report.parameter_table import parameter_rows

    steady = ", ".join(
        f"{strides['steady'].sum()} of {len(strides)} {foot.removesuffix('_foot')}"
        for foot, strides in parameters.strides.items()
    )
    legend = [f"over the steady strides: {steady}", "stride length: both feet made to go equally far"]
    if not parameters.no_step_lengths:
        legend.append("step length: sums up the errors of all strides before, good for a rough asymmetry and no more")
    table = small_table("Gait parameters", "\n".join(legend), ["parameter"], padding=(0, 1))
    for foot in parameters.feet:
        add_columns(table, f"{foot.removesuffix('_foot')}, mean ± SD", "CV %", right=True)
    if parameters.sides:
        add_columns(table, "SI %", right=True)
    for row in parameter_rows(parameters, {}):
        symbol = DEFINITIONS[row.key].symbol
        cells = [f"{row.name}{f' ({symbol})' if symbol else ''}, {row.unit}"]
        for side in row.sides:
            cells += [f"{side.mean} ± {side.sd}" if side.n else "–", side.cv]
        table.add_row(*cells, *([row.index] if parameters.sides else []))
    return table


def parameter_lines(parameters: GaitParameters, hemiparetic: HemipareticWalk | None) -> list[str]:
    """Sentences for people."""
    walk = parameters.walk
    if not any(value.n for foot in parameters.feet.values() for value in foot.values()):
        return [f"No gait parameters: {parameters.no_step_lengths or 'no steady stride'}"]
    pace = f"{number(walk.walking_speed_mps, 2)} m/s, {number(walk.cadence_per_min, 1)} steps/min"
    belt = f", speed over belt {walk.belt_ratio:.3f}" if math.isfinite(walk.belt_ratio) else ""
    lines = [f"Walk: {pace}, walk ratio {number(1000.0 * walk.walk_ratio_m_min, 1)} mm/(steps/min){belt}"]
    if parameters.no_step_lengths:
        lines.append(f"No step lengths: {parameters.no_step_lengths}")
    if hemiparetic is None:
        return lines
    from fes.analysis.hemiparetic.walk import Terrain

    lines.append(capitalised(hemiparetic.side.describe()))
    for foot, terrain in hemiparetic.terrain.items():
        kinds = list(terrain.values())
        counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in Terrain if kind in kinds)
        lines.append(f"Ground, {foot.removesuffix('_foot')}: {counts}")
    if hemiparetic.windows is None:
        lines.append(f"No windows after Wang et al.: {hemiparetic.no_windows}")
    else:
        tracks = hemiparetic.windows.tracks
        counts = ", ".join(f"{len(t.windows) - 1} {foot.removesuffix('_foot')}" for foot, t in tracks.items())
        lines.append(f"Strides between windows after Wang et al.: {counts}")
    return lines
