"""The virtual patient's foot signals beside real ones: a table, and a figure of mean strides and spectra.

    python benchmarks/loop/virtual_patient.py [--data FOLDER] [--figure FILE.svg] [--json FILE]

Each real foot of ``stroke_treadmill`` (belt speed known), of its unseen walkers and of ``gaitmap_walk`` gets a virtual
twin at its speed and about its sampling rate. Both go through the same default calibration and tracker. How foot, knee
and ground move was chosen with the first group in view, never with the unseen walkers.
Without the recordings this says so and exits with 3.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import welch

from benchmarks.lib.real_sets import data_folder, gaitmap_walk, load_run
from benchmarks.lib.swing_judge import mid_swings
from benchmarks.lib.walkers import outcomes_of
from fes.calibration.recording import calibrate_track
from fes.recording import Track
from fes.signals import NS_PER_S, FloatArray, StrideResult
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of
from fes.simulation.forward.draw import draw_movement
from statemachine.phases import Transition

ORDER = (Transition.T1, Transition.T2, Transition.T3, Transition.T4)
POINTS = 101
LOW_HZ = 5.0
SPECTRUM_HZ = np.linspace(0.25, 25.0, 100)


@dataclass(frozen=True)
class Seen:
    """What one foot's signals show; accelerations m/s², rates rad/s, times s, lengths m."""

    group: str
    name: str
    speed_mps: float
    strides: int
    in_order: float
    stride_s: float
    pre_swing_s: float
    swing_s: float
    loading_s: float
    stance_s: float
    stride_m: float
    sensor_clearance_m: float
    acc_sd_mps2: float
    acc_99_mps2: float
    acc_peak_mps2: float
    rate_sd_radps: float
    toe_down_radps: float
    toe_up_radps: float
    rate_95_hz: float
    acc_95_hz: float
    off_axis: float
    contact_jerk_mps3: float
    acc_below_5_hz: float


@dataclass(frozen=True)
class Curves:
    """One foot's mean stride (POINTS,) and normalised spectra (100,) of toe-up rate and size of acceleration."""

    rate: FloatArray
    acc: FloatArray
    rate_power: FloatArray
    acc_power: FloatArray


def look(group: str, name: str, track: Track, speed_mps: float) -> tuple[Seen, Curves]:
    """Calibrate and track one foot with default settings, and measure its signals while it walks."""
    calibration = calibrate_track(track)
    outcomes = outcomes_of(track, calibration)
    strides = [one for one in outcomes if isinstance(one, StrideResult) and one.valid and one.stride_length_m > 0.3]
    changes = [one for one in outcomes if not isinstance(one, StrideResult)]
    toe_up = -track.gyr_radps @ np.array(calibration.toe_down)
    size = np.linalg.norm(track.acc_mps2, axis=1)
    middles = mid_swings(toe_up, track.rate_hz)
    rows = slice(int(middles[1]), int(middles[-2]))
    durations: dict[int, list[float]] = {0: [], 1: [], 2: [], 3: []}
    for one, other in pairwise(changes):
        durations[int(one.destination)].append(1e-9 * (other.t_ns - one.t_ns))
    good = 0
    for a, b in pairwise(middles):
        inside = [c.transition for c in changes if track.t_sensor_ns[a] <= c.t_ns < track.t_sensor_ns[b]]
        good += inside == [ORDER[2], ORDER[3], ORDER[0], ORDER[1]]
    usual = float(np.median(np.diff(middles)))
    cycles = [(a, b) for a, b in pairwise(middles) if abs(b - a - usual) < 0.25 * usual]
    rate_power, rate_95, _ = spectrum(toe_up[rows], track.rate_hz)
    acc_power, acc_95, acc_below = spectrum(size[rows], track.rate_hz)
    pre_swing_s, swing_s, loading_s, stance_s = (
        float(np.median(durations[k])) if durations[k] else math.nan for k in (1, 2, 3, 0)
    )
    seen = Seen(
        group, name, speed_mps, len(middles) - 1, good / max(len(middles) - 1, 1), usual / track.rate_hz,
        pre_swing_s, swing_s, loading_s, stance_s,
        float(np.median([s.stride_length_m for s in strides])), float(np.median([s.clearance_m for s in strides])),
        float(size[rows].std()), float(np.percentile(size[rows], 99)), float(np.percentile(size[rows], 99.8)),
        float(toe_up[rows].std()), float(np.percentile(toe_up[rows], 0.5)), float(np.percentile(toe_up[rows], 99.5)),
        rate_95, acc_95, off_main_axis(track.gyr_radps[rows]), calibration.contact_jerk_mps3, acc_below,
    )  # fmt: skip
    return seen, Curves(mean_stride(toe_up, cycles), mean_stride(size, cycles), rate_power, acc_power)


def mean_stride(signal: FloatArray, strides: list[tuple[int, int]]) -> FloatArray:
    """(POINTS,) the mean over strides from mid-swing to mid-swing."""
    grid = np.linspace(0.0, 1.0, POINTS)
    out: FloatArray = np.mean(
        [np.interp(a + grid * (b - a), np.arange(len(signal)), signal) for a, b in strides], axis=0
    )
    return out


