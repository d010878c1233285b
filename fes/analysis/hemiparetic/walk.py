"""A hemiparetic walk from both feet: the paretic side, level ground or stairs, and Wang et al.'s (2013) windows.

The figures to go by are those of :mod:`fes.analysis.parameters`. The windows, made for feet that come to rest on a
floor, and the reconstruction that rests on them are there for comparison with the paper and for its picture.

*Level, stairs up, stairs down*: the paper's Figure 4 shows that they differ, and gives no rule. Here it is the height
gained from stance to stance: half of the lowest usual riser is beyond what a level stride's error amounts to.

*The paretic side*: section 3.1 takes the ratio left over right of the largest power spectral density of the
acceleration along the walk, without a threshold or an error rate. So the ratio is one of four signs here, beside three
that textbooks agree on (Perry & Burnfield 2010; Olney & Richards 1996): the paretic side swings longer, rises less
steeply on its toes, and lands flatter. Each votes with its size; where they do not agree clearly, no side is told. The
score is no probability: nobody has counted how often it errs on patients.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from fes.analysis.hemiparetic.foot import (
    Foot,
    FootTrack,
    common_times,
    energy,
    fitted_threshold,
    foot_of,
    in_visualization_frame,
    mapped,
    still_windows,
    tracked,
)
from fes.analysis.parameters.gait import GaitParameters, Statistic, gait_parameters, symmetry
from fes.analysis.pipeline import uneven_strides
from fes.analysis.results import Analysis
from fes.estimation.foot.calibration import FootCalibration
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray
from fes.walk_record import finite_or_none

SEGMENT_S = 4.0  # of the spectrum
BLOCKS = 8  # of the recording, to see how steady the ratio is
SIGNS = ("power", "swing", "push_off", "landing")
FULL_VOTE = (math.log(2.0), math.log(1.25), math.radians(10.0), math.radians(10.0))
MIN_SCORE = 0.3
MIN_AGREEING = 3


@dataclass(frozen=True, slots=True)
class Power:
    """The paper's sign: ``ratio`` left over right of the largest power density; ``steady``, the share of the
    recording's eighths in which the same side is weaker."""

    ratio: float
    steady: float


@dataclass(frozen=True, slots=True)
class PareticSide:
    """The verdict."""

    side: str | None  # "left", "right", or None: not sure
    leaning: str  # the side that the votes lean to, however little
    score: float  # 0–1, size of the mean vote
    agreeing: int  # how many of the signs lean that way
    known: int  # how many could be measured
    votes: dict[str, float]  # by sign −1 … 1, left paretic positive; NaN where not measured
    power: Power  # the paper's ratio

    def describe(self) -> str:
        """One sentence for people."""
        of = f"score {self.score:.2f}, {self.agreeing} of {self.known} signs"
        steady = f"power left/right {self.power.ratio:.2f}, the same side weaker in {100 * self.power.steady:.0f} %"
        if self.side is None:
            return f"which side is paretic is not clear (leaning to the {self.leaning}: {of}; {steady})"
        if self.side != self.leaning:  # named by somebody
            of = f"as named; the walk's own signs lean to the {self.leaning}: {of}"
        return f"paretic side: {self.side} ({of}; {steady})"


def power(left: Foot, right: Foot, walk_ns: tuple[int, int] | None = None) -> Power:
    """The paper's ratio, over the walk (begin and end in ns; None: the whole recording) and over its eighths."""
    first, last = np.searchsorted(left.t_ns, walk_ns) if walk_ns is not None else (0, len(left.t_ns))
    along = [foot.along_mps2()[first:last] for foot in (left, right)]
    ratio = _ratio(along[0], along[1], left.rate_hz)
    blocks = [np.array_split(values, BLOCKS) for values in along]
    each = [_ratio(a, b, left.rate_hz) for a, b in zip(*blocks, strict=True)]
    same = [(value < 1.0) == (ratio < 1.0) for value in each if math.isfinite(value)]
    return Power(ratio, float(np.mean(same)) if same else 0.0)


def _ratio(left: FloatArray, right: FloatArray, rate_hz: float) -> float:
    """Of the largest power spectral densities by Welch's method."""
    from scipy.signal import welch

    if len(left) < rate_hz:
        return math.nan
    segment = min(int(SEGMENT_S * rate_hz), len(left))
    peaks = [float(welch(each - each.mean(), rate_hz, nperseg=segment)[1][1:].max()) for each in (left, right)]
    return peaks[0] / peaks[1] if min(peaks) > 0.0 else math.nan


