"""How soon the gate tells a wrong unit, or turned axes, in swing; exit code 1 if a bar is missed, 3 without data.

    python benchmarks/safety/wrong_unit.py [--moments N] [--patients N]

Into every recording, at random moments of pre-swing and swing, a change is put that lasts: force in g, force scaled by
g once more, force in mg, rates in °/s, and the sensor turned so that up comes from at least 80° elsewhere. The gate's
own judge (``fes.gate.plausibility``) reads it from one second before. The bars: each unit told within 100 ms at 99.5 %
of all real moments, and nothing said of any sensor as it was recorded.
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.ankle import load_shanks
from benchmarks.lib.real_sets import all_walks, data_folder, load_run, xio
from benchmarks.lib.walkers import outcomes_of
from benchmarks.loop.tuning_cohort import patient
from fes.calibration.recording import calibrate_shank_track, calibrate_track
from fes.datasets.common import even_track, two_header_csv
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.shank.tracker import ShankTracker
from fes.gate.plausibility import Plausibility
from fes.recording import Track, read_recording
from fes.signals import G_MPS2, NS_PER_S, SHANK_SENSORS, FloatArray, ImuSample, IntArray, Vector3
from fes.simulation.forward import VirtualPatient
from statemachine.phases import Phase, PhaseChange

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
WITHIN_MS, BAR = 100.0, 0.995
LONGEST_S = 2.0
UNITS = {"g": (1 / G_MPS2, 1.0), "× 9.81": (G_MPS2, 1.0), "mg": (1000 / G_MPS2, 1.0), "°/s": (1.0, 180 / np.pi)}


@dataclass
class Told:
    """Of one set: sensors, of how many something was said as they are and what, by change the times until told (ms)."""

    sensors: int = 0
    false: int = 0
    said: set[str] = field(default_factory=set)
    times_ms: dict[str, list[float]] = field(default_factory=dict)
    before_next: list[bool] = field(default_factory=list)


def turns() -> list[FloatArray]:
    """The 24 ways to put a box on (3, 3)."""
    signed = (
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    )
    return [m for m in signed if np.linalg.det(m) > 0]


def sensors(patients: int) -> Iterator[tuple[str, Track]]:
    """Set and track of every sensor there is; simulated ones first."""
    for path in sorted(TRIALS.glob("*.parquet")):
        if "truth" not in path.name:
            yield from (("bundled trials (simulated)", track) for track in read_recording(path).tracks.values())
    for seed in range(patients):
        samples = VirtualPatient(patient(seed)[0]).advance(40 * NS_PER_S)
        acc, gyr = (np.array([getattr(s, name) for s in samples]) for name in ("acc_mps2", "gyr_radps"))
        yield "virtual patients (simulated)", even_track("right_foot", 100.0, acc, gyr)
    folder = data_folder()
    for path in sorted((folder / "stroke_treadmill").glob("*.npz")):
        yield from (("stroke survivors, feet", track) for track in load_run(path)[0].values())
        shanks, rate_hz, _ = load_shanks(path)
        yield from (("stroke survivors, shanks", even_track(name, rate_hz, *both)) for name, both in shanks.items())
    yield from ((walk.data_set, walk.track) for walk in all_walks())
    stairs = folder / "gaitmap_walk" / "imu_sample_healthy_stair_up.csv"
    if stairs.is_file():
        columns = two_header_csv(stairs)
        for side in ("left", "right"):
            acc, gyr = (
                np.column_stack([columns[f"{side}_sensor", f"{k}_{axis}"] for axis in "xyz"]) for k in ("acc", "gyr")
            )
            yield "gaitmap stairs", even_track(f"{side}_foot", 204.8, acc, np.radians(gyr))
    walk = xio(folder)
    if walk is not None:
        yield "xio walk", walk


def swings(track: Track) -> tuple[Vector3, IntArray, IntArray]:
    """Upright, indices of pre-swing and swing, and those at which a pre-swing begins, by the session's own tracker."""
    if track.sensor in SHANK_SENSORS:
        shank = calibrate_shank_track(track)
        up, outcomes = shank.up, ShankTracker(shank).advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    else:
        foot = calibrate_track(track)
        up, outcomes = foot.up, outcomes_of(track, foot)
    phase = np.zeros(len(track.t_ns), dtype=int)
    begins = []
    for change in outcomes:
        if isinstance(change, PhaseChange):
            at = int(np.searchsorted(track.t_sensor_ns, change.t_ns))
            phase[at:] = change.destination
            begins += [at] * (change.destination is Phase.PRE_SWING)
    return up, np.flatnonzero((phase == Phase.PRE_SWING) | (phase == Phase.SWING)), np.array(begins, dtype=int)


