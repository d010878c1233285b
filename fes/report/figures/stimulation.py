"""Figures of the stimulation, the controller's latency, and the tuning: what it aimed at and what it set."""

from collections.abc import Callable, Sequence

import numpy as np

from fes.config import Band, Channel
from fes.report.figures.strides import FAINT_STRIDES
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.stimulation import ChannelInfo, TuningRow
from fes.report.strides import StrideStimulation
from fes.report.summary import ReportData
from fes.report.text import readable
from fes.signals import NS_PER_S, StrideResult
from fes.stimulation.contact import pitch_at_contact_rad, roll_at_contact_rad

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
    counted = "First command to stimulate, counted from the entry into pre-swing of the same foot."
    return [
        onset.figure("Onset", counted),
        lasted.figure("Duration", "All bursts of a channel in the stride together."),
        *(figure for info in data.channels if (figure := _envelopes(data, info)) is not None),
    ]


def _per_stride(data: ReportData, label: str, pick: Callable[[StrideStimulation], float], unit: str) -> Plot:
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
    return plot


def _envelopes(data: ReportData, info: ChannelInfo) -> Figure | None:
    """Current, or where pulse widths vary the charge per phase, against time from the entry into swing: every stride
    faint and the mean bold."""
    entries = [
        (one.t_swing_ns, one.t_pre_swing_ns, one.t_loading_response_ns)
        for one in data.record.strides
        if one.foot == info.phase_sensor and one.t_swing_ns is not None and one.t_pre_swing_ns is not None
    ]
    if not data.bursts[info.number] or not entries:
        return None
    swing_ns = np.array([swing for swing, _, _ in entries], dtype=np.int64)
    pre_s = np.array([(pre - swing) / NS_PER_S for swing, pre, _ in entries])
    loading_s = np.array([np.nan if end is None else (end - swing) / NS_PER_S for swing, _, end in entries])
    low = float(np.percentile(pre_s, 5)) - 0.15
    high = (float(np.nanpercentile(loading_s, 95)) if np.isfinite(loading_s).any() else 0.6) + 0.35
    grid_s = np.arange(low, high, ENVELOPE_STEP_S)
    times_ns = swing_ns[:, None] + np.round(grid_s * NS_PER_S).astype(np.int64)
    commands = data.commands[info.number]
    what, unit, at_times = "current", "mA", commands.current_at
    if commands.widths_vary:
        what, unit, at_times = "charge per phase", "µC", commands.charge_per_phase_at
    level = at_times(times_ns)
    used = level[level.any(axis=1)]
    if not len(used):
        return None
    color = channel_color(info.number)
    title = f"{what.capitalize()} of {info.name} around the swing, {len(used)} strides"
    top = float(used.max()) * 1.25
    plot = Plot(title, "time from the entry into swing (s)", f"{what} ({unit})", (low, high), (0.0, top))
    for at in np.unique(np.linspace(0, len(used) - 1, min(len(used), FAINT_STRIDES)).round().astype(int)):
        plot.line(grid_s, used[at], color, width=0.8, opacity=0.3)
    plot.line(grid_s, used.mean(axis=0), color, width=3)
    plot.upright(float(pre_s.mean()), "#555555", "pre-swing")
    plot.upright(0.0, "#555555", "swing")
    if np.isfinite(loading_s).any():
        plot.upright(float(np.nanmean(loading_s)), "#555555", "loading response")
    caption = f"{len(used)} strides with stimulation; bold: mean. Upright lines: mean entries into the phases."
    return plot.figure(f"Envelope, {info.name}", caption)


def latency_figure(data: ReportData) -> Figure | None:
    """How often which decision latency occurred; the slowest half percent stands in the caption."""
    latency = data.summary.latency
    if not latency.count:
        return None
    values_ms = data.record.latency_ns / 1e6
    last = max(float(np.percentile(values_ms, 99.5)) * 1.15, 1e-3)
    counts, edges = np.histogram(values_ms, bins=LATENCY_BINS, range=(0.0, last))
    beyond = int((values_ms > last).sum())
    top = counts.max() * 1.15
    plot = Plot("Histogram of the decision latency", "latency (ms)", "decisions", (0.0, last), (0.0, top))
    middle = (edges[:-1] + edges[1:]) / 2
    plot.bars(middle, np.zeros(LATENCY_BINS), counts.astype(np.float64), last / LATENCY_BINS * 0.9, "#56B4E9")
    plot.upright(latency.p50_ms, "#000000", "p50")
    plot.upright(latency.p99_ms, "#D55E00", "p99")
    p50, p99, slowest = (f"{ms:.2f} ms" for ms in (latency.p50_ms, latency.p99_ms, latency.max_ms))
    more = f" {beyond} beyond the picture." if beyond else ""
    text = f"{latency.count} decisions: median {p50}, 99 % within {p99}, slowest {slowest}.{more}"
    return plot.figure("Decision latency", text)