def paretic_side(found: Power, feet: Mapping[str, Mapping[str, Statistic]]) -> PareticSide:
    """Weigh the signs: the paper's ratio, and each foot's parameters."""
    left, right = (feet.get(f"{side}_foot", {}) for side in ("left", "right"))

    def mean(of: Mapping[str, Statistic], key: str) -> float:
        return of[key].mean if key in of else math.nan

    swing = [mean(of, "swing_s") for of in (left, right)]
    differences = (
        -math.log(found.ratio) if found.ratio > 0.0 else math.nan,
        math.log(swing[0] / swing[1]) if min(swing) > 0.0 else math.nan,
        mean(right, "heel_rotation_rad") - mean(left, "heel_rotation_rad"),
        mean(right, "angle_contact_rad") - mean(left, "angle_contact_rad"),
    )
    votes = {
        sign: min(max(value / full, -1.0), 1.0) if math.isfinite(value) else math.nan
        for sign, value, full in zip(SIGNS, differences, FULL_VOTE, strict=True)
    }
    known = [vote for vote in votes.values() if math.isfinite(vote)]
    total = sum(known) / len(known) if known else 0.0
    leaning = "left" if total >= 0.0 else "right"
    agreeing = sum(vote * total > 0.0 for vote in known)
    sure = abs(total) >= MIN_SCORE and agreeing >= MIN_AGREEING
    return PareticSide(leaning if sure else None, leaning, abs(total), agreeing, len(known), votes, found)


RISER_M = 0.15
LEAST_SLOPE = 0.15  # height over length: a steep ramp is at 0.1, stairs are at 0.5


class Terrain(StrEnum):
    """What a stride went over."""

    LEVEL = "level"
    UP = "up"
    DOWN = "down"
    UNKNOWN = "unknown"


def terrain(height_gained_m: float, length_m: float) -> Terrain:
    """Of one stride, from the height (m) by which it ends higher and its horizontal length (m)."""
    if not (abs(height_gained_m) < 10.0 and length_m >= 0.0):  # also what is no number
        return Terrain.UNKNOWN
    if abs(height_gained_m) < 0.5 * RISER_M or abs(height_gained_m) < LEAST_SLOPE * length_m:
        return Terrain.LEVEL
    return Terrain.UP if height_gained_m > 0.0 else Terrain.DOWN


@dataclass(frozen=True)
class Windows:
    """The zero-velocity windows of both feet after Wang et al.

    ``tracks`` are by foot, reconstructed between its windows, in the visualization frame; a foot without windows is
    missing.
    """

    healthy: str  # name of the foot that was taken for healthy
    thresholds_m2ps4: dict[str, float]  # by foot
    shift_s: float  # by how much the mapped windows were shifted
    tracks: dict[str, FootTrack]


@dataclass(frozen=True)
class HemipareticWalk:
    """What a recording of both feet shows.

    ``terrain`` is by foot and stride number; ``windows`` None, with ``no_windows``, where the paper's method finds
    none.
    """

    side: PareticSide
    parameters: GaitParameters
    windows: Windows | None
    no_windows: str
    terrain: dict[str, dict[int, Terrain]]

    def rows(self) -> list[dict[str, Any]]:
        """One flat row per stride with its parameters, the side's part and the ground that it went over."""
        own = self.side.side
        return [
            {
                **row,
                "afflicted": "" if own is None else "yes" if row["foot"] == f"{own}_foot" else "no",
                "terrain": str(self.terrain.get(row["foot"], {}).get(row["number"], Terrain.UNKNOWN)),
            }
            for row in self.parameters.table
        ]

    def window_rows(self) -> list[dict[str, Any]]:
        """One flat row per stride between the centres of Wang et al.'s windows."""
        if self.windows is None:
            return []
        rows: list[dict[str, Any]] = []
        for foot, track in self.windows.tracks.items():
            times = track.t_ns[track.centres] / NS_PER_S
            columns = {
                "t_start_s": times[:-1],
                "t_end_s": times[1:],
                "stride_length_m": track.stride_lengths_m(),
                "swing_s": track.swing_s(),
                "stance_after_s": np.append(track.stance_s(), math.nan),
                "height_gained_m": track.height_changes_m(),
            }
            rows += [
                {"foot": foot, "number": k + 1}
                | {name: float(values[k]) for name, values in columns.items()}
                | {"healthy": foot == self.windows.healthy}
                for k in range(len(times) - 1)
            ]
        return sorted(rows, key=lambda row: (row["t_start_s"], row["foot"]))

    def track_rows(self, rate_hz: float = 25.0) -> list[dict[str, Any]]:
        """One flat row per foot and instant: place (m) in the visualization frame, x right, y along the walk, z up.

        Each foot starts at 0: how far apart they are is not known.
        """
        rows = []
        for foot, track in self.windows.tracks.items() if self.windows is not None else ():
            period_s = float(np.median(np.diff(track.t_ns))) / NS_PER_S
            picked = slice(None, None, max(round(1.0 / (rate_hz * period_s)), 1))
            for t, (x, y, z) in zip(track.t_ns[picked].tolist(), track.position_m[picked].tolist(), strict=True):
                rows.append({"foot": foot, "t_s": t / NS_PER_S, "x_m": x, "y_m": y, "z_m": z})
        return rows

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        counts = {
            foot: {kind.value: sum(t is kind for t in found.values()) for kind in Terrain}
            for foot, found in self.terrain.items()
        }
        windows: dict[str, Any] = {"reason": self.no_windows}
        if self.windows is not None:
            windows = {
                "healthy": self.windows.healthy,
                "thresholds_m2ps4": self.windows.thresholds_m2ps4,
                "shift_s": self.windows.shift_s,
                "strides": {foot: max(len(track.windows) - 1, 0) for foot, track in self.windows.tracks.items()},
            }
        return {
            "afflicted": self.side.side,
            "leaning": self.side.leaning,
            "score": self.side.score,
            "agreeing": self.side.agreeing,
            "votes": finite_or_none(self.side.votes),
            "power_ratio_left_over_right": self.side.power.ratio,
            "power_steady": self.side.power.steady,
            "terrain": counts,
            "windows": windows,
        }


