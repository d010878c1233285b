"""Bursts: stretches in which a channel was commanded on without a break."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.signals import NS_PER_S
from fes.view.channels import ChannelInfo, CommandColumns, StatusColumns
from fes.view.timeline import PhaseTimeline

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
