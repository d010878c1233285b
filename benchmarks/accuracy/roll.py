"""The foot's roll at initial contact against what is true: virtual patients live, and a walk with optical markers.

    python benchmarks/accuracy/roll.py [--data FOLDER] [--patients N] [--seed N] [--json FILE]

Virtual: patients drawn by number, each calibrated on half a minute without stimulation, then walked live for a minute
(the controller's own strides): without stimulation, with one channel on tibialis anterior (30 mA, 300 µs; it inverts
the foot), and with it while the sensor sits turned by 15, −10 and 40° (roll, pitch, yaw) beyond where it was drawn.
Figures are estimate − truth in degrees over the strides of all patients, and the means of single patients. The bars are
for the former: 1.5° for the mean, 2° for the SD.

Markers: gaitmap_walk, lateral shoes, heel, toe and fifth metatarsal; roll is the angle of the markers' mediolateral
axis against the horizontal since the stride's start, their long axis the line from heel to toe.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import console_of, parser_of, publish, verdict
from benchmarks.lib.real_sets import PathWalk, data_folder, gaitmap_walk
from benchmarks.lib.walkers import outcomes_of
from benchmarks.loop.closed_loop_walk import calibration_of, walk
from benchmarks.loop.tuning_cohort import channel_of, session_with
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import CalibrationError
from fes.signals import FloatArray, StrideResult
from fes.simulation.forward import PatientSettings, VirtualPatient, draw_patient
from fes.simulation.sensor import Placement
from fes.stimulation.contact import roll_at_contact_rad

FOOT = "right_foot"
SEED, PATIENTS, SECONDS, STRIDES = 4711, 15, 60.0, 60
CURRENT_MA = 30.0
TURNED_DEG = (15.0, -10.0, 40.0)
NEAR_NS = 100_000_000
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


def marker_rows(folder: Path) -> Iterator[Row]:
    """At contact, straight strides of the walk with markers; none without it."""
    found = {}
    for one in gaitmap_walk(folder):
        if not isinstance(one, PathWalk) or one.frame is None:
            continue
        inward = 1.0 if one.name == "right" else -1.0
        marked, at_s = inward * np.arcsin(one.frame[:, 2, 1]), np.arange(len(one.frame)) / one.rate_hz
        pairs = []
        for stride in outcomes_of(one.track, calibrate_track(one.track)):
            if not isinstance(stride, StrideResult) or not stride.valid or not one.comparable(stride):
                continue
            contact_ns, roll = stride.t_loading_response_ns, roll_at_contact_rad(stride)
            if contact_ns is not None:
                start, end = np.interp((1e-9 * stride.t_start_ns, 1e-9 * contact_ns), at_s, marked, math.nan, math.nan)
                pairs.append((roll, end - start))
        angles = np.degrees(pairs)
        found[one.name] = angles[np.isfinite(angles).all(axis=1)]
    if found:
        yield row_of("gaitmap walk, markers", found)


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
    said = "Estimate − truth at initial contact, inversion positive, mean ± SD over strides."
    publish(console, [table], options, [said])
    held = all(abs(row.bias_deg) <= BIAS_DEG and row.sd_deg <= SD_DEG for row in virtual)
    return verdict(console, held)


if __name__ == "__main__":
    raise SystemExit(main())
