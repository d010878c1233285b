"""The foot's roll at initial contact against what is true: virtual patients live, and a walk with optical markers.

    python benchmarks/roll.py [--data FOLDER] [--patients N] [--seed N] [--json FILE]

Virtual: patients drawn by number, each calibrated on half a minute without stimulation, then walked live for a minute
(the controller's own strides): without stimulation, with one channel on tibialis anterior (30 mA, 300 µs; it inverts
the foot), and with it while the sensor sits turned by 15, −10 and 40° (roll, pitch, yaw) beyond where it was drawn.
Figures are estimate − truth in degrees over the strides of all patients, and the means of single patients. The bars are
for the former: 1.5° for the mean, 2° for the SD.

Markers: gaitmap_walk, lateral shoes, heel, toe and fifth metatarsal; roll is the angle of the markers' mediolateral
axis against the horizontal since the stride's start. The markers' long axis is the line from heel to toe, the sensor's
is at right angles to the axis about which the foot swings: no sensor knows where the toe is. So the markers are shown
with their own long axis, and with it turned inward by the angle that fits best from mid-swing to contact (one of each
foot, found on these strides): by how much the first row errs more is the axis's doing, not the measurement's.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from closed_loop_walk import calibration_of, walk
from command_line import console_of, parser_of, save, verdict
from real_sets import PathWalk, gaitmap_walk
from rich.table import Table
from scipy.optimize import minimize_scalar
from stroke_treadmill import data_folder, track_foot
from tuning_cohort import channel_of, session_with

from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import CalibrationError
from fes.signals import FloatArray, StrideResult
from fes.simulation.forward import PatientSettings, VirtualPatient, draw_patient
from fes.simulation.sensor import Placement
from fes.stimulation.tuning.targets import roll_at_contact_rad, times_ns

FOOT = "right_foot"
SEED, PATIENTS, SECONDS, STRIDES = 4711, 15, 60.0, 60
CURRENT_MA = 30.0
TURNED_DEG = (15.0, -10.0, 40.0)
NEAR_NS = 100_000_000
SWING_POINTS = 21
BIAS_DEG, SD_DEG = 1.5, 2.0


@dataclass(frozen=True)
class Row:
    """One condition: mean and SD of all strides' errors, the same of the true angle, and each patient's mean (°)."""

    condition: str
    strides: int
    bias_deg: float
    sd_deg: float
    true_deg: tuple[float, float]
    patients_deg: dict[str, float]


def turned(settings: PatientSettings) -> PatientSettings:
    """The same person with the sensor strapped on askew."""
    where = settings.placements[FOOT]
    roll, pitch, yaw = (a + b for a, b in zip(where.angles_deg, TURNED_DEG, strict=True))
    return replace(settings, placements={**settings.placements, FOOT: Placement(where.body_m, (roll, pitch, yaw))})


def live_errors(settings: PatientSettings, current_ma: float) -> FloatArray:
    """(K, 2) of the strides of one walk in degrees: roll at contact, live, and as it was.

    Raises:
        CalibrationError: the walk before shows no axis.
    """
    calibration = calibration_of(settings)
    channels = (channel_of(current_ma),) if current_ma else ()
    session = session_with(VirtualPatient(settings).geometry[FOOT], *channels)
    done = walk(settings, session, calibration, SECONDS, STRIDES)
    pairs = []
    for stride in done.measured:
        contact_ns, roll = stride.t_loading_response_ns, roll_at_contact_rad(stride)
        near = [s for s in done.strides if contact_ns is not None and abs(s.t_contact_ns - contact_ns) < NEAR_NS]
        if stride.valid and near and math.isfinite(roll):
            pairs.append((math.degrees(roll), math.degrees(near[0].inversion_at_contact_rad)))
    return np.array(pairs).reshape(-1, 2)


def virtual_rows(seed: int, patients: int) -> Iterator[Row]:
    """The three conditions."""
    for condition, current_ma, askew in (
        ("no stimulation", 0.0, False),
        ("stimulated", CURRENT_MA, False),
        ("stimulated, sensor turned", CURRENT_MA, True),
    ):
        found = {}
        for number in range(patients):
            settings = draw_patient(seed, number, sensors=(FOOT,))
            try:
                found[str(number)] = live_errors(turned(settings) if askew else settings, current_ma)
            except CalibrationError as error:
                print(f"{condition}, patient {number} not calibrated: {error}", flush=True)
        yield row_of(condition, found)


def row_of(condition: str, found: dict[str, FloatArray]) -> Row:
    """Of (K, 2) angles by who they are of."""
    every = np.vstack(list(found.values()))
    errors, true = every[:, 0] - every[:, 1], every[:, 1]
    means = {name: float(np.mean(own[:, 0] - own[:, 1])) for name, own in found.items() if len(own)}
    spread = float(true.mean()), float(true.std(ddof=1))
    return Row(condition, len(every), float(errors.mean()), float(errors.std(ddof=1)), spread, means)


def marked_swings(one: PathWalk) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Of every straight stride its roll (M,) in rad at equal steps from mid-swing to contact, and how far up the
    markers' forward and inner axes point then and, last, at the stride's start (M + 1, 2).
    """
    inward = 1.0 if one.name == "right" else -1.0
    frame = one.frame if one.frame is not None else np.empty((0, 3, 3))
    up, at_s = np.column_stack((frame[:, 2, 0], inward * frame[:, 2, 1])), np.arange(len(frame)) / one.rate_hz
    for stride in track_foot(one.track, calibrate_track(one.track)):
        if not isinstance(stride, StrideResult) or not stride.valid or not one.comparable(stride):
            continue
        off_ns, contact_ns = stride.t_swing_ns, stride.t_loading_response_ns
        if off_ns is None or contact_ns is None:
            continue
        when_s = 1e-9 * np.append(np.linspace(0.5 * (off_ns + contact_ns), contact_ns, SWING_POINTS), stride.t_start_ns)
        marked = np.column_stack([np.interp(when_s, at_s, up[:, k], math.nan, math.nan) for k in range(2)])
        if np.isfinite(marked).all():
            yield np.interp(when_s[:-1], 1e-9 * np.array(times_ns(stride)), stride.roll_rad), marked


