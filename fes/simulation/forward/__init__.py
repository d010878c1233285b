"""A patient simulated forward in time: stimulation pulses in, sensor samples and truth out."""

from fes.simulation.forward.closed_loop import recorded_walk
from fes.simulation.forward.draw import draw_patient
from fes.simulation.forward.patient import VirtualPatient
from fes.simulation.forward.settings import DeliveredPulse, MuscleSettings, PatientSettings, load_patient, settings_for
from fes.simulation.forward.walker import FootEvent, Harm, VirtualStride, harm_of

__all__ = [
    "DeliveredPulse",
    "FootEvent",
    "Harm",
    "MuscleSettings",
    "PatientSettings",
    "VirtualPatient",
    "VirtualStride",
    "draw_patient",
    "harm_of",
    "load_patient",
    "recorded_walk",
    "settings_for",
]
