"""Who is calibrated, how well, and who is refused: virtual drop feet that nobody chose, and what is no walk forward.

Of each seed the cohort's patient (:mod:`tuning_cohort`): whom the calibration refuses counts, nobody is drawn instead.
The truth is the foot's own mediolateral axis, level; it lies 7° of toe-out from the line across the walk. Turned too
far outward is positive. Planted, of the first feet: the same walk backward (the film runs backward), carried sideways,
standing, and a sensor shaken by hand; of the data folder the board of BROAD and every walk run backward. Each must be
refused for what it is, or answered rightly. Bars: of the virtual feet none refused, within 8° in 95 %, every sign
right.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.spatial.transform import Rotation

from benchmarks.accuracy.orientation import broad
from benchmarks.lib.command_line import parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import FOOT_SETS, feet_of
from benchmarks.loop.tuning_cohort import chosen
from fes.calibration.recording import calibrate_track
from fes.datasets.common import even_track
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.recording import Track
from fes.signals import G_MPS2, NS_PER_S, FloatArray
from fes.simulation.forward import PatientSettings, VirtualPatient
from fes.simulation.forward.closed_loop import recording_of
from fes.simulation.forward.leg import TOE_OUT_RAD
from fes.simulation.sensor import mounting, rotation

WALKED_S, STOOD_S, SHAKEN_S = 25, 30, 30.0
PLANTED = 60
NEAR_DEG, SHARE_NEAR = 8.0, 0.95
SLOW_MPS = 0.36
FAULT_WORDS = (
    "backward", "sideways", "strides found", "no one way forward", "uncertain", "too slow to turn", "off gravity",
    "quietest",
)  # fmt: skip


@dataclass
class Foot:
    """One virtual foot: refused and why, or its axis' errors in degrees."""

    seed: int
    pattern: str
    speed_mps: float
    refused: str = ""
    error_deg: float = float("nan")  # against the foot's own axis
    across_deg: float = float("nan")  # against the line across the walk
    sd_deg: float = float("nan")


def walked(settings: PatientSettings) -> tuple[Track, FloatArray]:
    """Half a minute of a patient's affected foot, and how that foot stood in the room at each sample (N, 3, 3)."""
    patient, foot = VirtualPatient(settings), settings.affected_foot
    track = recording_of(patient, patient.advance(WALKED_S * NS_PER_S), "calibration", "").tracks[foot]
    trace, t_s = patient.trace(foot), 1e-9 * track.t_ns
    yaw, pitch, roll = (np.interp(t_s, trace["t_s"], trace[f"{name}_rad"]) for name in ("yaw", "pitch", "roll"))
    return track, rotation(-pitch, roll, yaw) @ mounting(*settings.placements[foot].angles_deg)


def judged(seed: int, settings: PatientSettings, track: Track) -> Foot:
    """Calibrate one foot as ``fes calibrate`` does."""
    one = Foot(seed, settings.pattern, settings.speed_mps)
    try:
        found = calibrate_track(track)
    except CalibrationError as error:
        return replace(one, refused=str(error))
    up = np.array(found.up)
    own = mounting(*settings.placements[track.sensor].angles_deg)[1]
    own = own - (own @ up) * up
    outward = 1.0 if track.sensor.startswith("left") else -1.0
    off = outward * np.degrees(np.arctan2(up @ np.cross(own, found.toe_down), own @ found.toe_down))
    degrees = (float(each) for each in (off, off + np.degrees(TOE_OUT_RAD), np.degrees(found.axis_sd_rad)))
    return Foot(seed, settings.pattern, settings.speed_mps, "", *degrees)


def reversed_in_time(track: Track) -> Track:
    """The same movement, last sample first: joints go nearly the same way (Winter et al. 1989, Hum Mov Sci 8)."""
    t_ns, t_sensor_ns = track.t_ns, track.t_sensor_ns
    return replace(
        track,
        t_ns=t_ns[0] + t_ns[-1] - t_ns[::-1],
        t_sensor_ns=t_sensor_ns[0] + t_sensor_ns[-1] - t_sensor_ns[::-1],
        acc_mps2=track.acc_mps2[::-1].copy(),
        gyr_radps=-track.gyr_radps[::-1],
    )


def sideways(track: Track, sensor_in_room: FloatArray) -> Track:
    """The same turns, carried a quarter turn to the right of where they went."""
    force = np.einsum("nij,nj->ni", sensor_in_room, track.acc_mps2)
    force = np.column_stack([force[:, 1], -force[:, 0], force[:, 2]])
    return replace(track, acc_mps2=np.einsum("nji,nj->ni", sensor_in_room, force))


def shaken(seed: int) -> Track:
    """A sensor shaken by hand: turned and carried to and fro in three or four ways at 1–4 Hz, with pauses."""
    random, rate_hz = np.random.default_rng(seed), 100.0
    t_s = np.arange(0.0, SHAKEN_S, 1.0 / rate_hz)
    wave = [
        sum(
            random.normal(size=3) * np.sin(2.0 * np.pi * (random.uniform(1.0, 4.0) * t_s[:, None] + random.random(3)))
            for _ in range(4)
        )
        for _ in range(2)
    ]
    held = np.clip(2.0 * np.sin(2.0 * np.pi * t_s / random.uniform(3.0, 8.0)) + 0.5, 0.0, 1.0)[:, None]
    turned = Rotation.from_rotvec(random.uniform(0.1, 0.5) * held * wave[0])
    place = random.uniform(0.01, 0.06) * held * wave[1]
    rate = np.gradient(turned.as_matrix(), 1.0 / rate_hz, axis=0)
    spin = np.einsum("nji,njk->nik", turned.as_matrix(), rate)
    force = np.gradient(np.gradient(place, 1.0 / rate_hz, axis=0), 1.0 / rate_hz, axis=0)
    force[:, 2] += G_MPS2
    noise = random.normal(size=(2, len(t_s), 3)) * np.array([0.02, 0.002])[:, None, None]
    gyr = np.column_stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]])
    return even_track("right_foot", rate_hz, turned.inv().apply(force) + noise[0], gyr + noise[1])


