"""How near real feet come to what the gate calls impossible; exit code 1 if one goes beyond, 3 without data.

    python benchmarks/plausibility.py

Per set of recordings: the level of force that three quarters of a span of 80 ms stay below, at its least, and above, at
its greatest; the greatest steps of the force (× from one sample to the next, samples lost left aside) that are followed
by such a span below 7 m/s² or above the bound for a step up; the highest rate of any one axis; the longest time without
a changing value; the largest tilt from the calibrated upright in a rest that lasts as long as the gate asks for, and of
the force averaged over 0.3 s. The bundled simulated trials come first; real recordings lie in FES_DATA.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ankle import calibrate as calibrate_shank
from ankle import load_shanks
from real_sets import all_walks
from rich.console import Console
from rich.table import Table
from scipy.signal import lfilter
from stroke_treadmill import data_folder, load_run, track_of

from fes.gate.force import FOOT, MOST_APART_NS, MOSTLY, SHANK, SPAN_MS, STEP
from fes.gate.freshness import MAX_SAME_MS
from fes.gate.plausible import (
    MEAN_NS,
    MOST_RATE_RADPS,
    MOST_TILT_RAD,
    REST_FORCE_MPS2,
    REST_RATE_RADPS,
    SUSTAINED_MS,
)
from fes.recording import Track, read_recording
from fes.replay import calibrate_track
from fes.signals import G_MPS2, SHANK_SENSORS, FloatArray

TRIALS = Path(__file__).resolve().parents[1] / "sim_inputs"


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
        resting = (np.abs(force - G_MPS2) <= REST_FORCE_MPS2) & (rate <= REST_RATE_RADPS)
        tilt = np.degrees(np.arccos(np.clip(track.acc_mps2 @ up / np.maximum(force, 1e-9), -1, 1)))
        for begin, end in spells(resting):
            if t_ms[end - 1] - t_ms[begin] >= SUSTAINED_MS:
                # what it takes to be doubted: the tilt that it keeps for that long
                steps = max(1, round(SUSTAINED_MS * track.rate_hz / 1000))
                kept = np.lib.stride_tricks.sliding_window_view(tilt[begin:end], min(steps, end - begin)).min(axis=1)
                self.tilt_deg = max(self.tilt_deg, float(kept.max()))

        share = 1e9 / track.rate_hz / MEAN_NS
        state = (1.0 - share) * G_MPS2 * up[None, :]
        mean, _ = lfilter([share], [1.0, share - 1.0], track.acc_mps2, axis=0, zi=state)
        cosine = mean @ up / np.maximum(np.linalg.norm(mean, axis=1), 1e-9)
        self.mean_tilt_deg = max(self.mean_tilt_deg, float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max()))

    def _take_force(self, track: Track, force: FloatArray) -> None:
        bounds = SHANK if track.sensor in SHANK_SENSORS else FOOT
        samples = math.ceil(SPAN_MS * track.rate_hz / 1000 - 1e-6) + 1
        ordered = np.sort(np.lib.stride_tricks.sliding_window_view(force, samples), axis=1)
        most = math.ceil(MOSTLY[0] * samples / MOSTLY[1])
        below, above = ordered[:, most - 1], ordered[:, samples - most]
        self.weak_mps2 = min(self.weak_mps2, float(below.min()))
        self.strong = max(self.strong, float(above.max()) / bounds.strong)
        if 1e9 / track.rate_hz <= MOST_APART_NS:
            step = np.maximum(force[1 : len(below)], 1e-9) / np.maximum(force[: len(below) - 1], 1e-9)
            self.down = max(self.down, float((1.0 / step[below[1:] < bounds.low]).max(initial=0.0)))
            self.up = max(self.up, float(step[above[1:] > bounds.high].max(initial=0.0)))

    @property
    def holds(self) -> bool:
        """Whether the gate would have let all of it pass."""
        force = self.weak_mps2 > FOOT.weak and self.strong < 1.0 and max(self.down, self.up) < STEP
        tilt = max(self.tilt_deg, self.mean_tilt_deg) < math.degrees(MOST_TILT_RAD)
        return force and tilt and self.same_ms < MAX_SAME_MS and self.rate_radps < MOST_RATE_RADPS


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
            track = track_of(sensor, rate_hz, acc, gyr)
            yield "stroke survivors, shanks", track, np.array(calibrate_shank(sensor, rate_hz, acc, gyr).up)
    for walk in all_walks():
        yield walk.data_set, walk.track, np.array(calibrate_track(walk.track).up)


def main() -> int:
    """Print the table."""
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
        f"{FOOT.weak:g}",
        "100 %",
        f"{STEP:g}",
        f"{STEP:g}",
        f"{MOST_RATE_RADPS:g}",
        f"{MAX_SAME_MS}",
        f"{math.degrees(MOST_TILT_RAD):.0f}",
        f"{math.degrees(MOST_TILT_RAD):.0f}",
        end_section=True,
    )
    for name, e in found.items():
        force = (f"{e.weak_mps2:.1f}", f"{e.strong:.0%}", f"{e.down:.1f}", f"{e.up:.1f}")
        numbers = (e.rate_radps, e.same_ms, e.tilt_deg, e.mean_tilt_deg)
        table.add_row(name, str(e.sensors), *force, *(f"{number:.0f}" for number in numbers))
    Console(width=120).print(table)
    if len(found) < 2:
        print("no real recordings: set FES_DATA", file=sys.stderr)
        return 3
    return 0 if all(e.holds for e in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
