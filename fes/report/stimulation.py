"""The stimulation channels of a session and what was commanded and delivered on each, as columns.

Bursts: stretches in which a channel was commanded on without a break.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from fes.config import Session
from fes.report.timeline import PhaseTimeline, phases_between
from fes.signals import NS_PER_S, FloatArray, IntArray, StimCommand, StimStatus
from statemachine.phases import Phase

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ChannelInfo:
    """Who a channel is: ``foot`` is "" and ``phases`` empty when the session's settings do not name it."""

    number: int
    name: str
    foot: str
    muscle: str
    start_phase: str
    stop_phase: str
    phases: tuple[Phase, ...]


@dataclass(frozen=True)
class CommandColumns:
    """Commands of one channel in order of time, each (N,); ``until_ns`` is how long a command held."""

    t_ns: IntArray
    until_ns: IntArray
    on: BoolArray
    current_ma: FloatArray
    pulse_width_us: FloatArray
    frequency_hz: FloatArray

    @property
    def held_s(self) -> FloatArray:
        """How long each command was in force (N,), seconds."""
        return np.asarray((self.until_ns - self.t_ns) / NS_PER_S, dtype=np.float64)

    def current_at(self, t_ns: IntArray) -> FloatArray:
        """Commanded current (N,) in mA in force at each time; 0 where off or lapsed."""
        if self.t_ns.size == 0:
            return np.zeros(t_ns.shape)
        at = np.searchsorted(self.t_ns, t_ns, side="right") - 1
        in_force = (at >= 0) & (t_ns < self.until_ns[at]) & self.on[at]
        return np.where(in_force, self.current_ma[at], 0.0)


@dataclass(frozen=True)
class StatusColumns:
    """What the stimulator said of one channel in order of time, each (N,)."""

    t_ns: IntArray
    on: BoolArray
    pulses: IntArray
    charge_uc: FloatArray


def session_settings(header: dict[str, Any]) -> Session | None:
    """The settings kept in a log's header, or None where they are absent or from another version."""
    try:
        return Session.model_validate(header.get("session"))
    except ValidationError:
        return None


def channel_infos(settings: Session | None, commands: Sequence[StimCommand]) -> tuple[ChannelInfo, ...]:
    """All channels that the settings name or a command mentions, by number."""
    known = {
        channel.number: ChannelInfo(
            number=channel.number,
            name=channel.name,
            foot=channel.foot,
            muscle=channel.muscle,
            start_phase=channel.start_phase,
            stop_phase=channel.stop_phase,
            phases=phases_between(channel.start_phase, channel.stop_phase),
        )
        for channel in (settings.channels if settings else ())
    }
    for number in {command.channel for command in commands} - set(known):
        known[number] = ChannelInfo(number, f"channel {number}", "", "", "", "", ())
    return tuple(known[number] for number in sorted(known))


def command_columns(commands: Sequence[StimCommand], channel: int) -> CommandColumns:
    """Pick one channel's commands; a command holds until the next one or until its validity has run out."""
    own = sorted((command for command in commands if command.channel == channel), key=lambda command: command.t_ns)
    t_ns = np.array([command.t_ns for command in own], dtype=np.int64)
    until_ns = t_ns + np.array([command.validity_ms for command in own], dtype=np.int64) * 1_000_000
    until_ns[:-1] = np.minimum(until_ns[:-1], t_ns[1:])
    return CommandColumns(
        t_ns=t_ns,
        until_ns=until_ns,
        on=np.array([command.on for command in own], dtype=np.bool_),
        current_ma=np.array([command.current_ma for command in own], dtype=np.float64),
        pulse_width_us=np.array([command.pulse_width_us for command in own], dtype=np.float64),
        frequency_hz=np.array([command.frequency_hz for command in own], dtype=np.float64),
    )


def status_columns(statuses: Sequence[StimStatus], channel: int) -> StatusColumns:
    """Pick one channel's answers; charge is counted from pulses where the device counts only those."""
    own = sorted((status for status in statuses if status.channel == channel), key=lambda status: status.t_ns)
    return StatusColumns(
        t_ns=np.array([status.t_ns for status in own], dtype=np.int64),
        on=np.array([status.on for status in own], dtype=np.bool_),
        pulses=np.array([status.pulses for status in own], dtype=np.int64),
        charge_uc=np.array(
            [status.charge_uc or status.pulses * status.current_ma * status.pulse_width_us * 1e-3 for status in own],
            dtype=np.float64,
        ),
    )


