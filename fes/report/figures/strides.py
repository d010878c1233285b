"""Figures of strides: every stride by itself, means over the stride, and the swing paths as a butterfly.

Clinics call *butterfly* the path of the centre of pressure on an instrumented treadmill: it crosses from foot to foot
in double support, and its two wings are the two steps. No force is measured here. These wings are the paths of the two
foot sensors from stance to stance, left foot to the left, right foot to the right, laid against each other so that the
sides can be compared at a glance. Where the feet stand to each other is not known and not shown.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from fes.config import Band
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.gait import POINTS, FootCurves, by_distance, spread_of
from fes.report.quality import LOST, UNSURE, Flag, describe_flags
from fes.report.summary import ReportData
from fes.report.text import count_of, readable
from fes.signals import FOOT_SENSORS, FloatArray, StrideResult
from fes.stimulation.contact import times_ns
from statemachine.phases import Phase

FAINT_STRIDES = 80  # so many single strides are drawn behind the mean, evenly picked
FOOT_COLORS = {"left_foot": "#0072B2", "right_foot": "#D55E00"}  # Okabe–Ito
PHASE_COLORS = {"pre_swing": "#E69F00", "swing": "#56B4E9", "loading_response": "#CC79A7", "stance": "#C9CED3"}
OTHER_COLOR = "#444444"
RING_COLOR = "#1b1f24"
Flags = Mapping[tuple[str, int], Sequence[Flag]]
NO_FLAGS: Final[Flags] = {}
STRIP_SHARE = 0.065  # of the plot's height: a foot's phases
DASHES: Final = {"right_foot": "9 4"}  # so that the feet differ in grey, too
_CURVES: Final[tuple[tuple[str, str, Callable[[FootCurves], FloatArray], str], ...]] = (
    ("Height", "height (cm)", lambda one: 100.0 * one.path_m[:, :, 2], "Height of the sensor above the stance before."),
    (
        *("Pitch", "pitch (°), toe up +", lambda one: np.degrees(one.pitch_rad)),
        "Rotation of the foot about the axis across it; 0° is the stance before.",
    ),
    (
        *("Forward speed", "forward speed (m/s)", lambda one: one.speed_mps),
        "Speed of the sensor along the stride, over the ground (on a treadmill: over the belt).",
    ),
)
BUTTERFLY_FAINT_STRIDES = 40  # of a foot, evenly picked
NO_FORCE = (
    "Not the clinics' butterfly of the centre of pressure: no force is measured. Each wing is the path of one foot's "
    "sensor, both from the same point; how far apart the feet are is not known."
)


def foot_color(foot: str) -> str:
    """Blue for the left, vermilion for the right foot or shank, in every figure."""
    return FOOT_COLORS.get(foot.replace("shank", "foot"), OTHER_COLOR)


def stride_figures(data: ReportData, flags: Flags = NO_FLAGS) -> list[Figure]:
    """Stride length and clearance of every stride against time; flagged strides are ringed."""
    rows, belt = data.summary.strides, data.summary.belt_speed_mps
    if not rows:
        return []
    care = {key: own for key, found in flags.items() if (own := [flag for flag in found if flag.kind != UNSURE])}
    length, lengths = _per_stride(data, [row.stride_length_m for row in rows], "stride length (m)", 2, "m", care)
    clearance, clearances = _per_stride(data, [row.clearance_cm for row in rows], "clearance (cm)", 1, "cm", care)
    times = [row.duration_s for row in rows if row.valid]
    legend = "Filled: used, hollow: left out. Dashed: mean"
    if np.isfinite(belt) and times:
        expected_m = belt * float(np.mean(times))
        length.level(expected_m, "#000000", dash="2 3")
        lengths += f". Dotted: belt speed · mean stride time, {expected_m:.2f} m"
    ringed = f" Ringed, with care: {described}." if (described := describe_flags(care.values())) else ""
    height = "Greatest height of the sensor above its start."
    return [
        length.figure("Stride length", f"{legend} {lengths}.{ringed}"),
        clearance.figure("Clearance", f"{height} {legend} {clearances}.{ringed}"),
    ]


def _per_stride(
    data: ReportData, values: Sequence[float], label: str, digits: int, unit: str, care: Flags
) -> tuple[Plot, str]:
    """The plot, and the means as text."""
    rows = data.summary.strides
    y = np.array(values)
    start_s = np.array([row.start_s for row in rows])
    valid = np.array([row.valid for row in rows])
    low, high = padded([y[valid] if valid.any() else y], share=0.15)
    y = np.clip(y, low, high)  # a stride that was left out may lie anywhere and must not squeeze the others
    plot = Plot(f"{label} of every stride", "time (s)", label, padded([start_s], share=0.03), (low, high))
    means: list[str] = []
    for foot in data.timelines:
        for used in (True, False):
            pick = [i for i, row in enumerate(rows) if row.foot == foot and row.valid == used]
            titles = [
                f"{readable(foot)} {rows[i].number}: {values[i]:.{digits}f} {unit} {rows[i].reason}" for i in pick
            ]
            plot.points(start_s[pick], y[pick], foot_color(foot), titles, hollow=not used)
            good = y[pick][np.isfinite(y[pick])]
            if used and good.size:
                mean = float(good.mean())
                means.append(f"{readable(foot)} {mean:.{digits}f} {unit}")
                plot.level(mean, foot_color(foot))
    ringed = [i for i, row in enumerate(rows) if (row.foot, row.number) in care]
    plot.rings(start_s[ringed], y[ringed], RING_COLOR)
    return plot, ", ".join(means) or "–"


def phase_figures(data: ReportData, flags: Flags = NO_FLAGS) -> list[Figure]:
    """Per foot: how long each phase of each stride lasted, stacked; strides with a flag that tells on times ringed."""
    return [
        _phase_figure(data, foot, flags) for foot in data.timelines if foot in {r.foot for r in data.summary.strides}
    ]


def _phase_figure(data: ReportData, foot: str, flags: Flags) -> Figure:
    rows = [row for row in data.summary.strides if row.foot == foot]
    kinds = (LOST, UNSURE)
    told = {row.number: [flag for flag in flags.get((foot, row.number), ()) if flag.kind in kinds] for row in rows}
    layers = {phase: np.array([getattr(row, f"{phase}_s") for row in rows]) for phase in PHASE_COLORS}
    layers["stance"][[row.stance_is_standing for row in rows]] = np.nan
    number = np.array([float(row.number) for row in rows])
    floors = np.cumsum([np.zeros(len(rows)), *map(np.nan_to_num, layers.values())], axis=0)
    name, ends = readable(foot), (float(number.min()) - 0.7, float(number.max()) + 0.7)
    y_range = padded([floors[-1]], zero=True)
    plot = Plot(f"Phase durations of every stride, {name}", "stride number", "time since heel rise (s)", ends, y_range)
    for phase, low, high in zip(layers, floors[:-1], floors[1:], strict=True):
        plot.bars(number, low, high, 0.84, PHASE_COLORS[phase], readable(phase))
    ringed = np.array([bool(told[row.number]) for row in rows])
    plot.rings(number[ringed], floors[-1][ringed], RING_COLOR)
    care = f" Ringed, with care: {flaws}." if (flaws := describe_flags(told.values())) else ""
    text = "From below: pre-swing, swing, loading response, stance. Stances over 3 s are standing, not drawn."
    return plot.figure(f"Phase durations, {name}", text + care)


def curve_figures(curves: Mapping[str, FootCurves], care: str = "") -> list[Figure]:
    """Height, pitch and forward speed over the stride; ``care``: a sentence on the strides' flags."""
    counts = ", ".join(f"{readable(foot)} {count_of(one.count, 'stride')}" for foot, one in curves.items())
    figures = []
    for name, label, values_of, about in _CURVES if curves else ():
        spreads = {foot: (values_of(one).mean(axis=0), spread_of(values_of(one))) for foot, one in curves.items()}
        bands = {foot: (mean - sd, mean + sd) for foot, (mean, sd) in spreads.items()}
        low, high = padded([edge for band in bands.values() for edge in band], zero=True, share=0.05)
        floor = low - (high - low) * STRIP_SHARE * (len(curves) + 0.5)
        title, across = f"{name} over the stride", "stride (%), from mid-stance to mid-stance"
        y_range = (floor, high)
        plot = Plot(f"{title}, mean and standard deviation", across, label, (0.0, 100.0), y_range, ticks_from=low)
        share = np.linspace(0.0, 100.0, POINTS)
        for foot, band in bands.items():
            plot.band(share, *band, foot_color(foot), 0.25)
        for foot, (mean, _) in spreads.items():
            plot.line(share, mean, foot_color(foot), width=2.6, dash=DASHES.get(foot, ""))
        _strips(plot, curves, floor, (high - low) * STRIP_SHARE)
        caption = (
            f"{about} Mean (right dashed) and ±1 SD: {counts}, heel rise and foot flat brought together. "
            f"Below: mean phases.{care}"
        )
        figures.append(plot.figure(title, caption))
    return figures


