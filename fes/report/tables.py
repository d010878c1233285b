"""What the terminal shows: a row per stride and a summary of about a dozen lines; colour is decoration only."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from fes.report.findings import Finding, findings
from fes.report.strides import StrideRow
from fes.report.summary import SessionSummary
from fes.report.text import count_of, mean_sd, number, readable
from fes.report.tuning import told

MARKS = {"good": ("✓", "green"), "info": ("·", ""), "warning": ("!", "yellow"), "alert": ("✗", "bold red")}


def path_mark(row: StrideRow) -> str:
    """How the stride went through its phases: ``4``, ``T6`` or ``part``, and ``+T5`` for heels put back before it."""
    how = "4" if row.four_phases else ("T6" if row.path.endswith("T6") else "part")
    if not row.heel_lifts_put_back:
        return how
    return f"{how}+{row.heel_lifts_put_back if row.heel_lifts_put_back > 1 else ''}T5"


def stride_table(summary: SessionSummary, limit: int | None = None) -> Table:
    """A row per stride and channel, at most 100 columns wide; ``limit`` shows only the last so many strides."""
    rows = summary.strides if limit is None else summary.strides[max(len(summary.strides) - limit, 0) :]
    remarks = list(dict.fromkeys(text for row in rows for text in _remarks(row)))
    legend = [
        "len.: stride length; clr.: greatest height of the sensor; pre to stance: time",
        "path: 4 = all four phases, T6 = no loading response, +T5 = heel put back",
        "onset: after pre-swing began; dose: charge of one phase of all pulses",
        *(f"note {index}: {text}" for index, text in enumerate(remarks, 1)),
    ]
    shown, total = len(rows), len(summary.strides)
    table = Table(
        title="Strides" if shown == total else f"The last {shown} of {total} strides",
        caption=escape("\n".join(legend)),
        caption_justify="left",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
        show_edge=False,
    )
    for title in ("\nfoot", "\nno."):
        table.add_column(title, no_wrap=True)
    for title in ("start\ns", "len.\nm", "clr.\ncm", "pre\nms", "swing\nms", "load\nms", "stance\nms"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("\npath", no_wrap=True)
    for title in ("\nch", "onset\nms", "on\nms", "peak\nmA", "dose\nµC"):
        table.add_column(title, justify="right", no_wrap=True)
    if remarks:
        table.add_column("\nnote", no_wrap=True)
    for row in rows:
        _add(table, row, " ".join(str(remarks.index(text) + 1) for text in _remarks(row)))
    return table


def _remarks(row: StrideRow) -> tuple[str, ...]:
    left_out = (f"left out: {row.reason or 'no reason given'}",) if not row.valid else ()
    return (*left_out, *(f"gate: {reason}" for reason in row.refused))


def _add(table: Table, row: StrideRow, note: str) -> None:
    gait = [
        {"left_foot": "L", "right_foot": "R"}.get(row.foot, escape(row.foot)),
        str(row.number),
        number(row.start_s, 1),
        number(row.stride_length_m, 2),
        number(row.clearance_cm, 1),
        *(number(s * 1e3, 0) for s in (row.pre_swing_s, row.swing_s, row.loading_response_s, row.stance_s)),
        path_mark(row),
    ]
    stimulation: Sequence[list[str]] = [
        [
            str(item.channel),
            number(item.onset_after_pre_swing_ms, 0),
            number(item.duration_s * 1e3, 0),
            number(item.peak_current_ma, 1),
            number(item.charge_uc, 0),
        ]
        for item in row.stimulation
    ] or [["–"] * 5]
    for at, cells in enumerate(stimulation):
        first = at == 0
        style = "" if row.valid else "dim"
        notes = ([note] if first else [""]) if len(table.columns) > len(gait) + len(cells) else []
        table.add_row(*(gait if first else [""] * len(gait)), *cells, *notes, style=style)


def summary_block(summary: SessionSummary) -> RenderableType:
    """The session in about a dozen lines."""
    lines = [_title(summary)]
    lines += [_foot_line(summary, foot) for foot in summary.feet]
    for channel in summary.channels:
        if channel.bursts:
            counted = "" if channel.charge_counted_by_device else " (estimated)"
            lines.append(
                Text(
                    f"  {channel.name}: {channel.bursts} bursts, {channel.on_time_s:.1f} s on, "
                    f"peak {channel.peak_current_ma:.1f} mA, {channel.charge_uc / 1e3:.2f} mC{counted}, "
                    f"onset {mean_sd(channel.onset_after_pre_swing_ms, 0, 'ms')}"
                )
            )
    lines += [Text(f"  {line}") for line in told(summary.tuning, summary.dose)]
    lines += [_finding_line(finding) for finding in findings(summary)]
    return Group(*lines)


def _title(summary: SessionSummary) -> Text:
    about = ", ".join(filter(None, (summary.subject, summary.recording, summary.created)))
    return Text(f"{summary.name} ({about})  {summary.duration_s:.1f} s", style="bold")


def _foot_line(summary: SessionSummary, name: str) -> Text:
    foot = summary.feet[name]
    text = f"  {readable(name)}: {foot.valid} of {count_of(foot.strides, 'stride')} valid"
    if foot.valid:
        phases = (
            ("pre-swing", foot.pre_swing_s),
            ("swing", foot.swing_s),
            ("loading", foot.loading_response_s),
            ("stance", foot.stance_s),
        )
        times = ", ".join(f"{label} {number(s.mean, 2)} s ±{number(s.sd_percent, 0)}%" for label, s in phases)
        text += (
            f", length {mean_sd(foot.stride_length_m, 2, 'm')}, sensor lifted {mean_sd(foot.clearance_cm, 1, 'cm')}"
            f"\n    {times}"
        )
    return Text(text)


def _finding_line(finding: Finding) -> Text:
    mark, style = MARKS[finding.level]
    return Text(f"{mark} {finding.text}", style=style)
