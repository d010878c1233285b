"""One combination of settings tried on one recording or virtual patient, scored, and its row kept at once.

Scores are counts and times that can be compared.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fes import __version__
from fes.cohort.store import CohortError, Source, local_copy, program
from fes.cohort.sweep.grid import Point, Value, change_thresholds, session_with, thresholds_of
from fes.cohort.sweep.table import RESULTS
from fes.cohort.task import DONE, Rows, Task
from fes.config import Ground, Session
from fes.estimation.foot.calibration import FootCalibration
from fes.evaluation.timing.marks import (
    TRUTH_TOLERANCE_MS,
    WINDOW_MS,
    Burst,
    bursts_of,
    marks_of_phases,
    marks_of_truth,
    pair_times,
    timing_rows,
)
from fes.recording import read_recording
from fes.recording.tracks import samples_of
from fes.signals import NS_PER_S, FloatArray, StimRequest, StrideResult
from fes.simulation.forward import VirtualPatient, VirtualStride, draw_patient
from fes.simulation.truth import Truth, load_truth
from statemachine.guards import Thresholds
from statemachine.phases import PhaseChange

if TYPE_CHECKING:
    from fes.estimation.sensor_choice import Calibration
    from fes.recording import Recording
    from fes.simulation.forward import PatientSettings

BAND_M: Final = (0.010, 0.040)  # of true toe clearance: clear of the ground, and no higher than it must be
SETTLED: Final = 10  # strides that tuning may take
Scores = dict[str, float | int | None]
TRUTH_FILES: Final = (".truth.parquet", ".strides.csv", ".activities.csv")
CREATED: Final = "2000-01-01T00:00:00+00:00"  # the same run, the same bytes
ARM_AFTER_S: Final = 0.5
STAND_S: Final = 10.0  # of a patient, who is armed for meanwhile


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
    rows = timing_rows(expected, found, TRUTH_TOLERANCE_MS)
    errors = {(row.who, row.what): np.abs(row.error_ms) for row in rows}
    every = np.concatenate([np.zeros(0), *errors.values()])
    length = np.concatenate([np.zeros(0), *(_length_errors(truth, foot, strides) for foot in sorted(feet))])
    return {
        "marks": len(expected),
        "missed": sum(len(row.missed_ns) for row in rows),
        "extra": sum(len(row.extra_ns) for row in rows),
        "off": sum(row.moved for row in rows),
        "error_ms": _median(every),
        "error_p95_ms": float(np.percentile(every, 95)) if every.size else None,
        "foot_off_error_ms": _median(ms for (_, what), own in errors.items() if what == "T2" for ms in own),
        "contact_error_ms": _median(ms for (_, what), own in errors.items() if what == "T3" for ms in own),
        "stride_length_rmse_m": float(np.sqrt(np.mean(length**2))) if length.size else None,
    }


def burst_scores(bursts: dict[int, list[Burst]], foot_of: dict[int, str], truth: Truth | None) -> Scores:
    """How many bursts; with a truth, swings of walking without one, and bursts that touch no swing."""
    scores: Scores = {"bursts": sum(map(len, bursts.values())), "swings_without": None, "bursts_without": None}
    if truth is None:
        return scores
    without, idle = 0, 0
    for channel, foot in foot_of.items():
        spans, strides = bursts.get(channel, []), truth.strides_of(foot)
        own = [(round(s.t_swing_s * NS_PER_S), round(s.t_loading_response_s * NS_PER_S), s) for s in strides]
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


def _length_errors(truth: Truth, foot: str, strides: Sequence[StrideResult]) -> FloatArray:
    known = [s for s in truth.strides_of(foot) if s.walking and s.steady]
    mine = [s for s in strides if s.foot == foot and s.valid and s.t_swing_ns is not None]
    should = np.array([round(s.t_swing_s * NS_PER_S) for s in known], np.int64)
    did = np.array([s.t_swing_ns for s in mine], np.int64)
    pairs = pair_times(should, did, 1e6 * WINDOW_MS)
    return np.array([mine[j].stride_length_m - known[i].stride_length_m for i, j in pairs], np.float64)


def _median(values: Iterable[float]) -> float | None:
    known = np.array([value for value in values if np.isfinite(value)], np.float64)
    return float(np.median(known)) if known.size else None


@dataclass(frozen=True, slots=True)
class Bench:
    """What all combinations are tried on and with: the settings that they change, and their file, for messages.

    ``seconds``: a virtual patient walks for; ``program``: that was asked to try them.
    """

    session: Session
    path: str
    seconds: float = 90.0
    program: str = field(default_factory=program)

    def identity(self, case: Case, point: Point) -> str:
        """The name of a result: the same for the same case, session, settings and program."""
        name = case.url if isinstance(case, Patient) else case.identity("sweep")
        text = "\n".join((name, self.session.model_dump_json(), str(self.seconds), point.text(), self.program))
        return hashlib.sha256(text.encode()).hexdigest()[:20]


@dataclass(frozen=True, slots=True)
class Patient:
    """A virtual patient by number; the same number and seed, the same person."""

    number: int
    seed: int

    @property
    def url(self) -> str:
        """For tables."""
        return f"patient {self.number} of seed {self.seed}"

    def settings(self, foot: str, channel: int) -> PatientSettings:
        """Someone with a drop foot on that side, whose dorsiflexors that channel stimulates."""
        side = foot.removesuffix("_foot")
        return draw_patient(self.seed, self.number, side=side, channel=channel, sensors=(foot,), stand_s=STAND_S)


Case = Source | Patient


@dataclass(frozen=True)
class Trial(Task):
    """One combination on one case; a worker reads a case once where its trials come one after the other."""

    case: Case
    point: Point
    bench: Bench

    @property
    def key(self) -> str:
        """The same for the same case, session, settings and program."""
        return self.bench.identity(self.case, self.point)

    @property
    def name(self) -> str:
        """The settings, and what they are tried on."""
        return f"{self.point.text()} on {self.case.url}"

    def row(self, status: str, reason: str = "") -> dict[str, Any]:
        """What was tried on what."""
        row = {"result": self.key, "combination": self.point.identity, "settings": self.point.text()}
        return row | {"on": self.case.url, "status": status, "reason": reason, "fes_version": __version__}

    def tables(self) -> Rows:
        """Its scores."""
        case, what = self.case, (self.bench, self.point)
        scores = _on_patient(case, *what) if isinstance(case, Patient) else _on_recording(case, *what)
        return {RESULTS: [self.row(DONE) | scores]}


@dataclass(frozen=True, slots=True)
class SweptFoot(FootCalibration):
    """A calibration whose thresholds a combination changes."""

    changes: tuple[tuple[str, Value], ...] = ()

    def thresholds(self, *, swing_at_reversal: bool = False) -> Thresholds:
        """This person's, changed."""
        own = FootCalibration.thresholds(self, swing_at_reversal=swing_at_reversal)
        return change_thresholds(own, dict(self.changes))


