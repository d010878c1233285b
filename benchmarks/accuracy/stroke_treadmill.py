"""Phases and walking speed on the stroke-treadmill recordings: the table, and an exit code that says if the bar holds.

    python benchmarks/accuracy/stroke_treadmill.py [--data FOLDER] [--json FILE]

One default setting for all runs and both feet. Strides are counted independently of the phase machine, by the mid-swing
peaks of the low-passed mediolateral rate; a stride counts as in order when exactly T3, T4, T1, T2 fire between two
mid-swings. Speed is the sum of stride lengths over the sum of stride times in the last 120 s, against the belt.
The recordings are not part of the project (see docs/accuracy.md); without them this says so and exits with 3.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.signal import butter, filtfilt, find_peaks

from benchmarks.lib.command_line import console_of, parser_of, publish, verdict
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker, Outcome
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import Track
from fes.recording.tracks import TrackQuality
from fes.signals import FloatArray, IntArray, StrideResult
from statemachine.phases import PhaseChange, Transition

IN_ORDER = (Transition.T3, Transition.T4, Transition.T1, Transition.T2)
LAST_S = 120.0
MIN_IN_ORDER = 0.98
SPEED_BAR = (0.98, 1.02)


@dataclass(frozen=True)
class FootResult:
    """One foot of one run; ``belt_mps`` and ``speed_ratio`` are NaN when the belt's speed is not known."""

    run: str
    foot: str
    belt_mps: float
    speed_ratio: float
    strides: int
    in_order: int
    false_swings: int
    invalid: int
    push_off_radps: float


def data_folder() -> Path:
    """Where the recordings are: $FES_DATA, else ../shared/data beside the project."""
    return Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")


def runs_of(folder: Path) -> list[Path]:
    """All runs below a folder; where there are none, says what to do about that."""
    paths = sorted((folder / "stroke_treadmill").glob("*.npz"))
    if not paths:
        print(f"No recordings in {folder / 'stroke_treadmill'}; set FES_DATA or give --data.", file=sys.stderr)
    return paths


def track_of(sensor: str, rate_hz: float, acc: FloatArray, gyr: FloatArray) -> Track:
    """A track from bare arrays (N, 3) in m/s² and rad/s."""
    t_ns = np.round(np.arange(len(acc)) * 1e9 / rate_hz).astype(np.int64)
    return Track(
        sensor=sensor,
        rate_hz=rate_hz,
        t_ns=t_ns,
        t_sensor_ns=t_ns,
        acc_mps2=np.ascontiguousarray(acc, dtype=float),
        gyr_radps=np.ascontiguousarray(gyr, dtype=float),
        acc_range_mps2=None,
        gyr_range_radps=None,
        quality=TrackQuality(samples=len(acc)),
    )


def load_run(path: Path) -> tuple[dict[str, Track], float]:
    """The feet of one run and the belt's speed (m/s, NaN when self-paced)."""
    data = np.load(path)
    rate_hz = float(data["fs"])
    tracks = {
        f"{side}_foot": track_of(f"{side}_foot", rate_hz, data[f"acc_{side}foot"], data[f"gyr_{side}foot"])
        for side in ("left", "right")
    }
    return tracks, float(data["belt_speed"])


def mid_swings(toe_up_radps: FloatArray, rate_hz: float) -> IntArray:
    """Indices of mid-swing: peaks of the 6 Hz low-passed toe-up rate over half of its 97th percentile."""
    b, a = butter(2, 6.0 / (0.5 * rate_hz))
    smooth = filtfilt(b, a, toe_up_radps)
    peaks, _ = find_peaks(smooth, height=0.5 * np.percentile(smooth, 97), distance=int(0.5 * rate_hz))
    return np.asarray(peaks, dtype=np.int64)


def track_foot(track: Track, calibration: FootCalibration) -> list[Outcome]:
    """Phase changes and strides, causally, with default settings."""
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker(track.sensor, settings))
    return tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)


def evaluate_foot(run: str, track: Track, belt_mps: float) -> FootResult:
    """One foot of one run."""
    calibration = calibrate_track(track)
    outcomes = track_foot(track, calibration)
    # the data set's own axis (+y is toe-up on both feet), so that the count does not hang on our calibration
    peaks_ns = track.t_ns[mid_swings(track.gyr_radps[:, 1], track.rate_hz)]
    changes = [outcome for outcome in outcomes if isinstance(outcome, PhaseChange)]
    times = np.array([change.t_ns for change in changes])
    in_order = false_swings = 0
    for begin, end in pairwise(peaks_ns):
        fired = tuple(changes[k].transition for k in np.flatnonzero((times >= begin) & (times < end)))
        in_order += fired == IN_ORDER
        false_swings += max(fired.count(Transition.T2) - 1, 0)
    strides = [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]
    late = [s for s in strides if s.valid and s.t_start_ns >= track.t_ns[-1] - LAST_S * 1e9]
    length_m = sum(s.stride_length_m for s in late)
    time_s = 1e-9 * sum(s.t_end_ns - s.t_start_ns for s in late)
    return FootResult(
        run=run,
        foot=track.sensor,
        belt_mps=belt_mps,
        speed_ratio=length_m / time_s / belt_mps,
        strides=len(peaks_ns) - 1,
        in_order=in_order,
        false_swings=false_swings,
        invalid=sum(not s.valid for s in strides),
        push_off_radps=calibration.push_off_radps,
    )


def evaluate(path: Path) -> list[FootResult]:
    """Both feet of one run."""
    tracks, belt_mps = load_run(path)
    return [evaluate_foot(path.stem, track, belt_mps) for track in tracks.values()]


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 0 when the bar holds, 1 when not, 3 without data."""
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    if not (paths := runs_of(options.data)):
        return 3
    results = [result for path in paths for result in evaluate(path)]
    table = Table("run", "foot", "belt m/s", "speed / belt", "strides", "in order", "%", "false swings", "rest rad/s")
    for r in results:
        known = not np.isnan(r.speed_ratio)
        table.add_row(
            r.run,
            r.foot,
            f"{r.belt_mps:.1f}" if known else "–",
            f"{r.speed_ratio:.4f}" if known else "–",
            str(r.strides),
            str(r.in_order),
            f"{100 * r.in_order / r.strides:.1f}",
            str(r.false_swings),
            f"{r.push_off_radps:.2f}",
        )
    console = console_of(120)
    ratios = np.array([r.speed_ratio for r in results if not np.isnan(r.speed_ratio)])
    strides, in_order = sum(r.strides for r in results), sum(r.in_order for r in results)
    worst = min(results, key=lambda r: r.in_order / r.strides)
    share = in_order / strides
    total = [
        f"Speed over belt, {len(ratios)} feet: mean {ratios.mean():.4f}, SD {ratios.std(ddof=1):.4f}, "
        f"from {ratios.min():.4f} to {ratios.max():.4f}",
        f"Four phases in order: {in_order} of {strides} ({100 * share:.2f} %), worst foot {worst.run} {worst.foot} "
        f"{100 * worst.in_order / worst.strides:.1f} %; false swings per 100 strides: "
        f"{100 * sum(r.false_swings for r in results) / strides:.2f}",
    ]
    console.print(table)
    publish(console, [], options, total)
    return verdict(console, share >= MIN_IN_ORDER and SPEED_BAR[0] <= ratios.min() and ratios.max() <= SPEED_BAR[1])


if __name__ == "__main__":
    raise SystemExit(main())
