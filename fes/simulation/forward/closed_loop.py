"""The loop closed in one process, on the patient's own time: samples out, commands in, pulses back.

No clock is read and nothing waits, so a minute's walk takes a second, and the same settings give the same bytes. The
stimulator is handed in: anything with :meth:`PulseSource.take_pulses`, such as the simulated one of the drivers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol

from fes.recording import Recording
from fes.signals import NS_PER_S, Event, ImuSample
from fes.simulation.forward.patient import VirtualPatient
from fes.simulation.forward.settings import DeliveredPulse, PatientSettings
from fes.simulation.forward.truth import recording_of

INTERVENTIONS: Final = ("walk", "stand", "speed", "electrode", "fitness")
CALIBRATION_S: Final = 25.0


def intervene(patient: VirtualPatient, intervention: str, value: float = 0.0) -> None:
    """Do one of :data:`INTERVENTIONS` to the patient now.

    Start or stop the belt, change its speed (m/s), how much of the charge reaches the nerve, or how much of its fresh
    force the muscle has left (shares 0–1).

    Raises:
        ValueError: no such thing, or a value out of range.
    """
    if intervention == "walk":
        patient.walk()
    elif intervention == "stand":
        patient.stop()
    elif intervention == "speed":
        patient.set_speed(value)
    elif intervention == "electrode":
        patient.set_electrode_quality(value)
    elif intervention == "fitness":
        patient.set_fitness(value)
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
    patient = VirtualPatient(settings)
    begun_s = settings.stand_s + walk_s
    samples = list(patient.advance(round(begun_s * NS_PER_S)))
    if after_s:
        patient.stop()
        samples += patient.advance(round((begun_s + after_s) * NS_PER_S))
    return recording_of(patient, samples, name, description)


def calibration_walk(settings: PatientSettings) -> Recording:
    """A walk of the same patient with the same sensors, without stimulation: what ``fes calibrate`` would be given."""
    return recorded_walk(settings, CALIBRATION_S, 0.0, "calibration", "A walk to calibrate the sensors, not stimulated")
