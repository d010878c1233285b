"""What a session leaves behind, as plain values."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from fes.signals import FootSwitchEvent, OperatorAct, StimOpened, SystemFault, WireFrame
from fes.walk_record import WalkRecord


class SessionLogError(ValueError):
    """A session log cannot be written or read; the message names the file and says what to do."""


def not_made(path: Path, error: OSError, instead: str) -> SessionLogError:
    """Why a new file or folder cannot be made; ``instead``: what to do where it is there already."""
    if isinstance(error, FileExistsError):
        return SessionLogError(f"{path}: is there already and is not overwritten; {instead}")
    return SessionLogError(f"{path}: cannot be made: {error.strerror or error}")


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes that a serial stimulator's line brought, as they came; ``t_ns`` is the event that they were looked for at.

    What such a port sends next depends on them (what is still unanswered, what must be asked), so a replay needs them.
    """

    t_ns: int
    data: bytes


@dataclass(eq=False)
class SessionRecord(WalkRecord):
    """All that a session left behind: the walk, and what came in and went out. Lists are in the order of writing."""

    acts: list[OperatorAct] = field(default_factory=list)
    frames: list[WireFrame] = field(default_factory=list)
    reopened: list[StimOpened] = field(default_factory=list)
    switches: list[FootSwitchEvent] = field(default_factory=list)
    faults: list[SystemFault] = field(default_factory=list)
    received: list[Received] = field(default_factory=list)
