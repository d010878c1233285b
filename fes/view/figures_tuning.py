"""Figures of the tuning: what it aimed at and what it set, stride by stride; and the charge of each minute."""

from __future__ import annotations

import numpy as np

from fes.config import Channel
from fes.view.figures_gait import Figure
from fes.view.figures_stimulation import channel_color
from fes.view.summary import SessionView
from fes.view.svg import Plot, padded

BAND_COLOR = "#009E73"
CHANGE_COLOR = "#D55E00"


def tuning_figures(view: SessionView) -> list[Figure]:
    """For each tuned channel toe clearance with its target and current per stride; none where nothing is tuned."""
    tuned = [
        channel
        for channel in (view.settings.channels if view.settings else ())
        if channel.tuning is not None and channel.tuning.mode != "off"
    ]
    return [figure for channel in tuned for figure in _of(view, channel)]


def _of(view: SessionView, channel: Channel) -> list[Figure]:
    rows = [row for row in view.summary.strides if row.foot == channel.foot]
    if not rows or channel.tuning is None:
        return []
    start_s = np.array([row.start_s for row in rows])
    x_range = padded([start_s], share=0.03)
    changes = [said for said in view.summary.tuning if said.channel == channel.number and said.kind == "change"]
    figures = []
    band = channel.tuning.toe_clearance_m
    toe_cm = np.array([row.toe_clearance_cm for row in rows])
    if band is not None and np.isfinite(toe_cm).any():
        edges = 100.0 * np.array([band.low, band.high])
        plot = Plot("toe clearance per stride", "time (s)", "toe clearance (cm)", x_range, padded([toe_cm, edges]))
        whole = np.array(x_range)
        plot.band(whole, np.full(2, edges[0]), np.full(2, edges[1]), BAND_COLOR)
        titles = [f"stride {row.number}: {row.toe_clearance_cm:.1f} cm" for row in rows]
        plot.points(start_s, toe_cm, channel_color(channel.number), titles)
        figures.append(
            Figure(
                f"Toe clearance and target, {channel.name}",
                plot.render(),
                "As measured in each stride; the band is the tuning's target.",
            )
        )
    peak_ma = np.array(
        [
            max((i.peak_current_ma for i in row.stimulation if i.channel == channel.number), default=np.nan)
            for row in rows
        ]
    )
    if np.isfinite(peak_ma).any():
        plot = Plot("peak current per stride", "time (s)", "peak current (mA)", x_range, padded([peak_ma], zero=True))
        plot.line(start_s, peak_ma, channel_color(channel.number), width=2.0)
        at_s = np.array([said.time_s for said in changes])
        level_ma = np.interp(at_s, start_s[np.isfinite(peak_ma)], peak_ma[np.isfinite(peak_ma)])
        plot.points(at_s, level_ma, CHANGE_COLOR, [said.text for said in changes])
        figures.append(
            Figure(
                f"What the tuning set, {channel.name}",
                plot.render(),
                f"Greatest current of each stride; marked: {len(changes)} changes, with their reasons to hover over.",
            )
        )
    return figures
