"""One fault, once: walk, inject in mid-burst, watch the stimulator's end, ask the session, mend."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from drivers.virtual.node_record import RecordEntry
from fes.hil.injections import INJECTIONS
from fes.hil.judge import MS, began_after, length_ms, off_after_ms, on_at
from fes.hil.results import Attempt
from fes.hil.rig import LATCHED, CampaignBroken, Rig
from fes.hil.scenarios import Effect, Scenario
from fes.hil.settings import CHANNEL, CURRENT_MA, DOSE_MC, FREQUENCY_HZ, INTENSITY, PULSE_WIDTH_US
from fes.journal import SessionLogError, read_session

INTO_BURST_MS: Final = (60.0, 100.0, 140.0, 180.0, 80.0, 120.0, 160.0)  # by turns; a swing lasts 400 ms
TRIES: Final = 4  # a burst may have ended by itself while the fault was on its way
LOST_MS: Final = 250.0
END_S: Final = 15.0
STUCK_MS: Final = 1500.0  # on for so long, the burst is none of walking
DOSE_WAIT_S: Final = 60.0
DOSE_ROUNDING_UC: Final = 12.0  # one command's and one pulse's charge
FRAMES_LOST_SHARE: Final = 0.02  # a bus over UDP may lose some on the way
AGAIN_S: Final = 12.0


def attempt(rig: Rig, scenario: Scenario, n: int) -> Attempt:
    """Bring a scenario about for the n-th time and judge the answer.

    Raises:
        CampaignBroken: it could not be brought about.
    """
    return _JUDGES[scenario.effect](rig, scenario, n)


def _goes_off(rig: Rig, scenario: Scenario, n: int) -> Attempt:
    inject, heal = INJECTIONS[scenario.name]
    for _ in range(TRIES):
        rig.prepare(scenario.variant)
        rig.in_burst(INTO_BURST_MS[n % len(INTO_BURST_MS)])
        t_ns = inject(rig, n)
        deadline_s = (scenario.deadline_ms or 0.0) * 1e-3
        left_s = max(0.0, t_ns * 1e-9 + deadline_s - time.monotonic())
        rig.watch(left_s + scenario.watch_s)
        faults = _ended(rig, t_ns) if scenario.effect is Effect.ENDED else []
        named = _named(rig, scenario)
        faults += _badly_named(named, scenario) if scenario.effect is Effect.LATCHED else []
        heal(rig)
        if not scenario.restart:
            rig.watch(0.4)
            status = rig.status()
            if not rig.session().alive:
                faults = [f"the session has ended: {rig.session().said()[-300:]}"]
            elif status is None or status.state not in LATCHED:
                faults.append(f"not latched: the session is {status.state if status else 'gone'}")
        output = on_at(rig.outputs(), t_ns)
        if output is None:
            continue
        stretches = rig.outputs()
        last_ms = max((o.last_pulse_ns - t_ns) / MS for o in stretches)
        again = began_after(stretches, t_ns)
        if again:
            faults.append("current again without arming")
        off_ms = off_after_ms(stretches, t_ns)
        if not scenario.restart and rig.session().alive:
            faults += _not_armed_again(rig)
        return Attempt(off_ms, last_ms, named, tuple(faults))
    raise CampaignBroken(f"no burst lasted until the fault was there, {TRIES} times")


def _not_armed_again(rig: Rig) -> list[str]:
    """When the fault is over, a person must be able to go on; else the next row begins with a new session."""
    try:
        rig.arm()
    except CampaignBroken as error:
        rig.end_session()
        return [f"cannot be armed again: {error}"]
    return []


def _ended(rig: Rig, t_ns: int) -> list[str]:
    """What is wrong with how the session ended."""
    session = rig.session()
    status = session.wait(END_S)
    if status is None:
        return ["the session goes on"]
    faults = [] if status == 3 else [f"exit code {status} instead of 3"]
    if "ALARM" not in session.said():
        faults.append("no alarm")
    log = session.log()
    if log is None:
        return [*faults, "no log"]
    try:
        record = read_session(log)
    except SessionLogError as error:
        return [*faults, str(error)]
    newest_ns = max((int(samples.t_ns[-1]) for samples in record.samples.values() if len(samples.t_ns)), default=0)
    lost_ms = (t_ns - newest_ns) / MS
    return [*faults, f"{lost_ms:.0f} ms of the log lost"] if lost_ms > LOST_MS else faults


def _named(rig: Rig, scenario: Scenario) -> str:
    if scenario.effect is Effect.ENDED:
        return next((line for line in rig.session().said().splitlines() if "ALARM" in line), "").strip("\a")
    status = rig.status() if rig.session().alive else None
    return status.fault if status else ""


def _badly_named(named: str, scenario: Scenario) -> list[str]:
    if scenario.restart or not scenario.words or any(word in named for word in scenario.words):
        return []
    return [f"the reason given is {named!r}, it should speak of {' or '.join(scenario.words)}"]


def _no_effect(rig: Rig, scenario: Scenario, n: int) -> Attempt:
    inject, heal = INJECTIONS[scenario.name]
    rig.prepare(scenario.variant)
    rig.in_burst(INTO_BURST_MS[n % len(INTO_BURST_MS)])
    t_ns = inject(rig, n)
    rig.watch(scenario.watch_s)
    rig.watch(AGAIN_S, lambda: began_after(rig.outputs(), t_ns) > 0 or _is_latched(rig))
    status = rig.status()
    heal(rig)
    faults = []
    if status is None or status.state in LATCHED:
        faults.append(f"went off: {status.fault if status else 'the session is gone'}")
    bursts = began_after(rig.outputs(), t_ns)
    if not bursts:
        faults.append("no burst after it")
    return Attempt(faults=tuple(faults), remark=f"goes on: {bursts} bursts after it")


def _is_latched(rig: Rig) -> bool:
    status = rig.status()
    return status is not None and status.state in LATCHED


def _nothing_executed(rig: Rig, scenario: Scenario, n: int) -> Attempt:
    inject, heal = INJECTIONS[scenario.name]
    for _ in range(TRIES):
        rig.prepare(scenario.variant)
        rig.in_burst(INTO_BURST_MS[0])
        rig.sent = 0
        before = len(rig.bench.entries())
        t_ns = inject(rig, n)
        rig.watch(0.3)
        entries = [entry for entry in rig.bench.entries()[before:] if entry.t_ns >= t_ns]
        status = rig.status()
        named = status.fault if status else ""
        heal(rig)
        if not rig.sent:
            continue
        refused = sum(entry.event == "refused" for entry in entries)
        odd = [entry for entry in entries if _odd(entry)]
        faults = [f"{len(odd)} executed: {odd[0]}"] if odd else []
        if refused < (1.0 - FRAMES_LOST_SHARE) * rig.sent:
            faults.append(f"only {refused} of {rig.sent} refused")
        remark = f"{rig.sent} sent, {refused} refused, {len(odd)} executed"
        return Attempt(named=named, faults=tuple(faults), remark=remark)
    raise CampaignBroken(f"the controller sent no command in the burst, {TRIES} times")


def _odd(entry: RecordEntry) -> bool:
    """Whether the stimulator did what the campaign's session never asks for."""
    if entry.event == "session":
        return True
    return entry.event in ("on", "level") and (
        entry.channel != CHANNEL
        or entry.pulse_width_us != PULSE_WIDTH_US
        or entry.frequency_hz != FREQUENCY_HZ
        or entry.current_ma > CURRENT_MA * INTENSITY + 1e-6
    )


