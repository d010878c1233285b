"""Figures of the stimulated foot through the swing: pitch and roll, as stimulation began and as it ended."""

from typing import Final

import numpy as np

from fes.config import Band
from fes.report.figures.strides import foot_color
from fes.report.figures.svg import Figure, Plot, padded
from fes.report.gait import spread_of
from fes.report.summary import ReportData
from fes.report.text import count_of, readable
from fes.signals import FOOT_SENSORS, FloatArray, StrideResult
from fes.stimulation.contact import times_ns

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
