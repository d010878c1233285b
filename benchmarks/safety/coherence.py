"""Accelerometer against gyroscope: false alarms on every walk there is, and how soon a triad that lies is told.

    python benchmarks/safety/coherence.py [--moments N] [--patients N] [--first SEED] [--only SET …] [--json FILE]

The gate's own judge (``fes.gate.plausibility``) reads every recording of the data folder and its ``unseen_walkers`` as
it is, and so many walks of virtual patients (a quarter of them at 0.2–0.36 m/s; a foot and a shank each): it must say
nothing. Left out: the footswitch set's P06, whose accelerometer lies (README of the data), and in that set whatever
lies within 3 s of a stall, a burst of late samples, or of a turn without any noise:
there its numbers were made up by whoever resampled it.

Then faults that last are put in at random moments of stance and of swing, and it is counted how many are told within a
stride (1.5 s), and how many before the next pre-swing begins. "stuck" holds the value of the moment, with a sensor's
noise on it (0.05 m/s², 0.02 rad/s); "frozen" without. The main axis is the one that turns most.
Exit code 1 at a false alarm, 3 without data.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from random import Random

import numpy as np
from rich.table import Table

from benchmarks.lib.command_line import console_of, parser_of, save
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import SETS, feet_of
from benchmarks.loop.tuning_cohort import drawn
from benchmarks.safety.wrong_unit import sensors as labelled_sensors
from benchmarks.safety.wrong_unit import swings
from fes.datasets.common import even_track
from fes.estimation.foot.calibration import CalibrationError
from fes.gate.plausibility import Plausibility
from fes.recording import Track
from fes.signals import G_MPS2, NS_PER_S, FloatArray, ImuSample, Vector3
from fes.simulation.forward import VirtualPatient

STRIDE_S, BEFORE_S, LONGEST_S = 1.5, 20.0, 3.0  # what is usual of a person is learnt in the 20 s before
LYING = "P06"
STALL_NS, AROUND_NS = 60_000_000, 3 * NS_PER_S
ACC_NOISE, GYR_NOISE = 0.05, 0.02

Fault = Callable[[FloatArray, FloatArray, np.random.Generator, float], None]
"""Changes force and rate (N, 3) in place, from the fault's first sample on; last the sampling rate."""


def held(which: int, axes: str, noise: float) -> Fault:
    def fault(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float) -> None:
        main = int(np.argmax(gyr.std(axis=0)))
        chosen = {"all": [0, 1, 2], "main": [main], "other": [(main + 1 + int(rng.integers(2))) % 3]}[axes]
        values = (acc, gyr)[which]
        for axis in chosen:
            values[:, axis] = values[0, axis] + rng.normal(0.0, noise, len(values)) if noise else values[0, axis]

    return fault


def scaled(which: int, factor: float) -> Fault:
    def fault(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float) -> None:
        (acc, gyr)[which][:] *= factor

    return fault


def dangles(acc: FloatArray, gyr: FloatArray, rng: np.random.Generator, rate_hz: float) -> None:
    """A pendulum on 0.15–0.4 m of cable, 25–60° to either side, hanging as it happened to be at that moment."""
    length_m, angle = rng.uniform(0.15, 0.4), np.radians(rng.uniform(25, 60))
    omega = np.sqrt(G_MPS2 / length_m)
    t_s = np.arange(len(acc)) / rate_hz
    tilt, turn = angle * np.sin(omega * t_s), angle * omega * np.cos(omega * t_s)
    along = acc[0] / np.linalg.norm(acc[0])
    across = np.cross(along, rng.normal(size=3))
    across /= np.linalg.norm(across)
    acc[:] = (G_MPS2 * np.cos(tilt) + turn**2 * length_m)[:, None] * along + rng.normal(0, ACC_NOISE, acc.shape)
    gyr[:] = turn[:, None] * across + rng.normal(0, GYR_NOISE, gyr.shape)


