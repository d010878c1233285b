"""A closed-loop run in one process, on the patient's own time: no clock, no waiting, the same bytes every time."""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any, Final

import numpy as np

from drivers.simulated.stimulator.in_process import InProcessStimulator
from fes import __version__
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Session
from fes.control.controller import Controller
from fes.control.replay import header_of, identity, log_header, recording_digest, refuse_long_silence, session_for
from fes.control.runner import Runner, armed_after, with_ticks
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, phase_sensors, shank_phase_sensors
from fes.gate import gate_of
from fes.hil.closed_loop.processes import WALK_S, Happening, Protocol, armed_protocol
from fes.recording import Recording
from fes.recording.tracks import samples_of
from fes.session_log import Note, SessionWriter
from fes.signals import FOOT_SENSORS, NS_PER_S, SHANK_SENSORS, Event, ImuSample, OperatorAct, OperatorAction, Vector3
from fes.simulation.forward import PatientSettings, VirtualPatient, VirtualStride, harm_of, settings_for
from fes.simulation.forward.closed_loop import PulseSource, calibration_walk, intervene, patient_events

ARMED_AFTER_S: Final = 0.5
_ACTS: Final = ("arm", "freeze_tuning", "resume_tuning", "accept_suggestion", "roll_back")


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

    The samples are rounded to what the sensors' lines carry (single precision), as between processes. The log must not
    be there; ``created`` is an ISO time for it. ``on_stride`` is given the affected foot's strides, ``on_note`` the
    log's notes; ``after`` is called after every event and may raise to end the run.

    SessionLogError: the log cannot be written.
    """
    patient = VirtualPatient(settings)
    numbers = identity(f"{__version__}{settings!r}{protocol!r}", session)
    about = {
        "name": session.name,
        "rates_hz": dict.fromkeys(settings.sensors, settings.rate_hz),
        "belt_speed_mps": settings.speed_mps,
    }
    header = header_of("simulated", about, session, calibrations, numbers.session_id, created)
    log = NotifyingLog(log_path, header, on_note)
    stimulator = InProcessStimulator(numbers.session_id, numbers.boot_id)
    told = 0

    def see(event: Event) -> None:
        nonlocal told
        for stride in patient.strides[told:]:
            if stride.foot == settings.affected_foot:
                on_stride(stride)
        told = len(patient.strides)
        after(event)

    events = with_ticks(_events(patient, stimulator, session, protocol))
    _run_loop(session, calibrations, stimulator, log, events, see, with_dose=True)
    return patient


def _run_loop(
    session: Session,
    calibrations: Mapping[str, Calibration],
    stimulator: InProcessStimulator,
    log: SessionWriter,
    events: Iterable[Event],
    after: Callable[[Event], None] = lambda event: None,
    *,
    begin_ns: int = 0,
    with_dose: bool = False,
) -> None:
    """Open the session with a simulated stimulator at ``begin_ns``, put all events through the loop, close it and the
    log; ``after`` is called after every event and may raise to end the run.
    """
    ended, controller = "interrupted", Controller(session, calibrations)
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
        ended = "complete"
    finally:
        try:
            stimulator.close()
        finally:
            log.close({"ended": ended, **({"dose": controller.tuning.ledger.to_dict()} if with_dose else {})})


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

    It is armed after half a second; afterwards the patient knows its strides. The log must not be there; ``name`` is
    the recording's in it. ``after`` is called after every event and may raise to end the run.

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
    _run_loop(session, calibrations, stimulator, log, _armed(patient_walk(), session), after)


def replay_in_one_process(
    recording: Recording, session: Session | None, calibrations: Mapping[str, Calibration], log_path: Path
) -> None:
    """Put a recording through the loop, armed after half a second, into a simulated stimulator.

    The session's channels without a sensor are left out; None stimulates nothing. The log must not be there.

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
    log = SessionWriter(log_path, header)
    _run_loop(chosen, calibrations, stimulator, log, _armed(samples, chosen), begin_ns=begin_ns)


