"""The states of a live session and the table of what may lead from where to where. Pure: no clock, no I/O.

*off*: nothing is decided yet. *shadow*: phases, strides and bursts are decided, none is delivered. *armed*: current is
allowed. *running*: a foot is judged to walk, so steps start bursts. *paused*: off by choice, one key from armed.
*stopped* (a person's emergency stop) and *fault* are latched: only a person's arming leads out of them.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class State(StrEnum):
    """Where a session stands."""

    OFF = "off"
    SHADOW = "shadow"
    ARMED = "armed"
    RUNNING = "running"
    PAUSED = "paused"
    STOPPED = "stopped"
    FAULT = "fault"


class Cause(StrEnum):
    """What can move a session on."""

    READY = "calibrated and warm"
    ARM = "armed by hand"
    WALK = "walking"
    STAND = "not walking"
    PAUSE = "paused by hand"
    DISARM = "disarmed by hand"
    STOP = "emergency stop"
    FAULT = "fault"
    QUIT = "ended"


class Row(NamedTuple):
    """One transition."""

    source: State
    cause: Cause
    destination: State


TABLE: tuple[Row, ...] = (
    Row(State.OFF, Cause.READY, State.SHADOW),
    Row(State.SHADOW, Cause.ARM, State.ARMED),
    Row(State.ARMED, Cause.WALK, State.RUNNING),
    Row(State.RUNNING, Cause.STAND, State.ARMED),
    Row(State.ARMED, Cause.PAUSE, State.PAUSED),
    Row(State.RUNNING, Cause.PAUSE, State.PAUSED),
    Row(State.PAUSED, Cause.ARM, State.ARMED),
    Row(State.STOPPED, Cause.ARM, State.ARMED),
    Row(State.FAULT, Cause.ARM, State.ARMED),
    *(Row(state, Cause.DISARM, State.SHADOW) for state in (State.ARMED, State.RUNNING, State.PAUSED)),
    *(Row(state, Cause.STOP, State.STOPPED) for state in State if state is not State.STOPPED),
    *(Row(state, Cause.FAULT, State.FAULT) for state in State if state not in (State.STOPPED, State.FAULT)),
    *(Row(state, Cause.QUIT, State.OFF) for state in State if state is not State.OFF),
)
CURRENT_ALLOWED = frozenset((State.ARMED, State.RUNNING))

_NEXT = {(row.source, row.cause): row.destination for row in TABLE}


class SessionMachine:
    """Follows the table; a cause that has no row where the session stands changes nothing."""

    def __init__(self) -> None:
        self.state = State.OFF

    def may(self, cause: Cause) -> bool:
        """Whether the cause leads anywhere from here."""
        return (self.state, cause) in _NEXT

    def move(self, cause: Cause) -> bool:
        """Follow the cause; returns whether it led anywhere."""
        if not self.may(cause):
            return False
        self.state = _NEXT[self.state, cause]
        return True
