"""What ``import fes`` offers to Python and notebooks (``docs/api.md``): files and arrays in, tables and reports out.

Units are SI and stand in the columns' names. Errors name the place and the remedy; all but OSError are ValueErrors.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Literal

from fes import config
from fes.analysis.own_methods import Detector, EventRule, StrideMethod, with_own_methods
from fes.analysis.pipeline import analyse_chunks, calibrations_of_chunks
from fes.analysis.results import Analysis
from fes.analysis.tables import table_of
from fes.calibration.recording import (
    SensorCalibrations,
    calibrate_all,
    calibrate_phase_sensors,
    labelled,
    save,
    stored_calibrations,
)
from fes.config import FootGeometry, Ground, Session
from fes.control.replay import session_for
from fes.notebook.results import Agreement, File, Log, Result, Simulated, gather, log_of
from fes.recording import Recording, read_recording, recording_from_arrays
from fes.recording.arrays import Frames, is_frames
from fes.recording.chunks import Chunk, recording_chunks
from fes.session_log import read_session
from fes.signals import ImuSample

if TYPE_CHECKING:
    from fes.simulation.forward import PatientSettings


def read(path: File) -> Recording:
    """Read a recording: CSV, Parquet or a CAN log, with its sidecar (``.toml``) beside it.

    ``.tracks["left_foot"]`` then has ``acc_mps2`` and ``gyr_radps`` (N, 3), ``t_sensor_ns`` (N,) and ``rate_hz``.

    Raises:
        RecordingError: a file is missing or damaged, or its numbers cannot be what the sidecar says; where there is no
            sidecar, the message proposes one.
    """
    return read_recording(Path(path))


def calibrate(recording: Recording | File, path: File | None = None, *, level: bool = True) -> SensorCalibrations:
    """Find how each sensor sits and how this person moves: from a still second, then at least five strides ahead.

    Args:
        recording: of :func:`read` or ``fes.recording``, or a file.
        path: JSON is written there, for ``--calibration`` of the commands.
        level: False over stairs and slopes.

    Raises:
        CalibrationError: no sensor could be calibrated, or which unlabelled foot is which is not clear.
        RecordingError: as of :func:`read`.
    """
    walk = _recording(recording)
    found = _checked(calibrate_all(walk, incline=walk.ground.incline if level else math.nan))
    if path is not None:
        save(found, Path(path))
    return found


def analyse(
    recording: Recording | File | Frames,
    calibration: SensorCalibrations | File | None = None,
    ground: Literal["level", "free"] | float | None = None,
    geometry: Mapping[str, FootGeometry] | None = None,
    detector: str | Detector | None = None,
    stride_method: str | StrideMethod | None = None,
    event_rule: EventRule | None = None,
    rate_hz: float | None = None,
) -> Result:
    """Find strides, events, phases, the path over the ground and gait parameters.

    Args:
        recording: of :func:`read` or ``fes.recording``, or a file; one of more than half an hour is read in parts. Or a
            data frame or a mapping of frames, as for ``fes.recording``.
        calibration: of :func:`calibrate`, or its file. Default: from the recording itself.
        ground: "level", a treadmill's incline in percent, or "free" on stairs and ramps, where the height gained is
            measured. Default: as the recording's sidecar says, else level.
        geometry: by foot, where toe and heel are. Default: the recording's own, or else estimated from the walk.
        detector: of foot off and initial contact, and
        stride_method: of stride lengths: functions, or names of parts that another package brings (docs/extensions.md).
        event_rule: says sample by sample, as while walking, when a foot goes off and comes down: a function. What it
            says is ``events_causal``, with the delay to the events.
        rate_hz: of a frame whose index counts samples.

    Raises:
        RecordingError: as of :func:`read`.
        ExtensionError: there is no such detector or stride method, or a function failed or gave what it must not.
        CalibrationError: no sensor can be calibrated, or the calibration does not fit the recording.
    """
    if is_frames(recording):
        recording = recording_from_arrays(recording, rate_hz=rate_hz, name="frame")
    first = Chunk(recording) if isinstance(recording, Recording) else next(recording_chunks(Path(recording)))

    def chunks() -> Iterator[Chunk]:
        return iter((first,)) if isinstance(recording, Recording) or first.whole else recording_chunks(Path(recording))

    def analyses() -> Iterator[Analysis]:
        named = (replace(chunk, recording=labelled(chunk.recording, found.sides)) for chunk in chunks())
        own = analyse_chunks(named, found.calibrations, geometry=geometry, ground=walked_on)
        return with_own_methods(own, detector, stride_method, event_rule)

    walked_on = first.recording.ground
    if ground is not None:
        walked_on = Ground(free=ground == "free", incline_percent=ground if isinstance(ground, float | int) else 0.0)
    found = _checked(calibrations_of_chunks(chunks(), _stored(calibration), incline=walked_on.incline))
    return gather(list(analyses())) if first.whole else gather(analyses)


def load_session(path: File) -> Session:
    """Read the settings of a session (``session.toml``).

    Raises:
        ConfigError: it is missing or not valid; the message names the setting.
    """
    return config.load_session(Path(path))


def replay(
    recording: Recording | File,
    session: Session | File | None = None,
    calibration: SensorCalibrations | File | None = None,
    log: File | None = None,
) -> Log:
    """Put a recording through the loop of a live session, sample by sample, into a simulated stimulator.

    It is armed after half a second, at the session's intensity. Nothing real is stimulated.

    Args:
        recording: of :func:`read` or ``fes.recording``, or a file.
        session: of :func:`load_session`, or its file; channels without a sensor are left out. None: no stimulation.
        calibration: of :func:`calibrate`, or its file. Default: from the recording itself.
        log: where to keep the session log, a new file. Default: it is not kept.

    Raises:
        RecordingError, ConfigError: an input cannot be used.
        CalibrationError: no sensor can be calibrated, or not the one of a channel's foot.
        SessionLogError: ``log`` is there already, or cannot be written.
    """
    from fes.hil.closed_loop.one_process import replay_in_one_process

    walk, stored, asked = _recording(recording), _stored(calibration), _session(session)
    if stored is None:
        found = _checked(calibrate_phase_sensors(walk, incline=session_for(walk, asked).ground.incline))
    else:
        walk, found = stored_calibrations(stored, walk)
    with TemporaryDirectory() as folder:
        path = Path(log or Path(folder, "session.feslog"))
        replay_in_one_process(walk, asked, found.calibrations, path)
        return read_log(path)


def read_log(path: File) -> Log:
    """Read a session log (``.feslog``), also one whose end is torn: ``record.lost`` then says what is missing.

    Raises:
        SessionLogError: it is missing, or no session log.
    """
    return log_of(read_session(Path(path)), str(path))


def simulate(
    patient: PatientSettings | str = "moderate",
    session: Session | File | None = None,
    seconds: float = 60.0,
    log: File | None = None,
) -> Simulated:
    """Let a virtual patient walk on a treadmill, with a session stimulated in closed loop.

    Args:
        patient: "healthy", "mild", "moderate" or "severe" drop foot; a settings file (.toml); or ``PatientSettings``.
        session: of :func:`load_session`, or its file. None: no stimulation.
        seconds: how long; the first seconds it stands.
        log: where to keep the session log, a new file. Default: it is not kept.

    Raises:
        ValueError: no such patient.
        ConfigError, CalibrationError, SessionLogError: as of :func:`replay`.
    """
    from fes.hil.closed_loop.one_process import walk_stimulated
    from fes.simulation.forward import VirtualPatient
    from fes.simulation.forward.closed_loop import patient_events, recording_of, truth_of
    from fes.simulation.forward.settings import load_patient, settings_for

    if isinstance(patient, str):
        patient = load_patient(Path(patient)) if patient.endswith(".toml") else settings_for(patient)
    walker, samples, written = VirtualPatient(patient), list[ImuSample](), None
    asked = _session(session)
    if asked is None:
        for _ in patient_events(walker, None, seconds, samples.append):
            pass
    else:
        with TemporaryDirectory() as folder:
            path = Path(log or Path(folder, "session.feslog"))
            walk_stimulated(walker, asked, seconds, path, name="simulated", on_sample=samples.append)
            written = read_log(path)
    walk = recording_of(walker, samples, "simulated", f"Virtual patient, {patient.speed_mps:g} m/s")
    return Simulated(walk, truth_of(walker, walk.name), table_of([asdict(each) for each in walker.strides]), written)


def evaluate(
    result: Result | Log, reference: File | Sequence[File], foot: str | None = None, belt_speed_mps: float | None = None
) -> Agreement:
    """Hold an analysis, or a session as it was decided, against a reference.

    Args:
        result: of :func:`analyse`, one part; or of :func:`replay` or :func:`read_log`.
        reference: CSV or C3D files (docs/evaluation.md): strides, events, footfalls, foot switches, paths, belt speed.
        foot: "left_foot" or "right_foot", where a reference does not say whose it is.
        belt_speed_mps: of the treadmill. Default: the recording's own.

    Raises:
        ReferenceError: a reference cannot be read, or fits nothing that was estimated.
        ValueError: the result has several parts.
    """
    from fes.evaluation.reference.compare import from_analysis, from_session
    from fes.evaluation.reference.evaluation import Settings
    from fes.evaluation.reference.evaluation import evaluate as evaluate_reference
    from fes.evaluation.reference.read import read_references
    from fes.report.agreement import agreement_rows, pair_rows

    files = [reference] if isinstance(reference, str | os.PathLike) else reference
    if isinstance(result, Log):
        estimate = from_session(result.record, result.source)
        own_belt = result.record.header.get("recording", {}).get("belt_speed_mps")
    else:
        estimate, own_belt = from_analysis(result.analysis()), result.analysis().recording.belt_speed_mps
    settings = Settings(belt_mps=belt_speed_mps or own_belt, compare_belt=belt_speed_mps is not None)
    found = evaluate_reference(estimate, read_references([Path(file) for file in files], foot=foot), settings)
    return Agreement(table_of(agreement_rows(found)), table_of(pair_rows(found)), found)


def _recording(recording: Recording | File | Frames) -> Recording:
    if is_frames(recording):
        return recording_from_arrays(recording, name="frame")
    return recording if isinstance(recording, Recording) else read(recording)


def _session(session: Session | File | None) -> Session | None:
    return session if session is None or isinstance(session, Session) else load_session(session)


def _stored(calibration: SensorCalibrations | File | None) -> SensorCalibrations | Path | None:
    return calibration if calibration is None or isinstance(calibration, SensorCalibrations) else Path(calibration)


def _checked(found: SensorCalibrations) -> SensorCalibrations:
    """Warn of the sensors that are not used."""
    for reason in found.missing.values():
        warnings.warn(f"not calibrated, so not used: {reason}", stacklevel=3)
    return found
