"""The virtual patient's foot signals beside real ones; exit code 3 without recordings.

Each real foot of ``stroke_treadmill`` (belt speed known), of its unseen walkers and of ``gaitmap_walk`` gets a virtual
twin at its speed and about its sampling rate. Both go through the same default calibration and tracker. How foot, knee
and ground move was chosen with the first group in view, never with the unseen walkers.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
from scipy.signal import welch

from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of
from benchmarks.lib.real_sets import data_folder, gaitmap_walk, load_run
from benchmarks.lib.swing_judge import mid_swings
from benchmarks.lib.walkers import causal
from fes.calibration.recording import calibrate_track
from fes.recording import Track
from fes.signals import NS_PER_S, FloatArray
from fes.simulation.forward import VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import recording_of
from fes.simulation.forward.draw import draw_movement

LOW_HZ = 5.0
NAMES = {
    "belt speed, m/s": ".2f", "stride time, s": ".2f", "pre-swing, s": ".2f", "swing, s": ".2f",
    "loading response, s": ".2f", "stance, s": ".2f", "stride length, m": ".2f", "sensor clearance, m": ".3f",
    "acceleration, SD, m/s²": ".1f", "acceleration, 99.8th percentile, m/s²": ".0f", "toe-up rate, SD, rad/s": ".2f",
    "fastest toe-down, rad/s": ".1f", "fastest toe-up, rad/s": ".1f", "95 % of the rate's power below, Hz": ".1f",
    "95 % of the acceleration's power below, Hz": ".1f", "share of the acceleration's power below 5 Hz": ".2f",
    "share of the rates' power off the main axis": ".3f", "jerk at contact, m/s³": ".0f",
}  # fmt: skip


def look(track: Track, speed_mps: float) -> list[float]:
    """Calibrate and track one foot with default settings, and measure its signals while it walks, in NAMES' order."""
    calibration = calibrate_track(track)
    changes, strides = causal(track, calibration)
    strides = [stride for stride in strides if stride.valid and stride.stride_length_m > 0.3]
    toe_up, size = -track.gyr_radps @ np.array(calibration.toe_down), np.linalg.norm(track.acc_mps2, axis=1)
    middles = mid_swings(toe_up, track.rate_hz)
    rows = slice(int(middles[1]), int(middles[-2]))
    lasted_s = defaultdict[int, list[float]](list)
    for one, other in pairwise(changes):
        lasted_s[int(one.destination)].append(1e-9 * (other.t_ns - one.t_ns))
    phases_s = [float(np.median(lasted_s[k])) if lasted_s[k] else math.nan for k in (1, 2, 3, 0)]
    rate_95_hz, _ = spectrum(toe_up[rows], track.rate_hz)
    length_m = float(np.median([s.stride_length_m for s in strides]))
    stride_s = float(np.median(np.diff(middles))) / track.rate_hz
    speed_mps = length_m / stride_s if math.isnan(speed_mps) else speed_mps
    return [
        speed_mps, stride_s, *phases_s, length_m, float(np.median([s.clearance_m for s in strides])),
        size[rows].std(), np.percentile(size[rows], 99.8), toe_up[rows].std(), np.percentile(toe_up[rows], 0.5),
        np.percentile(toe_up[rows], 99.5), rate_95_hz, *spectrum(size[rows], track.rate_hz),
        off_main_axis(track.gyr_radps[rows]), calibration.contact_jerk_mps3,
    ]  # fmt: skip


def off_main_axis(gyr_radps: FloatArray) -> float:
    """Share of the power of rates (N, 3) in rad/s that is not about the axis with the most of it."""
    rates = gyr_radps - gyr_radps.mean(axis=0)
    power = np.linalg.eigvalsh(rates.T @ rates)
    return float(1.0 - power[-1] / power.sum())


def spectrum(signal: FloatArray, rate_hz: float) -> tuple[float, float]:
    """The frequency below which 95 % of the power is, and the share of the power below 5 Hz."""
    frequency, power = welch(signal - signal.mean(), rate_hz, nperseg=min(int(8 * rate_hz), len(signal)))
    below = float(power[frequency < LOW_HZ].sum() / power.sum())
    return float(np.interp(0.95, np.cumsum(power) / power.sum(), frequency)), below


def pairs(folder: Path) -> Iterator[tuple[str, Track, float, str]]:
    """Real feet: group, track, speed, and the severity of the virtual twin."""
    for group, root in (("stroke", folder), ("unseen", folder / "unseen_walkers")):
        runs = root / "stroke_treadmill"
        for path in sorted(runs.glob("*_FB*.npz")) + sorted(runs.glob("*_2FB.npz")):
            tracks, belt_mps = load_run(path)
            for foot, track in tracks.items() if not math.isnan(belt_mps) else ():
                yield group, track, belt_mps, "mild" if foot == "right_foot" else "healthy"
    for walk in gaitmap_walk(folder):
        yield "gaitmap", walk.track, math.nan, "healthy"


def twin(group: str, severity: str, speed_mps: float, seed: int, track: Track) -> Track:
    """A minute of a virtual patient at this speed, sampled at 100 or 200 Hz, whichever is nearer.

    A stroke survivor's foot, shoe, sensor and knee move as drawn for a patient of a cohort, by ``seed``.
    """
    drawn = draw_movement(Random(f"{seed}")) if group != "gaitmap" else {}
    settings = settings_for(
        severity, speed_mps=min(max(speed_mps, 0.1), 2.0), seed=seed, side=track.sensor.split("_")[0],
        sensors=(track.sensor,), rate_hz=200.0 if track.rate_hz > 150.0 else 100.0, **drawn,
    )  # fmt: skip
    patient = VirtualPatient(settings)
    return recording_of(patient, patient.advance(60 * NS_PER_S), "twin", "").tracks[track.sensor]


def main() -> int:
    options = parser_of(__doc__, data_folder()).parse_args()
    seen: dict[str, list[list[float]]] = {}
    for seed, (group, track, belt_mps, severity) in enumerate(pairs(options.data)):
        real = look(track, belt_mps)
        seen.setdefault(group, []).append(real)
        seen.setdefault(f"{group} virtual", []).append(look(twin(group, severity, real[0], seed, track), real[0]))
    if not seen:
        return no_recordings(options.data)
    values = {group: np.array(feet) for group, feet in seen.items()}
    heads = ["median (range) over feet", *(f"{group}, n = {len(feet)}" for group, feet in values.items())]
    rows = []
    for k, (name, form) in enumerate(NAMES.items()):
        cells = [[format(f(v[:, k]), form) for f in (np.nanmedian, np.nanmin, np.nanmax)] for v in values.values()]
        ratios = []
        for groups in (["stroke"], [group for group in ("stroke", "unseen") if group in values]):
            real, virtual = (np.vstack([values[g + kind] for g in groups])[:, k] for kind in ("", " virtual"))
            ratios.append(f"{np.nanmedian(virtual) / np.nanmedian(real):.2f}")
        rows.append([name, *(f"{middle} ({low} … {high})" for middle, low, high in cells), *ratios])
    table = table_of("", (*heads, "virtual / real, stroke", "… with the unseen"), rows)
    publish([table], options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
