"""A walk as tables and the report take it: what an analysis found in a recording, or a session left behind."""

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fes.signals import FloatArray, IntArray, OperatorAct, StimAlive, StimCommand, StimStatus, StrideResult
from statemachine.phases import PhaseChange

SEVERITIES = ("info", "warning", "fault")
MARK = "mark"  # the source of a note that a person set: what the patient did, what was changed
Level = Literal["good", "info", "warning", "alert"]


@dataclass(frozen=True)
class Finding:
    """One thing that was found, as a sentence: ``alert`` is what must be looked at before the numbers are used.

    Attributes:
        level: how much it matters.
        text: all of it, for people.
        leads: it stands on the first page, right after what must be looked at.
        code: what kind it is, for programs; "" of what is no fault of a sensor.
        sensor: whose; of several that say the same, all, with commas between.
        cause: the physical cause, without the sensor's name.
        effect: what it does to which numbers, and by how much.
        remedy: what to do about it.
        corrected: the numbers are those without it.
        count: how many sensors say the same.
    """

    level: Level
    text: str
    leads: bool = False
    code: str = ""
    sensor: str = ""
    cause: str = ""
    effect: str = ""
    remedy: str = ""
    corrected: bool = False
    count: int = 1


@dataclass(frozen=True, slots=True)
class Note:
    """Something worth reading later: ``severity`` is one of ``SEVERITIES``, ``source`` the part that speaks."""

    t_ns: int
    severity: str
    source: str
    text: str

    def __post_init__(self) -> None:
        if self.severity not in SEVERITIES:
            raise ValueError(f"severity {self.severity!r} is none of {', '.join(SEVERITIES)}")


@dataclass(frozen=True, eq=False)
class SampleArrays:
    """One sensor's samples in the order they came: (N,) arrival and sensor times, (N, 3) m/s² and rad/s."""

    t_ns: IntArray
    t_sensor_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray


def finite_or_none(value: Any) -> Any:
    """The value, also a nested one, with None for numbers that are not known (NaN, infinite), which JSON has not."""
    if isinstance(value, dict):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def no_times() -> IntArray:
    """An empty array of times."""
    return np.zeros(0, np.int64)


@dataclass(eq=False)
class WalkRecord:
    """What is known of a walk, in the order in which it happened.

    ``header`` says what it is and what is known of its sensors: its kind, when it was made, the recording's name, belt
    and ranges, the calibrations. ``commands`` and what follows are empty where nothing was stimulated. ``complete`` is
    False where the end is missing; ``lost`` says what that cost, "" if nothing. ``own_ns`` of a part of a longer walk:
    phases and strides are of what is newer than the first, up to the second; samples are of what lies around it, too.
    ``findings`` are of whoever examined the sensors.
    ``live`` of an analysis, whose phases are at their off-line instants: phases and strides as the live machine has
    them.
    """

    header: dict[str, Any]
    samples: dict[str, SampleArrays] = field(default_factory=dict)
    phases: list[PhaseChange] = field(default_factory=list)
    strides: list[StrideResult] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    commands: list[StimCommand] = field(default_factory=list)
    statuses: list[StimStatus] = field(default_factory=list)
    alive: list[StimAlive] = field(default_factory=list)
    acts: list[OperatorAct] = field(default_factory=list)
    ticks_ns: IntArray = field(default_factory=no_times)
    latency_t_ns: IntArray = field(default_factory=no_times)
    latency_ns: IntArray = field(default_factory=no_times)
    summary: dict[str, Any] = field(default_factory=dict)
    complete: bool = False
    lost: str = ""
    own_ns: tuple[int, int] | None = None
    live: tuple[list[PhaseChange], list[StrideResult]] | None = None
    findings: tuple[Finding, ...] = ()

    def __repr__(self) -> str:
        counts = f"{len(self.strides)} strides, {len(self.phases)} phase changes, {len(self.commands)} commands"
        return f"{type(self).__name__} of {', '.join(self.samples) or 'no sensor'}: {counts}"
