"""A closed-loop run in one process, on the patient's own time: no clock, no waiting, the same bytes every time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes import __version__
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Session
from fes.control.controller import Controller
from fes.control.replay import (
    LOG_FORMAT,
    identity,
    log_header,
    recording_digest,
    refuse_long_silence,
    session_for,
)
from fes.control.runner import Runner
from fes.control.sources import armed_after, with_ticks
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, phase_sensors, shank_phase_sensors
from fes.gate import gate_of
from fes.hil.closed_loop.processes import Happening, Protocol
from fes.recording import Recording
from fes.recording.samples import samples_of
from fes.session_log import Note, SessionWriter
from fes.signals import NS_PER_S, SHANK_SENSORS, Event, ImuSample, OperatorAct, OperatorAction, Vector3
from fes.simulation.forward import PatientSettings, VirtualPatient, VirtualStride
from fes.simulation.forward.closed_loop import PulseSource, calibration_walk, intervene, patient_events

ARMED_AFTER_S: Final = 0.5
_ACTS = {
    "arm": OperatorAction.ARM,
    "freeze_tuning": OperatorAction.FREEZE_TUNING,
    "resume_tuning": OperatorAction.RESUME_TUNING,
    "accept_suggestion": OperatorAction.ACCEPT_SUGGESTION,
    "roll_back": OperatorAction.ROLL_BACK,
}


class NotifyingLog(SessionWriter):
    """The session log; its notes are also given to ``on_note``."""

    def __init__(self, path: Path, header: dict[str, Any], on_note: Callable[[Note], None]) -> None:
        super().__init__(path, header)
        self._on_note = on_note

    def note(self, note: Note) -> None:
        """As the log's."""
        super().note(note)
        self._on_note(note)


def run_in_one_process(
    settings: PatientSettings,
    session: Session,
    calibrations: Mapping[str, Calibration],
    protocol: Protocol,
    log_path: Path,
    created: str,
    *,
    on_stride: Callable[[VirtualStride], None] = lambda stride: None,
    on_note: Callable[[Note], None] = lambda note: None,
    after: Callable[[Event], None] = lambda event: None,
) -> VirtualPatient:
    """Run a protocol with everything in this process; the patient as it is afterwards.

    The samples are rounded to what the sensors' lines carry (single precision), as between processes.

    Args:
        settings: the patient.
        session: the controller's.
        calibrations: by sensor.
        protocol: what happens when.
        log_path: of the session log, which must not be there.
        created: an ISO time for the log.
        on_stride: given every stride of the affected foot.
        on_note: given every note in the log.
        after: called after every event; may raise to end the run.

    Raises:
        SessionLogError: the log cannot be written.
    """
    patient = VirtualPatient(settings)
    numbers = identity(f"{__version__}{settings!r}{protocol!r}", session)
    header = _header(settings, session, calibrations, numbers.session_id, created)
    log = NotifyingLog(log_path, header, on_note)
    stimulator = InProcessStimulator(numbers.session_id, numbers.boot_id)
    ended = "interrupted"
    told = 0

    def see(event: Event) -> None:
        nonlocal told
        for stride in patient.strides[told:]:
            if stride.foot == settings.affected_foot:
                on_stride(stride)
        told = len(patient.strides)
        after(event)

    controller = Controller(session, calibrations)
    try:
        events = with_ticks(_events(patient, stimulator, session, protocol))
        run_loop(controller, session, calibrations, stimulator, log, events, see)
        ended = "complete"
    finally:
        log.close({"ended": ended, "dose": controller.tuning.ledger.to_dict()})
    return patient


def run_loop(
    controller: Controller,
    session: Session,
    calibrations: Mapping[str, Calibration],
    stimulator: InProcessStimulator,
    log: SessionWriter,
    events: Iterable[Event],
    after: Callable[[Event], None] = lambda event: None,
    begin_ns: int = 0,
) -> None:
    """Open the session with a simulated stimulator at ``begin_ns``, put all events through the loop, and close it.

    ``after`` is called after every event; it may raise to end the run. The log is left open.

    Raises:
        SessionLogError: the log cannot be written.
    """
    try:
        handshake = stimulator.start(begin_ns)
        gate = gate_of(
            session, {sensor: each.up for sensor, each in calibrations.items()}, shank_phase_sensors(calibrations)
        )
        runner = Runner(controller, gate, stimulator, log, lambda: 0)
        for frame in handshake.frames:
            log.frame(frame)
        for alive in handshake.alive:
            runner.handle(alive)
        runner.run(events, after)
    finally:
        stimulator.close()


