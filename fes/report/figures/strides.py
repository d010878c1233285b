"""Figures of strides: each by itself, means over the stride, the swing paths, the way over the ground, and space.

The butterfly's wings are the paths of the two foot sensors from stance to stance, laid against each other; clinics call
so the path of the centre of pressure, but no force is measured here. Strides in three dimensions are drawn as Figure 5
of Wang et al. (2013), mean and mean ± SD, in its visualization frame: x to the right, y along the walk, z up.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import islice
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from fes.analysis.ground_path import GroundPath
from fes.config import Band
from fes.report.figures import svg
from fes.report.figures.svg import BOTTOM, LEFT, RIGHT, TOP, Figure, Plot, nice_ticks, padded
from fes.report.gait import POINTS, FootCurves, by_distance, spread_of
from fes.report.quality import LOST, UNSURE, Flag, describe_flags
from fes.report.summary import ReportData
from fes.report.text import count_of, readable
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, StrideResult
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


HEIGHTS = (200, 520)  # of the view from above, whose two scales are the same
LEAST_HEIGHT_M = 0.05  # a path that rises or falls less gets no side view
WIDTH, HEIGHT, MARGIN = 640, 340, 22
AZIMUTH_DEG, ELEVATION_DEG = -62.0, 24.0
MOST_LARGER = 6.0  # height and width, compared to length
FEET_GAP = 0.3  # of the length: how far apart the feet are drawn
FLOOR, POST, TEXT = "#c3cad1", "#6b747d", "#3c444d"
_MARKED: Final = (Phase.SWING, Phase.LOADING_RESPONSE)


def ground_figures(data: ReportData, paths: Mapping[str, GroundPath]) -> list[Figure]:
    """All feet from above, and their heights along the path where they change."""
    known = {foot: path for foot, path in paths.items() if len(path.t_ns) > 1}
    if not known:
        return []
    figures = [_paths_from_above(data, known)]
    level = data.record.header.get("ground", {}).get("level", True)
    if not level and any(np.ptp(path.position_m[:, 2]) > LEAST_HEIGHT_M for path in known.values()):
        figures.append(_heights(data, known))
    return figures


def _paths_from_above(data: ReportData, paths: Mapping[str, GroundPath]) -> Figure:
    x = padded((path.position_m[:, 0] for path in paths.values()), zero=True)
    y = padded((path.position_m[:, 1] for path in paths.values()), zero=True)
    x_range, y_range, height = same_scale(x, y)
    plot = Plot("Path of the feet from above", "ahead (m)", "to the left (m)", x_range, y_range, height=height)
    parts = []
    for foot, path in paths.items():
        color = foot_color(foot)
        plot.line(path.position_m[:, 0], path.position_m[:, 1], color, width=1.6, opacity=0.75)
        strides = [stride for stride in data.record.strides if stride.foot == foot and stride.valid]
        places = path.places_at(np.array([stride.t_end_ns for stride in strides], dtype=np.int64))
        titles = [
            f"{readable(foot)}, stride {stride.number}, {(stride.t_end_ns - data.origin_ns) / NS_PER_S:.1f} s: "
            f"{stride.stride_length_m:.2f} m"
            for stride in strides
        ]
        plot.points(places[:, 0], places[:, 1], color, titles)
        parts.append(f"{readable(foot)} {path.distance_m:.1f} m, ends {path.closure_m:.2f} m from its start")
    plot.points(np.zeros(1), np.zeros(1), "#000000", ["start"], hollow=True)
    return plot.figure(
        "Path over the ground, from above",
        f"Distance from stance to stance: {'; '.join(parts)}. Points: ends of strides; hollow: the start, drawn in one "
        "place for every foot. Heading is the gyroscope's alone and drifts; on a treadmill this is the path over the "
        "belt.",
    )


def _heights(data: ReportData, paths: Mapping[str, GroundPath]) -> Figure:
    """Height over time; stances are level."""
    seconds = {foot: (path.t_ns - data.origin_ns) / NS_PER_S for foot, path in paths.items()}
    x_range = padded(seconds.values(), share=0.02)
    y_range = padded((path.position_m[:, 2] for path in paths.values()), zero=True)
    plot = Plot("Height of the feet over time", "time (s)", "height above the start (m)", x_range, y_range)
    parts = []
    for foot, path in paths.items():
        plot.line(seconds[foot], path.position_m[:, 2], foot_color(foot), width=1.6)
        gained = [s.height_gained_m for s in data.record.strides if s.foot == foot and s.valid]
        usual = f", {100 * float(np.median(gained)):+.1f} cm in the median stride" if gained else ""
        parts.append(f"{readable(foot)} {path.height_gained_m:+.2f} m{usual}")
    return plot.figure("Height gained", f"From start to end: {'; '.join(parts)}.")


def same_scale(x: tuple[float, float], y: tuple[float, float]) -> tuple[tuple[float, float], tuple[float, float], int]:
    """Ranges and the plot's height with which a metre is as long along x as along y; the smaller range is widened."""
    across, least, most = svg.WIDTH - LEFT - RIGHT, *(height - TOP - BOTTOM for height in HEIGHTS)
    wide, tall = x[1] - x[0], y[1] - y[0]
    drawn = min(max(across * tall / wide, least), most)
    metre = min(across / wide, drawn / tall)
    x_air, y_air = 0.5 * (across / metre - wide), 0.5 * (drawn / metre - tall)
    return (x[0] - x_air, x[1] + x_air), (y[0] - y_air, y[1] + y_air), round(drawn) + TOP + BOTTOM


