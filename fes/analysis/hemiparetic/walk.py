"""A hemiparetic walk from both feet: the paretic side, Wang et al.'s windows, and today's strides beside them.

The figures to go by are those of :mod:`fes.analysis.parameters`, from the project's own strides:
``benchmarks/hemiparetic.py`` shows that they count strides and measure speed better than the windows. The windows, and
the reconstruction that rests on them, are there for comparison with the paper and for its picture of both feet in one
frame.

Level walking, stairs up and stairs down, told apart stride by stride.

Source: Wang et al. (2013), Figure 4: with z against gravity the three are seen to differ in the reconstruction. No
rule is given there. Here it is the height gained from stance to stance: half of the lowest usual riser (ISO and
building codes: 15 cm and more) is beyond what a level stride's error amounts to, and a person who sets both feet on
every stair still climbs a whole riser per stride.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from fes.analysis.hemiparetic.foot import Foot, FootTrack, common_times, foot_of, in_visualization_frame, tracked
from fes.analysis.hemiparetic.side import PareticSide, paretic_side, power
from fes.analysis.hemiparetic.windows import energy, fitted_threshold, mapped, still_windows
from fes.analysis.parameters.gait import GaitParameters, gait_parameters
from fes.analysis.parameters.summary import symmetry
from fes.analysis.pipeline import uneven_strides
from fes.analysis.results import Analysis
from fes.estimation.foot.calibration import FootCalibration
from fes.signals import FOOT_SENSORS, NS_PER_S, StrideResult

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


def terrains(height_changes_m: Sequence[float], lengths_m: Sequence[float]) -> list[Terrain]:
    """Of the strides of one foot, in order."""
    return [terrain(height, length) for height, length in zip(height_changes_m, lengths_m, strict=True)]


@dataclass(frozen=True)
class Windows:
    """The zero-velocity windows of both feet after Wang et al.

    Attributes:
        healthy: name of the foot that was taken for healthy. thresholds_m2ps4: by foot. shift_s: by how much the
        mapped windows were shifted. tracks: by foot, reconstructed between its windows, in the visualization frame; a
        foot without windows is missing.
    """

    healthy: str
    thresholds_m2ps4: dict[str, float]
    shift_s: float
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
            for row in self.parameters.rows()
        ]

    def window_rows(self) -> list[dict[str, Any]]:
        """One flat row per stride between the centres of Wang et al.'s windows."""
        if self.windows is None:
            return []
        rows = []
        for foot, track in self.windows.tracks.items():
            lengths, swings = track.stride_lengths_m(), track.swing_s()
            stances = np.append(track.stance_s(), math.nan)
            gains, times = track.height_changes_m(), track.t_ns[track.centres] / NS_PER_S
            for k in range(len(lengths)):
                rows.append(
                    {
                        "foot": foot,
                        "number": k + 1,
                        "t_start_s": float(times[k]),
                        "t_end_s": float(times[k + 1]),
                        "stride_length_m": float(lengths[k]),
                        "swing_s": float(swings[k]),
                        "stance_after_s": float(stances[k]),
                        "height_gained_m": float(gains[k]),
                        "healthy": foot == self.windows.healthy,
                    }
                )
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
            "votes": {sign: None if math.isnan(vote) else vote for sign, vote in self.side.votes.items()},
            "power_ratio_left_over_right": self.side.power.ratio,
            "power_steady": self.side.power.steady,
            "terrain": counts,
            "windows": windows,
        }


def hemiparetic_walk(analysis: Analysis, *, paretic: str | None = None) -> HemipareticWalk:
    """Look at a recording of both feet as at a hemiparetic walk.

    Args:
        analysis: with both feet's sensors, synchronised (else see :mod:`fes.analysis.hemiparetic.sync`).
        paretic: "left" or "right" where somebody knows; None: told from the walk, if it can be.

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
    side = paretic_side(power(feet["left_foot"], feet["right_foot"], _walk_ns(analysis)), parameters.feet)
    if paretic is not None:
        side = replace(side, side=paretic, leaning=paretic)
    parameters = replace(parameters, paretic=side.side, sides=symmetry(parameters.feet, side.side))
    healthy = "left_foot" if side.leaning == "right" else "right_foot"
    windows, why = None, ""
    try:
        windows = windows_of(feet, healthy)
    except ValueError as error:
        why = str(error)
    return HemipareticWalk(side, parameters, windows, why, _terrain(analysis))


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


def windows_of(feet: Mapping[str, Foot], healthy: str, threshold_m2ps4: float | None = None) -> Windows:
    """Wang et al.'s windows and reconstruction of both feet.

    Args:
        feet: by name, on common instants. healthy: name of the healthy one. threshold_m2ps4: of both feet; None: fitted
        to each, see :func:`fes.analysis.hemiparetic.windows.fitted_threshold`.

    Raises:
        ValueError: the healthy foot shows fewer than three windows.
    """
    other = next(name for name in feet if name != healthy)
    energies = {name: energy(foot.acc_mps2, foot.rate_hz) for name, foot in feet.items()}
    thresholds = {name: threshold_m2ps4 or fitted_threshold(values) for name, values in energies.items()}
    own = still_windows(energies[healthy], thresholds[healthy])
    if len(own) < 3:
        raise ValueError(f"{healthy}: {len(own)} zero-velocity windows at {thresholds[healthy]:.3f} m²/s⁴")
    its = mapped(
        own, energies[healthy], energies[other], (thresholds[healthy], thresholds[other]), feet[healthy].rate_hz
    )
    tracks = {}
    for name, found in ((healthy, own), (other, its.windows)):
        if len(found) >= 2:
            track = tracked(feet[name], found)
            try:
                tracks[name] = in_visualization_frame(track)
            except ValueError:  # it leads nowhere: there is no frame, but the strides are what they are
                tracks[name] = track
    return Windows(healthy, thresholds, its.shift_s, tracks)


def _walk_ns(analysis: Analysis) -> tuple[int, int] | None:
    events = [analysis.events[foot] for foot in FOOT_SENSORS if len(analysis.events[foot])]
    if not events:
        return None
    return min(int(e.fo_ns[0]) for e in events), max(int(e.ic_ns[-1]) for e in events)


def _terrain(analysis: Analysis) -> dict[str, dict[int, Terrain]]:
    strides: Mapping[str, list[StrideResult]]
    if analysis.level:
        strides = uneven_strides(analysis.recording, analysis.calibrations)
    else:
        strides = {foot: [s for s in analysis.strides if s.foot == foot] for foot in analysis.events}
    return {
        foot: dict(
            zip(
                [s.number for s in own],
                terrains([s.height_gained_m for s in own], [s.stride_length_m for s in own]),
                strict=True,
            )
        )
        for foot, own in strides.items()
    }