DEVICE_TAIL_NS = 100_000_000  # longest validity (60 ms) plus two command periods for the answer to come back


@dataclass(frozen=True)
class Burst:
    """One stretch of stimulation on one channel.

    ``charge_uc`` is the charge of one phase summed over all pulses, counted by the device where ``counted``
    and otherwise worked out from the commands (current · width · frequency · time). ``outside_s`` is the time
    in a phase in which the channel must be off, NaN when the channel's foot is not known.
    """

    channel: int
    t_start_ns: int
    t_end_ns: int
    peak_current_ma: float
    pulses: float
    charge_uc: float
    counted: bool
    outside_s: float

    @property
    def duration_s(self) -> float:
        """How long the burst lasted, seconds."""
        return (self.t_end_ns - self.t_start_ns) / NS_PER_S


def find_bursts(
    info: ChannelInfo, commands: CommandColumns, statuses: StatusColumns, timeline: PhaseTimeline | None
) -> tuple[Burst, ...]:
    """Cut one channel's commands into bursts; a command that lapsed before the next one ends a burst too."""
    on = commands.on
    if not on.any():
        return ()
    follows = np.zeros(on.size, dtype=np.bool_)
    follows[1:] = on[:-1] & (commands.until_ns[:-1] >= commands.t_ns[1:])
    first = np.flatnonzero(on & ~follows)
    number = np.cumsum(on & ~follows)[on] - 1
    last = np.append(np.flatnonzero(on)[np.flatnonzero(np.diff(number))], np.flatnonzero(on)[-1])
    start_ns, end_ns = commands.t_ns[first], commands.until_ns[last]

    peak_ma = np.zeros(first.size)
    np.maximum.at(peak_ma, number, commands.current_ma[on])
    pulse_share = (commands.frequency_hz * commands.held_s)[on]
    charge_share = pulse_share * (commands.current_ma * commands.pulse_width_us)[on] * 1e-3
    pulses = np.bincount(number, pulse_share, first.size)
    charge_uc = np.bincount(number, charge_share, first.size)
    counted = statuses.pulses.size > 0 and bool(statuses.pulses.any() or statuses.charge_uc.any())
    if counted:
        # An answer speaks of the time before it, so it may come just after the burst that it counts.
        owner = np.searchsorted(start_ns, statuses.t_ns, side="right") - 1
        ok = owner >= 0
        ok[ok] = statuses.t_ns[ok] <= end_ns[owner[ok]] + DEVICE_TAIL_NS
        pulses = np.bincount(owner[ok], statuses.pulses[ok].astype(np.float64), first.size)
        charge_uc = np.bincount(owner[ok], statuses.charge_uc[ok], first.size)

    outside_s = np.full(first.size, np.nan)
    if timeline is not None and info.phases:
        outside_s = (end_ns - start_ns) / NS_PER_S - timeline.time_in(info.phases, start_ns, end_ns)
        outside_s = np.maximum(outside_s, 0.0).round(9)
    return tuple(
        Burst(
            channel=info.number,
            t_start_ns=int(start_ns[i]),
            t_end_ns=int(end_ns[i]),
            peak_current_ma=float(peak_ma[i]),
            pulses=float(pulses[i]),
            charge_uc=float(charge_uc[i]),
            counted=counted,
            outside_s=float(outside_s[i]),
        )
        for i in range(first.size)
    )


def answers_without_command(commands: CommandColumns, statuses: StatusColumns) -> int:
    """How many answers say that the device was on when no command had it on for longer than a command may hold."""
    answered_on = statuses.t_ns[statuses.on]
    if answered_on.size == 0:
        return 0
    on_until = commands.until_ns[commands.on]
    on_from = commands.t_ns[commands.on]
    at = np.searchsorted(on_from, answered_on, side="right") - 1
    stray = at < 0
    stray[~stray] = answered_on[~stray] > on_until[at[~stray]] + DEVICE_TAIL_NS
    return int(stray.sum())
