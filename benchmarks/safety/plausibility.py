"""How near real feet come to what the gate calls impossible; exit code 1 if one goes beyond, 3 without data.

    python benchmarks/safety/plausibility.py [--patients N] [--first SEED]

Per set of recordings: the level of force that three quarters of a span of 80 ms stay below, at its least, and above, at
its greatest; the greatest steps of the force (× from one sample to the next, samples lost left aside) that are followed
by such a span below 7 m/s² or above the bound for a step up; the highest rate of any one axis; the longest time without
a changing value; the largest tilt from the calibrated upright that is kept for as long as the gate asks for, in a rest
and of the force averaged over 0.3 s. The bundled simulated trials come first; real recordings lie in FES_DATA.

With ``--patients`` a second table compares them with so many of the tuning's virtual patients, without stimulation: the
percentiles of the least force in each 1.25 s of a walk, and of the largest tilt of its mean; and how many sensors go
beyond what the gate allows either.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter

from benchmarks.accuracy.ankle import calibrate as calibrate_shank
from benchmarks.accuracy.ankle import load_shanks
from benchmarks.lib.real_sets import all_walks, data_folder, load_run
from benchmarks.loop.tuning_cohort import patient
from fes.calibration.recording import calibrate_track
from fes.datasets.common import even_track
from fes.gate.freshness import MAX_SAME_MS
from fes.gate.plausibility import BOUNDS, place_of
from fes.recording import Track, read_recording
from fes.signals import G_MPS2, NS_PER_S, FloatArray
from fes.simulation.forward import VirtualPatient

STRIDE_S, WALKED_S = 1.25, 45
SUSTAINED_MS = 1e-6 * BOUNDS.sustained_ns
WEAK_MPS2 = place_of("left_foot", None, None).weak_mps2
LOW, HIGH = (0, 1, 10, 50), (50, 90, 99, 100)
TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"


@dataclass
class Extremes:
    """The worst of a set; ``strong`` is a share of its bound, steps are ratios, ``same_ms`` a time."""

    sensors: int = 0
    weak_mps2: float = math.inf
    strong: float = 0.0
    down: float = 0.0
    up: float = 0.0
    rate_radps: float = 0.0
    same_ms: float = 0.0
    tilt_deg: float = 0.0
    mean_tilt_deg: float = 0.0

    def take(self, track: Track, up: FloatArray) -> None:
        """Count one sensor's track; ``up`` is its upright in its own frame."""
        t_ms = 1e-6 * track.t_sensor_ns
        force = np.linalg.norm(track.acc_mps2, axis=1)
        rate = np.abs(track.gyr_radps).max(axis=1)
        values = np.hstack((track.acc_mps2, track.gyr_radps))
        same = np.concatenate(([False], (np.diff(values, axis=0) == 0).all(axis=1)))
        self.sensors += 1
        self._take_force(track, force)
        self.rate_radps = max(self.rate_radps, float(rate.max()))
        self.same_ms = max([self.same_ms, *(t + 1000 / track.rate_hz for t in lasting_ms(t_ms, same))])
        resting = (np.abs(force - G_MPS2) <= BOUNDS.rest_mps2) & (rate <= BOUNDS.rest_radps)
        tilt = np.degrees(np.arccos(np.clip(track.acc_mps2 @ up / np.maximum(force, 1e-9), -1, 1)))
        for begin, end in spells(resting):
            if t_ms[end - 1] - t_ms[begin] >= SUSTAINED_MS:
                self.tilt_deg = max(self.tilt_deg, kept_deg(tilt[begin:end], track.rate_hz))
        self.mean_tilt_deg = max(self.mean_tilt_deg, kept_deg(mean_tilt_deg(track, up), track.rate_hz))

    def _take_force(self, track: Track, force: FloatArray) -> None:
        bounds = place_of(track.sensor, None, None)
        below, above = levels(track.rate_hz, force)
        self.weak_mps2 = min(self.weak_mps2, float(below.min()))
        self.strong = max(self.strong, float(above.max()) / bounds.strong_mps2)
        if 1e9 / track.rate_hz <= BOUNDS.most_apart_ns:
            step = np.maximum(force[1 : len(below)], 1e-9) / np.maximum(force[: len(below) - 1], 1e-9)
            self.down = max(self.down, float((1.0 / step[below[1:] < bounds.low_mps2]).max(initial=0.0)))
            self.up = max(self.up, float(step[above[1:] > bounds.high_mps2].max(initial=0.0)))

    @property
    def force_holds(self) -> bool:
        """Whether the gate would have taken its unit for the right one."""
        return self.weak_mps2 > WEAK_MPS2 and self.strong < 1.0 and max(self.down, self.up) < BOUNDS.step

    @property
    def holds(self) -> bool:
        """Whether the gate would have let all of it pass."""
        tilt = max(self.tilt_deg, self.mean_tilt_deg) < math.degrees(math.acos(BOUNDS.upright))
        return self.force_holds and tilt and self.same_ms < MAX_SAME_MS and self.rate_radps < BOUNDS.most_rate_radps


