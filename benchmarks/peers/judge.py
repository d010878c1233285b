"""Rows of the accuracy table from the peers' results, measured against the truth as our own are."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable
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
from benchmarks.accuracy.orientation import upward
from benchmarks.accuracy.zero_velocity import LIMIT_MPS, scores
from benchmarks.lib.real_sets import STRAIGHT_RAD
from benchmarks.peers.cases import OUR_ENDS, Asked, between
from fes.signals import FloatArray

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
