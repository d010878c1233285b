"""The tables of the four papers, their published values beside ours: docs/paper_tables.md.

Negård et al. (``--simulated``): the bundled trials imitate their two patients (simulated: the same set-up, not the same
people), held against the bundled 25 Hz ultrasonic reference, as `fes evaluate` does. Without that option: Kumar et al.
print no figures: IC and FO against markers. Wu et al.: shanks of stroke survivors on a belt; the error of the distance
is that of the mean speed in the last 120 s. Wang et al.: the same for the feet, with their parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.accuracy.shank_phases import evaluate as shanks_of
from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of
from benchmarks.lib.real_sets import LAST_S, TRIALS, data_folder, runs_of
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.datasets import read_file
from fes.evaluation.agreement import Differences
from fes.evaluation.reference.compare import from_analysis
from fes.evaluation.reference.evaluation import BOTH, Settings, evaluate
from fes.evaluation.reference.read import read_references
from fes.evaluation.reference.table import Reference, ReferenceEvent
from fes.recording import Recording, read_recording
from fes.simulation.truth import Truth, load_truth

Cells = list[list[str]]
PHASES = ("pre_swing", "swing", "loading_response", "stance")
DEG = 57.29578
WANG = {
    "stride_length_common_m": ("SL, m", 1.0, 2), "swing_s": ("swing, s", 1.0, 2), "stance_s": ("stance, s", 1.0, 2),
    "position_variation_m": ("PV, m", 1.0, 2), "orientation_variation_rad": ("OV, deg", DEG, 1),
    "deviation_m": ("MDD, m", 1.0, 2), "lift_m": ("MLH, m", 1.0, 2), "heel_rotation_rad": ("MLR, deg", DEG, 1),
}  # fmt: skip

# of their Table 2: the control and the first of five hemiparetic gaits, side by side with WANG
PUBLISHED_WANG = """
published, H, 1.37 ± 0.06, 0.61 ± 0.02, 0.51 ± 0.06, 0.07 ± 0.02, 7.4 ± 1.7, 0.02 ± 0.03, 0.14 ± 0.01, 61.2 ± 1.1
published H1, A, 0.83 ± 0.08, 1.54 ± 0.25, 1.04 ± 0.40, 0.10 ± 0.04, 10.6 ± 4.8, 0.02 ± 0.03, 0.04 ± 0.01, 44.0 ± 9.9
the same, H, 0.85 ± 0.06, 0.44 ± 0.04, 2.05 ± 0.21, 0.14 ± 0.10, 7.0 ± 3.3, 0.04 ± 0.03, 0.26 ± 0.16, 64.8 ± 2.9
"""


def analysed(recording: Recording) -> Analysis:
    recording, found = calibrations_of(recording)
    return analyse(recording, found.calibrations)


def negard() -> list[Table]:
    published = {  # mean and SD of both patients
        "stride_length_m": ("stride length, cm", ("3.63", "1.65"), ("1.74", "3.32")),
        "clearance_m": ("clearance, cm", ("0.30", "0.38"), ("0.50", "1.30")),
    }
    errors, phases = [], []
    for k, name in enumerate(("negard_patient1", "negard_patient2")):
        analysis = analysed(read_recording(TRIALS / f"{name}.parquet"))
        reference = read_references([TRIALS / f"{name}.reference.csv"], foot="right_foot")
        settings = Settings(belt_mps=analysis.recording.belt_speed_mps, fit_lag=True)
        result = evaluate(from_analysis(analysis), reference, settings)
        rows = {row.quantity: row for row in result.rows}
        for key, (what, *theirs) in published.items():
            row = rows[key]
            ours = *agreement(row.differences, 100.0, 2), f"{row.icc.value:.2f}", str(row.differences.n)
            errors.append([f"patient {k + 1}", what, *theirs[k], *ours])
        if k == 1:
            phases = phase_durations(analysis, load_truth(TRIALS / f"{name}.parquet"))
    head = ["patient", "error", "published mean", "published SD", "our mean", "our SD", "limits", "ICC", "n"]
    title = "Negård et al., Table 2: errors against the ultrasonic reference (theirs: patients; ours: simulated)"
    named = ["", "pre-swing", "swing", "loading", "stance"]
    first = table_of("Negård et al., Table 1: phase durations, patient 2", named, phases)
    return [first, table_of(title, head, errors)]


def phase_durations(analysis: Analysis, truth: Truth) -> Cells:
    """As detected, causally, and as the simulated patient really moved."""
    ours = [
        [t and 1e-9 * t for t in (s.t_pre_swing_ns, s.t_swing_ns, s.t_loading_response_ns, s.t_stance_ns)]
        for s in analysis.strides
        if s.valid
    ]
    true = [[s.t_pre_swing_s, s.t_swing_s, s.t_loading_response_s, s.t_stance_s] for s in truth.strides if s.steady]
    return [
        ["published, mean", "0.40 s", "0.69 s", "0.19 s", "0.74 s"],
        ["published, SD", "5.0 %", "4.0 %", "20.8 %", "8.6 %"],
        *means_and_spreads("ours, detected as in a session", ours),
        *means_and_spreads("truth of the simulated patient", true),
    ]


def means_and_spreads(who: str, begins: Sequence[Sequence[float | None]]) -> Cells:
    lasted: list[list[float]] = [[] for _ in PHASES]
    for k, own in enumerate(begins):
        following = begins[k + 1][0] if k + 1 < len(begins) else None
        for phase, begin, end in zip(lasted, own, [*own[1:], following], strict=True):
            if begin is not None and end is not None:
                phase.append(end - begin)
    means = [f"{np.mean(phase):.2f} s" for phase in lasted]
    return [
        [f"{who}, mean", *means],
        [f"{who}, SD", *(f"{100 * np.std(phase, ddof=1) / np.mean(phase):.1f} %" for phase in lasted)],
    ]


def kumar(folder: Path) -> list[Table]:
    imported = read_file("gaitmap", folder / "gaitmap_walk" / "imu_sample.csv")
    rows = list(imported.references[".events.csv"][1])
    events = tuple(sorted(ReferenceEvent(float(t), str(foot), str(what)) for foot, what, t in rows))
    result = evaluate(from_analysis(analysed(imported.recording)), Reference(("gaitmap",), events))
    cells = [
        [row.about.label, str(row.differences.n), *agreement(row.differences, row.about.factor, 1)]
        for row in result.rows
        if row.foot == BOTH
    ]
    missed, extra = (sum(getattr(count, what) for count in result.counts) for what in ("missed", "extra"))
    title = f"Kumar et al. (no figures printed): IC and FO off-line, gaitmap; {missed} missed, {extra} extra"
    return [table_of(title, ["quantity, ms", "n", "mean", "SD", "limits"], cells)]


def agreement(d: Differences, factor: float, digits: int) -> list[str]:
    """Mean, SD and limits of agreement."""
    limits = " … ".join(f"{factor * limit.value:+.{digits}f}" for limit in (d.lower_limit, d.upper_limit))
    return [f"{factor * d.bias.value:+.{digits}f}", f"{factor * d.sd:.{digits}f}", limits]


def belt_runs(folder: Path) -> list[Path]:
    """Those on a belt of known speed."""
    return [path for path in runs_of(folder) if np.isfinite(float(np.load(path)["belt_speed"]))]


def wu(folder: Path, feet: dict[str, float]) -> list[Table]:
    values = 100 * np.array([
        [abs(side.zupt - 1.0), abs(side.learnt - 1.0), feet[f"{path.stem} {side.sensor.removesuffix('_shank')}"]]
        for path in belt_runs(folder) for side in shanks_of(path)
    ])  # fmt: skip
    rows = [
        ["published, mean of 10 healthy (columns as printed)", "13.44", "3.58", "2.33"],
        ["the same, worked out from the printed rows", "13.44", "3.53", "2.33"],
        [f"ours, mean of {len(values)} sides of stroke survivors", *(f"{v:.2f}" for v in values.mean(axis=0))],
        ["ours, worst side", *(f"{v:.2f}" for v in values.max(axis=0))],
    ]
    head = ["error of the distance, %", "ankle, ZUPT", "ankle, non-ZUPT", "foot (theirs: ZUPT; ours: as `fes analyse`)"]
    return [table_of("Wu et al., Table I: level walking (theirs over ground; ours on a belt)", head, rows)]


def wang(folder: Path) -> tuple[list[Table], dict[str, float]]:
    errors: dict[str, float] = {}
    parameters: Cells = []
    for path in belt_runs(folder):
        recording = read_file("stroke_treadmill", path).recording
        analysis, since = analysed(recording), 1e9 * (max(t.duration_s for t in recording.tracks.values()) - LAST_S)
        for foot in ("left_foot", "right_foot"):
            late = [s for s in analysis.strides if s.foot == foot and s.valid and s.t_start_ns >= since]
            speed = sum(s.stride_length_m for s in late) / (1e-9 * sum(s.t_end_ns - s.t_start_ns for s in late))
            errors[f"{path.stem} {foot.removesuffix('_foot')}"] = abs(speed / (recording.belt_speed_mps or 1.0) - 1)
        if path.stem.endswith("FBIC"):
            for foot, found in gait_parameters(analysis).feet.items():
                cells = [
                    f"{unit * found[k].mean:.{digits}f} ± {unit * found[k].sd:.{digits}f}" if k in found else "–"
                    for k, (_, unit, digits) in WANG.items()
                ]
                parameters.append([path.stem, foot.removesuffix("_foot"), *cells])
    percent = 100.0 * np.array(list(errors.values()))
    distance = [
        ["published, healthy, over ground", "3.08 ± 1.77"],
        ["published, hemiparetic walks: healthy side", "1.01 ± 0.72"],
        ["published, hemiparetic walks: afflicted side", "3.55 ± 3.60"],
    ]
    ours = f"ours, stroke survivors on a belt, {len(percent)} feet (sides not known)"
    distance.append([ours, f"{percent.mean():.2f} ± {percent.std(ddof=1):.2f}"])
    published = [[cell.strip() for cell in line.split(",")] for line in PUBLISHED_WANG.strip().splitlines()]
    title = "Wang et al., Table 2: parameters (H healthy, A afflicted side; ours: the runs FBIC)"
    return [
        table_of("Wang et al.: absolute error of the distance, %", ["", "mean ± SD"], distance),
        table_of(title, ["walk", "side", *(name for name, _, _ in WANG.values())], published + parameters),
    ], errors


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--simulated", action="store_true", help="those of the bundled trials")
    options = parser.parse_args(arguments)
    folder = data_folder()
    if options.simulated:
        publish(negard(), options)
    elif (folder / "gaitmap_walk").is_dir() and belt_runs(folder):
        of_wang, errors = wang(folder)
        publish([*kumar(folder), *wu(folder, errors), *of_wang], options, folder=folder)
    else:
        return no_recordings(folder)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
