"""Where a foot went over the ground: its path through a whole recording, for analysis after the fact.

The path is that of the smoothed ZUPT-aided filter (``fes.estimation.zupt``). A long recording is cut into stretches at
long rests, so that memory does not grow with it, and the stretches are joined there by place and heading. Nothing
measures heading but the gyroscope, so it drifts; two feet that go the same way tell what part of that they do not
share. On a treadmill the path is that over the belt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fes.estimation.calibration import FootCalibration
from fes.estimation.rest import RestCalibration, at_rest, calibrate_rest
from fes.estimation.rotation import rotate_all
from fes.estimation.zupt import stance_instants, with_quietest, zupt_path
from fes.recording import Track
from fes.replay import increasing
from fes.signals import FloatArray, IntArray

STRETCH_S = 90.0
SEARCH_S = 30.0  # around the end of a stretch, for a rest to cut it at
LEAST_REST_S = 0.15  # of the rest to cut at: the filter begins once the foot has rested for 0.1 s
JOIN_S = 0.12  # after the cut: there both stretches know where the foot is
AHEAD_M = 2.0
KEPT_HZ = 50.0
LEAST_STANCES = 12  # of either foot, to tell a drift of the headings from a turn
MOST_STANCES = 400  # of a long walk, evenly picked

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


@dataclass(frozen=True, slots=True)
class GroundPath:
    """The path of one foot's sensor; K samples of at most 50 Hz.

    Attributes:
        foot: its name.
        t_ns: (K,) time stamps.
        position_m: (K, 3): x ahead, towards where the foot first is 2 m away from its start, y left, z up; from its
            start.
        heading_rad: (K,) where the toe points, from x towards y; it turns by less than half a turn between stances.
        way_m: horizontal distances from stance to stance, summed.
        stance_ns: (M,) the quietest instant of every stance.
    """

    foot: str
    t_ns: IntArray
    position_m: FloatArray
    heading_rad: FloatArray
    way_m: float
    stance_ns: IntArray

    @property
    def closure_m(self) -> float:
        """Horizontal distance of the end from the start: the error, for who returned to where he set out."""
        return float(np.hypot(*self.position_m[-1, :2]))

    @property
    def height_gained_m(self) -> float:
        """How much higher the end is than the start; 0 but for small errors if the ground was said to be level."""
        return float(self.position_m[-1, 2])

    def at(self, t_ns: IntArray) -> FloatArray:
        """Rows (M, 4) of x, y, z (m) and heading (rad) at M instants; beyond the ends the path stands still."""
        begin = self.t_ns[0]
        asked, known = (np.asarray(t - begin, dtype=np.float64) for t in (np.asarray(t_ns, np.int64), self.t_ns))
        columns = (*self.position_m.T, self.heading_rad)
        return np.column_stack([np.interp(asked, known, column) for column in columns])

    def rows(self, rate_hz: float = 10.0) -> list[dict[str, Any]]:
        """One flat row per instant, units in the names."""
        seconds = (self.t_ns - self.t_ns[0]) * 1e-9
        instants = self.t_ns[0] + np.round(np.arange(0.0, seconds[-1] + 1e-9, 1.0 / rate_hz) * 1e9).astype(np.int64)
        names = ("x_m", "y_m", "z_m", "heading_rad")
        return [
            {"foot": self.foot, "t_s": 1e-9 * t, **dict(zip(names, row, strict=True))}
            for t, row in zip(instants.tolist(), self.at(instants).tolist(), strict=True)
        ]


def ground_path(track: Track, calibration: FootCalibration, *, level: bool = True) -> GroundPath:
    """Follow one foot through a whole recording.

    Args:
        track: its samples.
        calibration: of the same sensor, for where the toe points.
        level: the foot rests at one height; not on stairs and slopes.

    Raises:
        ValueError: the recording is too short, or the foot never rests.
    """
    newer = increasing(track)
    t_ns, acc, gyr = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
    if len(t_ns) < 3:
        raise ValueError(f"{track.sensor}: {len(t_ns)} samples make no path")
    rest_calibration = calibrate_rest(acc, gyr, track.rate_hz)
    rest = with_quietest(at_rest(rest_calibration, acc, gyr, track.rate_hz), gyr, track.rate_hz)
    if not rest.any():
        raise ValueError(f"{track.sensor}: the foot never rests, so nothing holds a path; check the units")
    position, heading = np.empty((len(t_ns), 3)), np.empty(len(t_ns))
    join = round(JOIN_S * track.rate_hz)
    cuts = [0, *_cuts(t_ns, rest, track.rate_hz), len(t_ns)]
    for k, begin in enumerate(cuts[:-1]):
        span = slice(begin, min(cuts[k + 1] + join + 1, len(t_ns)))
        found, pointing = _stretch(track, t_ns[span], acc[span], gyr[span], rest[span], rest_calibration, level)
        headings = np.unwrap(np.arctan2(*(rotate_all(pointing, calibration.forward())[:, (1, 0)].T)))
        at = begin + join if k else 0
        if k:
            turn = heading[at] - headings[at - begin]
            found = found @ _about_z(turn).T
            found += position[at] - found[at - begin]
            headings = headings + turn
        position[at : span.stop], heading[at : span.stop] = found[at - begin :], headings[at - begin :]
    stances = stance_instants(rest, gyr, track.rate_hz)
    way_m = float(np.hypot(*np.diff(position[stances, :2], axis=0).T).sum())
    heading = _continuous(heading, stances)
    keep = np.unique(np.append(np.arange(0, len(t_ns), max(round(track.rate_hz / KEPT_HZ), 1)), len(t_ns) - 1))
    path = GroundPath(calibration.sensor, t_ns[keep], position[keep], heading[keep], way_m, t_ns[stances])
    return ahead(path)


def _continuous(heading: FloatArray, stances: IntArray) -> FloatArray:
    """The heading (N,) without false whole turns: a toe that points straight down in between has no heading."""
    at_stance = heading[stances]
    off = np.unwrap(at_stance) - at_stance
    nearest = np.searchsorted((stances[1:] + stances[:-1]) // 2, np.arange(len(heading)), side="right")
    return np.asarray(heading + off[nearest])


def _stretch(
    track: Track,
    t_ns: IntArray,
    acc: FloatArray,
    gyr: FloatArray,
    rest: BoolArray,
    calibration: RestCalibration,
    level: bool,
) -> tuple[FloatArray, FloatArray]:
    """Position (N, 3) and orientation (N, 4) of one stretch."""
    path = zupt_path(
        t_ns,
        acc,
        gyr,
        calibration=calibration,
        rest=rest,
        level_ground=level,
        acc_range_mps2=track.acc_range_mps2,
        gyr_range_radps=track.gyr_range_radps,
    )
    return path.position_m, path.q_world_from_sensor


def _cuts(t_ns: IntArray, rest: BoolArray, rate_hz: float) -> list[int]:
    """Where to cut: at the longest rest near the end of every stretch, if it is long enough."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], rest, [False])).astype(np.int8)))
    begins, ends = edges[0::2], edges[1::2]
    seconds = 1e-9 * (t_ns[begins] - t_ns[0])
    cuts: list[int] = []
    last_s, total_s = 0.0, 1e-9 * float(t_ns[-1] - t_ns[0])
    while total_s - last_s > STRETCH_S + SEARCH_S:
        near = np.flatnonzero(np.abs(seconds - last_s - STRETCH_S) <= SEARCH_S)
        longest = near[np.argmax((ends - begins)[near])] if len(near) else -1
        last_s += STRETCH_S
        if longest >= 0 and ends[longest] - begins[longest] >= LEAST_REST_S * rate_hz:
            cuts.append(int(begins[longest]))
            last_s = float(seconds[longest])
    return cuts


