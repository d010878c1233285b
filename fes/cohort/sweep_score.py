"""How good one combination of settings was on one recording or patient: counts and times that can be compared."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from fes.patient.truth import Truth
from fes.patient.virtual import VirtualStride
from fes.signals import NS_PER_S, FloatArray, IntArray, StimRequest, StrideResult
from fes.timing import LOG_TOLERANCE_MS, TRUTH_TOLERANCE_MS, WINDOW_MS, Mark, marks_of_phases, pair, timing_rows
from fes.truth_marks import marks_of_truth
from statemachine.phases import PhaseChange

BAND_M: Final = (0.010, 0.040)  # of true toe clearance: clear of the ground, and no higher than it must be
SETTLED: Final = 10  # strides that tuning may take
Scores = dict[str, float | int | None]
Burst = tuple[int, int]  # from when on to when off, ns


def stride_scores(strides: Sequence[StrideResult]) -> Scores:
    """What needs no truth: how many strides, how many valid and through all four phases, and their medians."""
    valid = [stride for stride in strides if stride.valid]
    four = sum(None not in (s.t_pre_swing_ns, s.t_swing_ns, s.t_loading_response_ns, s.t_stance_ns) for s in strides)
    return {
        "strides": len(strides),
        "valid_strides": len(valid),
        "four_phases": four,
        "stride_time_s": _median(1e-9 * (s.t_end_ns - s.t_start_ns) for s in valid),
        "stride_length_m": _median(s.stride_length_m for s in valid),
    }


def truth_scores(
    truth: Truth, feet: set[str], phases: Sequence[PhaseChange], strides: Sequence[StrideResult]
) -> Scores:
    """Transitions against the truth: missed, extra, off by more than the tolerance, and the errors of the pairs.

    Times are absolute values: the median and the 95th percentile over all pairs, and the medians of foot off (T2) and
    initial contact (T3). ``stride_length_rmse_m`` is over the steady strides of walking that were found.
    """
    expected, found = marks_of_truth(truth, feet), marks_of_phases(phases)
    rows = timing_rows(expected, found, TRUTH_TOLERANCE_MS, LOG_TOLERANCE_MS)
    errors = {(row.who, row.what): _errors_ms(row.who, row.what, row.tolerance_ms, expected, found) for row in rows}
    every = np.concatenate([np.zeros(0), *errors.values()])
    lengths = [_length_errors(truth, foot, strides) for foot in sorted(feet)]
    length = np.concatenate([np.zeros(0), *lengths])
    return {
        "marks": len(expected),
        "missed": sum(row.missed for row in rows),
        "extra": sum(row.extra for row in rows),
        "off": sum(row.early + row.late for row in rows),
        "error_ms": _median(every),
        "error_p95_ms": float(np.percentile(every, 95)) if every.size else None,
        "foot_off_error_ms": _median(
            np.concatenate([np.zeros(0), *(e for (_, what), e in errors.items() if what == "T2")])
        ),
        "contact_error_ms": _median(
            np.concatenate([np.zeros(0), *(e for (_, what), e in errors.items() if what == "T3")])
        ),
        "stride_length_rmse_m": float(np.sqrt(np.mean(length**2))) if length.size else None,
    }


def bursts_of(requests: Iterable[tuple[int, StimRequest]]) -> dict[int, list[Burst]]:
    """When each channel was asked to be on, by channel number, from requests by time."""
    since: dict[int, int] = {}
    found: dict[int, list[Burst]] = {}
    last_ns = 0
    for t_ns, request in requests:
        last_ns = t_ns
        if request.on:
            since.setdefault(request.channel, t_ns)
        elif request.channel in since:
            found.setdefault(request.channel, []).append((since.pop(request.channel), t_ns))
    for channel, begin_ns in since.items():
        found.setdefault(channel, []).append((begin_ns, last_ns))
    return found


def burst_scores(bursts: dict[int, list[Burst]], foot_of: dict[int, str], truth: Truth | None) -> Scores:
    """How many bursts; with a truth, swings of walking without one, and bursts that touch no swing."""
    scores: Scores = {"bursts": sum(map(len, bursts.values())), "swings_without": None, "bursts_without": None}
    if truth is None:
        return scores
    without, idle = 0, 0
    for channel, foot in foot_of.items():
        spans = bursts.get(channel, [])
        own = [(round(s.t_swing_s * NS_PER_S), round(s.t_loading_response_s * NS_PER_S), s) for s in truth.of(foot)]
        idle += sum(not any(off < end and begin < on for off, on, _ in own) for begin, end in spans)
        without += sum(s.walking and not any(off < end and begin < on for begin, end in spans) for off, on, s in own)
    return {**scores, "swings_without": without, "bursts_without": idle}


def patient_scores(strides: Sequence[VirtualStride], roll_backs: int, latched: bool) -> Scores:
    """A virtual patient's true strides from the first stimulated one on; shares of strides in :data:`BAND_M`.

    ``reached_after`` is the number of strides until four of five in a row lay in the band.
    """
    first = next((number for number, stride in enumerate(strides) if stride.charge_uc > 0.0), 0)
    mine = strides[first:]
    inside = [BAND_M[0] <= stride.toe_clearance_m <= BAND_M[1] for stride in mine]
    settled = inside[SETTLED:]
    return {
        "strides": len(mine),
        "in_band": sum(inside) / len(inside) if inside else None,
        "in_band_later": sum(settled) / len(settled) if settled else None,
        "reached_after": next((at for at in range(len(inside) - 4) if sum(inside[at : at + 5]) >= 4), None),
        "dragged": sum(stride.dragged for stride in mine),
        "stumbled": sum(stride.stumbled for stride in mine),
        "charge_uc": sum(stride.charge_uc for stride in mine) / len(mine) if mine else None,
        "roll_backs": roll_backs,
        "latched": int(latched),
    }


def _errors_ms(who: str, what: str, tolerance_ms: float, expected: Sequence[Mark], found: Sequence[Mark]) -> FloatArray:
    should, did = (_times(who, what, marks) for marks in (expected, found))
    pairs = pair(should, did, 1e6 * max(WINDOW_MS, 1.5 * tolerance_ms))
    return np.array([1e-6 * abs(int(did[j]) - int(should[i])) for i, j in pairs], np.float64)


def _times(who: str, what: str, marks: Iterable[Mark]) -> IntArray:
    return np.array(sorted(mark.t_ns for mark in marks if (mark.who, mark.what) == (who, what)), np.int64)


def _length_errors(truth: Truth, foot: str, strides: Sequence[StrideResult]) -> FloatArray:
    known = [s for s in truth.of(foot) if s.walking and s.steady]
    mine = [s for s in strides if s.foot == foot and s.valid and s.t_swing_ns is not None]
    should = np.array([round(s.t_swing_s * NS_PER_S) for s in known], np.int64)
    did = np.array([s.t_swing_ns for s in mine], np.int64)
    pairs = pair(should, did, 1e6 * WINDOW_MS)
    return np.array([mine[j].stride_length_m - known[i].stride_length_m for i, j in pairs], np.float64)


def _median(values: Iterable[float]) -> float | None:
    known = np.array([value for value in values if np.isfinite(value)], np.float64)
    return float(np.median(known)) if known.size else None