FAULTS: dict[str, Fault] = {
    "accelerometer frozen": held(0, "all", 0.0),
    "accelerometer stuck": held(0, "all", ACC_NOISE),
    "accelerometer, one axis frozen": held(0, "other", 0.0),
    "accelerometer, one axis stuck": held(0, "other", ACC_NOISE),
    "accelerometer × 0.8": scaled(0, 0.8),
    "accelerometer × 1.25": scaled(0, 1.25),
    "accelerometer × 1.5": scaled(0, 1.5),
    "gyroscope frozen": held(1, "all", 0.0),
    "gyroscope stuck": held(1, "all", GYR_NOISE),
    "gyroscope, main axis frozen": held(1, "main", 0.0),
    "gyroscope, another axis frozen": held(1, "other", 0.0),
    "gyroscope, main axis stuck": held(1, "main", GYR_NOISE),
    "gyroscope, another axis stuck": held(1, "other", GYR_NOISE),
    "gyroscope × 0.5": scaled(1, 0.5),
    "gyroscope × 2": scaled(1, 2.0),
    "dangling": dangles,
}


def real(only: list[str]) -> Iterator[tuple[str, Track]]:
    """Set and track of every real sensor, those of the bundled simulated trials first."""
    for name, track in labelled_sensors(0):
        if name in ("bundled trials (simulated)", "gaitmap stairs", "xio walk"):
            yield name, track
    for foot in feet_of(data_folder(), only):
        if foot.person != LYING:
            yield f"{foot.data_set}, {foot.part.split(',')[0]}", foot.track


def virtual(first: int, patients: int) -> Iterator[tuple[str, Track]]:
    for seed in range(first, first + patients):
        settings = replace(drawn(seed, 0), sensors=("right_foot", "right_shank"))
        if seed % 4 == 0:
            settings = replace(settings, speed_mps=round(Random(seed).uniform(0.2, 0.36), 2))
        samples = VirtualPatient(settings).advance(40 * NS_PER_S)
        for sensor in settings.sensors:
            own = [sample for sample in samples if sample.sensor == sensor]
            acc, gyr = (np.array([getattr(sample, name) for sample in own]) for name in ("acc_mps2", "gyr_radps"))
            yield f"virtual {sensor.split('_')[1]}", even_track(sensor, settings.rate_hz, acc, gyr)


