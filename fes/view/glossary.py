"""What the words and numbers mean: shown on hover and, for paper and tablets, at the end of the report."""

from __future__ import annotations

GLOSSARY: dict[str, str] = {
    "stride": "From mid-stance to the next mid-stance of the same foot (m, s). Some papers call it a step.",
    "stride length": "Horizontal distance of the foot sensor between the two mid-stances (m).",
    "clearance": "Greatest height of the sensor during the stride above its height at the start (cm).",
    "toe clearance": "Least height of the toe in mid-swing (cm); the settings, or fes analyse, say where the toe is.",
    "heel clearance": "Greatest height of the heel (cm); the settings, or fes analyse, say where the heel is.",
    "pre-swing": "From heel rise until the toe leaves the ground.",
    "swing": "The foot is off the ground, until first contact.",
    "loading response": "From first contact until the foot lies still.",
    "stance": "The foot lies still, until the heel rises again.",
    "four phases": "Pre-swing, swing, loading response and stance were all entered, in this order.",
    "T5": "The heel was lifted and put back without a swing.",
    "T6": "The swing ended in stance without a loading response being seen.",
    "valid": "The stride's numbers can be used; if not, the reason is given and it is left out of all averages.",
    "walking speed": "Way over time of the valid strides within 30 % of the median one's speed (m/s); mean of feet.",
    "cadence": "Two steps per stride: 120 s divided by the mean stride time in s (steps/min).",
    "onset": "First command to stimulate, counted from the entry into pre-swing of the same foot (ms).",
    "burst": "A stretch in which a channel was commanded on without a break.",
    "charge": "Charge of one phase of all pulses (µC): counted by the stimulator, else current · width · number.",
    "outside": "Time a channel was commanded on while its foot was in a phase in which it must be off (s).",
    "latency": "From a sample's arrival to the controller's decision (ms).",
    "p50, p99": "Half, and 99 of 100, of the values are no greater than this.",
    "SD": "Standard deviation; for phase durations in percent of the mean.",
    "gate": "The safety gate: the last check before the wire. It turns a command off when in doubt and says why.",
    "pitch": "Rotation of the foot about the axis across it (°): toe up positive, 0 in the stance at the start.",
}