def until_told_ms(track: Track, up: Vector3 | None, at: int, acc: FloatArray, gyr: FloatArray, first: int) -> float:
    """From sample ``at``, with these values from ``first`` on, until the judge objects; infinite after two seconds."""
    judge = Plausibility(track.sensor, None, up)
    t_ns = track.t_ns[first : first + len(acc)].tolist()
    for k, (t, force, rate) in enumerate(zip(t_ns, acc.tolist(), gyr.tolist(), strict=True)):
        fault = judge.fault(ImuSample(t, track.sensor, t, tuple(force), tuple(rate)))
        if first + k >= at and (fault or judge.not_ready):
            return float(t - track.t_ns[at]) / 1e6
    return float("inf")


def take(told: Told, track: Track, moments: int, rng: np.random.Generator) -> None:
    """One sensor: as it is, then with every change at random moments."""
    up, swing, begins = swings(track)
    told.sensors += 1
    judge, said = Plausibility(track.sensor, None, up), set[str]()
    for t, acc, gyr in zip(track.t_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist(), strict=True):
        said |= {judge.fault(ImuSample(t, track.sensor, t, tuple(acc), tuple(gyr))), judge.not_ready} - {""}
    told.said |= said
    told.false += bool(said)
    before, after = round(track.rate_hz), round(LONGEST_S * track.rate_hz)
    swing = swing[(swing > before) & (swing < len(track.t_ns) - after)]
    for at in rng.choice(swing, min(moments, len(swing)), replace=False).tolist():
        rows = slice(at - before, at + after)
        for name, (of_acc, of_gyr) in UNITS.items():
            acc, gyr = track.acc_mps2[rows].copy(), track.gyr_radps[rows].copy()
            acc[before:] *= of_acc
            gyr[before:] *= of_gyr
            told.times_ms.setdefault(name, []).append(until_told_ms(track, None, at, acc, gyr, rows.start))
        turn = TURNS[rng.integers(len(TURNS))]
        if np.dot(turn @ np.array(up), up) > np.cos(np.radians(80)):
            continue
        acc, gyr = track.acc_mps2[rows].copy(), track.gyr_radps[rows].copy()
        acc[before:], gyr[before:] = acc[before:] @ turn.T, gyr[before:] @ turn.T
        time_ms = until_told_ms(track, up, at, acc, gyr, rows.start)
        told.times_ms.setdefault("turned", []).append(time_ms)
        later = begins[begins > at]
        if len(later):
            told.before_next.append(time_ms <= float(track.t_ns[later[0]] - track.t_ns[at]) / 1e6)


TURNS = turns()


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--moments", type=int, default=60, help="per sensor")
    parser.add_argument("--patients", type=int, default=40, help="simulated ones")
    arguments = parser.parse_args()
    rng = np.random.default_rng(1)
    found: dict[str, Told] = {}
    for name, track in sensors(arguments.patients):
        try:
            take(found.setdefault(name, Told()), track, arguments.moments, rng)
        except CalibrationError as error:
            print(f"{name}: {error}", file=sys.stderr)
    real = [told for name, told in found.items() if "simulated" not in name]
    table = Table(title=f"Told within {WITHIN_MS:.0f} ms of a change in swing, and the longest time in ms")
    for column in ("recordings", "sensors", "false", *UNITS, "turned", "before next burst"):
        table.add_column(column, justify="left" if column == "recordings" else "right")
    shares: dict[str, float] = {}
    for name, told in found.items():
        cells = [f"{share(told.times_ms[kind]):.2%} {max(told.times_ms[kind]):.0f}" for kind in (*UNITS, "turned")]
        before = np.mean(told.before_next)
        table.add_row(name, str(told.sensors), str(told.false), *cells, f"{before:.1%}")
    if real:
        pooled = {unit: [t for told in real for t in told.times_ms[unit]] for unit in (*UNITS, "turned")}
        shares = {unit: share(times) for unit, times in pooled.items() if unit in UNITS}
        before = np.mean([each for told in real for each in told.before_next])
        cells = [f"{share(times):.2%} {max(times):.0f}" for times in pooled.values()]
        false = str(sum(told.false for told in real))
        table.add_row("all real ones", str(sum(t.sensors for t in real)), false, *cells, f"{before:.1%}")
    Console(width=140).print(table)
    for name, told in found.items():
        for said in sorted(told.said):
            print(f"{name}: {said}")
    if not real:
        print("no real recordings: set FES_DATA", file=sys.stderr)
        return 3
    return 0 if min(shares.values()) >= BAR and not any(told.said for told in found.values()) else 1


def share(times_ms: list[float]) -> float:
    """How many of them are within the time that the gate has."""
    return float(np.mean(np.array(times_ms) <= WITHIN_MS))


if __name__ == "__main__":
    sys.exit(main())
