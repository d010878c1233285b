"""What harms the virtual patient: bursts of different strength and onset, and what is counted of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from statistics import median

from benchmarks.lib.command_line import parser_of, publish, table_of
from fes.signals import NS_PER_S
from fes.simulation.forward import DeliveredPulse, VirtualPatient, VirtualStride, harm_of, settings_for

STEP_NS = 10_000_000
SECONDS, SKIPPED = 40.0, 6
AFTER_CONTACT_S, WIDTH_US, RATE_HZ = 0.1, 300.0, 40.0
BURSTS = ((0.0, 0.0), (20.0, 0.0), (20.0, 0.25), (32.0, 0.0), (32.0, 0.25))  # mA, s after heel rise
HEAD = (
    *("severity", "burst", "toe-down at foot off", "toe clearance", "push-off lost", "early bursts"),
    *("inversion at contact", "over 5°", "spasms", "co-contraction", "charge"),
)


def strides_of(severity: str, current_ma: float, onset_s: float) -> list[VirtualStride]:
    """The affected foot's strides of a walk with such a burst in each."""
    patient = VirtualPatient(settings_for(severity, seed=3, speed_mps=0.8))
    foot = patient.settings.affected_foot
    begins_ns, ends_ns, next_ns, seen = math.inf, math.inf, 0, 0
    for t_ns in range(STEP_NS, round(SECONDS * NS_PER_S) + 1, STEP_NS):
        for event in patient.events[seen:]:
            if (event.foot, event.kind) == (foot, "heel_off"):
                begins_ns, ends_ns = event.t_ns + onset_s * NS_PER_S, math.inf
                next_ns = round(begins_ns)
            elif (event.foot, event.kind) == (foot, "initial_contact"):
                ends_ns = event.t_ns + AFTER_CONTACT_S * NS_PER_S
        seen, pulses = len(patient.events), []
        while current_ma and begins_ns <= next_ns <= min(t_ns, ends_ns):
            pulses.append(DeliveredPulse(next_ns, patient.settings.channel, current_ma, WIDTH_US))
            next_ns += round(NS_PER_S / RATE_HZ)
        patient.advance(t_ns, pulses)
    return [one for one in patient.strides if one.foot == foot and one.walking][SKIPPED:]


def rows() -> Iterator[list[str]]:
    for severity in ("moderate", "severe"):
        for current_ma, onset_s in BURSTS:
            strides = strides_of(severity, current_ma, onset_s)
            harm = harm_of(strides)
            yield [
                severity,
                f"{current_ma:g} mA, {onset_s:g} s after heel rise" if current_ma else "none",
                f"{-math.degrees(median(one.pitch_at_foot_off_rad for one in strides)):.1f}°",
                f"{1e3 * median(one.toe_clearance_m for one in strides):.0f} mm",
                f"{harm.push_off_lost:.0%}",
                f"{harm.early_bursts} of {harm.strides}",
                f"{math.degrees(median(one.inversion_at_contact_rad for one in strides)):.1f}°",
                *map(str, (harm.inverted_contacts, harm.spasms)),
                f"{harm.co_contraction_nms:.2f} N·m·s",
                f"{harm.charge_uc:.0f} µC",
            ]


def main() -> None:
    publish([table_of("", HEAD, rows())], parser_of(__doc__).parse_args())


if __name__ == "__main__":
    main()
