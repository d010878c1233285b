"""Signals for the zoomable plots: even grids, least and greatest value per bin, packed into 16-bit numbers."""

import base64
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from fes.config import Channel
from fes.report.figures.strides import FAINT_STRIDES, PHASE_COLORS, foot_color
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.quality import SensorFlags, sample_times
from fes.report.stimulation import ChannelInfo, PhaseTimeline
from fes.report.strides import StrideStimulation
from fes.report.summary import ReportData
from fes.report.text import readable
from fes.signals import NS_PER_S, BoolArray, FloatArray
from fes.stimulation.contact import pitch_at_contact_rad, roll_at_contact_rad
from fes.walk_record import SampleArrays
from statemachine.phases import Phase

# --- Figures of the stimulation, the controller's latency, and the tuning: what it aimed at and what it set ---


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
    rows, tuning = [row for row in data.summary.strides if row.foot == sensor], channel.tuning
    if not rows or tuning is None or tuning.mode == "off":
        return []
    said = [row for row in data.summary.tuning if row.channel == channel.number]
    changes, faults = [row for row in said if row.changes], [row for row in said if row.kind == "fault"]
    told = f" Upright: {'; '.join(f'{row.time_s:.0f} s, {row.text}' for row in faults)}." if faults else ""
    color, figures = channel_color(channel.number), list[Figure]()

    def add(plot: Plot, title: str, caption: str) -> None:
        for row in faults:
            plot.upright(row.time_s, CHANGE_COLOR, "fault")
        figures.append(plot.figure(f"{title}, {channel.name}", caption + told))

    valid = [stride for stride in data.record.strides if stride.foot == sensor and stride.valid]
    contacts = [(stride.number, (stride.t_start_ns - data.origin_ns) / NS_PER_S) for stride in valid]
    toe = [(row.number, row.start_s, row.toe_clearance_cm) for row in rows]
    pitch = [(*at, np.degrees(pitch_at_contact_rad(one))) for at, one in zip(contacts, valid, strict=True)]
    eversion = [(*at, -np.degrees(roll_at_contact_rad(one))) for at, one in zip(contacts, valid, strict=True)]
    of_stride, of_contact = ("in each stride", 100.0, 1, " cm"), ("at each initial contact", 1.0, 0, "°")
    for name, axis, band, (when, scale, digits, unit), measured in (
        ("Toe clearance", "toe clearance (cm)", tuning.toe_clearance_m, of_stride, toe),
        ("Foot pitch at contact", "pitch, toe up (°)", tuning.pitch_at_contact_deg, of_contact, pitch),
        ("Eversion at contact", "eversion (°)", tuning.eversion_at_contact_deg, of_contact, eversion),
    ):
        numbers, at_s, values = np.array(measured, dtype=np.float64).reshape(-1, 3).T
        if band is None or not np.isfinite(values).any():
            continue
        x_range, edges = padded([at_s], share=0.03), scale * np.array([band.low, band.high])
        plot = Plot(f"{name} per stride", "time (s)", axis, x_range, padded([values, edges]))
        plot.band(np.array(x_range), np.full(2, edges[0]), np.full(2, edges[1]), BAND_COLOR)
        titles = [
            f"stride {number:.0f}: {value:.{digits}f}{unit}" for number, value in zip(numbers, values, strict=True)
        ]
        plot.points(at_s, values, color, titles)
        add(plot, f"{name} and target", f"As measured {when}; the band is the tuning's target.")
    own = [[item for item in row.stimulation if item.channel == channel.number] for row in rows]
    if tuning.method == "learning":  # it moves the pulses' widths: their charge shows what it set
        given = [sum(i.charge_uc for i in each) if each else np.nan for each in own]
        shown, what, unit = "Charge", "charge", "µC"
    else:
        given = [max((i.peak_current_ma for i in each), default=np.nan) for each in own]
        shown, what, unit = "Greatest current", "peak current", "mA"
    start_s, level = np.array([row.start_s for row in rows]), np.array(given)
    if (known := np.isfinite(level)).any():
        x_range = padded([start_s], share=0.03)
        plot = Plot(f"{what} per stride", "time (s)", f"{what} ({unit})", x_range, padded([level], zero=True))
        plot.line(start_s, level, color, width=2.0)
        at_s = np.array([row.time_s for row in changes])
        marked = np.interp(at_s, start_s[known], level[known])
        plot.points(at_s, marked, CHANGE_COLOR, [row.text for row in changes])
        changed = f"marked: {len(changes)} changes, with their reasons to hover over."
        add(plot, "What the tuning set", f"{shown} of each stride; {changed}")
    return figures


