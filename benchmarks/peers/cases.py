"""The cases put to the peers, with their truth, which stays here."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy.orientation import Trial, broad, gaitmap_pitch
from benchmarks.accuracy.stride_length import quietest_near, strides_of
from benchmarks.lib import real_sets
from benchmarks.lib.real_sets import LAST_S, BoolArray, BorderedWalk, PathWalk, Walk, gaitmap, pyshoe, ruler, xio
from benchmarks.peers.exchange import Case
from fes.analysis.ground_path import GroundPath, ground_path
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Track
from fes.signals import FloatArray, IntArray, StrideResult

WARM_UP_S = 10.0
OUR_ENDS = "our ends"  # the task of those peers that are also asked between the borders that our solver chose


@dataclass(frozen=True)
class Asked:
    """A case and what is true of it; what does not apply is empty, None or NaN.

    ``length_m`` and ``lift_m`` (M,) belong to the case's borders, NaN where nobody knows; ``walk`` tells the length
    between any two instants; ``swings_s`` (K,) lie inside the strides of the reference, for recall; ``path``
    tells where the foot points, so that what is a turn is the same for every method; ``speed_mps`` (N,) is the optical
    speed.
    """

    case: Case
    data_set: str
    length_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    lift_m: FloatArray = field(default_factory=lambda: np.zeros(0))
    walk: Walk | None = None
    swings_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    events: real_sets.Case | None = None
    path: GroundPath | None = None
    belt_mps: float = float("nan")
    speed_mps: FloatArray = field(default_factory=lambda: np.zeros(0))
    trial: Trial | None = None


def case_of(
    name: str, track: Track, calibration: FootCalibration, borders_ns: IntArray, tasks: tuple[str, ...],
    *, own_axes: bool = False,
) -> Case:  # fmt: skip
    """Turned into x forward, y left, z up, the gyroscope's bias taken off; borders (M, 2) in ns.

    ``own_axes``: the sensor's axes are near enough to that, and the peers' templates were made with them.
    """
    forward, up = calibration.forward(), np.array(calibration.up)
    axes = np.eye(3) if own_axes else np.stack((forward, np.cross(up, forward), up))
    borders = np.searchsorted(track.t_ns, borders_ns.reshape(-1, 2)).clip(0, len(track.t_ns) - 1)
    side, gyr = track.sensor.split("_")[0], track.gyr_radps - np.array(calibration.gyr_bias_radps)
    return Case(name, side, track.rate_hz, track.acc_mps2 @ axes.T, gyr @ axes.T, borders, tasks)


def bordered(walks: list[BorderedWalk], tasks: tuple[str, ...]) -> list[Asked]:
    """Walks with reference borders; a stride that the set itself disputes is measured, but does not count."""
    asked = []
    for borders in walks:
        walk = borders.walk
        ends = np.column_stack((borders.begin_ns, borders.end_ns))
        calibration, own = calibrate_track(walk.track), walk.data_set == "gaitmap_walk"
        counts = ~borders.disputed & _countable(walk, ends)
        lifts = [walk.true_clearance_m(between(walk.track, *pair)) for pair in ends.tolist()]
        asked.append(
            Asked(
                case_of(f"{walk.data_set}-{walk.name}", walk.track, calibration, ends, tasks, own_axes=own),
                walk.data_set,
                length_m=np.where(counts, borders.length_m, np.nan),
                lift_m=np.where(counts, lifts, np.nan),
                walk=walk,
                swings_s=0.5e-9 * ends.sum(axis=1),
                path=ground_path(walk.track, calibration),
                speed_mps=borders.speed_mps,
            )
        )
    return asked


def _countable(walk: Walk, ends_ns: IntArray) -> BoolArray:
    """Where the cameras followed the sensor (M,): no glitch, and more than a shuffle on the spot."""
    if not (isinstance(walk, PathWalk) and walk.at_sensor):
        return np.ones(len(ends_ns), dtype=bool)
    return np.array([np.isfinite(walk.true_length_m(between(walk.track, *pair))) for pair in ends_ns.tolist()])


def between(track: Track, begin_ns: int, end_ns: int) -> StrideResult:
    """A stride of which nothing but its ends is known, to ask a reference about."""
    return StrideResult(track.sensor, 0, begin_ns, end_ns, *[float("nan")] * 5, *[None] * 4)


def at_our_ends(one: Asked) -> Asked:
    """The same strides with each border where our own solver moves it, to the quietest instant within 50 ms.

    Truth is taken at the moved borders, as for our solver; strides that do not count there do not count here.
    """
    assert one.walk is not None
    track, walk = one.walk.track, one.walk
    borders = np.array(
        [quietest_near(track.t_ns, one.case.gyr_radps, int(track.t_ns[k])) for k in one.case.borders.ravel()]
    ).reshape(-1, 2)
    strides = [between(track, int(track.t_ns[first]), int(track.t_ns[last])) for first, last in borders]
    known = np.isfinite(one.length_m)
    arm = walk if isinstance(walk, PathWalk) and walk.lever_m is not None else None
    lifts = [walk.true_clearance_m(s) if arm is None else arm.true_lift_m(s) for s in strides]
    return replace(
        one,
        case=replace(one.case, name=f"{one.case.name}-our-ends", borders=borders, tasks=(OUR_ENDS,)),
        length_m=np.where(known, [walk.true_length_m(s) for s in strides], np.nan),
        lift_m=np.where(known, lifts, np.nan),
    )


def gaitmap_asked(folder: Path) -> list[Asked]:
    """Both feet: reference borders of the straight strides, all 57 strides for recall, events."""
    asked = []
    for one, events in zip(bordered(gaitmap(folder), ()), real_sets.gaitmap_cases(folder), strict=True):
        walk, case = one.walk, replace(one.case, tasks=("borders", "detection", "events"))
        assert isinstance(walk, PathWalk)
        ends_ns = np.round(1e9 * case.borders / case.rate_hz).astype(np.int64)
        lifts = np.array([walk.true_lift_m(between(walk.track, *pair)) for pair in ends_ns.tolist()])
        swings = 0.5 * (events.fo_s + events.ic_s)
        asked.append(replace(one, case=case, lift_m=lifts, swings_s=swings, events=events))
    return asked


def stroke_asked(folder: Path) -> list[Asked]:
    """24 feet in the last 120 s, between the borders that our own tracker found; warmed up for 10 s."""
    asked = []
    for run, track, belt_mps in real_sets.stroke_feet(folder):
        calibration = calibrate_track(track)
        strides, since_ns = strides_of(track, calibration, "maximum_likelihood"), track.t_ns[-1] - LAST_S * 1e9
        ends = np.array([(s.t_start_ns, s.t_end_ns) for s in strides if s.t_start_ns >= since_ns])
        first = int(np.searchsorted(track.t_ns, track.t_ns[-1] - round(1e9 * (LAST_S + WARM_UP_S))))
        part = track.part(slice(first, None))
        case = case_of(f"stroke-{run}-{track.sensor}", part, calibration, ends, ("borders", "detection"))
        asked.append(Asked(case, "stroke_treadmill", belt_mps=belt_mps))
    return asked


def orientation_asked(folder: Path) -> list[Asked]:
    """A board moved by hand and the pitch of a walking foot, in the sensors' own axes."""
    none = np.zeros((0, 2), dtype=np.int64)
    asked = []
    for trial in (*broad(folder), *gaitmap_pitch(folder)):
        name = f"orientation-{trial.data_set}-{trial.name}".replace(" ", "-")
        case = Case(name, "left", trial.rate_hz, trial.acc_mps2, trial.gyr_radps, none, ("orientation",))
        asked.append(Asked(case, trial.data_set, trial=trial))
    return asked


def all_asked(folder: Path) -> list[Asked]:
    walks = [
        *bordered(pyshoe(folder), ("borders", "detection", "rest")),
        *bordered(ruler(folder), ("borders", "detection")),
        *gaitmap_asked(folder),
    ]
    asked = [*walks, *map(at_our_ends, walks), *stroke_asked(folder), *orientation_asked(folder)]
    if loop := xio(folder):
        none = np.zeros((0, 2), dtype=np.int64)
        asked.append(Asked(case_of("xio_walk", loop, calibrate_track(loop), none, ("closure",)), "xio_walk"))
    return asked
