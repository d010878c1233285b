"""Injections by whoever else is on the CAN bus: what no controller would send, or not now.

Each returns when it began, by CLOCK_MONOTONIC in ns, and sets ``rig.sent`` to how many frames with identifiers that the
stimulator listens to it must have refused.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID
from drivers.stimulator.can_messages import Frame
from drivers.virtual.rogue import FRAMES_PER_S, Rogue, asks_for_current, flipped, random_frames
from fes.hil.rig import CampaignBroken, Rig

RANDOM_FRAMES: Final = 62_500  # each time: 21 seconds' worth, 1,000,000 in 16 attempts
TEND_EVERY: Final = 150
LATEST: Final = 40  # commands between one and its repetition: twice a count of 16 and more
REPEATS_S: Final = 3.0
ECHO_S: Final = 0.002  # what is sent to a multicast group comes back to its sender
PAIRS: Final = 10


def _rogue(rig: Rig) -> Rogue:
    if rig.devices.back is None:
        raise CampaignBroken("there is no CAN bus")
    return Rogue(rig.devices.back)


def flips(rig: Rig, n: int) -> int:
    """One of the present session's commands, with every one and every two bits inverted."""
    with _rogue(rig) as rogue:
        commands = rogue.on_commands(0.1)
        t_ns = time.monotonic_ns()
        rig.sent = sum(rogue.send(flipped(command)) for command in commands[:1])
    return t_ns


def repeats(rig: Rig, n: int) -> int:
    """After each command of the session an earlier one that asked for current: the newest itself, the one before …"""
    with _rogue(rig) as rogue:
        commands = [frame for frame in rogue.hear(0.1) if frame[0] == COMMAND_ID]
        lags = list(range(LATEST + 1))
        t_ns, end_s = time.monotonic_ns(), time.monotonic() + REPEATS_S
        while lags and time.monotonic() < end_s:
            heard = [frame for frame in rogue.hear(0.05, first_only=True) if frame[0] == COMMAND_ID]
            commands += heard
            lag = next((k for k in lags if k < len(commands) and asks_for_current(commands[-1 - k])), None)
            if heard and lag is not None:
                lags.remove(lag)
                rig.sent += rogue.send([commands[-1 - lag]])
                rogue.hear(ECHO_S)
    return t_ns


def exchange(rig: Rig, n: int) -> int:
    """On the line between them, each pair of commands changes places."""
    if rig.devices.link is None:
        raise CampaignBroken("there is no line between controller and stimulator")
    t_ns = rig.devices.link.tell("reorder", PAIRS)
    rig.watch(1.0)
    rig.sent = PAIRS
    return t_ns


def old_session(rig: Rig, n: int) -> int:
    """Commands of the present session, sent again in the next one, while its patient stands and it is armed."""
    with _rogue(rig) as rogue:
        commands = rogue.on_commands(0.25)
        rig.end_session()
        rig.prepare(rig.variant)
        t_ns = time.monotonic_ns()
        rig.sent = rogue.send([command for _ in range(20) for command in commands], 500.0)
    return t_ns


def random(rig: Rig, n: int) -> int:
    """By turns one with any identifier and one with those that a controller uses; the patient walks on meanwhile."""

    def frames() -> Iterator[Frame]:
        anything = random_frames(RANDOM_FRAMES // 2, 2 * n)
        commands = random_frames(RANDOM_FRAMES // 2, 2 * n + 1, (COMMAND_ID, OPEN_ID))
        for number, pair in enumerate(zip(anything, commands, strict=True)):
            if number % TEND_EVERY == 0:
                rig.outputs()
                rig.keep_armed()
            yield from pair

    t_ns = time.monotonic_ns()
    with _rogue(rig) as rogue:
        rig.sent = rogue.send(frames(), FRAMES_PER_S) // 2
    return t_ns
