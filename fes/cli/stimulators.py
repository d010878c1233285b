"""Which stimulator a replay talks to: none, a simulated one in its own process, or what is on the session's bus."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import click

from drivers.stimulator.bus import open_bus
from drivers.stimulator.byte_sink import ByteSink
from drivers.stimulator.can_codec import CONTROLLER_IDS, NODE_IDS, commands_of
from drivers.stimulator.can_port import CanStimulator
from drivers.virtual.can_node_spawn import spawn_node
from drivers.virtual.lockstep import LockstepStimulator
from fes.config import Session
from fes.delivered import Delivered, compare_delivered
from fes.runner import Stimulator
from fes.signals import StimAlive, StimStatus, WireFrame

LAST_ANSWERS_S = 0.5


class OpenStimulator(Stimulator, Protocol):
    """A stimulator with its session open."""

    @property
    def outstanding(self) -> int:
        """Commands not yet answered."""


@dataclass(frozen=True, slots=True)
class Opened:
    """An open stimulator, what its handshake sent and heard, and whether anything answers at all."""

    stimulator: OpenStimulator
    frames: tuple[WireFrame, ...] = ()
    alive: tuple[StimAlive, ...] = ()
    answers: bool = True


@contextmanager
def no_stimulator(session_id: int, boot_id: int, t_ns: int) -> Iterator[Opened]:
    """Bytes only: nothing is sent anywhere."""
    sink = ByteSink(session_id)
    yield Opened(sink, frames=(sink.open(t_ns, boot_id),), answers=False)


@contextmanager
def simulated(session_id: int, boot_id: int, t_ns: int, *, lockstep: bool, record: Path | None) -> Iterator[Opened]:
    """A simulated stimulator in its own process on virtual CAN; in lockstep its clock is the replay's.

    Raises:
        StimulatorLost, BusError: it did not start, or cannot be reached.
    """
    with spawn_node(boot_id=boot_id, record=record, clock="bus" if lockstep else "real") as node:
        bus = open_bus(node.bus, NODE_IDS)
        stimulator = (LockstepStimulator if lockstep else CanStimulator)(bus, session_id)
        try:
            handshake = stimulator.open(t_ns, timeout_s=10.0)
            yield Opened(stimulator, handshake.frames, handshake.alive)
        finally:
            stimulator.close()


@contextmanager
def on_the_bus(session: Session, session_id: int, t_ns: int) -> Iterator[Opened]:
    """Whatever stimulator is on the session's bus.

    Raises:
        StimulatorLost, BusError: the bus cannot be opened, or nothing answers there.
    """
    stimulator = CanStimulator(open_bus(session.bus, NODE_IDS), session_id)
    try:
        handshake = stimulator.open(t_ns)
        yield Opened(stimulator, handshake.frames, handshake.alive)
    finally:
        stimulator.close()


def last_answers(stimulator: OpenStimulator, t_ns: int) -> list[StimStatus | StimAlive]:
    """What still comes after the last command, for at most half a second."""
    replies: list[StimStatus | StimAlive] = []
    deadline = time.monotonic() + LAST_ANSWERS_S
    while True:
        replies += stimulator.poll(t_ns)
        if not stimulator.outstanding or time.monotonic() > deadline:
            return replies
        time.sleep(0.005)


def wire_truth(frames: list[WireFrame], statuses: list[StimStatus]) -> Delivered:
    """Hold the command frames that went out against what the stimulator said it delivered."""
    return compare_delivered(commands_of([f for f in frames if f.identifier in CONTROLLER_IDS]), statuses)


def as_summary(truth: Delivered) -> dict[str, Any]:
    """For the session log."""
    return {
        "commands": truth.commands,
        "matched": truth.matched,
        "missing": truth.missing,
        "different": truth.different,
        "unasked": truth.unasked,
        "pulses": {str(channel): count for channel, count in truth.pulses.items()},
        "charge_uc": {str(channel): round(charge, 3) for channel, charge in truth.charge_uc.items()},
    }


def warn_of_real_device(session: Session) -> None:
    """Before anything goes to a bus where hardware may listen."""
    click.secho(
        f"Sending to {session.bus.interface} {session.bus.channel}: a stimulator there WILL stimulate. Ctrl-C stops.",
        fg="red",
        bold=True,
        err=True,
    )