def ahead(path: GroundPath) -> GroundPath:
    """The same, turned so that x points to where the foot first is 2 m away (at most as far as it goes)."""
    flat = path.position_m[:, :2]
    far = np.hypot(*flat.T)
    at = int(np.argmax(far >= min(AHEAD_M, 0.999 * float(far.max()))))
    angle = float(np.arctan2(flat[at, 1], flat[at, 0]))
    start = round(float(path.heading_rad[0] - angle) / (2.0 * np.pi)) * 2.0 * np.pi
    return replace(path, position_m=path.position_m @ _about_z(-angle).T, heading_rad=path.heading_rad - angle - start)


def _about_z(angle_rad: float) -> FloatArray:
    c, s = float(np.cos(angle_rad)), float(np.sin(angle_rad))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def together(left: GroundPath, right: GroundPath) -> tuple[GroundPath, GroundPath]:
    """Both feet's paths without the part of their heading's drift in which they differ.

    Two feet of one walker go the same way, so their headings at stance differ by a constant (toes point outward) but
    for what a turn does for a moment. A drift per stride in that difference (the median slope over pairs of stances,
    Theil 1950, Sen 1968) is an error; nothing says whose, so each foot takes half. On a healthy walk before cameras,
    the errors were such mirror images: +0.56 and −0.48 °/s. Without enough strides both are returned as they are.
    """
    drift = _drift_apart(left, right)
    return ahead(_turned(left, left.stance_ns, -0.5 * drift)), ahead(_turned(right, left.stance_ns, 0.5 * drift))


def _drift_apart(left: GroundPath, right: GroundPath) -> float:
    """By how much the left heading runs away from the right one per stride (rad), positive to the left."""
    common = left.stance_ns[(left.stance_ns >= right.stance_ns[0]) & (left.stance_ns <= right.stance_ns[-1])]
    if len(common) < LEAST_STANCES:
        return 0.0
    of_right = np.interp(
        (common - common[0]).astype(np.float64),
        (right.stance_ns - common[0]).astype(np.float64),
        np.unwrap(right.at(right.stance_ns)[:, 3]),
    )
    apart = np.unwrap(np.unwrap(left.at(common)[:, 3]) - of_right)
    count = min(len(common), MOST_STANCES)
    picked = np.linspace(0, len(common) - 1, count).round().astype(int)
    i, j = np.triu_indices(count, k=count // 4)
    slopes = (apart[picked[j]] - apart[picked[i]]) / (picked[j] - picked[i])
    return float(np.median(slopes))


def _turned(path: GroundPath, stance_ns: IntArray, per_stride_rad: float) -> GroundPath:
    """The path bent by an angle that grows from stance to stance."""
    begin = path.t_ns[0]
    since, stances = ((t - begin).astype(np.float64) for t in (path.t_ns, stance_ns))
    angle = per_stride_rad * np.interp(since, stances, np.arange(len(stances), dtype=np.float64))
    step = np.diff(path.position_m[:, :2], axis=0)
    middle = 0.5 * (angle[1:] + angle[:-1])
    c, s = np.cos(middle), np.sin(middle)
    bent = np.column_stack((c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]))
    position = path.position_m.copy()
    position[1:, :2] = position[0, :2] + np.cumsum(bent, axis=0)
    return replace(path, position_m=position, heading_rad=path.heading_rad + angle)