def walk_stimulated(
    patient: VirtualPatient,
    session: Session,
    seconds: float,
    log_path: Path,
    *,
    name: str,
    on_sample: Callable[[ImuSample], None],
    on_note: Callable[[Note], None] = lambda note: None,
    after: Callable[[Event], None] = lambda event: None,
) -> None:
    """Calibrate on a walk of the same patient, then let it walk, stimulated by the controller in closed loop.

    Args:
        patient: who walks; knows its strides afterwards.
        session: the controller's settings.
        seconds: how long; it is armed after half a second.
        log_path: of the session log, which must not be there.
        name: the recording's, in the log.
        on_sample: given every sample.
        on_note: given every remark in the log.
        after: called after every event; may raise to end the run.

    Raises:
        CalibrationError: no foot could be calibrated.
        ConfigError: the settings do not fit the patient.
        SessionLogError: the log cannot be written.
    """
    walk = replace(calibration_walk(patient.settings), name=name)
    calibrations = calibrate_phase_sensors(walk).calibrations
    session = session_for(walk, session)
    numbers = identity(f"{__version__}{patient.settings!r}", session)
    header = log_header(walk, "", session, calibrations, numbers.session_id, _now()) | {"kind": "simulated"}
    stimulator = InProcessStimulator(numbers.session_id, numbers.boot_id)

    def patient_walk() -> Iterator[Event]:
        yield from patient_events(patient, stimulator, seconds, on_sample)
        # switched off at the end as by hand: the silence after it is no sensor that was lost
        yield OperatorAct(patient.now_ns, OperatorAction.DISARM)

    log = NotifyingLog(log_path, header, on_note)
    _armed(patient_walk(), session, calibrations, stimulator, log, after)


def replay_in_one_process(
    recording: Recording, session: Session | None, calibrations: Mapping[str, Calibration], log_path: Path
) -> None:
    """Put a recording through the loop, armed after half a second, into a simulated stimulator.

    Args:
        recording: what the sensors brought.
        session: its channels without a sensor are left out; None stimulates nothing.
        calibrations: by sensor.
        log_path: of the session log, which must not be there.

    Raises:
        RecordingError: nothing came for ten minutes.
        CalibrationError: a channel's foot has no calibration.
        SessionLogError: the log cannot be written.
    """
    refuse_long_silence(recording)
    chosen, sha256 = session_for(recording, session), recording_digest(recording)
    for channel in chosen.channels:
        if channel.foot not in phase_sensors(calibrations):
            raise CalibrationError(f"Channel {channel.name!r} follows the {channel.foot}, which has no calibration.")
    numbers = identity(sha256, chosen)
    header = log_header(recording, sha256, chosen, calibrations, numbers.session_id, _now())
    begin_ns = min(int(track.t_ns[0]) for track in recording.tracks.values())
    samples = samples_of(recording, set(calibrations) | (set(recording.tracks) & set(SHANK_SENSORS)))
    stimulator = InProcessStimulator(numbers.session_id, numbers.boot_id, begin_ns)
    _armed(samples, chosen, calibrations, stimulator, SessionWriter(log_path, header), begin_ns=begin_ns)


def _armed(
    events: Iterable[Event],
    session: Session,
    calibrations: Mapping[str, Calibration],
    stimulator: InProcessStimulator,
    log: SessionWriter,
    after: Callable[[Event], None] = lambda event: None,
    begin_ns: int = 0,
) -> None:
    ended, controller = "interrupted", Controller(session, calibrations)
    try:
        armed = armed_after(with_ticks(events), ARMED_AFTER_S, session.stimulation.intensity)
        run_loop(controller, session, calibrations, stimulator, log, armed, after, begin_ns)
        ended = "complete"
    finally:
        log.close({"ended": ended})


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _events(patient: VirtualPatient, pulses: PulseSource, session: Session, protocol: Protocol) -> Iterator[Event]:
    """The patient's samples and the protocol's orders, each right after the samples of its time; deeds are done."""
    due = list(protocol.happenings)
    newest_ns = 0
    for event in patient_events(patient, pulses, protocol.seconds):
        if event.t_ns > newest_ns:
            newest_ns = event.t_ns
            while due and due[0].t_s * NS_PER_S < event.t_ns:
                yield from _happen(due.pop(0), newest_ns, patient, session)
        yield _as_carried(event)
    yield OperatorAct(newest_ns, OperatorAction.DISARM)  # as who quits a live session


def _happen(one: Happening, t_ns: int, patient: VirtualPatient, session: Session) -> Iterator[Event]:
    if one.what == "full":
        yield OperatorAct(t_ns, OperatorAction.SET_INTENSITY, session.stimulation.intensity)
    elif one.what in _ACTS:
        if one.what == "arm":
            yield OperatorAct(t_ns, OperatorAction.SET_INTENSITY, 0.0)
        yield OperatorAct(t_ns, _ACTS[one.what], one.value)
    else:
        intervene(patient, one.what, one.value)


def _as_carried(event: Event) -> Event:
    """The sample as it comes out of a line that carries single precision."""
    if not isinstance(event, ImuSample):
        return event
    return event._replace(acc_mps2=_single(event.acc_mps2), gyr_radps=_single(event.gyr_radps))


def _single(values: Vector3) -> Vector3:
    x, y, z = (float(np.float32(value)) for value in values)
    return x, y, z


def _header(
    settings: PatientSettings, session: Session, calibrations: Mapping[str, Calibration], session_id: int, created: str
) -> dict[str, Any]:
    return {
        "format": LOG_FORMAT,
        "fes_version": __version__,
        "kind": "simulated",
        "created": created,
        "recording": {
            "name": session.name,
            "rates_hz": dict.fromkeys(settings.sensors, settings.rate_hz),
            "belt_speed_mps": settings.speed_mps,
        },
        "session": session.model_dump(mode="json"),
        "calibration": {sensor: calibration.to_dict() for sensor, calibration in calibrations.items()},
        "stim_session_id": session_id,
    }
