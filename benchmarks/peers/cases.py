"""The cases put to the peers, with their truth, which stays here; and what their results are worth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy.accuracy_rows import (
    BELT,
    BELT_OWN,
    CLOSURE,
    INCLINATION,
    LENGTH_GIVEN,
    LENGTH_OWN,
    LIFT_GIVEN,
    PITCH,
    Row,
    row_of,
)
from benchmarks.accuracy.events import OFFLINE_S, compare
from benchmarks.accuracy.orientation import Trial, broad, gaitmap_pitch, upward
from benchmarks.accuracy.stride_length import quietest_near, strides_of
from benchmarks.accuracy.zero_velocity import LIMIT_MPS, scores
from benchmarks.lib import real_sets
from benchmarks.lib.real_sets import (
    LAST_S,
    STRAIGHT_RAD,
    BoolArray,
    BorderedWalk,
    PathWalk,
    Walk,
    gaitmap,
    pyshoe,
    ruler,
    xio,
)
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
    lifts = [walk.true_lift_m(s) for s in strides]
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
        assert walk is not None
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


# --- rows of the accuracy table from their results, measured as our own are -------------------------------------------

Found = dict[str, np.ndarray]
Pairs = list[tuple[Asked, Found]]


def judge(folder: Path, asked: list[Asked]) -> list[Row]:
    """Rows of all results in ``folder``; a method that failed on any foot of a set says why."""
    by_name = {one.case.name: one for one in asked}
    groups: dict[tuple[str, str, str, str], Pairs] = defaultdict(list)
    for path in sorted(folder.glob("*.result.npz")):
        found = dict(np.load(path))
        one = by_name[str(found["case"])]
        groups[one.data_set, str(found["task"]), str(found["method"]), str(found["known"])].append((one, found))
    rows: list[Row] = []
    for (data_set, task, method, known), pairs in groups.items():
        errors = [str(found["error"]) for _, found in pairs if "error" in found]
        good = [(one, found) for one, found in pairs if "error" not in found]
        which = task if data_set != "stroke_treadmill" else f"belt {task}"
        if good:
            rows += JUDGES[which](data_set, method, known, good)
        if errors:
            why = f"failed on {len(errors)} of {len(pairs)} recordings: {errors[0]}"
            rows.append(Row(data_set, f"{task}: not run", "", method, known, note=why))
    return rows


def _borders(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    for quantity, key, truth in ((LENGTH_GIVEN, "length_m", "length_m"), (LIFT_GIVEN, "lift_m", "lift_m")):
        errors = np.concatenate([100.0 * (found[key] - getattr(one, truth)) for one, found in pairs])
        wanted = np.concatenate([getattr(one, truth) for one, _ in pairs])
        if np.isfinite(wanted).any():
            recall = float(np.isfinite(errors).sum() / np.isfinite(wanted).sum())
            yield row_of(data_set, quantity, "cm", method, known, errors, recall)


def _detection(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    errors, swings, hit = [], 0, 0
    for one, found in pairs:
        borders_s = found["borders"] / one.case.rate_hz
        errors += own_border_errors(one, borders_s, found["length_m"])
        swings += len(one.swings_s)
        hit += strides_hit(one.swings_s, borders_s)
    yield row_of(data_set, LENGTH_OWN, "cm", method, known, errors, hit / swings)


def own_border_errors(one: Asked, borders_s: FloatArray, length_m: FloatArray) -> list[float]:
    """Estimate − truth (cm) of the strides between a method's own borders that can be compared.

    Where the reference is not at the sensor, strides that turn by more than 20° are left out, for every method by the
    same heading: the foot swivels on the ground, and what the sensor travels is not what the footprint does.
    """
    assert one.walk is not None
    assert one.path is not None
    errors = []
    borders_ns = np.round(1e9 * borders_s).astype(np.int64)
    turns = np.diff([one.path.places_at(ends)[:, 3] for ends in borders_ns.T], axis=0)[0]
    for (begin_ns, end_ns), turn, length in zip(borders_ns.tolist(), turns, length_m, strict=True):
        truth = one.walk.true_length_m(between(one.walk.track, begin_ns, end_ns))
        if np.isfinite(truth) and (getattr(one.walk, "at_sensor", False) or abs(turn) <= STRAIGHT_RAD):
            errors.append(100.0 * (length - truth))
    return errors


def strides_hit(swings_s: FloatArray, borders_s: FloatArray) -> int:
    """How many of the reference's swings lie inside a found stride."""
    return sum(bool(np.any((borders_s[:, 0] < t) & (t < borders_s[:, 1]))) for t in swings_s)


