"""The report: one HTML file with all of a session in it, that opens anywhere without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from fes.analysis.ground_path import GroundPath
from fes.analysis.parameters.gait import GaitParameters
from fes.report.figures import strides
from fes.report.figures.strides import ground_figures, space_figure, swing_figures
from fes.report.figures.timeseries import channel_color, chart_data, latency_figure, stimulation_figures, tuning_figures
from fes.report.findings import front_page
from fes.report.gait import foot_curves, gait_of_strides
from fes.report.html import asset, css_text, embed, rendered, trusted, write_page_file
from fes.report.moments import moment_data
from fes.report.parameter_table import key_numbers, parameter_rows, parameter_slugs, scales_in_words, terms, walk_rows
from fes.report.quality import describe_flags
from fes.report.summary import ReportData, summarise_session
from fes.report.tables import path_mark
from fes.report.text import local_time, plain, readable
from fes.walk_record import WalkRecord

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.walk import HemipareticWalk


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
    section = None
    if hemiparetic is not None:
        from fes.report.hemiparetic import hemiparetic_section

        section = hemiparetic_section(hemiparetic)
    spaces = [figure for figure in (space, section.space if section else None) if figure is not None]
    named = " – ".join(part[:60] for part in (summary.name, summary.subject, local_time(summary.created)) if part)
    running_head = f"@page {{ @top-left {{ content: {css_text(named)}; }} }}\n"
    parts = {key: value for key, value in record.header.items() if isinstance(value, (dict, list)) and value}
    return rendered(
        "report.html.j2",
        s=summary,
        title=f"{summary.name} – gait and stimulation",
        front=front_page(summary, [section.finding] if section else []),
        front_figures=trusted(over_stride[:2]),
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
        stride_figures=trusted([*over_stride, *butterflies, *([space.figure] if space else [])]),
        window_figures=trusted([section.space.figure] if section and section.space else []),
        ground_figures=trusted(ground_figures(data, paths or {})),
        each_figures=trusted(strides.stride_figures(data, flags)),
        phase_figures=trusted(strides.phase_figures(data, flags)),
        stimulation_figures=trusted(stimulation_figures(data)),
        swing_figures=trusted(swing_figures(data)),
        tuning_figures=trusted(tuning_figures(data)),
        latency_figure=trusted([figure for figure in [latency_figure(data)] if figure]),
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
