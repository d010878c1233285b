"""A patient simulated forward in time: stimulation pulses in, sensor samples and truth out."""

from fes.patient.virtual.patient import VirtualPatient
from fes.patient.virtual.settings import DeliveredPulse, MuscleSettings, PatientSettings
from fes.patient.virtual.severity import load_patient, settings_for
from fes.patient.virtual.strides import FootEvent, VirtualStride

__all__ = [
    "DeliveredPulse",
    "FootEvent",
    "MuscleSettings",
    "PatientSettings",
    "VirtualPatient",
    "VirtualStride",
    "load_patient",
    "settings_for",
]
