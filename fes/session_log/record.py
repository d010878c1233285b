"""What a session leaves behind, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fes.signals import (
    FloatArray,
    FootSwitchEvent,
    IntArray,
    OperatorAct,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    StrideResult,
    SystemFault,
    WireFrame,
)
from statemachine.phases import PhaseChange

SEVERITIES = ("info", "warning", "fault")


class SessionLogError(ValueError):
    """A session log cannot be written or read; the message names the file and says what to do."""


def not_made(path: Path, error: OSError, instead: str) -> SessionLogError:
    """Why a new file or folder cannot be made; ``instead``: what to do where it is there already."""
    if isinstance(error, FileExistsError):
        return SessionLogError(f"{path}: is there already and is not overwritten; {instead}")
    return SessionLogError(f"{path}: cannot be made: {error.strerror or error}")


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


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes that a serial stimulator's line brought, as they came; ``t_ns`` is the event that they were looked for at.

    What such a port sends next depends on them (what is still unanswered, what must be asked), so a replay needs them.
    """

    t_ns: int
    data: bytes


@dataclass(frozen=True, eq=False)
class SampleArrays:
    """One sensor's samples in the order they came: (N,) arrival and sensor times, (N, 3) m/s² and rad/s."""

    t_ns: IntArray
    t_sensor_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray


def _no_times() -> IntArray:
    return np.zeros(0, np.int64)


@dataclass(eq=False)
class SessionRecord:
    """All that a session left behind.

    ``complete`` is True if the session was closed and its end is there; ``lost`` says what a torn or damaged end
    cost, "" if nothing. Lists are in the order of writing.
    """

    header: dict[str, Any]
    samples: dict[str, SampleArrays] = field(default_factory=dict)
    ticks_ns: IntArray = field(default_factory=_no_times)
    acts: list[OperatorAct] = field(default_factory=list)
    statuses: list[StimStatus] = field(default_factory=list)
    alive: list[StimAlive] = field(default_factory=list)
    phases: list[PhaseChange] = field(default_factory=list)
    strides: list[StrideResult] = field(default_factory=list)
    commands: list[StimCommand] = field(default_factory=list)
    frames: list[WireFrame] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    reopened: list[StimOpened] = field(default_factory=list)
    switches: list[FootSwitchEvent] = field(default_factory=list)
    faults: list[SystemFault] = field(default_factory=list)
    received: list[Received] = field(default_factory=list)
    latency_t_ns: IntArray = field(default_factory=_no_times)
    latency_ns: IntArray = field(default_factory=_no_times)
    summary: dict[str, Any] = field(default_factory=dict)
    complete: bool = False
    lost: str = ""
