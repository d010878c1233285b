"""A recording's truth as the moments that triggers are held against."""

from __future__ import annotations

from fes.patient.truth import Truth
from fes.signals import NS_PER_S
from fes.timing import Mark, heel_lifts


def marks_of_truth(truth: Truth, feet: set[str]) -> list[Mark]:
    """The transitions that these feet really made; a soft contact, which no sensor sees, ends by T6."""
    marks = []
    for stride in truth.strides:
        if stride.foot not in feet:
            continue
        times_s = {"T1": stride.t_pre_swing_s, "T2": stride.t_swing_s}
        if stride.loading_detectable:
            times_s |= {"T3": stride.t_loading_response_s, "T4": stride.t_stance_s}
        else:
            times_s["T6"] = stride.t_stance_s
        marks += [Mark(round(t_s * NS_PER_S), stride.foot, what) for what, t_s in times_s.items()]
    for foot, true in truth.feet.items():
        if foot in feet:
            marks += heel_lifts(true.t_ns, true.phase, foot)
    return sorted(marks)