def hemiparetic_walk(analysis: Analysis, *, paretic: str | None = None) -> HemipareticWalk:
    """Look at a recording of both feet, synchronised (else see ``sync.py``), as at a hemiparetic walk.

    ``paretic`` is "left" or "right" where somebody knows; None: told from the walk, if it can be.

    Raises:
        ValueError: not both feet were analysed.
    """
    missing = [foot for foot in FOOT_SENSORS if foot not in analysis.events]
    if missing:
        raise ValueError(
            f"{analysis.recording.name}: {' and '.join(missing)} missing; a hemiparetic walk needs both feet"
        )
    parameters = gait_parameters(analysis)
    feet = feet_of(analysis)
    events = [analysis.events[foot] for foot in FOOT_SENSORS if len(analysis.events[foot])]
    walk_ns = (min(int(e.fo_ns[0]) for e in events), max(int(e.ic_ns[-1]) for e in events)) if events else None
    side = paretic_side(power(feet["left_foot"], feet["right_foot"], walk_ns), parameters.feet)
    if paretic is not None:
        side = replace(side, side=paretic, leaning=paretic)
    parameters = replace(parameters, paretic=side.side, sides=symmetry(parameters.feet, side.side))
    healthy = "left_foot" if side.leaning == "right" else "right_foot"
    windows, why = None, ""
    try:
        windows = windows_of(feet, healthy)
    except ValueError as error:
        why = str(error)
    strides = (
        uneven_strides(analysis.recording, analysis.calibrations)
        if analysis.ground.level
        else {foot: [s for s in analysis.strides if s.foot == foot] for foot in analysis.events}
    )
    ground = {
        foot: {stride.number: terrain(stride.height_gained_m, stride.stride_length_m) for stride in own}
        for foot, own in strides.items()
    }
    return HemipareticWalk(side, parameters, windows, why, ground)


def feet_of(analysis: Analysis) -> dict[str, Foot]:
    """Both feet on common instants, turned into the world."""
    tracks = [analysis.recording.tracks[foot] for foot in FOOT_SENSORS]
    times = common_times(tracks)
    found = {}
    for track in tracks:
        calibration = analysis.calibrations[track.sensor]
        assert isinstance(calibration, FootCalibration)
        found[track.sensor] = foot_of(track, calibration, times)
    return found


def windows_of(feet: Mapping[str, Foot], healthy: str) -> Windows:
    """Wang et al.'s windows and reconstruction of both feet.

    ``feet`` are by name, on common instants; the threshold is fitted to each.

    Raises:
        ValueError: the healthy foot shows fewer than three windows.
    """
    other = next(name for name in feet if name != healthy)
    energies = {name: energy(foot.acc_mps2, foot.rate_hz) for name, foot in feet.items()}
    thresholds = {name: fitted_threshold(values) for name, values in energies.items()}
    own = still_windows(energies[healthy], thresholds[healthy])
    if len(own) < 3:
        raise ValueError(f"{healthy}: {len(own)} zero-velocity windows at {thresholds[healthy]:.3f} m²/s⁴")
    both = (thresholds[healthy], thresholds[other])
    its, shift_s = mapped(own, energies[healthy], energies[other], both, feet[healthy].rate_hz)
    tracks = {}
    for name, found in ((healthy, own), (other, its)):
        if len(found) >= 2:
            track = tracked(feet[name], found)
            try:
                tracks[name] = in_visualization_frame(track)
            except ValueError:  # it leads nowhere: there is no frame, but the strides are what they are
                tracks[name] = track
    return Windows(healthy, thresholds, shift_s, tracks)
