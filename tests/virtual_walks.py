"""Virtual patients' walks for the tests: stimulated by hand, from heel off to initial contact."""

from __future__ import annotations

from fes.signals import NS_PER_S, ImuSample
from fes.simulation.forward import DeliveredPulse, PatientSettings, VirtualPatient, VirtualStride

STEP_NS = 10_000_000


def walk(
    settings: PatientSettings,
    seconds: float,
    current_ma: float = 0.0,
    *,
    after_heel_off_s: float = 0.05,
    after_contact_s: float = 0.1,
    frequency_hz: float = 40.0,
    before_contact_s: float = 0.0,
    patient: VirtualPatient | None = None,
) -> tuple[VirtualPatient, list[ImuSample]]:
    """Walk with a burst in every step of the affected foot: rectangular, 300 µs; ``patient``: instead of a new one.

    ``before_contact_s`` ends the burst that long before the usual contact instead (from the strides before).
    """
    patient = patient or VirtualPatient(settings)
    samples: list[ImuSample] = []
    plan: list[tuple[int, bool]] = []
    on, seen, next_ns, usual_ns = False, 0, 0, 0
    for t_ns in range(STEP_NS, round(seconds * NS_PER_S) + 1, STEP_NS):
        for event in patient.events[seen:]:
            if event.foot != settings.affected_foot:
                continue
            if event.kind == "heel_off":
                plan.append((event.t_ns + round(after_heel_off_s * NS_PER_S), True))
            elif event.kind == "foot_off" and before_contact_s and usual_ns:
                plan.append((event.t_ns + usual_ns - round(before_contact_s * NS_PER_S), False))
            elif event.kind == "initial_contact":
                plan.append((event.t_ns + round(after_contact_s * NS_PER_S), False))
                offs = [e.t_ns for e in patient.events if e.foot == event.foot and e.kind == "foot_off"]
                usual_ns = event.t_ns - offs[-1]
        seen = len(patient.events)
        while plan and plan[0][0] <= t_ns:
            at_ns, on = plan.pop(0)
            next_ns = max(at_ns, next_ns)
        pulses = []
        while current_ma and on and next_ns <= t_ns:
            pulses.append(DeliveredPulse(next_ns, settings.channel, current_ma, 300.0))
            next_ns += round(NS_PER_S / frequency_hz)
        samples += patient.advance(t_ns, pulses)
    return patient, samples


def affected(patient: VirtualPatient, skip: int = 6) -> list[VirtualStride]:
    """The affected foot's strides in steady walking."""
    mine = [stride for stride in patient.strides if stride.foot == patient.settings.affected_foot]
    return mine[skip:]
