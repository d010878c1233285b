"""One fault, once: walk, inject in mid-burst, watch the stimulator's end, ask the session, mend."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from fes.hil.bounded import burst_without_end, charge_without_end
from fes.hil.injections import INJECTIONS
from fes.hil.judge import MS, off_after_ms, on_at, resumed_after
from fes.hil.naming import LATCHED, badly_named, named_now
from fes.hil.results import Attempt
from fes.hil.rig import CampaignBroken, Rig
from fes.hil.scenarios import Effect, Scenario
from fes.hil.withstood import no_burst_begins, no_effect, nothing_executed
from fes.journal import SessionLogError, read_session
from fes.signals import NS_PER_S

INTO_BURST_MS: Final = (60.0, 100.0, 140.0, 180.0, 80.0, 120.0, 160.0)  # by turns; a swing lasts 400 ms
TRIES: Final = 4  # a burst may have ended by itself while the fault was on its way
LOST_MS: Final = 250.0
END_S: Final = 15.0
ORPHANS_S: Final = 3.0
BEFORE_NS: Final = NS_PER_S // 5  # a moment of the machine's that began so long before the fault still tells


def attempt(rig: Rig, scenario: Scenario, n: int) -> Attempt:
    """Bring a scenario about for the n-th time and judge the answer.

    Raises:
        CampaignBroken: it could not be brought about.
    """
    rig.value = scenario.value(n)
    into_burst_ms = INTO_BURST_MS[n % len(INTO_BURST_MS)]
    found = _JUDGES[scenario.effect](rig, scenario, n, into_burst_ms)
    return replace(found, value=f"{rig.value:g} {scenario.unit}") if scenario.values else found


def _goes_off(rig: Rig, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
    inject, heal = INJECTIONS[scenario.name]
    for _ in range(TRIES):
        rig.prepare(scenario.variant)
        rig.in_burst(into_burst_ms)
        t_ns = inject(rig, n)
        deadline_s = (scenario.deadline_ms or 0.0) * 1e-3
        left_s = max(0.0, t_ns * 1e-9 + deadline_s - time.monotonic())
        rig.watch(left_s + scenario.watch_s)
        faults = _ended(rig, t_ns) if scenario.effect is Effect.ENDED else []
        named = _alarm(rig) if scenario.effect is Effect.ENDED else named_now(rig)
        heal(rig)
        if not scenario.restart:
            rig.watch(0.4)
            named = named or named_now(rig)  # one that was held up itself speaks when it is let go
            status = rig.status()
            if not rig.session().alive:
                faults = [f"the session has ended: {rig.session().said()[-300:]}"]
            elif status is None or status.state not in LATCHED:
                faults.append(f"not latched: the session is {status.state if status else 'gone'}")
        stretches = rig.outputs(t_ns - NS_PER_S)
        if on_at(stretches, t_ns) is None:
            continue
        last_ms = max((o.last_pulse_ns - t_ns) / MS for o in stretches)
        off_ms = off_after_ms(stretches, t_ns)
        if resumed_after(stretches, t_ns):
            faults.append("current again without arming")
        misnamed = badly_named(named, scenario) if scenario.effect is Effect.LATCHED else []
        if misnamed and not faults and off_ms <= deadline_s * 1e3:
            away = rig.was_away(named, t_ns - BEFORE_NS, t_ns + int(deadline_s * NS_PER_S))
            if away:
                return Attempt(off_ms, last_ms, named, away=True)
        faults += misnamed
        if scenario.restart:
            faults += _left_behind(rig, scenario, t_ns)
        elif rig.session().alive:
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


def _left_behind(rig: Rig, scenario: Scenario, t_ns: int) -> list[str]:
    """The next session is started; meanwhile nothing of a killed one may go on."""
    orphans, rig.orphans = rig.orphans, []
    rig.start(scenario.variant)
    if not orphans:
        return []
    rig.watch(max(0.0, t_ns * 1e-9 + ORPHANS_S - time.monotonic()))
    left = [child for child in orphans if child.runs]
    for child in left:
        child.kill()
    return [f"{ORPHANS_S:g} s later still running: {', '.join(child.module for child in left)}"] if left else []


def _alarm(rig: Rig) -> str:
    return next((line for line in rig.session().said().splitlines() if "ALARM" in line), "").strip("\a")


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


def _bounded(rig: Rig, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
    return charge_without_end(rig, scenario) if scenario.name == "dose" else burst_without_end(rig, scenario)


_JUDGES: Final[dict[Effect, Callable[[Rig, Scenario, int, float], Attempt]]] = {
    Effect.LATCHED: _goes_off,
    Effect.ENDED: _goes_off,
    Effect.NONE: no_effect,
    Effect.HARMLESS: no_effect,
    Effect.SILENT: no_burst_begins,
    Effect.NOT_EXECUTED: nothing_executed,
    Effect.BOUNDED: _bounded,
}