def levels(rate_hz: float, force: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What three quarters of each span stay below, and above, m/s²; the spans begin with each sample."""
    samples = math.ceil(SUSTAINED_MS * rate_hz / 1000 - 1e-6) + 1
    ordered = np.sort(np.lib.stride_tricks.sliding_window_view(force, samples), axis=1)
    most = math.ceil(BOUNDS.mostly * samples)
    return ordered[:, most - 1], ordered[:, samples - most]


def kept_deg(tilts_deg: FloatArray, rate_hz: float) -> float:
    """The largest of these tilts (N,) that is kept for as long as it takes to be doubted."""
    steps = round(SUSTAINED_MS * rate_hz / 1000) + 1
    return float(np.lib.stride_tricks.sliding_window_view(tilts_deg, min(steps, len(tilts_deg))).min(axis=1).max())


def mean_tilt_deg(track: Track, up: FloatArray) -> FloatArray:
    """Tilt of the force averaged over 0.3 s from the calibrated upright, (N,)."""
    share = 1e9 / track.rate_hz / BOUNDS.mean_ns
    state = (1.0 - share) * G_MPS2 * up[None, :]
    mean, _ = lfilter([share], [1.0, share - 1.0], track.acc_mps2, axis=0, zi=state)
    cosine = mean @ up / np.maximum(np.linalg.norm(mean, axis=1), 1e-9)
    out: FloatArray = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return out


def spells(true: FloatArray) -> list[tuple[int, int]]:
    """First and one past the last index of every run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], true.astype(np.int8), [0]))))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def lasting_ms(t_ms: FloatArray, true: FloatArray) -> list[float]:
    """From the first to the last sample of every run, as the gate counts."""
    return [float(t_ms[end - 1] - t_ms[begin]) for begin, end in spells(true)]


def sensors() -> Iterator[tuple[str, Track, FloatArray]]:
    """Set, track and upright of every sensor there is."""
    for path in sorted(TRIALS.glob("*.parquet")):
        if "truth" not in path.name:
            for track in read_recording(path).tracks.values():
                yield "bundled trials (simulated)", track, np.array(calibrate_track(track).up)
    for path in sorted((data_folder() / "stroke_treadmill").glob("*.npz")):
        for track in load_run(path)[0].values():
            yield "stroke survivors, feet", track, np.array(calibrate_track(track).up)
        shanks, rate_hz, _ = load_shanks(path)
        for sensor, (acc, gyr) in shanks.items():
            track = even_track(sensor, rate_hz, acc, gyr)
            yield "stroke survivors, shanks", track, np.array(calibrate_shank(sensor, rate_hz, acc, gyr).up)
    for walk in all_walks():
        yield walk.data_set, walk.track, np.array(calibrate_track(walk.track).up)


