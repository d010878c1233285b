"""What every guard saw over a whole session, for the report: its trackers run again over the samples of the log.

Stimulation and gate are not asked, so an hour takes seconds. Kept are the samples at which a phase changed, and between
them an even grid that gets coarser the longer the session is, so that a report's size is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fes.config import ConfigError, Session
from fes.control.replay import settings_of
from fes.estimation.sensor_choice import Calibration, phase_sensors, tracker_of
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult
from fes.stimulation.walking import WalkingJudge
from fes.walk_record import SampleArrays, WalkRecord
from statemachine.guards import Features, Thresholds

FINEST_NS: Final = NS_PER_S // 50  # between two kept samples
MOST_ROWS: Final = 20_000  # of the grid, all feet together; as many phase changes may come on top


@dataclass(frozen=True)
class GuardTrace:
    """One foot: ``t_ns`` (N,) arrival of the kept samples, ``phase`` (N,) before each, ``fired`` (N,) the transition.

    ``features`` (N, F) are what the guards saw, in the order of ``Features``, SI units. ``thresholds``: from which row
    on which hold. ``walking``: from which row on the judge says what. ``same``: whether the phases are the log's own.
    """

    foot: str
    sensor: str
    t_ns: IntArray
    phase: IntArray
    fired: IntArray
    features: FloatArray
    thresholds: list[tuple[int, Thresholds]]
    walking: list[tuple[int, str]]
    same: bool


def guard_traces(record: WalkRecord) -> list[GuardTrace]:
    """Of each foot whose phases the session's guards told; none where the record is no session of this version."""
    try:
        session, calibrations, _ = settings_of(record.header, Path())
        sensors = phase_sensors(calibrations)
        own = {foot: record.samples[name] for foot, name in sensors.items() if name in record.samples}
        if session.exercise is not None or not own:
            return []
        return [_trace(foot, session, calibrations[sensors[foot]], record, len(own)) for foot in own]
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError):
        return []  # of another version, or an analysis


def _trace(foot: str, session: Session, calibration: Calibration, record: WalkRecord, feet: int) -> GuardTrace:
    tracker, judge = tracker_of(session, calibration), WalkingJudge(session.stimulation)
    samples = record.samples[tracker.foot]
    own = [change for change in record.phases if change.foot == tracker.foot]
    ends = _kept(samples, np.array([change.t_ns for change in own], np.int64), MOST_ROWS // feet)
    changes: list[tuple[int, int]] = []
    rows = np.zeros((len(ends), len(Features._fields)))
    phase, fired = np.zeros(len(ends), np.int64), np.zeros(len(ends), np.int64)
    thresholds: list[tuple[int, Thresholds]] = []
    walking: list[tuple[int, str]] = []
    begin = 0
    times, acc, gyr = samples.t_sensor_ns, samples.acc_mps2, samples.gyr_radps
    for row, kept in enumerate(ends.tolist()):
        block = slice(begin, kept)
        outcomes = tracker.advance(times[block], acc[block], gyr[block]) if kept > begin else []
        begin, phase[row] = kept + 1, int(tracker.phase)
        # by itself: what a guard saw is kept of single steps
        for outcome in outcomes + tracker.step(int(times[kept]), tuple(acc[kept].tolist()), tuple(gyr[kept].tolist())):
            if isinstance(outcome, StrideResult):
                judge.on_stride(outcome)
                continue
            judge.on_phase(outcome)
            changes.append((outcome.t_ns, int(outcome.transition)))
            if outcome.t_ns == times[kept]:
                phase[row], fired[row] = int(outcome.source), int(outcome.transition)
        judge.on_time(int(times[kept]))
        rows[row], limits = tracker.seen()
        if not thresholds or thresholds[-1][1] != limits:
            thresholds.append((row, limits))
        if not walking or walking[-1][1] != judge.describe():
            walking.append((row, judge.describe()))
    same = changes == [(change.t_ns, int(change.transition)) for change in own]
    return GuardTrace(foot, tracker.foot, samples.t_ns[ends], phase, fired, rows, thresholds, walking, same)


def _kept(samples: SampleArrays, changes_ns: IntArray, most: int) -> IntArray:
    """Indices (N,) of the samples to keep, in order: those of phase changes (by the sensor's stamps), and a grid."""
    t_ns = samples.t_ns
    step_ns = max(FINEST_NS, int(t_ns[-1] - t_ns[0]) // most + 1)
    # the first sample of each cell of the grid
    grid = np.flatnonzero(np.diff((t_ns - t_ns[0]) // step_ns, prepend=-1))
    fired = np.flatnonzero(np.isin(samples.t_sensor_ns, changes_ns))[:MOST_ROWS]
    return np.union1d(grid, fired)