def marked_roll(marked: FloatArray, inward_rad: float) -> FloatArray:
    """(M,) rad by the markers, their long axis turned inward by so much."""
    ahead, inner = marked.T
    roll = np.arcsin(np.clip(math.cos(inward_rad) * inner - math.sin(inward_rad) * ahead, -1.0, 1.0))
    return np.asarray(roll[:-1] - roll[-1])


def marker_rows(folder: Path) -> Iterator[Row]:
    """At contact on the walk with markers: by the markers' long axis, and by the sensor's."""
    own_axis, same_axis, apart_deg = {}, {}, []
    for one in gaitmap_walk(folder):
        if not isinstance(one, PathWalk):
            continue
        swings = list(marked_swings(one))

        def apart(inward_rad: float, swings: list[tuple[FloatArray, FloatArray]] = swings) -> float:
            return sum(float(np.sum((roll - marked_roll(marked, inward_rad)) ** 2)) for roll, marked in swings)

        inward_rad = minimize_scalar(apart, bounds=(-0.6, 0.6), method="bounded").x
        apart_deg.append(f"{math.degrees(inward_rad):.0f}°")
        for found, angle_rad in ((own_axis, 0.0), (same_axis, inward_rad)):
            pairs = [(roll[-1], marked_roll(marked, angle_rad)[-1]) for roll, marked in swings]
            found[one.name] = np.degrees(pairs)
    if own_axis:
        yield row_of("markers, heel to toe", own_axis)
        yield row_of(f"markers, turned inward by {' and '.join(apart_deg)}", same_axis)


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 0 when the bars hold on the virtual patients, 1 when not."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--patients", type=int, default=PATIENTS)
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args(arguments)
    virtual = list(virtual_rows(options.seed, options.patients))
    rows = [*virtual, *marker_rows(options.data)]
    console = console_of(130)
    table = Table("roll", "strides", "error °", "true °", "means of patients or feet, °")
    for row in rows:
        means = " ".join(f"{value:+.1f}" for value in row.patients_deg.values())
        true = f"{row.true_deg[0]:+.1f} ± {row.true_deg[1]:.1f}"
        table.add_row(row.condition, str(row.strides), f"{row.bias_deg:+.2f} ± {row.sd_deg:.2f}", true, means)
    console.print(table)
    console.print("estimate − truth at initial contact, inversion positive, mean ± SD over strides")
    save([vars(row) for row in rows], options.json)
    held = all(abs(row.bias_deg) <= BIAS_DEG and row.sd_deg <= SD_DEG for row in virtual)
    return verdict(console, held, several=True)


if __name__ == "__main__":
    raise SystemExit(main())