def _strips(plot: Plot, curves: Mapping[str, FootCurves], floor: float, height: float) -> None:
    """The mean phases of each foot as a bar along the bottom, left above right."""
    for at, (foot, one) in enumerate(reversed(list(curves.items()))):
        base = floor + at * height
        entries = [(0.0, Phase.STANCE)]
        entries += [(percent, phase) for phase, percent in one.entries_percent.items()]
        for (begin, phase), (end, _) in zip(entries, [*entries[1:], (100.0, Phase.STANCE)], strict=True):
            span = np.clip(np.array([begin, end]), 0.0, 100.0)
            low, high = np.full(2, base + 0.08 * height), np.full(2, base + 0.92 * height)
            plot.band(span, low, high, PHASE_COLORS[phase.name.lower()], 1.0)
        plot.text(1.0, base + 0.25 * height, readable(foot).removesuffix(" foot"), "#1b1f24")


def butterfly_figures(curves: Mapping[str, FootCurves], care: str = "") -> list[Figure]:
    """From the side (height over distance) and from above (distance over excursion); with one foot one wing each."""
    distances = {foot: paths for foot, one in curves.items() if (paths := _by_distance(one)) is not None}
    if not distances:
        return []
    counts = ", ".join(f"{readable(foot)} {count_of(len(paths), 'stride')}" for foot, paths in distances.items())
    legend = f"Bold: mean (right dashed), band: ±1 SD at the same share of the distance; {counts}.{care}"
    name = "Butterfly" if len(distances) > 1 else "Path"
    return [_from_the_side(name, distances, legend), _from_above(name, distances, legend)]