DETAIL = ((600.0, 200), (1800.0, 100), (float("inf"), 80))  # sessions up to so long (s) keep so many points a second
GAP_INTERVALS = 2.5  # a pause this many intervals long is drawn as a gap
LONG_UNKNOWN = 1000  # of so many points without a value only the last is kept
MOST_RADPS = 1e6  # beyond what turns, and what can be squared: no number
MISSING = -32768
MOST_NOTICES = 2000  # that a click can show
MOST_MARKS = 500  # on the time line
SHOWN_OF_MARK = 32  # characters of its text there; the list has all
MARK_COLOR = "#7a1f6b"
FULL_SCALE = 32000


def chart_data(data: ReportData, sensors: Mapping[str, SensorFlags] | None = None) -> dict[str, Any]:
    """All that the script draws, in plain values: per foot its signals and phases, and the channels' current.

    ``sensors``: by foot, what is wrong with the samples; drawn where it is.
    """
    wrong = sensors or {}
    seconds = (data.end_ns - data.origin_ns) / NS_PER_S
    points_per_s = next(points for longest_s, points in DETAIL if seconds <= longest_s)
    feet = [
        _foot(data.record.samples[foot], timeline, data.origin_ns, points_per_s)
        | {"wrong": wrong[foot].spans(data.origin_ns) if foot in wrong else []}
        for foot, timeline in data.timelines.items()
        if foot in data.record.samples and data.record.samples[foot].t_ns.size > 1
    ]
    count = int(seconds * points_per_s) + 1 if data.channels else 0
    grid_ns = data.origin_ns + (np.arange(count) * (NS_PER_S // points_per_s)).astype(np.int64)
    channels = [
        {
            "name": info.name,
            "color": channel_color(info.number),
            "current_ma": pack(data.commands[info.number].current_at(grid_ns)),
        }
        for info in data.channels
    ]
    # the first window begins just before the first stimulation, or else the first stride
    bursts = [(burst.t_start_ns - data.origin_ns) / NS_PER_S - 3.0 for own in data.bursts.values() for burst in own]
    strides = [row.start_s - 0.5 for row in data.summary.strides]
    return {
        "duration_s": seconds,
        "opening_s": max(0.0, min(bursts or strides or [0.0])),
        "feet": feet,
        "current": {"start_s": 0.0, "step_s": 1.0 / points_per_s, "pieces": [[0, count]], "channels": channels},
        "notices": [
            {"time_s": round(each.time_s, 3), "source": each.source, "text": each.text}
            for each in data.summary.notices[:MOST_NOTICES]
        ],
        "marks": [
            {
                "t_s": round(each.time_s, 3),
                "name": each.text[:SHOWN_OF_MARK],
                "row": 0,
                "color": MARK_COLOR,
                "always": True,
            }
            for each in data.summary.marks[:MOST_MARKS]
        ],
        "phases": [{"name": readable(name), "color": PHASE_COLORS[name]} for name in (p.name.lower() for p in Phase)],
    }


def pack(values: FloatArray) -> dict[str, Any]:
    """Values (N,) as base64 of little-endian 16-bit numbers and the size of one step; NaN is −32768."""
    finite = np.isfinite(values)
    most = float(np.abs(values[finite]).max()) if finite.any() else 0.0
    step = most / FULL_SCALE if most > 0 else 1.0
    packed = np.full(values.shape, MISSING, dtype="<i2")
    packed[finite] = np.rint(values[finite] / step).astype("<i2")
    return {"step": step, "data": base64.b64encode(packed.tobytes()).decode("ascii")}


def even_grid(t_s: FloatArray, values: FloatArray, points_per_s: int) -> tuple[float, float, FloatArray]:
    """Bring a signal (N,) onto an even grid of at most ``points_per_s``: (start in s, step in s, values).

    A slow signal is interpolated at its own rate; of a fast one each bin of two points keeps the least and the
    greatest value, in the order in which the signal passed them. Pauses become NaN.
    """
    start, usual = float(t_s[0]), float(np.median(np.diff(t_s)))
    if usual * points_per_s >= 0.9:
        step = max(usual, 1e-3)
        grid = start + step * np.arange(int((t_s[-1] - start) / step) + 1)
        after = np.clip(np.searchsorted(t_s, grid), 1, t_s.size - 1)
        even = np.interp(grid, t_s, values)
        even[t_s[after] - t_s[after - 1] > GAP_INTERVALS * step] = np.nan
        return start, step, even
    width = 2.0 / points_per_s
    index = ((t_s - start) / width).astype(np.int64)
    first = np.flatnonzero(np.diff(index, prepend=-1))
    low, high = np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)
    rises = values[first] <= values[np.append(first[1:], values.size) - 1]
    even = np.full((int(index[-1]) + 1, 2), np.nan)
    even[index[first], 0] = np.where(rises, low, high)
    even[index[first], 1] = np.where(rises, high, low)
    return start, width / 2, even.ravel()


def _pieces(known: BoolArray) -> list[list[int]]:
    """Where the pieces of a grid (N,) begin that are worth keeping, and how long each is; between them it is long
    unknown, and the first after each is so too, which breaks the line."""
    at = np.flatnonzero(known)
    borders = np.flatnonzero(np.diff(at) > LONG_UNKNOWN)
    begins, ends = np.append(0, at[borders + 1] - 1), np.append(at[borders] + 1, known.size)
    pieces: list[list[int]] = np.column_stack((begins, ends - begins)).tolist()
    return pieces


def main_axis_rate_radps(samples: SampleArrays, timeline: PhaseTimeline) -> tuple[FloatArray, bool]:
    """Rotation rate (N,) about the axis that the foot turns about most, and whether its sign is known.

    The axis is the gyroscope's first principal axis, so no calibration is needed. Positive is toe-down: the sign
    that makes the mean rate of all pre-swings, in which the heel rises, positive.
    """
    gyr = samples.gyr_radps
    sound = (np.abs(gyr) < MOST_RADPS).all(axis=1)
    good = gyr if sound.all() else gyr[sound]
    if good.shape[0] < 2:
        return np.full(gyr.shape[0], np.nan), False
    axis = np.linalg.eigh(good.T @ good)[1][:, -1]
    rate = gyr @ axis
    rate[~sound] = np.nan
    at = np.clip(np.searchsorted(timeline.start_ns, samples.t_ns, side="right") - 1, 0, None)
    pushing = rate[(timeline.phase[at] == Phase.PRE_SWING) & np.isfinite(rate)]
    if pushing.size == 0:
        return rate, False
    return (rate if pushing.mean() >= 0 else -rate), True


def _foot(samples: SampleArrays, timeline: PhaseTimeline, origin_ns: int, points_per_s: int) -> dict[str, Any]:
    t_ns = sample_times(samples)
    t_s = (t_ns - origin_ns) / NS_PER_S
    rate, signed = main_axis_rate_radps(samples, timeline)
    x, y, z = samples.acc_mps2.T  # not by its norm, which would have hours of samples there twice more
    acc = np.sqrt(x * x + y * y + z * z)
    if (t_ns[1:] < t_ns[:-1]).any():
        order = np.argsort(t_ns, kind="stable")
        t_s, rate, acc = t_s[order], rate[order], acc[order]
    start, step, gyr_even = even_grid(t_s, np.degrees(rate), points_per_s)
    _, _, acc_even = even_grid(t_s, acc, points_per_s)
    pieces = _pieces(np.isfinite(gyr_even) | np.isfinite(acc_even))
    gyr_even, acc_even = (np.concatenate([x[at : at + n] for at, n in pieces]) for x in (gyr_even, acc_even))
    return {
        "name": readable(timeline.foot),
        "color": foot_color(timeline.foot),
        "start_s": start,
        "step_s": step,
        "pieces": pieces,
        "toe_down_positive": signed,
        "gyr_degps": pack(gyr_even),
        "acc_mps2": pack(acc_even),
        "phase_start_s": [round(value, 4) for value in ((timeline.start_ns - origin_ns) / NS_PER_S).tolist()],
        "phase_end_s": [round(value, 4) for value in ((timeline.end_ns - origin_ns) / NS_PER_S).tolist()],
        "phase": timeline.phase.tolist(),
    }
