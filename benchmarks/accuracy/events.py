"""Initial contact and foot off, off-line and causal, and the foot-strike angle; exit code 1 if a bar fails.

Truth: markers (gaitmap_walk) and the bundled trials. On stroke_treadmill, where no truth per stride exists, the causal
decisions are compared with the off-line events, and the foot-strike angle with Vicon's mean per run. Times are
estimate − truth; a causal decision's is the delay after the true event. An event further than 0.15 s (causal: 0.25 s)
from a true one is missed. One where the reference has none counts as extra, unless the heel marker confirms it. Without
recordings only the bundled trials are measured, and the exit code is 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import Case, bundled_cases, data_folder, gaitmap_cases
from benchmarks.lib.walkers import causal, stroke_treadmill
from fes.calibration.recording import calibrate_track
from fes.estimation.events.causal import OnlineEvent, OnlineEvents, Rule
from fes.estimation.events.offline import GaitEvents, find_events, foot_strike_angles
from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Track
from fes.signals import FloatArray

OFFLINE_S, CAUSAL_S = 0.15, 0.25
CONTACTS = 50  # that the Vicon mean per side is over
OFFLINE_BAR_MS = {"IC": (5.0, 7.0), "FO": (5.0, 5.0)}
CAUSAL_BAR_MS = (20.0, 50.0)
STRIKE_BAR = (0.96, 2.0)
NAN = float("nan")


@dataclass(frozen=True)
class Score:
    """One event of one method over all feet of a data set; times in ms, percentiles of estimate − truth."""

    data: str
    method: str
    event: str
    true: int
    found: int
    extra: int
    confirmed: int
    mean_ms: float = NAN
    sd_ms: float = NAN
    median_ms: float = NAN
    p95_ms: float = NAN
    least_ms: float = NAN
    most_ms: float = NAN

    @property
    def recall(self) -> float:
        return self.found / self.true

    @property
    def precision(self) -> float:
        """Of the events that no marker confirms."""
        return self.found / max(self.found + self.extra, 1)


def stroke_tracks(folder: Path) -> list[tuple[str, Track, float]]:
    """Run, foot and Vicon's mean foot-strike angle (deg)."""
    return [(foot.run, foot.track, foot.strike_deg) for foot in stroke_treadmill(folder, "")]


def offline(track: Track, calibration: FootCalibration) -> GaitEvents:
    return find_events(track.t_sensor_ns, track.acc_mps2, track.gyr_radps, calibration)


def seconds(track: Track, t_ns: list[int]) -> FloatArray:
    return np.array([t - int(track.t_sensor_ns[0]) for t in t_ns], float) * 1e-9


def by_events(track: Track, calibration: FootCalibration) -> dict[str, FloatArray]:
    found = offline(track, calibration)
    return {"IC": seconds(track, found.ic_ns.tolist()), "FO": seconds(track, found.fo_ns.tolist())}


def decided(track: Track, calibration: FootCalibration, rule: Rule) -> dict[str, FloatArray]:
    """When each event was known, in s from the start."""
    decisions = OnlineEvents(calibration, rule).advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    events = (OnlineEvent.IC, OnlineEvent.FO)
    return {event.name: seconds(track, [d.t_ns for d in decisions if d.event is event]) for event in events}


def phases(track: Track, calibration: FootCalibration) -> dict[str, FloatArray]:
    """When the phase machine entered loading response (or stance straight from swing) and swing."""
    changes, _ = causal(track, calibration)
    named = {"IC": ("T3", "T6"), "FO": ("T2",)}
    return {
        name: seconds(track, [change.t_ns for change in changes if change.transition.name in which])
        for name, which in named.items()
    }


METHODS: dict[str, Callable[[Track, FootCalibration], dict[str, FloatArray]]] = {
    "off-line": by_events,
    "causal, the paper's peaks": lambda track, c: decided(track, c, Rule.PEAKS),
    "causal, instants": lambda track, c: decided(track, c, Rule.INSTANTS),
    "causal, phase machine": phases,
}


def compare(estimated: FloatArray, true: FloatArray, tolerance_s: float) -> tuple[FloatArray, FloatArray]:
    """Errors of the nearest estimates to each true event, each estimate used once; and the estimates left over."""
    errors, left = [], list(estimated)
    for t in true:
        nearest = min(left, key=lambda e: abs(e - t), default=np.inf)
        if abs(nearest - t) <= tolerance_s:
            errors.append(nearest - t)
            left.remove(nearest)
    return np.array(errors), np.array(left)