def with_thresholds(calibrations: dict[str, Calibration], point: Point) -> dict[str, Calibration]:
    """Calibrations with a combination's thresholds.

    CohortError: a sensor is none on a foot, or a value is not of the threshold's kind.
    """
    changes = thresholds_of(point)
    if not changes:
        return calibrations
    changed: dict[str, Calibration] = {}
    for sensor, each in calibrations.items():
        if not isinstance(each, FootCalibration):
            raise CohortError(f"{sensor}: thresholds are swept for sensors on feet; this phase comes from a shank")
        own = {item.name: getattr(each, item.name) for item in fields(FootCalibration)}
        foot = SweptFoot(**own, changes=tuple(changes.items()))
        foot.thresholds()
        changed[sensor] = foot
    return changed


@lru_cache(maxsize=2)
def _loaded(source: Source) -> tuple[Recording, Truth | None]:
    """A recording and its truth; a process gets most combinations of one after the other."""
    with local_copy(source, TRUTH_FILES) as path:
        recording = read_recording(path)
        try:
            truth = load_truth(path)
        except FileNotFoundError:
            truth = None
    return recording, truth


@lru_cache(maxsize=2)
def _calibrations_on(source: Source, ground: Ground) -> dict[str, Calibration]:
    from fes.calibration.recording import calibrate_phase_sensors

    return calibrate_phase_sensors(_loaded(source)[0], incline=ground.incline).calibrations