def _armed(events: Iterable[Event], session: Session) -> Iterator[Event]:
    return armed_after(with_ticks(events), ARMED_AFTER_S, session.stimulation.intensity)


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
                one = due.pop(0)
                if one.what == "full":
                    yield OperatorAct(newest_ns, OperatorAction.SET_INTENSITY, session.stimulation.intensity)
                elif one.what in _ACTS:
                    if one.what == "arm":
                        yield OperatorAct(newest_ns, OperatorAction.SET_INTENSITY, 0.0)
                    yield OperatorAct(newest_ns, OperatorAction(one.what), one.value)
                else:
                    intervene(patient, one.what, one.value)
        if isinstance(event, ImuSample):
            event = event._replace(acc_mps2=_single(event.acc_mps2), gyr_radps=_single(event.gyr_radps))
        yield event
    yield OperatorAct(newest_ns, OperatorAction.DISARM)  # as who quits a live session


def _single(values: Vector3) -> Vector3:
    """As it comes out of a line that carries single precision."""
    x, y, z = (float(np.float32(value)) for value in values)
    return x, y, z


# --- The closed-loop demonstration: who walks, what happens, and what came of it ----------------------------


SECONDS: Final = 80.0
SLIPS_S: Final = 48.0
SLIPS_TO: Final = 0.7
CURRENT_MA: Final = 12.0  # far too little for this patient
LOW_MM: Final = 10.0  # of true toe clearance: what the demonstration's tuning aims at


def patient() -> PatientSettings:
    """Who walks: a severe drop foot, feet sensors, and little habit of lifting the leg instead."""
    return settings_for("severe", seed=1, compensation=0.3, stand_s=WALK_S, sensors=FOOT_SENSORS)


def demo_protocol(seconds: float = SECONDS) -> Protocol:
    """Walk, and let an electrode slip half-way."""
    slip = (Happening(SLIPS_S, "electrode", SLIPS_TO),) if seconds > SLIPS_S else ()
    return armed_protocol(seconds, slip)


def outcome(stride: VirtualStride) -> str:
    """What became of a stride, in a word."""
    if stride.stumbled:
        return "stumbled"
    return "dragged" if stride.dragged else "low" if 1e3 * stride.toe_clearance_m < LOW_MM else "clears"


def result_of(strides: Sequence[VirtualStride]) -> dict[str, Any]:
    """What came of it: the same between processes and in one."""
    walked = [stride for stride in strides if stride.walking]
    slip_ns = round(SLIPS_S * NS_PER_S)
    parts = {
        "first_8_strides": walked[:8],
        "before_the_slip": [stride for stride in walked if stride.t_flat_ns < slip_ns][-10:],
        "last_10_strides": walked[-10:],
    }
    return {
        "strides": len(walked),
        "charge_mc": round(1e-3 * sum(stride.charge_uc for stride in walked), 2),
        "strides_until_clear": _until_clear([stride for stride in walked if stride.t_flat_ns < slip_ns]),
        "strides_until_clear_again": _until_clear([stride for stride in walked if stride.t_flat_ns >= slip_ns]),
        "harm": {key: round(value, 3) for key, value in asdict(harm_of(walked)).items()},
        **{
            name: {
                "dragged": sum(stride.dragged for stride in part),
                "stumbled": sum(stride.stumbled for stride in part),
                "median_toe_clearance_mm": round(1e3 * median(s.toe_clearance_m for s in part), 1) if part else None,
                "charge_uc_a_step": round(median(s.charge_uc for s in part), 1) if part else None,
            }
            for name, part in parts.items()
        },
    }


def _until_clear(strides: Sequence[VirtualStride]) -> int | None:
    """Which stride, counted from 1, is the first of three in a row that clear the ground; None for none."""
    clear = [outcome(stride) == "clears" for stride in strides]
    return next((n + 1 for n in range(len(clear) - 2) if all(clear[n : n + 3])), None)


def write_strides(path: Path, strides: Sequence[VirtualStride]) -> None:
    """The patient's own account of its strides, as CSV. OSError: it cannot be written."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [item.name for item in fields(VirtualStride)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(stride) for stride in strides)
