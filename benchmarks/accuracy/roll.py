"""The foot's roll at initial contact against what is true: virtual patients live, and a walk with optical markers.

Virtual: patients drawn by number, each calibrated on half a minute without stimulation, then walked live for a minute:
without stimulation, with one channel on tibialis anterior (it inverts the foot), and with it while the sensor sits
turned by 15, −10 and 40° (roll, pitch, yaw) beyond where it was drawn. The bars are for the errors of all strides: 1.5°
for the mean, 2° for the SD. Markers: gaitmap_walk; roll is the angle of the markers' mediolateral axis against the
horizontal since the stride's start.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import mean_sd, parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import data_folder, gaitmap_walk
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


def virtual(seed: int, patients: int) -> Iterator[tuple[str, list[FloatArray]]]:
    """Each condition with the angles (K, 2) of every patient."""
    for condition in ("no stimulation", "stimulated", "stimulated, sensor turned"):
        current_ma, askew = 0.0 if condition.startswith("no") else CURRENT_MA, "turned" in condition
        found = []
        for number in range(patients):
            settings = draw_patient(seed, number, sensors=(FOOT,))
            try:
                found.append(live_errors(turned(settings) if askew else settings, current_ma))
            except CalibrationError as error:
                print(f"{condition}, patient {number} not calibrated: {error}", flush=True)
        yield condition, found


def marked(folder: Path) -> Iterator[tuple[str, list[FloatArray]]]:
    """At contact, straight strides of the walk with markers; none without it."""
    found = []
    for one in gaitmap_walk(folder):
        assert one.frame is not None
        inward = 1.0 if one.name == "right" else -1.0
        angle, at_s = inward * np.arcsin(one.frame[:, 2, 1]), np.arange(len(one.frame)) / one.rate_hz
        pairs = []
        for stride in outcomes_of(one.track, calibrate_track(one.track)):
            if not isinstance(stride, StrideResult) or not stride.valid or not one.comparable(stride):
                continue
            contact_ns, roll = stride.t_loading_response_ns, roll_at_contact_rad(stride)
            if contact_ns is not None:
                start, end = np.interp((1e-9 * stride.t_start_ns, 1e-9 * contact_ns), at_s, angle, math.nan, math.nan)
                pairs.append((roll, end - start))
        angles = np.degrees(pairs)
        found.append(angles[np.isfinite(angles).all(axis=1)])
    if found:
        yield "gaitmap walk, markers", found


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--patients", type=int, default=PATIENTS)
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args(arguments)
    rows, held = [], True
    for condition, found in (*virtual(options.seed, options.patients), *marked(options.data)):
        errors, true = (np.vstack(found) @ axes for axes in ((1.0, -1.0), (0.0, 1.0)))
        means = " ".join(f"{np.mean(own[:, 0] - own[:, 1]):+.1f}" for own in found if len(own))
        rows.append([condition, str(len(errors)), mean_sd(errors, 2), mean_sd(true, 1), means])
        held &= "markers" in condition or bool(abs(errors.mean()) <= BIAS_DEG and errors.std(ddof=1) <= SD_DEG)
    table = table_of("", ("roll", "strides", "error °", "true °", "means of patients or feet, °"), rows)
    said = "Estimate − truth at initial contact, inversion positive, mean ± SD over strides."
    publish([table], options, [said])
    return verdict(held)


if __name__ == "__main__":
    raise SystemExit(main())
