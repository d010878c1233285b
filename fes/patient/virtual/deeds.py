"""What can happen to a virtual patient while it lives, by name: for commands, processes and courses."""

from __future__ import annotations

from typing import Final

from fes.patient.virtual.patient import VirtualPatient

DEEDS: Final = ("walk", "stand", "speed", "electrode", "fitness")


def do_to(patient: VirtualPatient, deed: str, value: float = 0.0) -> None:
    """Let something happen now: start or stop the belt, change its speed (m/s), how much of the charge reaches the
    nerve, or how much of its fresh force the muscle has left (shares 0–1).

    Raises:
        ValueError: no such thing, or a value out of range.
    """
    if deed == "walk":
        patient.walk()
    elif deed == "stand":
        patient.stop()
    elif deed == "speed":
        patient.set_speed(value)
    elif deed == "electrode":
        patient.set_electrode_quality(value)
    elif deed == "fitness":
        patient.set_fitness(value)
    else:
        raise ValueError(f"{deed!r} cannot be done to a patient; one of {', '.join(DEEDS)}")
