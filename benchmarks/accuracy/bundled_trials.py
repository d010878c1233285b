"""Phases, stride length and clearance on the bundled trials against their truth; exit code 1 if the bar fails.

    python benchmarks/accuracy/bundled_trials.py [--json FILE]

The bar is Table 2 of Negård et al. (2005), the better of its two patients: stride length error mean 1.7 cm, SD 1.7 cm;
clearance error mean 0.3 cm, SD 0.4 cm. Strides during which the belt changes its speed are left out (``steady`` = no in
the truth): what an inertial sensor measures then is not the way on the belt.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import console_of, parser_of, publish, verdict
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.recording import Recording, read_recording
from fes.signals import StrideResult
from fes.simulation.truth import TruthStride, load_truth

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
NAMES = (
    "negard_patient1",
    "negard_patient2",
    "both_feet_100hz",
    "both_feet_200hz",
    "misaligned",
    "soft_contact",
    "not_walking",
)
LENGTH_BAR_M = (0.017, 0.017)
CLEARANCE_BAR_M = (0.003, 0.004)


@dataclass(frozen=True)
class Errors:
    """Mean and SD of estimate − truth of one foot of one trial; lengths in m, times in s, NaN where there is none."""

    trial: str
    foot: str
    strides: int
    found: int
    in_order: int
    length_m: tuple[float, float]
    clearance_m: tuple[float, float]
    toe_clearance_m: tuple[float, float]
    heel_clearance_m: tuple[float, float]
    initial_contact_s: tuple[float, float]
    foot_off_s: tuple[float, float]

    @property
    def holds(self) -> bool:
        """Whether length and clearance meet the bar."""
        pairs = ((self.length_m, LENGTH_BAR_M), (self.clearance_m, CLEARANCE_BAR_M))
        return all(abs(error[0]) <= bar[0] and error[1] <= bar[1] for error, bar in pairs)


def strides_of(recording: Recording, foot: str) -> list[StrideResult]:
    """All strides that the tracker finds, with the recording's own calibration and geometry."""
    track = recording.tracks[foot]
    calibration = calibrate_track(track)
    settings = stride_settings(calibration, recording.geometry.get(foot))
    tracker = FootTracker(calibration, StrideMaker(foot, settings))
    outcomes = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    return [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]


def compare(recording: Recording, foot: str, truth: list[TruthStride]) -> Errors:
    """One foot: each true stride with the estimated one that holds its foot off."""
    estimates = strides_of(recording, foot)
    pairs = []
    for true in truth:
        found = next((s for s in estimates if s.t_start_ns < 1e9 * true.t_swing_s < s.t_end_ns), None)
        if found is not None and found.valid:
            pairs.append((found, true))
    in_order = sum(
        None not in (s.t_pre_swing_ns, s.t_swing_ns, s.t_loading_response_ns, s.t_stance_ns) for s, _ in pairs
    )
    return Errors(
        trial=recording.name,
        foot=foot,
        strides=len(truth),
        found=len(pairs),
        in_order=in_order,
        length_m=_spread([s.stride_length_m - t.stride_length_m for s, t in pairs]),
        clearance_m=_spread([s.clearance_m - t.clearance_m for s, t in pairs]),
        toe_clearance_m=_spread([s.toe_clearance_m - t.toe_clearance_m for s, t in pairs]),
        heel_clearance_m=_spread([s.heel_clearance_m - t.heel_clearance_m for s, t in pairs]),
        initial_contact_s=_spread(
            [
                1e-9 * s.t_loading_response_ns - t.t_loading_response_s
                for s, t in pairs
                if s.t_loading_response_ns is not None
            ]
        ),
        foot_off_s=_spread([1e-9 * s.t_swing_ns - t.t_swing_s for s, t in pairs if s.t_swing_ns is not None]),
    )


def _spread(values: list[float]) -> tuple[float, float]:
    if len(values) < 2:
        return float("nan"), float("nan")
    return float(np.mean(values)), float(np.std(values, ddof=1))


def evaluate(name: str) -> list[Errors]:
    """Every foot of one trial."""
    recording = read_recording(TRIALS / f"{name}.parquet")
    truth = load_truth(TRIALS / f"{name}.parquet")
    return [
        compare(recording, foot, [s for s in truth.strides_of(foot) if s.steady and s.walking])
        for foot in recording.tracks
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    options = parser_of(__doc__).parse_args(arguments)
    results = [errors for name in NAMES for errors in evaluate(name)]
    table = Table(
        "trial",
        "foot",
        "strides",
        "found",
        "4 phases",
        "length cm",
        "clearance cm",
        "toe cm",
        "heel cm",
        "IC ms",
        "FO ms",
    )
    for e in results:
        cells = [_cell(v, 100.0, 2) for v in (e.length_m, e.clearance_m, e.toe_clearance_m, e.heel_clearance_m)]
        cells += [_cell(v, 1000.0, 0) for v in (e.initial_contact_s, e.foot_off_s)]
        table.add_row(e.trial, e.foot, str(e.strides), str(e.found), str(e.in_order), *cells)
    console = console_of(150)
    publish(console, [table], options, ["Errors are estimate − truth, mean ± SD."])
    return verdict(console, all(e.holds and e.found == e.strides for e in results))


def _cell(value: tuple[float, float], scale: float, digits: int) -> str:
    return "–" if np.isnan(value[0]) else f"{scale * value[0]:+.{digits}f} ± {scale * value[1]:.{digits}f}"


if __name__ == "__main__":
    raise SystemExit(main())
