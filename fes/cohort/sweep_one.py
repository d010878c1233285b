"""One combination of settings on one recording or virtual patient, in whichever process; its row is kept at once."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, Final

from fes import __version__
from fes.cohort.one import DONE, FAILED, LONGEST_REASON, Outcome, reason_of
from fes.cohort.program import program
from fes.cohort.sources import CohortError, Source, local_copy
from fes.cohort.store import Store
from fes.cohort.sweep_grid import Factor, Point, Value, changed, session_at, thresholds_at
from fes.cohort.sweep_table import RESULTS
from fes.config import Session
from fes.estimation.calibration import FootCalibration
from statemachine.guards import Thresholds

if TYPE_CHECKING:
    from fes.cohort.sweep_score import Scores
    from fes.driving import Calibration
    from fes.patient.truth import Truth
    from fes.patient.virtual import PatientSettings
    from fes.recording import Recording

TRUTH_FILES: Final = (".truth.parquet", ".strides.csv", ".activities.csv")
CREATED: Final = "2000-01-01T00:00:00+00:00"  # the same run, the same bytes
ARM_AFTER_S: Final = 0.5
STAND_S: Final = 10.0  # of a patient, who is armed for meanwhile


@dataclass(frozen=True, slots=True)
class Bench:
    """What all combinations are tried on and with.

    Attributes:
        session: the settings that combinations change.
        path: its file, for messages.
        seconds: a virtual patient walks for.
        program: that was asked to try them.
    """

    session: Session
    path: str
    seconds: float = 90.0
    program: str = field(default_factory=program)

    def identity(self, case: str, point: Point) -> str:
        """The name of a result: the same for the same case, session, settings and program."""
        text = "\n".join((case, self.session.model_dump_json(), str(self.seconds), point.text(), self.program))
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
        from fes.patient.virtual import MuscleSettings, PatientSettings

        chance = Random(f"{self.seed}/{self.number}")
        threshold_uc = chance.uniform(2.5, 5.0)
        return PatientSettings(
            seed=chance.randrange(1 << 30),
            side=foot.removesuffix("_foot"),
            channel=channel,
            sensors=(foot,),
            stand_s=STAND_S,
            speed_mps=round(chance.uniform(0.4, 1.3), 2),
            voluntary_dorsiflexion=chance.choice((0.0, 0.0, 0.2, 0.4)),
            spasticity=chance.uniform(0.0, 0.6),
            compensation=chance.uniform(0.4, 0.9),
            electrode_quality=chance.uniform(0.75, 1.0),
            muscle=MuscleSettings(
                threshold_uc=threshold_uc,
                saturation_uc=threshold_uc + chance.uniform(5.0, 8.0),
                max_torque_nm=chance.uniform(9.0, 15.0),
                fatigue_s=chance.choice((float("inf"), 600.0, 250.0)),
            ),
        )


Case = Source | Patient


def case_identity(case: Case) -> str:
    """Another file or another patient, another name."""
    return case.url if isinstance(case, Patient) else case.identity("sweep")


def try_one(case: Case, bench: Bench, point: Point, store: Store) -> Outcome:
    """Try a combination and keep its row; what is wrong with it, or with the recording, is kept as its reason.

    Raises:
        OSError: the results cannot be kept; it counts as not done.
    """
    work: Callable[[], Scores] = (
        (lambda: _on_patient(case, bench, point))
        if isinstance(case, Patient)
        else (lambda: _on_recording(case, bench, point))
    )
    try:
        scores = work()
    except Exception as error:  # one bad combination, however bad, must not stop the others
        return keep(case, bench, point, store, FAILED, reason_of(error), {})
    return keep(case, bench, point, store, DONE, "", scores)


def keep(case: Case, bench: Bench, point: Point, store: Store, status: str, reason: str, scores: Scores) -> Outcome:
    """Keep a row."""
    identity = bench.identity(case_identity(case), point)
    row = {"result": identity, "combination": point.identity, "settings": point.text(), "on": case.url}
    row |= {"status": status, "reason": reason[:LONGEST_REASON], "fes_version": __version__}
    store.put(identity, {RESULTS: [{**row, **scores}]})
    return Outcome(identity, f"{point.text()} on {case.url}", status, reason)


@dataclass(frozen=True, slots=True)
class SweptFoot(FootCalibration):
    """A calibration whose thresholds a combination changes."""

    changes: tuple[tuple[str, Value | Factor], ...] = ()

    def thresholds(self, *, swing_at_reversal: bool = False) -> Thresholds:
        """This person's, changed."""
        own = FootCalibration.thresholds(self, swing_at_reversal=swing_at_reversal)
        return changed(own, dict(self.changes))


