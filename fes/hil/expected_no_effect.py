"""Rows in which nothing may come of the fault: the session goes on, no foreign frame acts, no burst begins."""

from __future__ import annotations

import math
import time
from typing import Final

from drivers.simulated.record import RecordEntry
from fes.hil.campaign_bench import ALLOWED, CampaignBench, CampaignBroken, badly_named, is_latched, named_now
from fes.hil.injections import INJECTIONS
from fes.hil.judge import began_after, resumed_after
from fes.hil.results import Attempt
from fes.hil.scenarios import Effect, Scenario
from fes.hil.settings import CHANNEL, CURRENT_MA, FREQUENCY_HZ, INTENSITY, PULSE_WIDTH_US
from fes.session_log import SessionLogError, read_session
from fes.signals import NS_PER_S

TRIES: Final = 4
AGAIN_S: Final = 12.0
DISARM_S: Final = 0.3
ARM_TRIED_S: Final = 8.0  # they come to a stand, and rest for a second
FRAMES_LOST_SHARE: Final = 0.02  # a bus over UDP may lose some on the way
CHECKED_SHARE: Final = 1 / 256  # of random frames have the right CRC (docs/can.md) and are looked at at all
LATCHES_WITHIN_NS: Final = NS_PER_S // 10  # after the first refused command the session has heard of it
SESSION: Final = "session"  # the record's word for one that was opened
NO_CRC: Final = ("wrong CRC", "bytes instead")


def no_effect(rig: CampaignBench, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
    """The walk goes on with the next burst."""
    inject, heal = INJECTIONS[scenario.name]
    rig.prepare(scenario.variant)
    rig.in_burst(into_burst_ms)
    t_ns = inject(rig, n)
    rig.watch(scenario.watch_s)
    rig.watch(AGAIN_S, lambda: resumed_after(rig.outputs(t_ns), t_ns) > 0 or is_latched(rig))
    latched, named, ended = is_latched(rig), named_now(rig), not rig.session().alive
    bursts = resumed_after(rig.outputs(t_ns), t_ns)
    heal(rig)
    if latched and scenario.effect is Effect.HARMLESS and not ended:
        rig.arm()
        return Attempt(named=named, remark="off, armed again by hand")
    if latched and rig.was_away(named, t_ns, time.monotonic_ns()):
        return Attempt(named=named, away=True)
    if ended:
        return Attempt(faults=("the session has ended",))
    faults = [f"went off: {named}"] if latched else [] if bursts else ["no burst after it"]
    return Attempt(faults=tuple(faults), remark=f"goes on: {bursts} bursts after it")


def no_burst_begins(rig: CampaignBench, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
    """Brought about while the patient stands, armed: they walk, and nothing is stimulated; nor can it be armed."""
    inject, heal = INJECTIONS[scenario.name]
    rig.prepare(scenario.variant, walks=False)
    t_ns = inject(rig, n)
    rig.stand(False)
    rig.watch(scenario.watch_s)
    named = named_now(rig)
    faults = ["a burst began"] if began_after(rig.outputs(t_ns), t_ns) else []
    if not faults and named and rig.was_away(named, t_ns, time.monotonic_ns()):
        heal(rig)
        return Attempt(named=named, away=True)
    rig.order("disarm")
    rig.stand(True)
    rig.watch(DISARM_S)
    rig.watch(ARM_TRIED_S, lambda: _arms_or_says_why_not(rig, scenario))
    status = rig.status()
    if status is None or status.state in ALLOWED:
        faults.append("can be armed though it is not mended")
    refusal = status.message if status is not None else ""
    faults += badly_named(refusal, scenario)
    heal(rig)
    rig.arm()
    return Attempt(named=named or refusal, faults=tuple(faults), remark="no burst began, arming refused")


def _arms_or_says_why_not(rig: CampaignBench, scenario: Scenario) -> bool:
    rig.keep_armed()
    status = rig.status()
    return status is not None and (status.state in ALLOWED or not badly_named(status.message, scenario))


def nothing_executed(rig: CampaignBench, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
    """What others send is refused by the stimulator, and it does nothing that the session did not ask for."""
    inject, heal = INJECTIONS[scenario.name]
    for _ in range(TRIES):
        rig.prepare(scenario.variant)
        rig.in_burst(into_burst_ms)
        rig.sent = 0
        rig.outputs()
        heard: list[RecordEntry] = []
        rig.heard = heard
        t_ns = inject(rig, n)
        rig.watch(scenario.watch_s)
        rig.outputs()
        rig.heard = None
        named = named_now(rig)
        heal(rig)
        if rig.sent:
            entries = [entry for entry in heard if entry.t_ns >= t_ns]
            own = _opened_by_itself(rig) if any(entry.event == SESSION for entry in entries) else frozenset()
            return judged(entries, rig.sent, named, random="random" in scenario.name, own_sessions=own)
    raise CampaignBroken(f"the controller sent no command in the burst, {TRIES} times")


def _opened_by_itself(rig: CampaignBench) -> frozenset[str]:
    """The sessions that the controller has opened again since its start, by its log, as the record names them.

    It does that when it hears no heartbeat for a while, or a false one that chance gave the right CRC.
    """
    log = rig.session().log()
    try:
        reopened = read_session(log).reopened if log is not None else []
    except SessionLogError:
        return frozenset()
    return frozenset(f"session {opened.session_id}" for opened in reopened)


def judged(
    entries: list[RecordEntry], sent: int, named: str, *, random: bool, own_sessions: frozenset[str] = frozenset()
) -> Attempt:
    """What the stimulator's record since the injection says of ``sent`` foreign frames under its own identifiers.

    Args:
        named: the session's reason for being off; "": it is not.
        random: of random frames a share passes the CRC by chance; more than that share must not.
        own_sessions: that the controller itself has opened.
    """
    refused = [entry for entry in entries if entry.event == "refused"]
    odd = [entry for entry in entries if _odd(entry) and entry.detail not in own_sessions]
    faults = [f"{len(odd)} executed: {odd[0]}"] if odd else []
    if len(refused) < (1.0 - FRAMES_LOST_SHARE) * sent:
        faults.append(f"only {len(refused)} of {sent} refused")
    if named and refused and not random:
        quiet_ns = refused[0].t_ns + LATCHES_WITHIN_NS
        if late := [entry for entry in entries if entry.event == "on" and entry.t_ns > quiet_ns]:
            faults.append(f"current though the session is off: {late[0]}")
    remark = f"{sent} sent, {len(refused)} refused, {len(odd)} executed"
    if random:
        passed = sum(not any(word in entry.detail for word in NO_CRC) for entry in refused)
        expected = CHECKED_SHARE * sent
        if passed > expected + 5.0 * math.sqrt(expected):
            faults.append(f"{passed} have a right CRC, {expected:.0f} are expected")
        remark += f"; {passed} had a right CRC, {expected:.0f} expected"
    return Attempt(named=named, faults=tuple(faults), remark=remark)


def _odd(entry: RecordEntry) -> bool:
    """Whether the stimulator did what the campaign's session never asks for."""
    if entry.event == SESSION:
        return True
    return entry.event in ("on", "level") and (
        entry.channel != CHANNEL
        or entry.pulse_width_us != PULSE_WIDTH_US
        or entry.frequency_hz != FREQUENCY_HZ
        or entry.current_ma > CURRENT_MA * INTENSITY + 1e-6
    )
