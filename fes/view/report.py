"""The report: one HTML file with all of a session in it, that opens anywhere without a network."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from fes.ground_path import GroundPath
from fes.journal import SessionRecord
from fes.view.aggregate import Spread
from fes.view.figures_gait import PHASE_COLORS, Figure, foot_color, path_figures, phase_figures, stride_figures
from fes.view.figures_ground import ground_figures
from fes.view.figures_stimulation import channel_color, latency_figure, stimulation_figures
from fes.view.figures_tuning import tuning_figures
from fes.view.findings import count_of, findings, mean_sd, words
from fes.view.glossary import GLOSSARY
from fes.view.jsonable import plain
from fes.view.summary import SessionView, view_session
from fes.view.tables import number, path_mark
from fes.view.timeseries import chart_data

LONG_TABLE_ROWS = 200  # on paper a longer table stops here


class ReportError(OSError):
    """The report cannot be written; the message names the file and what to do."""


def write_report(record: SessionRecord, path: Path, *, paths: Mapping[str, GroundPath] | None = None) -> None:
    """Write the report of a session as one self-contained HTML file, replacing an older one.

    ``paths``: where each foot went over the ground, if that was worked out. The same record always gives the same
    bytes.

    Raises:
        ReportError: the file cannot be written.
    """
    text = render_report(record, paths=paths)
    draft = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.write_text(text, encoding="utf-8")
        draft.replace(path)
    except OSError as error:
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        why = error.strerror or str(error)
        failure = ReportError(f"{path}: the report cannot be written: {why}. Choose a place that can be written to.")
        failure.strerror = why
        raise failure from error


def render_report(record: SessionRecord, *, paths: Mapping[str, GroundPath] | None = None) -> str:
    """The report of a session as HTML text."""
    view = view_session(record)
    summary = view.summary
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            s=summary,
            title=f"{summary.name} – gait and stimulation",
            findings=findings(summary),
            cards=_cards(view),
            glossary=GLOSSARY,
            path_figures=_safe([*path_figures(view), *ground_figures(view, paths or {})]),
            stride_figures=_safe(stride_figures(view)),
            phase_figures=_safe(phase_figures(view)),
            stimulation_figures=_safe(stimulation_figures(view)),
            tuning_figures=_safe(tuning_figures(view)),
            latency_figure=_safe([figure for figure in [latency_figure(view)] if figure]),
            phase_colors=PHASE_COLORS,
            long_table=len(summary.strides) > LONG_TABLE_ROWS,
            run_summary=json.dumps(summary.run_summary, indent=2, ensure_ascii=False),
            header_parts=_header_parts(record.header),
            data=Markup(embed(chart_data(view))),
            style=Markup(_asset("uPlot.min.css") + _asset("report.css")),
            script=Markup(_asset("report.js")),
            uplot=Markup(f"/*\n{_asset('uPlot.LICENSE')}*/\n{_asset('uPlot.iife.min.js')}"),
        )
    )


def embed(value: Any) -> str:
    """JSON that cannot end the script element it stands in, whatever its strings hold."""
    text = json.dumps(plain(value), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def when(created: str) -> str:
    """An ISO time as people write it; anything else as it is."""
    try:
        moment = datetime.fromisoformat(created)
    except ValueError:
        return created
    return f"{moment:%Y-%m-%d %H:%M} {moment.tzname() or ''}".strip()


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("fes.view"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"num": number, "words": words, "mark": path_mark, "mean_sd": mean_sd, "when": when}
    environment.globals |= {"foot_color": foot_color, "channel_color": channel_color}
    return environment


@cache
def _asset(name: str) -> str:
    return files("fes.view").joinpath("static", name).read_text(encoding="utf-8")


def _safe(figures: list[Figure]) -> list[dict[str, Any]]:
    """Figures for the template; only the plot itself, whose texts are escaped where it is made, is trusted."""
    return [{"title": figure.title, "svg": Markup(figure.svg), "caption": figure.caption} for figure in figures]


def _header_parts(header: dict[str, Any]) -> list[tuple[str, str]]:
    """The parts of a log's header as indented text, one per key that holds more than a word."""
    parts = [(key, value) for key, value in header.items() if isinstance(value, (dict, list)) and value]
    return [(words(str(key)), json.dumps(plain(value), indent=2, ensure_ascii=False)) for key, value in parts]


def _cards(view: SessionView) -> list[dict[str, str]]:
    """The key figures: a name from the glossary, a value with its unit, and a small line below."""
    s = view.summary
    total = len(s.strides)
    four, valid = sum(row.four_phases for row in s.strides), sum(row.valid for row in s.strides)
    share = f"{100 * four / total:.0f} %" if total else "–"
    belt = "no belt known"
    if s.belt_speed_mps > 0:
        belt = f"belt {s.belt_speed_mps:.2f} m/s, ratio {number(s.speed_over_belt, 3)}"
    cards = [
        _card("stride", "Strides", f"{total}", f"{valid} valid"),
        _card("four phases", "All four phases", share, f"{four} of {total} strides"),
        _card("walking speed", "Walking speed", f"{number(s.walking_speed_mps, 2)} m/s", belt),
    ]
    feet = [(words(foot.foot).removesuffix(" foot"), foot) for foot in s.feet.values() if foot.valid]
    for side, foot in feet:
        length, below = foot.stride_length_m, _plus_minus(foot.stride_length_m, 3, "m")
        cards.append(_card("stride length", f"Stride, {side}", f"{number(length.mean, 2)} m", below))
    for side, foot in feet:
        height, below = foot.clearance_cm, _plus_minus(foot.clearance_cm, 1, "cm")
        cards.append(_card("clearance", f"Clearance, {side}", f"{number(height.mean, 1)} cm", below))
    if feet:
        cadence = sum(foot.cadence_steps_per_min for _, foot in feet) / len(feet)
        cards.append(_card("cadence", "Cadence", f"{number(cadence, 0)} /min", "steps"))
    if s.channels:
        bursts, on_s = sum(channel.bursts for channel in s.channels), sum(channel.on_time_s for channel in s.channels)
        charge_mc = sum(channel.charge_uc for channel in s.channels) / 1e3
        cards.append(_card("burst", "Stimulation", count_of(bursts, "burst"), f"{on_s:.1f} s on, {charge_mc:.2f} mC"))
    if s.latency.count:
        cards.append(_card("latency", "Latency p99", f"{s.latency.p99_ms:.2f} ms", f"median {s.latency.p50_ms:.2f} ms"))
    return cards


def _card(term: str, name: str, value: str, below: str) -> dict[str, str]:
    return {"term": GLOSSARY[term], "name": name, "value": value, "below": below}


def _plus_minus(values: Spread, digits: int, unit: str) -> str:
    return f"± {number(values.sd, digits)} {unit}"