def virtual(first: int, patients: int) -> Iterator[tuple[str, Track, FloatArray]]:
    """The cohort's affected feet without stimulation, by speed."""
    for seed in range(first, first + patients):
        settings, calibration, _ = patient(seed)
        samples = VirtualPatient(settings).advance(WALKED_S * NS_PER_S)
        acc, gyr = (np.array([getattr(sample, name) for sample in samples]) for name in ("acc_mps2", "gyr_radps"))
        slow = 0.3 * int(settings.speed_mps / 0.3)
        track = even_track(settings.affected_foot, settings.rate_hz, acc, gyr)
        yield f"virtual drop feet, {slow:.1f}–{slow + 0.3:.1f} m/s", track, np.array(calibration.up)


def by_stride(tracks: Iterator[tuple[str, Track, FloatArray]]) -> Table:
    """Percentiles over strides of the least force and the largest tilt of the mean."""
    weak: dict[str, list[float]] = {}
    tilt: dict[str, list[float]] = {}
    beyond: dict[str, list[tuple[bool, bool]]] = {}
    for name, track, up in tracks:
        below, _ = levels(track.rate_hz, np.linalg.norm(track.acc_mps2, axis=1))
        tilts = mean_tilt_deg(track, up)
        found = Extremes()
        found.take(track, up)
        beyond.setdefault(name, []).append(
            (not found.force_holds, found.mean_tilt_deg > math.degrees(math.acos(BOUNDS.upright)))
        )
        span = round(STRIDE_S * track.rate_hz)
        for begin in range(0, len(below) - span, span):
            weak.setdefault(name, []).append(float(below[begin : begin + span].min()))
            tilt.setdefault(name, []).append(float(tilts[begin : begin + span].max()))
    table = Table(title="Stride by stride")
    for column in (
        "recordings",
        "strides",
        *(f"force, {p} %" for p in LOW),
        *(f"mean's tilt, {p} %" for p in HIGH),
        "beyond",
    ):
        table.add_column(column, justify="left" if column == "recordings" else "right")
    for name in sorted(weak):
        low = (f"{value:.1f}" for value in np.percentile(weak[name], LOW))
        high = (f"{value:.0f}" for value in np.percentile(tilt[name], HIGH))
        forces, tilts_beyond = (sum(which) for which in zip(*beyond[name], strict=True))
        count = f"{forces} force, {tilts_beyond} tilt of {len(beyond[name])}"
        table.add_row(name, str(len(weak[name])), *low, *high, count)
    return table


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--patients", type=int, default=0, help="virtual ones, for the second table")
    parser.add_argument("--first", type=int, default=300, help="seed of the first")
    asked = parser.parse_args()
    found: dict[str, Extremes] = {}
    for name, track, up in sensors():
        found.setdefault(name, Extremes()).take(track, up)
    table = Table(title="How near living sensors come to the gate's bounds")
    for column in (
        "recordings",
        "sensors",
        "weak m/s²",
        "strong",
        "step down ×",
        "up ×",
        "rate rad/s",
        "unchanged ms",
        "tilt at rest °",
        "of mean °",
    ):
        table.add_column(column, justify="left" if column == "recordings" else "right")
    table.add_row(
        "the gate's bounds",
        "",
        f"{place_of('left_foot', None, None).weak_mps2:g}",
        "100 %",
        f"{BOUNDS.step:g}",
        f"{BOUNDS.step:g}",
        f"{BOUNDS.most_rate_radps:g}",
        f"{MAX_SAME_MS}",
        f"{math.degrees(math.acos(BOUNDS.upright)):.0f}",
        f"{math.degrees(math.acos(BOUNDS.upright)):.0f}",
        end_section=True,
    )
    for name, e in found.items():
        force = (f"{e.weak_mps2:.1f}", f"{e.strong:.0%}", f"{e.down:.1f}", f"{e.up:.1f}")
        numbers = (e.rate_radps, e.same_ms, e.tilt_deg, e.mean_tilt_deg)
        table.add_row(name, str(e.sensors), *force, *(f"{number:.0f}" for number in numbers))
    Console(width=120).print(table)
    if asked.patients:
        Console(width=180).print(by_stride(itertools.chain(sensors(), virtual(asked.first, asked.patients))))
    if len(found) < 2:
        print("no real recordings: set FES_DATA", file=sys.stderr)
        return 3
    return 0 if all(e.holds for e in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
