"""The loop closed in one process, on the patient's own time: samples out, commands in, pulses back.

No clock is read and nothing waits, so a minute's walk takes a second, and the same settings give the same bytes. The
stimulator is handed in: anything with :meth:`PulseSource.take_pulses`, such as the simulated one of the drivers.

A virtual walk's truth in the project's usual form (:mod:`fes.simulation.truth`), and its signals as a recording.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol

import numpy as np

from fes.recording import Recording, Track
from fes.signals import FOOT_SENSORS, NS_PER_S, SENSORS, Event, FloatArray, ImuSample
from fes.simulation.forward.patient import VirtualPatient
from fes.simulation.forward.settings import DeliveredPulse, PatientSettings
from fes.simulation.forward.walker import VirtualStride
from fes.simulation.sensor import mounting, quaternions, rotation
from fes.simulation.truth import Activity, FootTruth, Truth, TruthStride
from statemachine.phases import Phase

EVERY = 2  # rows of the 200 Hz trace: truth at 100 Hz
_S = 1.0 / NS_PER_S


def truth_of(patient: VirtualPatient, name: str) -> Truth:
    """Poses at 100 Hz, phases and strides of all that the patient has done so far."""
    feet, strides = {}, []
    for foot in FOOT_SENSORS:
        mine = [stride for stride in patient.strides if stride.foot == foot]
        feet[foot], t_s, yaw = _foot(patient, foot, mine)
        strides += [_stride(patient, k, mine, feet[foot].sensor_m, t_s, yaw) for k in range(len(mine))]
    strides.sort(key=lambda stride: (stride.t_pre_swing_s, stride.foot))
    return Truth(name, feet, strides, _activities(patient))


def _foot(patient: VirtualPatient, foot: str, strides: list[VirtualStride]) -> tuple[FootTruth, FloatArray, FloatArray]:
    trace = {key: values[EVERY - 1 :: EVERY] for key, values in patient.trace(foot).items()}
    geometry, placement = patient.geometry[foot], patient.settings.placements[foot]
    sole_m = patient.sole_m
    bx, by, bz = placement.body_m
    turned = rotation(-trace["pitch_rad"], trace["roll_rad"], trace["yaw_rad"])
    ankle = np.column_stack([trace["x_m"], trace["y_m"], trace["z_m"]])

    def point(x: float, y: float, z: float) -> FloatArray:
        out: FloatArray = ankle + turned @ np.array([x, y, z])
        return out

    t_ns = np.round(trace["t_s"] * NS_PER_S).astype(np.int64)
    phase = np.where(trace["heel_m"] > 0.005, int(Phase.PRE_SWING), int(Phase.STANCE)).astype(np.int64)
    for stride in strides:
        off, contact, flat = np.searchsorted(t_ns, [stride.t_foot_off_ns, stride.t_contact_ns, stride.t_flat_ns])
        phase[off:contact] = int(Phase.SWING)
        phase[contact:flat] = int(Phase.LOADING_RESPONSE)
    truth = FootTruth(
        t_ns,
        point(bx, by, bz - sole_m),
        point(bx + geometry.toe_forward_m, 0.0, -sole_m),
        point(bx + geometry.heel_forward_m, 0.0, -sole_m),
        quaternions(turned @ mounting(*placement.angles_deg)),
        phase,
    )
    return truth, trace["t_s"], trace["yaw_rad"]


def _stride(
    patient: VirtualPatient, k: int, mine: list[VirtualStride], sensor_m: FloatArray, t_s: FloatArray, yaw: FloatArray
) -> TruthStride:
    stride = mine[k]
    before = mine[k - 1].t_flat_ns if k else stride.t_heel_off_ns - NS_PER_S // 4
    after = mine[k + 1].t_heel_off_ns if k + 1 < len(mine) else stride.t_flat_ns + NS_PER_S // 4
    start = 0.5 * _S * (before + stride.t_heel_off_ns)
    end = min(0.5 * _S * (stride.t_flat_ns + after), float(t_s[-1]))
    i, j = (min(int(np.searchsorted(t_s, t)), len(t_s) - 1) for t in (start, end))
    pitch = math.degrees(stride.pitch_at_contact_rad)
    return TruthStride(
        foot=stride.foot, number=stride.number, t_start_s=start, t_end_s=end,
        t_pre_swing_s=_S * stride.t_heel_off_ns, t_swing_s=_S * stride.t_foot_off_ns,
        t_loading_response_s=_S * stride.t_contact_ns, t_stance_s=_S * stride.t_flat_ns,
        stride_length_m=float(np.hypot(*(sensor_m[j] - sensor_m[i])[:2])),
        clearance_m=float(sensor_m[i : j + 1, 2].max() - sensor_m[i, 2]), toe_clearance_m=stride.toe_clearance_m,
        heel_clearance_m=stride.heel_clearance_m, foot_strike_deg=pitch, turn_deg=math.degrees(float(yaw[j] - yaw[i])),
        contact="heel" if pitch > 3.0 else "forefoot" if pitch < -3.0 else "flat",
        steady=abs(stride.speed_mps - patient.speed_mps) < 0.02, walking=stride.walking,
    )  # fmt: skip


def _activities(patient: VirtualPatient) -> list[Activity]:
    now_s, out, t_s = _S * patient.now_ns, [], 0.0
    for begin_s, end_s in patient.walks:
        if begin_s > t_s:
            out.append(Activity(t_s, begin_s, "standing", False))
        t_s = min(end_s, now_s)
        out.append(Activity(begin_s, t_s, "walking", True))
    if now_s > t_s:
        out.append(Activity(t_s, now_s, "standing", False))
    return out


def recording_of(patient: VirtualPatient, samples: Sequence[ImuSample], name: str, description: str) -> Recording:
    """All that the worn sensors delivered, as a recording.

    Raises:
        ValueError: no samples.
    """
    if not samples:
        raise ValueError(f"{name}: no samples; let the patient live for longer")
    settings = patient.settings
    tracks = {}
    for sensor in SENSORS:
        if mine := [sample for sample in samples if sample.sensor == sensor]:
            t_ns, t_sensor_ns = (np.array([s[k] for s in mine], np.int64) for k in (0, 2))
            acc, gyr = np.array([s.acc_mps2 for s in mine]), np.array([s.gyr_radps for s in mine])
            ranges = settings.imu.acc_range_mps2, settings.imu.gyr_range_radps
            tracks[sensor] = Track(sensor, settings.rate_hz, t_ns, t_sensor_ns, acc, gyr, *ranges)
    return Recording(
        name=name,
        path=None,
        tracks=tracks,
        belt_speed_mps=settings.speed_mps,
        subject="simulated",
        description=description,
        geometry={foot: value for foot, value in patient.geometry.items() if foot in tracks},
        extra={"simulated": True, "seed": settings.seed, "generator": "fes.simulation.forward"},
    )


INTERVENTIONS: Final = ("walk", "stand", "speed", "electrode", "fitness")
CALIBRATION_S: Final = 25.0


def intervene(patient: VirtualPatient, intervention: str, value: float = 0.0) -> None:
    """Do one of :data:`INTERVENTIONS` to the patient now.

    Start or stop the belt, change its speed (m/s), how much of the charge reaches the nerve, or how much of its fresh
    force the muscle has left (shares 0–1).

    Raises:
        ValueError: no such thing, or a value out of range.
    """
    valued = {"speed": patient.set_speed, "electrode": patient.set_electrode_quality, "fitness": patient.set_fitness}
    if intervention in valued:
        valued[intervention](value)
    elif intervention in ("walk", "stand"):
        (patient.walk if intervention == "walk" else patient.stop)()
    else:
        raise ValueError(f"{intervention!r} cannot be done to a patient; one of {', '.join(INTERVENTIONS)}")


class PulseSource(Protocol):
    """A stimulator that reports what it has delivered."""

    def take_pulses(self) -> Sequence[DeliveredPulse]:
        """The pulses since the last call, by time."""
        ...


def patient_events(
    patient: VirtualPatient,
    pulses: PulseSource | None,
    seconds: float,
    heard: Callable[[ImuSample], None] = lambda sample: None,
) -> Iterator[Event]:
    """The patient's samples as a source of events, ``seconds`` from now on, one sampling interval at a time.

    While the consumer deals with an interval's samples the stimulator delivers; its pulses reach the patient with the
    next interval, sooner than the muscle answers, so the result is that of one continuous time.
    """
    step_ns = round(NS_PER_S / patient.settings.rate_hz)
    t_ns, end_ns = patient.now_ns, patient.now_ns + round(seconds * NS_PER_S)
    while t_ns + step_ns <= end_ns:
        t_ns += step_ns
        for sample in patient.advance(t_ns, pulses.take_pulses() if pulses is not None else ()):
            heard(sample)
            yield sample


def recorded_walk(settings: PatientSettings, walk_s: float, after_s: float, name: str, description: str) -> Recording:
    """Stand for ``settings.stand_s``, walk for ``walk_s``, stop and stand until ``after_s`` later; not stimulated."""
    return walk_with_truth(settings, walk_s, after_s, name, description)[0]


def walk_with_truth(
    settings: PatientSettings, walk_s: float, after_s: float, name: str, description: str
) -> tuple[Recording, Truth]:
    """As :func:`recorded_walk`, with what really happened."""
    patient = VirtualPatient(settings)
    begun_s = settings.stand_s + walk_s
    samples = list(patient.advance(round(begun_s * NS_PER_S)))
    if after_s:
        patient.stop()
        samples += patient.advance(round((begun_s + after_s) * NS_PER_S))
    return recording_of(patient, samples, name, description), truth_of(patient, name)


def calibration_walk(settings: PatientSettings) -> Recording:
    """A walk of the same patient with the same sensors, without stimulation: what ``fes calibrate`` would be given."""
    return recorded_walk(settings, CALIBRATION_S, 0.0, "calibration", "A walk to calibrate the sensors, not stimulated")
