"""Figures of the stimulation, the controller's latency, and the tuning: what it aimed at and what it set."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fes.config import Channel
from fes.report.figures.strides import FAINT_STRIDES
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.stimulation import ChannelInfo
from fes.report.strides import StrideStimulation
from fes.report.summary import ReportData
from fes.report.text import readable
from fes.signals import NS_PER_S, FloatArray, IntArray

CHANNEL_COLORS = ("#009E73", "#CC79A7", "#0072B2", "#E69F00", "#000000", "#D55E00", "#56B4E9", "#8C7A00")
ENVELOPE_STEP_S = 0.01
LATENCY_BINS = 60
BAND_COLOR = "#009E73"
CHANGE_COLOR = "#D55E00"


def channel_color(number: int) -> str:
    """The colour of a channel, the same in every figure."""
    return CHANNEL_COLORS[number % len(CHANNEL_COLORS)]


def stimulation_figures(data: ReportData) -> list[Figure]:
    """Onset and duration per stride for all channels, then one figure of envelopes per channel that was used."""
    if not any(row.stimulation for row in data.summary.strides):
        return []
    onset = _per_stride(data, "onset after pre-swing (ms)", lambda item: item.onset_after_pre_swing_ms, "ms")
    lasted = _per_stride(data, "time on in the stride (s)", lambda item: item.duration_s, "s")
    envelopes = [_envelopes(data, info) for info in data.channels]
    return [
        Figure("Onset", onset, "First command to stimulate, counted from the entry into pre-swing of the same foot."),
        Figure("Duration", lasted, "All bursts of a channel in the stride together."),
        *(figure for figure in envelopes if figure is not None),
    ]


def _per_stride(data: ReportData, label: str, pick: Callable[[StrideStimulation], float], unit: str) -> str:
    chosen = {
        info: [(row, item) for row in data.summary.strides for item in row.stimulation if item.channel == info.number]
        for info in data.channels
    }
    start_s = np.array([row.start_s for row in data.summary.strides])
    y_range = padded([np.array([pick(item) for _, item in own]) for own in chosen.values()], zero=True, share=0.25)
    plot = Plot(f"{label} per stride", "time (s)", label, padded([start_s], share=0.03), y_range)
    for info, own in chosen.items():
        y = np.array([pick(item) for _, item in own])
        titles = [f"{info.name}, {readable(row.foot)} {row.number}: {pick(item):.3g} {unit}" for row, item in own]
        plot.points(np.array([row.start_s for row, _ in own]), y, channel_color(info.number), titles)
    return plot.render()


def _envelopes(data: ReportData, info: ChannelInfo) -> Figure | None:
    """Current against time from the entry into swing, every stride faint and the mean bold."""
    bursts = data.bursts[info.number]
    strides = [
        stride
        for stride in data.record.strides
        if stride.foot == info.foot and stride.t_swing_ns is not None and stride.t_pre_swing_ns is not None
    ]
    if not bursts or not strides:
        return None
    swing_ns = np.array([stride.t_swing_ns for stride in strides], dtype=np.int64)
    pre_s = _relative(np.array([stride.t_pre_swing_ns or 0 for stride in strides], dtype=np.int64), swing_ns)
    loading_s = np.array(
        [
            np.nan if stride.t_loading_response_ns is None else (stride.t_loading_response_ns - int(swing)) / NS_PER_S
            for stride, swing in zip(strides, swing_ns, strict=True)
        ]
    )
    low = float(np.percentile(pre_s, 5)) - 0.15
    high = (float(np.nanpercentile(loading_s, 95)) if np.isfinite(loading_s).any() else 0.6) + 0.35
    grid_s = np.arange(low, high, ENVELOPE_STEP_S)
    times_ns = swing_ns[:, None] + np.round(grid_s * NS_PER_S).astype(np.int64)
    current_ma = data.commands[info.number].current_at(times_ns)
    used = current_ma[current_ma.any(axis=1)]
    if not len(used):
        return None
    color = channel_color(info.number)
    plot = Plot(
        f"Current of {info.name} around the swing, {len(used)} strides",
        "time from the entry into swing (s)",
        "current (mA)",
        (low, high),
        (0.0, float(used.max()) * 1.25),
    )
    for at in np.unique(np.linspace(0, len(used) - 1, min(len(used), FAINT_STRIDES)).round().astype(int)):
        plot.line(grid_s, used[at], color, width=0.8, opacity=0.3)
    plot.line(grid_s, used.mean(axis=0), color, width=3)
    plot.upright(float(pre_s.mean()), "#555555", "pre-swing")
    plot.upright(0.0, "#555555", "swing")
    if np.isfinite(loading_s).any():
        plot.upright(float(np.nanmean(loading_s)), "#555555", "loading response")
    return Figure(
        f"Envelope, {info.name}",
        plot.render(),
        f"{len(used)} strides with stimulation; bold: mean. Upright lines: mean entries into the phases.",
    )


def _relative(t_ns: IntArray, origin_ns: IntArray) -> FloatArray:
    return np.asarray((t_ns - origin_ns) / NS_PER_S, dtype=np.float64)


def latency_figure(data: ReportData) -> Figure | None:
    """How often which decision latency occurred; the slowest half percent stands in the caption."""
    latency = data.summary.latency
    if not latency.count:
        return None
    values_ms = data.record.latency_ns / 1e6
    last = max(float(np.percentile(values_ms, 99.5)) * 1.15, 1e-3)
    counts, edges = np.histogram(values_ms, bins=LATENCY_BINS, range=(0.0, last))
    beyond = int((values_ms > last).sum())
    plot = Plot(
        "Histogram of the decision latency", "latency (ms)", "decisions", (0.0, last), (0.0, counts.max() * 1.15)
    )
    middle = (edges[:-1] + edges[1:]) / 2
    plot.bars(middle, np.zeros(LATENCY_BINS), counts.astype(np.float64), last / LATENCY_BINS * 0.9, "#56B4E9")
    plot.upright(latency.p50_ms, "#000000", "p50")
    plot.upright(latency.p99_ms, "#D55E00", "p99")
    more = f" {beyond} beyond the picture." if beyond else ""
    return Figure(
        "Decision latency",
        plot.render(),
        f"{latency.count} decisions: median {latency.p50_ms:.2f} ms, 99 % within {latency.p99_ms:.2f} ms, "
        f"slowest {latency.max_ms:.2f} ms.{more}",
    )


def tuning_figures(data: ReportData) -> list[Figure]:
    """For each tuned channel toe clearance with its target and current per stride; none where nothing is tuned."""
    tuned = [
        channel
        for channel in (data.settings.channels if data.settings else ())
        if channel.tuning is not None and channel.tuning.mode != "off"
    ]
    return [figure for channel in tuned for figure in _tuning_of_channel(data, channel)]


def _tuning_of_channel(data: ReportData, channel: Channel) -> list[Figure]:
    rows = [row for row in data.summary.strides if row.foot == channel.foot]
    if not rows or channel.tuning is None:
        return []
    start_s = np.array([row.start_s for row in rows])
    x_range = padded([start_s], share=0.03)
    changes = [row for row in data.summary.tuning if row.channel == channel.number and row.kind == "change"]
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
        at_s = np.array([row.time_s for row in changes])
        level_ma = np.interp(at_s, start_s[np.isfinite(peak_ma)], peak_ma[np.isfinite(peak_ma)])
        plot.points(at_s, level_ma, CHANGE_COLOR, [row.text for row in changes])
        figures.append(
            Figure(
                f"What the tuning set, {channel.name}",
                plot.render(),
                f"Greatest current of each stride; marked: {len(changes)} changes, with their reasons to hover over.",
            )
        )
    return figures