@dataclass(frozen=True)
class SpaceFoot:
    """One foot's ``count`` strides: ``mean_m`` and ``sd_m`` (K, 3) of x right, y along, z up; points to mark."""

    mean_m: FloatArray
    sd_m: FloatArray
    count: int
    marks: Sequence[int] = ()


class SpaceFigure:
    """A figure and the numbers that the script turns it by."""

    def __init__(self, key: str, feet: Mapping[str, SpaceFoot], title: str, about: str) -> None:
        self.key = key
        self._lines: list[tuple[FloatArray, str]] = []  # points (K, 3) in drawn units, how it is drawn
        self._texts: list[tuple[FloatArray, str, str]] = []  # place (3,) in drawn units, text, colour
        length = max(float(np.ptp(foot.mean_m[:, 1])) for foot in feet.values()) or 1.0
        height = max(float(np.ptp(foot.mean_m[:, 2])) for foot in feet.values()) or 0.1 * length
        self._larger = max(1.0, min(MOST_LARGER, round(0.45 * length / height)))
        self._build(feet, length)
        counts = ", ".join(f"{readable(name)} {count_of(foot.count, 'stride')}" for name, foot in feet.items())
        dots = "Dots: foot off and first contact. " if any(foot.marks for foot in feet.values()) else ""
        caption = (
            f"{about} Bold: mean; thin: mean + SD and mean − SD; grey: the mean's shadow; {counts}. {dots}"
            f"Height and width are drawn {self._larger:.0f} times larger than length; how far apart the feet are is "
            "not known."
        )
        self.figure = Figure(title, Markup(self._svg(title)), caption)

    def to_data(self) -> dict[str, Any]:
        """For the script: places in drawn units, rounded."""
        return {
            "key": self.key,
            "azimuth_deg": AZIMUTH_DEG,
            "elevation_deg": ELEVATION_DEG,
            "lines": [np.round(points.T, 4).tolist() for points, _ in self._lines],
            "texts": [np.round(place, 4).tolist() for place, _, _ in self._texts],
        }

    def _line(self, points: FloatArray | list[list[float]], color: str, width: float, dash: str = "") -> None:
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._lines.append((np.asarray(points), f'stroke="{color}" stroke-width="{width:g}"{dashed}'))

    def _build(self, feet: Mapping[str, SpaceFoot], length: float) -> None:
        larger = np.array([self._larger, 1.0, self._larger])
        sideways = FEET_GAP * length * (np.arange(len(feet)) - 0.5 * (len(feet) - 1))
        ends = [foot.mean_m * larger + [aside, 0.0, 0.0] for aside, foot in zip(sideways, feet.values(), strict=True)]
        every = np.concatenate(ends)
        (left, near, _), (right, far, top) = every.min(axis=0), every.max(axis=0)
        self._floor(left - 0.06 * length, right + 0.06 * length, min(near, 0.0), far, top)
        for (name, foot), mean in zip(feet.items(), ends, strict=True):
            color, sd = foot_color(name), foot.sd_m * larger
            self._line(mean * [1.0, 1.0, 0.0], "#8a939c", 1.2)
            for sign in (1.0, -1.0):
                self._line(mean + sign * sd, color, 1.1, "4 2")
            self._line(mean, color, 3.2)
            for at in foot.marks:
                if 0 <= at < len(mean):
                    self._line(mean[[at, at]], color, 9.0)
            self._texts.append((mean[-1] + [0.0, 0.03 * length, 0.0], readable(name), color))

    def _floor(self, left: float, right: float, near: float, far: float, top: float) -> None:
        wide = right - left
        for y in nice_ticks(near, max(far, near + 0.1), about=5):
            self._line([[left, y, 0.0], [right, y, 0.0]], FLOOR, 1.0)
            self._texts.append((np.array([right + 0.06 * wide, y, 0.0]), f"{y:g} m", TEXT))
        for x in (left, right):
            self._line([[x, near, 0.0], [x, far, 0.0]], FLOOR, 1.0)
        up_cm = [cm for cm in nice_ticks(0.0, max(100.0 * top / self._larger, 1.0), about=3) if cm > 0]
        self._line([[left, near, 0.0], [left, near, self._larger * up_cm[-1] / 100 if up_cm else top]], POST, 1.4)
        for cm in up_cm:
            z = self._larger * cm / 100
            self._line([[left, near, z], [left + 0.03 * wide, near, z]], POST, 1.4)
            self._texts.append((np.array([left - 0.05 * wide, near, z]), f"{cm:g} cm", TEXT))

    def _svg(self, label: str) -> str:
        every = [points for points, _ in self._lines] + [place[None] for place, _, _ in self._texts]
        flat = projected(np.concatenate(every), math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG))
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH - 4.0 * MARGIN, HEIGHT - 2.0 * MARGIN])
        scale = float((room / np.maximum(high - low, 1e-9)).min())
        drawn = (flat - 0.5 * (low + high)) * scale * np.array([1.0, -1.0]) + np.array([WIDTH, HEIGHT]) / 2
        places = iter(drawn.tolist())
        parts = []
        for points, how in self._lines:
            path = "L".join(f"{x:.1f} {y:.1f}" for x, y in islice(places, len(points)))
            parts.append(f'<path d="M{path}" {how}/>')
        for (_, text, color), (x, y) in zip(self._texts, places, strict=True):
            parts.append(f'<text x="{x:.1f}" y="{y:.1f}" style="fill:{color}">{escape(text)}</text>')
        return (
            f'<svg class="plot space" data-space="{escape(self.key)}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
        )