def score(data: str, cases: list[Case], method: str) -> list[Score]:
    """Both events of one method, all feet of a data set together."""
    tolerance_s = OFFLINE_S if method == "off-line" else CAUSAL_S
    found: dict[str, list[FloatArray]] = {"IC": [], "FO": []}
    true, extra, confirmed = (dict.fromkeys(found, 0) for _ in range(3))
    for case in cases:
        events = METHODS[method](case.track, calibrate_track(case.track))
        begin, end = case.fo_s[0] - 0.1, case.ic_s[-1] + 0.1
        for event, at_s in (("IC", case.ic_s), ("FO", case.fo_s)):
            errors, left = compare(events[event], at_s, tolerance_s)
            found[event].append(errors)
            told = [case.confirmed(event, float(t)) for t in left if begin < t < end]
            true[event] += len(at_s)
            confirmed[event] += sum(told)
            extra[event] += len(told) - sum(told)
    scores = []
    for event, parts in found.items():
        ms = 1e3 * np.concatenate(parts)
        numbers = [NAN] * 6
        if len(ms) > 1:
            numbers = [ms.mean(), ms.std(ddof=1), np.median(ms), np.percentile(ms, 95), ms.min(), ms.max()]
        counts = true[event], len(ms), extra[event], confirmed[event]
        scores.append(Score(data, method, event, *counts, *(float(x) for x in numbers)))
    return scores


def strike_angles(tracks: list[tuple[str, Track, float]]) -> dict[str, tuple[float, float]]:
    """Per run: Vicon's mean and ours over the first contacts of both sides (deg, toe-up positive)."""
    angles: dict[str, list[FloatArray]] = {}
    vicon = {}
    for run, track, mean_deg in tracks:
        calibration = calibrate_track(track)
        angle = foot_strike_angles(track.t_sensor_ns, track.gyr_radps, offline(track, calibration), calibration)
        angles.setdefault(run, []).append(np.degrees(angle[np.isfinite(angle)][:CONTACTS]))
        vicon[run] = mean_deg
    return {run: (vicon[run], float(np.concatenate(parts).mean())) for run, parts in angles.items()}


def strike_score(angles: dict[str, tuple[float, float]]) -> tuple[float, float, float]:
    """Correlation, offset and SD after offset (deg) of ours against Vicon's."""
    vicon, ours = np.array(list(angles.values())).T
    return float(np.corrcoef(vicon, ours)[0, 1]), float((ours - vicon).mean()), float((ours - vicon).std(ddof=1))


def holds(s: Score) -> bool:
    """Whether a score on the marker data meets its bar; the paper's and the phase machine's have none."""
    if s.method == "off-line":
        bias, sd = OFFLINE_BAR_MS[s.event]
        return abs(s.mean_ms) <= bias and s.sd_ms <= sd and s.recall >= 0.99 and s.precision == 1.0
    median, p95 = CAUSAL_BAR_MS
    return s.median_ms <= median and s.p95_ms <= p95 and s.found == s.true


def _as_truth(run: str, track: Track) -> Case:
    events = by_events(track, calibrate_track(track))
    return Case(run, track, events["IC"], events["FO"])


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    there = (options.data / "gaitmap_walk").is_dir() and (options.data / "stroke_treadmill").is_dir()
    bundled = bundled_cases()
    sets = [(name, [c for c in bundled if c.name == name]) for name in dict.fromkeys(c.name for c in bundled)]
    if there:
        sets.insert(0, ("gaitmap_walk", gaitmap_cases(options.data)))
    scores = [s for name, cases in sets for method in METHODS for s in score(name, cases, method)]
    lines = []
    if there:
        tracks = stroke_tracks(options.data)
        known = [_as_truth(run, track) for run, track, _ in tracks]
        scores += [s for method in list(METHODS)[1:] for s in score("stroke, against off-line", known, method)]
        angles = strike_angles(tracks)
        correlation, offset, sd = strike_score(angles)
        each = ", ".join(f"{k} {v[0]:.1f} {v[1]:.1f}" for k, v in angles.items())
        lines = [
            f"Foot-strike angle, deg (Vicon, ours): {each}.",
            f"Foot-strike angle against Vicon: correlation {correlation:.3f}, offset {offset:+.1f}°, SD {sd:.2f}°.",
        ]
    columns = ("data", "method", "event", "true", "found", "extra", "confirmed", "mean ± SD ms")
    rows = [
        [s.data, s.method, s.event, *(str(x) for x in (s.true, s.found, s.extra, s.confirmed)),
         f"{s.mean_ms:+.1f} ± {s.sd_ms:.1f}", *(f"{x:+.0f}" for x in (s.median_ms, s.p95_ms, s.least_ms, s.most_ms))]
        for s in scores
    ]  # fmt: skip
    publish([table_of("", (*columns, "median", "95 %", "least", "most"), rows)], options, lines)
    if not there:
        return no_recordings(options.data)
    judged = [s for s in scores if s.data == "gaitmap_walk" and s.method in ("off-line", "causal, instants")]
    return verdict(all(map(holds, judged)) and correlation >= STRIKE_BAR[0] and sd <= STRIKE_BAR[1])


if __name__ == "__main__":
    raise SystemExit(main())