def _bounded(rig: Rig, scenario: Scenario, n: int) -> Attempt:
    return _dose(rig, scenario) if scenario.name == "dose" else _stuck(rig, scenario)


def _stuck(rig: Rig, scenario: Scenario) -> Attempt:
    rig.prepare(scenario.variant)
    burst = rig.in_burst(STUCK_MS)
    rig.watch((scenario.deadline_ms or 0.0) * 1e-3 - 1e-3 * STUCK_MS + 0.3)
    named = _named(rig, scenario)
    stretches = rig.outputs()
    longest = next(output for output in stretches if output.on_ns == burst.on_ns)
    off_ms = off_after_ms([longest], burst.on_ns) if longest.off_ns else length_ms(longest, time.monotonic_ns())
    faults = _badly_named(named, scenario)
    if began_after(stretches, burst.on_ns):
        faults.append("current again without arming")
    return Attempt(off_ms, (longest.last_pulse_ns - burst.on_ns) / MS, named, tuple(faults))


def _dose(rig: Rig, scenario: Scenario) -> Attempt:
    begin_ns = time.monotonic_ns()
    rig.prepare(scenario.variant)
    for _ in range(TRIES):
        rig.until(lambda status: status.state in LATCHED, "", DOSE_WAIT_S, "the charge is not capped")
        named = _named(rig, scenario)
        if not _badly_named(named, scenario):
            break
        rig.unasked.append(named)  # the machine was away for a moment, or the like: not what is asked here
        rig.arm()
    rig.watch(scenario.watch_s)
    charge_uc = sum(output.charge_uc for output in rig.outputs() if output.on_ns >= begin_ns)
    faults = _badly_named(named, scenario)
    if not 0.0 < charge_uc <= 1e3 * DOSE_MC + DOSE_ROUNDING_UC:
        faults.append(f"{charge_uc:.0f} µC delivered, limit {1e3 * DOSE_MC:.0f} µC")
    return Attempt(named=named, faults=tuple(faults), remark=f"{charge_uc:.0f} µC of {1e3 * DOSE_MC:.0f} µC allowed")


_JUDGES: Final[dict[Effect, Callable[[Rig, Scenario, int], Attempt]]] = {
    Effect.LATCHED: _goes_off,
    Effect.ENDED: _goes_off,
    Effect.NONE: _no_effect,
    Effect.NOT_EXECUTED: _nothing_executed,
    Effect.BOUNDED: _bounded,
}