def projected(points: FloatArray, azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """Places (N, 3) seen from far away: (N, 2), to the right and up. Azimuth 0: from behind; elevation 0: level."""
    across = points[:, 0] * math.cos(azimuth_rad) - points[:, 1] * math.sin(azimuth_rad)
    away = points[:, 0] * math.sin(azimuth_rad) + points[:, 1] * math.cos(azimuth_rad)
    return np.column_stack((across, points[:, 2] * math.cos(elevation_rad) + away * math.sin(elevation_rad)))


def space_figure(curves: Mapping[str, FootCurves]) -> SpaceFigure | None:
    """Of the project's own strides; None without any."""
    feet = {}
    for foot, one in curves.items():  # from forward, left, up to right, along, up
        mean, sd = one.path_m.mean(axis=0)[:, [1, 0, 2]] * [-1.0, 1.0, 1.0], spread_of(one.path_m)[:, [1, 0, 2]]
        marks = [round(one.entries_percent[phase]) for phase in _MARKED if phase in one.entries_percent]
        feet[foot] = SpaceFoot(mean, sd, one.count, marks)
    about = (
        "As Figure 5 of Wang et al. (2013), from the strides of this report, heel rise and foot flat brought together: "
        "x right, y along the stride, z up."
    )
    return SpaceFigure("strides", feet, "Strides in three dimensions", about) if feet else None