def off_main_axis(gyr_radps: FloatArray) -> float:
    """Share of the power of rates (N, 3) in rad/s that is not about the axis with the most of it."""
    rates = gyr_radps - gyr_radps.mean(axis=0)
    power = np.linalg.eigvalsh(rates.T @ rates)
    return float(1.0 - power[-1] / power.sum())


def spectrum(signal: FloatArray, rate_hz: float) -> tuple[FloatArray, float, float]:
    """Amplitude density at SPECTRUM_HZ (same units per root Hz), the frequency below which 95 % of the power is, and
    the share of the power below 5 Hz."""
    frequency, power = welch(signal - signal.mean(), rate_hz, nperseg=min(int(8 * rate_hz), len(signal)))
    share = np.cumsum(power) / power.sum()
    below_5_hz = float(power[frequency < LOW_HZ].sum() / power.sum())
    return np.sqrt(np.interp(SPECTRUM_HZ, frequency, power)), float(np.interp(0.95, share, frequency)), below_5_hz


def pairs(folder: Path) -> Iterator[tuple[str, str, Track, float, str]]:
    """Real feet: group, name, track, speed, and the severity of the virtual twin."""
    for group, root in (("stroke", folder), ("unseen", folder / "unseen_walkers")):
        runs = root / "stroke_treadmill"
        for path in sorted(runs.glob("*_FB*.npz")) + sorted(runs.glob("*_2FB.npz")):
            tracks, belt = load_run(path)
            if math.isnan(belt):
                continue
            for foot, track in tracks.items():
                yield group, f"{path.stem} {foot[:-5]}", track, belt, "mild" if foot == "right_foot" else "healthy"
    for walk in gaitmap_walk(folder):
        if "stair" not in walk.name:
            yield "gaitmap", walk.name, walk.track, math.nan, "healthy"


def twin(group: str, severity: str, speed_mps: float, seed: int, foot: str, rate_hz: float) -> Track:
    """A minute of a virtual patient at this speed, sampled at 100 or 200 Hz, whichever is nearer.

    A stroke survivor's foot, shoe, sensor and knee move as drawn for a patient of a cohort, by ``seed``.
    """
    speed = min(max(speed_mps, 0.1), 2.0)
    near = 200.0 if rate_hz > 150.0 else 100.0
    side = foot.split("_")[0]
    drawn = draw_movement(Random(f"{seed}")) if group != "gaitmap" else {}
    settings = settings_for(severity, speed_mps=speed, seed=seed, side=side, sensors=(foot,), rate_hz=near, **drawn)
    patient = VirtualPatient(settings)
    samples = patient.advance(60 * NS_PER_S)
    return recording_of(patient, samples, "twin", "").tracks[foot]


NAMES = (
    ("speed_mps", "belt speed, m/s", "{:.2f}"), ("in_order", "phases in order", "{:.3f}"),
    ("stride_s", "stride time, s", "{:.2f}"), ("pre_swing_s", "pre-swing, s", "{:.2f}"),
    ("swing_s", "swing, s", "{:.2f}"), ("loading_s", "loading response, s", "{:.2f}"),
    ("stance_s", "stance, s", "{:.2f}"), ("stride_m", "stride length, m", "{:.2f}"),
    ("sensor_clearance_m", "sensor clearance, m", "{:.3f}"), ("acc_sd_mps2", "acceleration, SD, m/s²", "{:.1f}"),
    ("acc_99_mps2", "acceleration, 99th percentile, m/s²", "{:.0f}"),
    ("acc_peak_mps2", "acceleration, 99.8th percentile, m/s²", "{:.0f}"),
    ("rate_sd_radps", "toe-up rate, SD, rad/s", "{:.2f}"), ("toe_down_radps", "fastest toe-down, rad/s", "{:.1f}"),
    ("toe_up_radps", "fastest toe-up, rad/s", "{:.1f}"), ("rate_95_hz", "95 % of the rate's power below, Hz", "{:.1f}"),
    ("acc_95_hz", "95 % of the acceleration's power below, Hz", "{:.1f}"),
    ("off_axis", "share of the rates' power off the main axis", "{:.3f}"),
    ("contact_jerk_mps3", "jerk at contact, m/s³", "{:.0f}"),
    ("acc_below_5_hz", "share of the acceleration's power below 5 Hz", "{:.2f}"),
)  # fmt: skip


def table(rows: dict[str, list[Seen]]) -> list[list[str]]:
    """Median and range over the feet of each group."""
    out = []
    for key, label, form in NAMES:
        line = [label]
        for group in rows:
            numbers = np.array([getattr(seen, key) for seen in rows[group]])
            numbers = numbers[~np.isnan(numbers)]
            if len(numbers):
                middle, low, high = (form.format(v) for v in (np.median(numbers), numbers.min(), numbers.max()))
                line.append(f"{middle} ({low} … {high})")
            else:
                line.append("—")
        out.append(line)
    return out


