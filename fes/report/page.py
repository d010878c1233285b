"""The report: one HTML file with all of a session in it, that opens anywhere without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from fes.analysis.ground_path import GroundPath
from fes.analysis.parameters.gait import GaitParameters
from fes.report.figures.space import ground_figures, space_figure
from fes.report.figures.stimulation import channel_color, latency_figure, stimulation_figures, tuning_figures
from fes.report.figures.strides import (
    PHASE_COLORS,
    butterfly_figures,
    curve_figures,
    foot_color,
    phase_figures,
    stride_figures,
)
from fes.report.figures.timeseries import chart_data
from fes.report.findings import front_page
from fes.report.gait import foot_curves, gait_of_strides
from fes.report.glossary import parameter_slugs, terms
from fes.report.html import asset, css_text, embed, templates, trusted, write_page_file
from fes.report.parameter_table import KEY_NUMBERS, parameter_rows, scales_in_words, sides_compared, walk_rows
from fes.report.quality import Flag, all_flags, describe_flags, stride_flags
from fes.report.summary import ReportData, summarise_session
from fes.report.tables import path_mark
from fes.report.text import local_time, plain, readable
from fes.walk_record import WalkRecord

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.walk import HemipareticWalk


LONG_TABLE_ROWS = 200  # on paper a longer table stops here
STYLES = ("uPlot.min.css", "report.css", "report_page.css")
SCRIPTS = ("report.js", "terms.js", "space.js")


def write_report(
    record: WalkRecord,
    path: Path,
    *,
    paths: Mapping[str, GroundPath] | None = None,
    gait: GaitParameters | None = None,
    hemiparetic: HemipareticWalk | None = None,
) -> None:
    """Write the report of a session as one self-contained HTML file, replacing an older one.

    ``paths``: where each foot went over the ground, if that was worked out. ``gait``: its parameters from the samples;
    else they are worked out from the strides. ``hemiparetic``: what was found of the walk as a hemiparetic one. The
    same record always gives the same bytes.

    Raises:
        ReportError: the file cannot be written.
    """
    text = render_report(record, paths=paths, gait=gait, hemiparetic=hemiparetic)
    write_page_file(text, path, "Choose a place that can be written to.")


def render_report(
    record: WalkRecord,
    *,
    paths: Mapping[str, GroundPath] | None = None,
    gait: GaitParameters | None = None,
    hemiparetic: HemipareticWalk | None = None,
) -> str:
    """The report of a session as HTML text; arguments as of :func:`write_report`."""
    data = summarise_session(record)
    summary = data.summary
    measured = gait if gait is not None else gait_of_strides(record.strides, summary.belt_speed_mps)
    sensors = all_flags(record, data.settings)
    flags = stride_flags(record, summary.strides, sensors)
    curves = foot_curves(record.strides, measured, list(data.timelines))
    care = _care(flags, {foot: one.numbers for foot, one in curves.items()})
    over_stride = curve_figures(curves, care)
    space = space_figure(curves)
    section = None
    if hemiparetic is not None:
        from fes.report.hemiparetic import hemiparetic_section

        section = hemiparetic_section(hemiparetic)
    spaces = [figure for figure in (space, section.space if section else None) if figure is not None]
    return (
        templates()
        .get_template("report.html.j2")
        .render(
            s=summary,
            title=f"{summary.name} – gait and stimulation",
            front=front_page(summary, flags, sensors, [section.finding] if section else []),
            front_figures=trusted(over_stride[:2]),
            gait=measured,
            from_samples=gait is not None,
            compared=sides_compared(measured),
            common_scales=scales_in_words(measured),
            key_rows=parameter_rows(measured, flags, KEY_NUMBERS),
            walk_rows=walk_rows(measured),
            front_walk=[row for row in walk_rows(measured) if row.norm],
            parameter_rows=parameter_rows(measured, flags),
            hemiparetic=section,
            flags=flags,
            flags_described=describe_flags(flags.values()),
            sensors=sensors,
            terms=terms(),
            parameter_slugs=parameter_slugs(),
            stride_figures=trusted(
                [*over_stride, *butterfly_figures(curves, care), *([space.figure] if space else [])]
            ),
            window_figures=trusted([section.space.figure] if section and section.space else []),
            ground_figures=trusted(ground_figures(data, paths or {})),
            each_figures=trusted(stride_figures(data, flags)),
            phase_figures=trusted(phase_figures(data, flags)),
            stimulation_figures=trusted(stimulation_figures(data)),
            tuning_figures=trusted(tuning_figures(data)),
            latency_figure=trusted([figure for figure in [latency_figure(data)] if figure]),
            phase_colors=PHASE_COLORS,
            foot_color=foot_color,
            channel_color=channel_color,
            path_mark=path_mark,
            long_table=len(summary.strides) > LONG_TABLE_ROWS,
            run_summary=json.dumps(summary.run_summary, indent=2, ensure_ascii=False),
            header_parts=_header_parts(record.header),
            data=Markup(embed(chart_data(data, sensors) | {"spaces": [figure.to_data() for figure in spaces]})),
            style=Markup("".join(asset(name) for name in STYLES) + _running_head(data)),
            script=Markup("".join(asset(name) for name in SCRIPTS)),
            uplot=Markup(f"/*\n{asset('uPlot.LICENSE')}*/\n{asset('uPlot.iife.min.js')}"),
        )
    )


def _running_head(data: ReportData) -> str:
    """What stands at the top of every printed page but the first."""
    s = data.summary
    text = " – ".join(part[:60] for part in (s.name, s.subject, local_time(s.created)) if part)
    return f"@page {{ @top-left {{ content: {css_text(text)}; }} }}\n"


def _care(flags: Mapping[tuple[str, int], tuple[Flag, ...]], numbers: Mapping[str, tuple[int, ...]]) -> str:
    """What is to be said of the drawn strides' flags."""
    described = describe_flags(flags.get((foot, number), ()) for foot, own in numbers.items() for number in own)
    return f" With care: {described}." if described else ""


def _header_parts(header: dict[str, Any]) -> list[tuple[str, str]]:
    """The parts of a log's header as indented text, one per key that holds more than a word."""
    parts = [(key, value) for key, value in header.items() if isinstance(value, (dict, list)) and value]
    return [(readable(str(key)), json.dumps(plain(value), indent=2, ensure_ascii=False)) for key, value in parts]