def sound_parts(name: str, track: Track) -> list[slice]:
    """The rows between stalls, for the set whose rows around them nobody measured."""
    if not name.startswith("footswitch"):
        return [slice(0, len(track.t_ns))]
    step_ns = np.diff(track.t_ns)
    quick = np.convolve(step_ns, np.ones(20) / 20, "same") < 0.7e9 / track.rate_hz
    bend = np.abs(np.diff(track.gyr_radps, 2, axis=0, append=track.gyr_radps[-2:])).max(axis=1)
    made_up = np.convolve(bend, np.ones(20) / 20, "same") < 0.1 * np.median(bend)  # without noise though it turns
    made_up &= np.linalg.norm(track.gyr_radps, axis=1) > 0.5
    spoilt = np.zeros(len(track.t_ns), dtype=bool)
    for at in np.flatnonzero((step_ns > STALL_NS) | quick | made_up[:-1]):
        begin, end = np.searchsorted(track.t_ns, (track.t_ns[at] - AROUND_NS, track.t_ns[at + 1] + AROUND_NS))
        spoilt[begin:end] = True
    edges = np.flatnonzero(np.diff(np.concatenate(([True], spoilt, [True])).astype(int)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def said_of(track: Track, rows: slice, up: Vector3 | None) -> tuple[set[str], float]:
    """What the judge says of these rows as they are, and how long they last (s)."""
    judge = Plausibility(track.sensor, None, up)
    columns = (track.t_ns[rows].tolist(), track.t_sensor_ns[rows].tolist())
    values = (track.acc_mps2[rows].tolist(), track.gyr_radps[rows].tolist())
    said = {
        judge.fault(ImuSample(t, track.sensor, own, tuple(acc), tuple(gyr)))
        for t, own, acc, gyr in zip(*columns, *values, strict=True)
    }
    return said - {""}, 1e-9 * float(track.t_ns[rows][-1] - track.t_ns[rows][0]) if rows.stop > rows.start else 0.0


def told_after_s(track: Track, at: int, fault: Fault, rng: np.random.Generator) -> float:
    """From sample ``at``, where the fault begins, until the judge objects; infinite if it does not in three seconds."""
    first, last = at - round(BEFORE_S * track.rate_hz), at + round(LONGEST_S * track.rate_hz)
    rows = slice(first, last)
    acc, gyr = track.acc_mps2[rows].copy(), track.gyr_radps[rows].copy()
    fault(acc[at - first :], gyr[at - first :], rng, track.rate_hz)
    judge = Plausibility(track.sensor, None, None)
    for k, t, force, rate in zip(
        range(first, last), track.t_ns[rows].tolist(), acc.tolist(), gyr.tolist(), strict=True
    ):
        if judge.fault(ImuSample(t, track.sensor, t, tuple(force), tuple(rate))) and k >= at:
            return 1e-9 * float(t - track.t_ns[at])
    return float("inf")


def main() -> int:
    """Print both tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--moments", type=int, default=3, help="per sensor, fault, and of stance and swing each")
    parser.add_argument("--patients", type=int, default=40, help="virtual ones")
    parser.add_argument("--first", type=int, default=2000, help="seed of the first")
    parser.add_argument("--only", nargs="*", default=list(SETS), choices=SETS)
    asked = parser.parse_args()
    rng = np.random.default_rng(1)
    alarms: dict[str, list[tuple[str, float, set[str]]]] = {}
    times: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for name, track in (*real(asked.only), *virtual(asked.first, asked.patients)):
        said, seconds = set[str](), 0.0
        for rows in sound_parts(name, track):
            more, lasted = said_of(track, rows, None)
            said, seconds = said | more, seconds + lasted
        alarms.setdefault(name, []).append((track.sensor, seconds, said))
        try:
            take(times, name, track, asked.moments, rng)
        except CalibrationError as error:
            print(f"{name}: {error}", file=sys.stderr)
    console = console_of(180)
    table = Table(title="Sound sensors")
    for column in ("recordings", "sensors", "hours", "false alarms"):
        table.add_column(column, justify="left" if column == "recordings" else "right")
    for name, found in alarms.items():
        hours = f"{sum(seconds for _, seconds, _ in found) / 3600:.2f}"
        table.add_row(name, str(len(found)), hours, str(sum(bool(said) for _, _, said in found)))
    console.print(table)
    told = Table(title="Told: within a stride; before the next pre-swing; median and 95 % (s)")
    for column in ("fault", *(f"{kind}, in {phase}" for kind in KINDS for phase in PHASES)):
        told.add_column(column, justify="left" if column == "fault" else "right")
    for fault in FAULTS:
        told.add_row(fault, *(summary(times.get((fault, kind, phase), [])) for kind in KINDS for phase in PHASES))
    console.print(told)
    for name, found in alarms.items():
        for sensor, _, said in found:
            for each in sorted(said):
                print(f"{name}, {sensor}: {each}")
    save({f"{fault}, {kind}, {phase}": found for (fault, kind, phase), found in times.items()}, asked.json)
    if not any("treadmill" in name for name in alarms):
        print("no real recordings: set FES_DATA", file=sys.stderr)
        return 3
    return 1 if any(said for found in alarms.values() for _, _, said in found) else 0


KINDS, PHASES = ("real feet", "real shanks", "virtual"), ("swing", "stance")


def take(
    times: dict[tuple[str, str, str], list[tuple[float, float]]],
    name: str,
    track: Track,
    moments: int,
    rng: np.random.Generator,
) -> None:
    """Put every fault into one sensor's track at random moments; when it was told, and when the next pre-swing was."""
    if not moments or "bundled" in name or name.startswith("footswitch"):
        return
    _, swing, begins = swings(track)
    kind = "virtual" if "virtual" in name else f"real {'feet' if track.sensor.endswith('foot') else 'shanks'}"
    before, after = round(BEFORE_S * track.rate_hz) + 1, round(LONGEST_S * track.rate_hz) + 1
    walked = np.arange(max(before, swing[0]), min(len(track.t_ns) - after, swing[-1]))
    in_swing = np.isin(walked, swing)
    for phase, where in (("swing", walked[in_swing]), ("stance", walked[~in_swing])):
        for fault, put in FAULTS.items():
            for at in rng.choice(where, min(moments, len(where)), replace=False).tolist():
                later = begins[begins > at]
                next_s = 1e-9 * float(track.t_ns[later[0]] - track.t_ns[at]) if len(later) else float("inf")
                times.setdefault((fault, kind, phase), []).append((told_after_s(track, at, put, rng), next_s))


def summary(found: list[tuple[float, float]]) -> str:
    if not found:
        return "–"
    told, following = np.array(found).T
    middle, late = np.percentile(told, (50, 95), method="higher")
    return f"{np.mean(told <= STRIDE_S):.0%}; {np.mean(told <= following):.0%}; {middle:.2f}, {late:.2f}"


if __name__ == "__main__":
    sys.exit(main())