def against(rows: dict[str, list[Seen]], groups: Sequence[str]) -> list[str]:
    """The median of the virtual feet of these groups over that of the real ones, row by row."""
    out = []
    for key, _, _ in NAMES:
        real, virtual = (
            np.nanmedian([getattr(seen, key) for group in groups for seen in rows.get(group + kind, [])])
            for kind in ("", " virtual")
        )
        out.append(f"{virtual / real:.2f}")
    return out


def figure(curves: dict[str, list[Curves]]) -> str:
    """The figure as SVG text: mean strides and spectra, real beside virtual."""
    panels = (
        ("toe-up rate over the stride, rad/s", "rate", None),
        ("size of acceleration over the stride, m/s²", "acc", None),
        ("spectrum of the rate, rad/s/√Hz", "rate_power", SPECTRUM_HZ),
        ("spectrum of the acceleration, m/s²/√Hz", "acc_power", SPECTRUM_HZ),
    )  # fmt: skip
    colours = {"stroke": "#1b6ca8", "unseen": "#b3541e", "gaitmap": "#2f8f4e"}
    parts = [
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 960 640" font-family="sans-serif" font-size="12">',
        '<rect width="960" height="640" fill="white"/>',
    ]
    for number, (title, key, x_values) in enumerate(panels):
        left, top = 60 + 470 * (number % 2), 50 + 300 * (number // 2)
        every = [np.asarray(getattr(one, key)) for group in curves.values() for one in group]
        low, high = (0.0 if x_values is not None else min(c.min() for c in every)), max(c.max() for c in every)
        parts.append(f'<text x="{left}" y="{top - 8}" font-weight="bold">{title}</text>')
        parts.append(f'<rect x="{left}" y="{top}" width="380" height="220" fill="none" stroke="#999"/>')
        for share in (0.0, 0.5, 1.0):
            y = top + 220 * (1.0 - share)
            parts.append(
                f'<text x="{left - 6}" y="{y + 4:.0f}" text-anchor="end">{low + share * (high - low):.1f}</text>'
            )
            label = f"{share * 25:.0f} Hz" if x_values is not None else f"{share:.0%}"
            parts.append(f'<text x="{left + 380 * share:.0f}" y="{top + 236}" text-anchor="middle">{label}</text>')
        for group, members in curves.items():
            values = np.array([getattr(one, key) for one in members])
            colour = colours[group.split()[0]]
            dashed = ' stroke-dasharray="6 4"' if "virtual" in group else ""
            for quantile, width, opacity in ((0.5, 2.2, 1.0), (0.1, 0.8, 0.6), (0.9, 0.8, 0.6)):
                line = np.quantile(values, quantile, axis=0)
                points = " ".join(
                    f"{left + 380 * i / (len(line) - 1):.1f},{top + 220 * (1 - (v - low) / (high - low)):.1f}"
                    for i, v in enumerate(line)
                )
                parts.append(
                    f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="{width}" '
                    f'stroke-opacity="{opacity}"{dashed}/>'
                )
    parts.append(
        '<text x="60" y="20">Blue: stroke survivors on a treadmill; brown: two not looked at. Green: a healthy '
        "adult. Solid: real; dashed: virtual, same speeds. Thick: median; thin: 10th and 90th percentile.</text></svg>"
    )
    return "\n".join(parts) + "\n"


def main() -> int:
    """Print the table; write figure and numbers where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=data_folder())
    parser.add_argument("--figure", type=Path, help="write the figure (SVG) here")
    parser.add_argument("--markdown", type=Path, help="write the table (Markdown) here")
    parser.add_argument("--json", type=Path, help="write every foot's numbers here")
    options = parser.parse_args()
    seen: dict[str, list[Seen]] = {}
    curves: dict[str, list[Curves]] = {}
    for seed, (group, name, track, belt, severity) in enumerate(pairs(options.data)):
        real, real_curves = look(group, name, track, belt)
        speed = belt if not math.isnan(belt) else real.stride_m / real.stride_s
        other = twin(group, severity, speed, seed, track.sensor, track.rate_hz)
        virtual, virtual_curves = look(f"{group} virtual", name, other, speed)
        for one, curve in ((real, real_curves), (virtual, virtual_curves)):
            seen.setdefault(one.group, []).append(one)
            curves.setdefault(one.group, []).append(curve)
    if not seen:
        print(f"{options.data}: no recordings; set FES_DATA or --data", file=sys.stderr)
        return 3
    heads = ["median (range) over feet", *(f"{group}, n = {len(members)}" for group, members in seen.items())]
    heads += ["virtual / real, stroke", "… with the unseen"]
    ratios = against(seen, ["stroke"]), against(seen, ["stroke", "unseen"])
    rows = [[*row, *pair] for row, *pair in zip(table(seen), *ratios, strict=True)]
    shown = Table(*heads)
    for row in rows:
        shown.add_row(*row)
    Console(width=190).print(shown)
    if options.figure:
        options.figure.write_text(figure(curves), encoding="utf-8")
    if options.markdown:
        lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
        lines += ["| " + " | ".join(row) + " |" for row in rows]
        options.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if options.json:
        numbers = [asdict(one) for members in seen.values() for one in members]
        options.json.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