def _belt(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    ratios = [_speed(one.case.borders, found["length_m"], one) for one, found in pairs]
    yield row_of(data_set, BELT, "%", method, known, 100.0 * (np.array(ratios) - 1.0), 1.0)


def _belt_detection(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    ratios, found_strides, all_strides = [], 0, 0
    for one, found in pairs:
        ratios.append(_speed(found["borders"], found["length_m"], one))
        middles = one.case.borders.mean(axis=1) / one.case.rate_hz
        found_strides += strides_hit(middles, found["borders"] / one.case.rate_hz)
        all_strides += len(middles)
    recall = found_strides / all_strides
    yield row_of(data_set, BELT_OWN, "%", method, known, 100.0 * (np.array(ratios) - 1.0), recall)


def _speed(borders: np.ndarray, length_m: FloatArray, one: Asked) -> float:
    known = np.isfinite(length_m)
    time_s = float((borders[known, 1] - borders[known, 0]).sum()) / one.case.rate_hz
    return float(length_m[known].sum()) / time_s / one.belt_mps if time_s > 0.0 else float("nan")


def _events(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    for event in ("IC", "FO"):
        errors, true_events = [], 0
        for one, found in pairs:
            assert one.events is not None
            true = one.events.ic_s if event == "IC" else one.events.fo_s
            errors.append(1e3 * compare(found[event], true, OFFLINE_S)[0])
            true_events += len(true)
        together = np.concatenate(errors)
        yield row_of(data_set, f"{event} time", "ms", method, known, together, len(together) / true_events)


def _rest(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    found_scores = []
    for one, found in pairs:
        seen = np.isfinite(one.speed_mps)
        found_scores.append(scores(one.speed_mps[seen] < LIMIT_MPS, found["rest"].astype(bool)[seen]))
    f1, _, recall = np.mean(found_scores, axis=0).tolist()
    yield f1_row(data_set, method, known, len(pairs), f1, recall, min(score[0] for score in found_scores))


def f1_row(data_set: str, method: str, known: str, n: int, f1: float, recall: float, worst_f1: float) -> Row:
    """Rest by sample: the shortfall of F1 from 1, in percent, over walks."""
    return Row(
        data_set, "rest per sample: 1 − F1", "%", method, known, n=n, bias=100.0 * (1.0 - f1),
        worst=100.0 * (1.0 - worst_f1), recall=recall,
    )  # fmt: skip


def _orientation(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    errors = []
    for one, found in pairs:
        assert one.trial is not None
        errors.append(one.trial.score(upward(found["q"])))
    yield orientation_row(data_set, method, known, errors)


def orientation_row(data_set: str, method: str, known: str, rmse_deg: list[float]) -> Row:
    """RMSE of the trials: their mean, and the worst of them."""
    quantity = INCLINATION if data_set == "broad" else PITCH
    mean, worst = float(np.mean(rmse_deg)), max(rmse_deg)
    return Row(data_set, quantity, "°", method, known, n=len(rmse_deg), rmse=mean, worst=worst)


def _closure(data_set: str, method: str, known: str, pairs: Pairs) -> Iterable[Row]:
    gaps = [float(np.hypot(*found["end_m"][:2])) for _, found in pairs]
    yield row_of(data_set, CLOSURE, "m", method, known, gaps)


JUDGES: dict[str, Callable[[str, str, str, Pairs], Iterable[Row]]] = {
    "borders": _borders,
    OUR_ENDS: _borders,
    "detection": _detection,
    "events": _events,
    "rest": _rest,
    "closure": _closure,
    "orientation": _orientation,
    "belt borders": _belt,
    "belt detection": _belt_detection,
}