def _by_distance(one: FootCurves) -> FloatArray | None:
    """(S, POINTS, 3): forward (m), outward (cm), height (cm) at equal shares of each stride's distance; None if 0."""
    outward = -100.0 if one.foot.startswith("right") else 100.0
    paths = [path * [1.0, outward, 100.0] for each in one.path_m if (path := by_distance(each)) is not None]
    return np.array(paths) if paths else None


def _from_the_side(name: str, distances: Mapping[str, FloatArray], legend: str) -> Figure:
    sides = _wings(distances, 0)
    plot = Plot(
        f"{name} of the swing paths seen from the side",
        _ends(distances, "forward (m)"),
        "height (cm)",
        padded(sides.values(), zero=True, share=0.03),
        padded((paths[:, :, 2] for paths in distances.values()), zero=True),
        mirrored=True,
    )
    for foot, paths in distances.items():
        color, x, height = foot_color(foot), sides[foot], paths[:, :, 2]
        _faint(plot, x, height, color)
        mean, sd = height.mean(axis=0), spread_of(height)
        plot.band(x.mean(axis=0), mean - sd, mean + sd, color, 0.32)
        plot.line(x.mean(axis=0), mean, color, width=3, dash=DASHES.get(foot, ""))
    no_force = NO_FORCE if len(distances) > 1 else ""
    return plot.figure(f"{name}, from the side", f"{legend} Height is drawn larger than length. {no_force}")


def _from_above(name: str, distances: Mapping[str, FloatArray], legend: str) -> Figure:
    sides = _wings(distances, 1)
    most = max(float(np.abs(values).max()) for values in sides.values()) * 1.1 or 1.0
    plot = Plot(
        f"{name} of the swing paths seen from above",
        _ends(distances, "outwards from the straight line (cm)"),
        "forward (m)",
        (-most, most),
        padded((paths[:, :, 0] for paths in distances.values()), zero=True, share=0.03),
        mirrored=True,
    )
    plot.upright(0.0, "#555555", "")
    for foot, paths in distances.items():
        color, x, ahead = foot_color(foot), sides[foot], paths[:, :, 0]
        _faint(plot, x, ahead, color)
        mean, sd, along = x.mean(axis=0), spread_of(x), ahead.mean(axis=0)
        plot.area(np.append(mean - sd, (mean + sd)[::-1]), np.append(along, along[::-1]), color, 0.32)
        plot.line(mean, along, color, width=3, dash=DASHES.get(foot, ""))
    how = "A wing that bulges is circumduction; one that crosses the middle went inwards."
    return plot.figure(f"{name}, from above", f"{legend} {how} Width is drawn larger than length.")


def _wings(distances: Mapping[str, FloatArray], axis: int) -> dict[str, FloatArray]:
    """One axis of the paths, the left foot's to the left."""
    return {foot: (-1.0 if foot.startswith("left") else 1.0) * paths[:, :, axis] for foot, paths in distances.items()}


def _ends(distances: Mapping[str, FloatArray], label: str) -> str:
    return f"◀ left foot · {label} · right foot ▶" if len(distances) > 1 else label