def swept(calibrations: dict[str, Calibration], point: Point) -> dict[str, Calibration]:
    """Calibrations with a combination's thresholds.

    Raises:
        CohortError: a sensor is none on a foot, or a value is not of the threshold's kind.
    """
    changes = thresholds_at(point)
    if not changes:
        return calibrations
    found: dict[str, Calibration] = {}
    for sensor, each in calibrations.items():
        if not isinstance(each, FootCalibration):
            raise CohortError(f"{sensor}: thresholds are swept for sensors on feet; this phase comes from a shank")
        own = {item.name: getattr(each, item.name) for item in fields(FootCalibration)}
        foot = SweptFoot(**own, changes=tuple(changes.items()))
        foot.thresholds()
        found[sensor] = foot
    return found


@lru_cache(maxsize=2)
def _loaded(source: Source) -> tuple[Recording, dict[str, Calibration], Truth | None]:
    """A recording with its calibrations and its truth; a process gets most combinations of one after the other."""
    from fes.calibrations import calibrate_drivers
    from fes.patient.truth import load_truth
    from fes.recording import read_recording

    with local_copy(source, TRUTH_FILES) as path:
        recording = read_recording(path)
        try:
            truth = load_truth(path)
        except FileNotFoundError:
            truth = None
    return recording, calibrate_drivers(recording).calibrations, truth


def _on_recording(source: Source, bench: Bench, point: Point) -> Scores:
    from fes.cohort.sweep_score import burst_scores, bursts_of, stride_scores, truth_scores
    from fes.controller import Controller
    from fes.driving import driving, tracker_of
    from fes.replay import samples_of, session_for
    from fes.signals import Event, StimRequest, StrideResult
    from fes.sources import armed_after, with_ticks
    from statemachine.phases import PhaseChange

    recording, calibrations, truth = _loaded(source)
    session = session_for(recording, session_at(bench.session, point, Path(bench.path)))
    calibrations = swept(calibrations, point)
    drivers = driving(calibrations)
    scores: Scores = {}
    if any(name.startswith(("stimulation.", "channels.")) for name, _ in point.values):
        controller, requests = Controller(session, calibrations), list[tuple[int, StimRequest]]()
        outcomes: list[PhaseChange | StrideResult] = []
        events: Iterator[Event] = with_ticks(samples_of(recording, set(calibrations)))
        for event in armed_after(events, ARM_AFTER_S, session.stimulation.intensity):
            decision = controller.step(event)
            outcomes.extend(decision.outcomes)
            requests.extend((event.t_ns, request) for request in decision.requests)
        foot_of = {channel.number: str(channel.foot) for channel in session.channels}
        scores |= burst_scores(bursts_of(requests), foot_of, truth)
    else:
        outcomes = []
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
def _met(patient: Patient, foot: str, channel: int) -> tuple[PatientSettings, dict[str, Calibration], Any]:
    """A patient's settings, calibrations from a walk without stimulation, and where toe and heel are."""
    from fes.hil.patient_session import calibration_of
    from fes.patient.virtual import VirtualPatient

    settings = patient.settings(foot, channel)
    geometry = VirtualPatient(settings).geometry[foot]
    return settings, calibration_of(settings).calibrations, geometry


def _on_patient(patient: Patient, bench: Bench, point: Point) -> Scores:
    from fes.cohort.sweep_score import patient_scores
    from fes.hil.course import course
    from fes.hil.one_process import run_in_one_process
    from fes.journal import Note
    from fes.patient.virtual import VirtualStride

    asked = session_at(bench.session, point, Path(bench.path))
    if not asked.channels:
        raise CohortError(f"{bench.path}: has no channel, so there is nothing to try on patients")
    foot = asked.channels[0].foot
    settings, calibrations, geometry = _met(patient, foot, asked.channels[0].number)
    channels = tuple(channel for channel in asked.channels if channel.foot == foot)
    session = asked.model_copy(update={"geometry": {foot: geometry}, "channels": channels, "treadmill": None})
    strides: list[VirtualStride] = []
    notes: list[Note] = []
    with tempfile.TemporaryDirectory(prefix="fes-sweep-") as folder:
        run_in_one_process(
            settings,
            session,
            swept(calibrations, point),
            course(STAND_S + bench.seconds),
            Path(folder) / "session.feslog",
            CREATED,
            on_stride=strides.append,
            on_note=notes.append,
        )
    walked = [stride for stride in strides if stride.walking]
    backs = sum(note.source == "tuning" and "rolled back" in note.text for note in notes)
    latched = any(note.severity == "fault" for note in notes)
    return patient_scores(walked, backs, latched)