def standing(settings: PatientSettings) -> Track:
    patient = VirtualPatient(settings)
    patient.stay()
    samples = patient.advance(STOOD_S * NS_PER_S)
    return recording_of(patient, samples, "standing", "").tracks[settings.affected_foot]


def planted(
    feet: list[tuple[PatientSettings, Track, FloatArray]], data: Path
) -> Iterator[tuple[str, str, Track, Track]]:
    """What is no walk forward: its name, the word that a refusal should have, the track, and the walk it comes from."""
    for number, (settings, track, in_room) in enumerate(feet):
        yield "virtual, backward", "backward", reversed_in_time(track), track
        yield "virtual, sideways", "sideways", sideways(track, in_room), track
        yield "virtual, standing", "strides found", standing(settings), track
        yield "shaken by hand", "", shaken(number), track
    for trial in broad(data):
        yield "a board", "", even_track("right_foot", trial.rate_hz, trial.acc_mps2, trial.gyr_radps), track
    for foot in feet_of(data, FOOT_SETS):
        yield f"{foot.data_set}, backward", "backward", reversed_in_time(foot.track), foot.track


def outcome(word: str, track: Track, source: Track) -> str:
    """What became of it: refused and by which of the words, or answered with an axis of that sign."""
    try:
        found = calibrate_track(track)
    except CalibrationError as error:
        said = next((each for each in FAULT_WORDS if each in str(error)), "other words")
        return f"refused: {said}"
    try:
        forward: FootCalibration | None = calibrate_track(source)
    except CalibrationError:
        forward = None
    if word != "backward" or forward is None:
        return "answered"
    return f"answered, sign {'right' if np.dot(found.toe_down, forward.toe_down) > 0.0 else 'wrong'}"


def axis_table(feet: list[Foot]) -> Table:
    """Refusals, signs and percentiles of the axis' error: all, and the slow ones."""
    table = Table("virtual drop feet", "n", "refused", "sign wrong", "off, median (5–95 %)°", "|off| 50/90/95/100 %°",
                  f"within {NEAR_DEG:g}°", "against the line across: 95 %°, within", "told SD, median°")  # fmt: skip
    groups = {"all": feet, f"up to {SLOW_MPS} m/s": [one for one in feet if one.speed_mps <= SLOW_MPS]}
    for name, own in groups.items():
        off, across, sd = (
            np.array([getattr(one, key) for one in own if not one.refused])
            for key in ("error_deg", "across_deg", "sd_deg")
        )
        if not len(off):
            continue
        size = np.percentile(np.abs(off), [50, 90, 95, 100])
        low, high = np.percentile(off, [5, 95])
        table.add_row(
            name, str(len(own)), str(sum(bool(one.refused) for one in own)), str(int((np.abs(off) > 90.0).sum())),
            f"{np.median(off):+.1f} ({low:+.1f} … {high:+.1f})", " / ".join(f"{value:.1f}" for value in size),
            f"{100.0 * (np.abs(off) <= NEAR_DEG).sum() / len(own):.1f} %",
            f"{np.percentile(np.abs(across), 95):.1f}, {100.0 * (np.abs(across) <= NEAR_DEG).sum() / len(own):.1f} %",
            f"{np.median(sd):.1f}",
        )  # fmt: skip
    return table


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--first", type=int, default=8000)
    parser.add_argument("--patients", type=int, default=300)
    options = parser.parse_args(arguments)
    feet: list[Foot] = []
    sources: list[tuple[PatientSettings, Track, FloatArray]] = []
    for seed in range(options.first, options.first + options.patients):
        settings, _ = chosen(seed)
        track, in_room = walked(settings)
        feet.append(judged(seed, settings, track))
        if len(sources) < PLANTED:
            sources.append((settings, track, in_room))
    counts: dict[str, Counter[str]] = {}
    for name, word, track, source in planted(sources, options.data):
        counts.setdefault(name, Counter())[outcome(word, track, source)] += 1
    rows = [
        [name, str(became.total()), "; ".join(f"{count} {words}" for words, count in became.most_common())]
        for name, became in counts.items()
    ]
    table = table_of("", ("planted", "n", "what became of it"), rows)
    off = [
        f"{one.seed} {one.pattern} {one.speed_mps} m/s: {one.refused or f'{one.error_deg:+.1f}°'}"
        for one in feet
        if one.refused or abs(one.error_deg) > NEAR_DEG
    ]
    publish([axis_table(feet), table], options, off)
    near = sum(abs(one.error_deg) <= NEAR_DEG for one in feet) >= SHARE_NEAR * len(feet)
    signs = not any(abs(one.error_deg) > 90.0 for one in feet)
    return verdict(near and signs and not any(one.refused for one in feet))


if __name__ == "__main__":
    raise SystemExit(main())