def tuning_figures(data: ReportData) -> list[Figure]:
    """For each tuned channel toe clearance with its target and current per stride; none where nothing is tuned."""
    channels = data.settings.channels if data.settings else ()
    sensor_of = {info.number: info.phase_sensor for info in data.channels}
    return [figure for own in channels for figure in _tuning_of_channel(data, own, sensor_of[own.number])]


def _tuning_of_channel(data: ReportData, channel: Channel, sensor: str) -> list[Figure]:
    rows = [row for row in data.summary.strides if row.foot == sensor]
    if not rows or channel.tuning is None or channel.tuning.mode == "off":
        return []
    start_s = np.array([row.start_s for row in rows])
    x_range = padded([start_s], share=0.03)
    said = [row for row in data.summary.tuning if row.channel == channel.number]
    changes, faults = [row for row in said if row.changes], [row for row in said if row.kind == "fault"]
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
        for row in faults:
            plot.upright(row.time_s, CHANGE_COLOR, "fault")
        caption = f"As measured in each stride; the band is the tuning's target.{_faults(faults)}"
        figures.append(plot.figure(f"Toe clearance and target, {channel.name}", caption))
    pitch, roll = channel.tuning.pitch_at_contact_deg, channel.tuning.eversion_at_contact_deg
    measures = (
        ("Foot pitch", "pitch, toe up", pitch, pitch_at_contact_rad),
        ("Eversion", "eversion", roll, _eversion_rad),
    )
    for name, axis, target, at_contact in measures:
        figures += _at_contact(data, channel, sensor, faults, name, axis, target, at_contact)
    learns = channel.tuning.method == "learning"  # it moves the pulses' widths: their charge shows what it set
    own = [[item for item in row.stimulation if item.channel == channel.number] for row in rows]
    if learns:
        given, what, unit = [sum(item.charge_uc for item in each) if each else np.nan for each in own], "charge", "µC"
    else:
        given = [max((item.peak_current_ma for item in each), default=np.nan) for each in own]
        what, unit = "peak current", "mA"
    level = np.array(given)
    if np.isfinite(level).any():
        plot = Plot(f"{what} per stride", "time (s)", f"{what} ({unit})", x_range, padded([level], zero=True))
        plot.line(start_s, level, channel_color(channel.number), width=2.0)
        at_s = np.array([row.time_s for row in changes])
        marked = np.interp(at_s, start_s[np.isfinite(level)], level[np.isfinite(level)])
        plot.points(at_s, marked, CHANGE_COLOR, [row.text for row in changes])
        for row in faults:
            plot.upright(row.time_s, CHANGE_COLOR, "fault")
        shown = "Charge" if learns else "Greatest current"
        caption = f"{shown} of each stride; marked: {len(changes)} changes, with their reasons to hover over."
        caption += _faults(faults)
        figures.append(plot.figure(f"What the tuning set, {channel.name}", caption))
    return figures


def _eversion_rad(stride: StrideResult) -> float:
    return -roll_at_contact_rad(stride)


def _at_contact(
    data: ReportData, channel: Channel, sensor: str, faults: Sequence[TuningRow], name: str, axis: str,
    band: Band | None, angle_rad: Callable[[StrideResult], float],
) -> list[Figure]:  # fmt: skip
    """An angle of the foot at initial contact per stride, with its target; none without one."""
    strides = [stride for stride in data.record.strides if stride.foot == sensor and stride.valid]
    angle_deg = np.degrees([angle_rad(stride) for stride in strides])
    if band is None or not np.isfinite(angle_deg).any():
        return []
    start_s = np.array([(stride.t_start_ns - data.origin_ns) / NS_PER_S for stride in strides])
    x_range, edges = padded([start_s], share=0.03), np.array([band.low, band.high])
    plot = Plot(f"{name} at contact per stride", "time (s)", f"{axis} (°)", x_range, padded([angle_deg, edges]))
    plot.band(np.array(x_range), np.full(2, edges[0]), np.full(2, edges[1]), BAND_COLOR)
    titles = [f"stride {one.number}: {deg:.0f}°" for one, deg in zip(strides, angle_deg, strict=True)]
    plot.points(start_s, angle_deg, channel_color(channel.number), titles)
    for row in faults:
        plot.upright(row.time_s, CHANGE_COLOR, "fault")
    caption = f"As measured at each initial contact; the band is the tuning's target.{_faults(faults)}"
    return [plot.figure(f"{name} at contact and target, {channel.name}", caption)]


def _faults(faults: Sequence[TuningRow]) -> str:
    """What upright lines stand for; "" where there are none."""
    return f" Upright: {'; '.join(f'{row.time_s:.0f} s, {row.text}' for row in faults)}." if faults else ""