def _faint(plot: Plot, x: FloatArray, y: FloatArray, color: str) -> None:
    """Some of the single strides, evenly picked."""
    for at in np.unique(np.linspace(0, len(x) - 1, min(len(x), BUTTERFLY_FAINT_STRIDES)).round().astype(int)):
        plot.line(x[at], y[at], color, width=0.8, opacity=0.2)


# --- Figures of the stimulated foot through the swing: pitch and roll, as stimulation began and as it ended ---


FIRST, LAST = 5, 10  # stimulated strides: hardly tuned yet, and as the session ended
BEFORE_COLOR, BAND_COLOR = "#6b7280", "#009E73"
SHARE: Final[FloatArray] = np.linspace(0.0, 1.0, 51)  # of the swing
BAND_PERCENT = (100.0, 104.0)  # where a target is drawn: at contact
_ANGLES: Final = (
    ("pitch", "pitch (°), toe up +", "Angle of the foot's long axis against the ground"),
    ("roll", "roll (°), inversion +", "Angle of the foot's mediolateral axis against the ground"),
)


def swing_figures(data: ReportData) -> list[Figure]:
    """Pitch, and where it is known roll, through the swing of each stimulated foot that has a sensor of its own."""
    stimulated = {(row.foot, row.number) for row in data.summary.strides if row.stimulation}
    figures = []
    for foot in FOOT_SENSORS:
        own = [s for s in data.record.strides if (s.foot, s.number) in stimulated and s.foot == foot and s.valid]
        figures += [figure for angle in _ANGLES if (figure := _of_angle(data, foot, own, *angle)) is not None]
    return figures


def _of_angle(
    data: ReportData, foot: str, strides: list[StrideResult], name: str, label: str, about: str
) -> Figure | None:
    """Mean ± SD of the first strides and of the last; None without strides that have the angle."""
    curves = [curve for stride in strides if (curve := _through_swing(stride, name)) is not None]
    if not curves:
        return None
    first, last = curves[:FIRST], curves[FIRST:][-LAST:]
    groups = [
        (np.degrees(first), BEFORE_COLOR, "6 4", f"Dashed: the first {count_of(len(first), 'stimulated stride')}")
    ]
    if last:
        more = f"solid: the last {len(last)}"
        groups.append((np.degrees(last), foot_color(foot), "", more))
    band = _target(data, foot, name)
    spreads = [(each.mean(axis=0), spread_of(each)) for each, *_ in groups]
    edges = [np.array([band.low, band.high])] if band is not None else []
    reach = [mean + sign * sd for mean, sd in spreads for sign in (-1.0, 1.0)]
    x_range = (0.0, BAND_PERCENT[1] + 1.0)
    title = f"{name.capitalize()} through the swing"
    y_range = padded([*reach, *edges], zero=True)
    plot = Plot(f"{title}, {readable(foot)}", "swing (%): foot off to contact", label, x_range, y_range)
    if band is not None:
        plot.band(np.array(BAND_PERCENT), np.full(2, band.low), np.full(2, band.high), BAND_COLOR, opacity=0.55)
    plot.level(0.0, "#9aa1a9", dash="2 3")
    plot.upright(100.0, "#555555", "contact")
    for (mean, sd), (_, color, dash, _) in zip(spreads, groups, strict=True):
        plot.band(100.0 * SHARE, mean - sd, mean + sd, color)
        plot.line(100.0 * SHARE, mean, color, width=2.5, dash=dash)
    target = f" Green: the target at contact, {band.low:g} to {band.high:g}°." if band is not None else ""
    shown = "; ".join(text for *_, text in groups)
    return plot.figure(f"{title}, {readable(foot)}", f"{about}, 0° in the stance before. {shown}; mean ± SD.{target}")


def _through_swing(stride: StrideResult, name: str) -> FloatArray | None:
    """The angle in rad (51,) at equal steps from foot off to contact; None where one of them was not seen."""
    angle: FloatArray = getattr(stride, f"{name}_rad")
    off_ns, contact_ns = stride.t_swing_ns, stride.t_loading_response_ns
    if off_ns is None or contact_ns is None or len(angle) < 2:
        return None
    return np.interp(off_ns + SHARE * (contact_ns - off_ns), times_ns(stride), angle)


def _target(data: ReportData, foot: str, name: str) -> Band | None:
    """What a channel of this foot is tuned to at contact, as the panel counts the angle; None where no channel says."""
    for channel in data.settings.channels if data.settings else ():
        tuning = channel.tuning
        if channel.foot != foot or tuning is None or tuning.mode == "off":
            continue
        if name == "pitch" and tuning.pitch_at_contact_deg is not None:
            return tuning.pitch_at_contact_deg
        if name == "roll" and (eversion := tuning.eversion_at_contact_deg) is not None:
            return Band(low=-eversion.high, high=-eversion.low)
    return None