def _on_recording(source: Source, bench: Bench, point: Point) -> Scores:
    from fes.control.controller import Controller
    from fes.control.replay import session_for
    from fes.control.runner import armed_after, with_ticks
    from fes.estimation.sensor_choice import phase_sensors, tracker_of

    recording, truth = _loaded(source)
    session = session_for(recording, session_with(bench.session, point, Path(bench.path)))
    calibrations = with_thresholds(_calibrations_on(source, session.ground), point)
    drivers = phase_sensors(calibrations)
    scores: Scores = {}
    outcomes: list[PhaseChange | StrideResult] = []
    if any(name.startswith(("stimulation.", "channels.")) for name, _ in point.values):
        controller, requests = Controller(session, calibrations), list[tuple[int, StimRequest]]()
        events = with_ticks(samples_of(recording, set(calibrations)))
        for event in armed_after(events, ARM_AFTER_S, session.stimulation.intensity):
            decision = controller.step(event)
            outcomes.extend(decision.outcomes)
            requests.extend((event.t_ns, request) for request in decision.requests)
        foot_of = {channel.number: str(channel.foot) for channel in session.channels}
        scores |= burst_scores(bursts_of(requests), foot_of, truth)
    else:
        for sensor in drivers.values():
            track = recording.tracks[sensor]
            tracker = tracker_of(session, calibrations[sensor])
            outcomes += tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    strides = [each for each in outcomes if isinstance(each, StrideResult)]
    phases = sorted((each for each in outcomes if isinstance(each, PhaseChange)), key=lambda each: each.t_ns)
    scores |= stride_scores(strides)
    if truth is not None:
        scores |= truth_scores(truth, set(drivers), phases, strides)
    return scores


@lru_cache(maxsize=4)
def _calibrated(patient: Patient, foot: str, channel: int) -> tuple[PatientSettings, dict[str, Calibration], Any]:
    """A patient's settings, calibrations from a walk without stimulation, and where toe and heel are."""
    from fes.hil.settings import patient_calibration

    settings = patient.settings(foot, channel)
    geometry = VirtualPatient(settings).geometry[foot]
    return settings, patient_calibration(settings).calibrations, geometry


def _on_patient(patient: Patient, bench: Bench, point: Point) -> Scores:
    from fes.hil.closed_loop.one_process import run_in_one_process
    from fes.hil.closed_loop.processes import armed_protocol
    from fes.session_log import Note

    asked = session_with(bench.session, point, Path(bench.path))
    if not asked.channels:
        raise CohortError(f"{bench.path}: has no channel, so there is nothing to try on patients")
    foot = asked.channels[0].foot
    settings, calibrations, geometry = _calibrated(patient, foot, asked.channels[0].number)
    channels = tuple(channel for channel in asked.channels if channel.foot == foot)
    session = asked.model_copy(update={"geometry": {foot: geometry}, "channels": channels, "treadmill": None})
    strides: list[VirtualStride] = []
    notes: list[Note] = []
    with tempfile.TemporaryDirectory(prefix="fes-sweep-") as folder:
        changed, acts = with_thresholds(calibrations, point), armed_protocol(STAND_S + bench.seconds)
        log, heard, noted = Path(folder) / "session.feslog", strides.append, notes.append
        run_in_one_process(settings, session, changed, acts, log, CREATED, on_stride=heard, on_note=noted)
    walked = [stride for stride in strides if stride.walking]
    backs = sum(note.source == "tuning" and "rolled back" in note.text for note in notes)
    latched = any(note.severity == "fault" for note in notes)
    return patient_scores(walked, backs, latched)
