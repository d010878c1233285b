"""A campaign: every fault of the table, one after the other, on one transport.

One fault, once: walk, inject in mid-burst, watch the stimulator's end, ask the session, mend.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from drivers.imu.port import ImuLost
from drivers.simulated.bus_guests import Rogue
from drivers.stimulator.port import StimulatorLost
from fes.hil.baseline import Baseline
from fes.hil.bounded import burst_without_end, charge_without_end
from fes.hil.campaign_bench import LATCHED, CampaignBench, CampaignBroken, badly_named, named_now
from fes.hil.devices import start_devices
from fes.hil.expected_no_effect import no_burst_begins, no_effect, nothing_executed
from fes.hil.hardware import BusWitness, Hardware, hardware_session
from fes.hil.injections import INJECTIONS
from fes.hil.judge import MS, off_after_ms, on_at, resumed_after
from fes.hil.results import Attempt, Campaign, Row
from fes.hil.scenarios import Effect, Needs, Scenario
from fes.session_log import SessionLogError, read_session
from fes.signals import NS_PER_S

INTO_BURST_MS: Final = (60.0, 100.0, 140.0, 180.0, 80.0, 120.0, 160.0)  # by turns; a swing lasts 400 ms
TRIES: Final = 4  # a burst may have ended by itself while the fault was on its way
LOST_MS: Final = 250.0
END_S: Final = 15.0
ORPHANS_S: Final = 3.0
BEFORE_NS: Final = NS_PER_S // 5  # a moment of the machine's that began so long before the fault still tells


def attempt(rig: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """Bring a scenario about for the n-th time and judge the answer.

    Raises:
        CampaignBroken: it could not be brought about.
    """
    rig.value = scenario.value(n)
    into_burst_ms = INTO_BURST_MS[n % len(INTO_BURST_MS)]
    found = _JUDGES[scenario.effect](rig, scenario, n, into_burst_ms)
    return replace(found, value=f"{rig.value:g} {scenario.unit}") if scenario.values else found


def _goes_off(rig: CampaignBench, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
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


def _not_armed_again(rig: CampaignBench) -> list[str]:
    """When the fault is over, a person must be able to go on; else the next row begins with a new session."""
    try:
        rig.arm()
    except CampaignBroken as error:
        rig.end_session()
        return [f"cannot be armed again: {error}"]
    return []


def _left_behind(rig: CampaignBench, scenario: Scenario, t_ns: int) -> list[str]:
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


def _alarm(rig: CampaignBench) -> str:
    return next((line for line in rig.session().said().splitlines() if "ALARM" in line), "").strip("\a")


def _ended(rig: CampaignBench, t_ns: int) -> list[str]:
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


def _bounded(rig: CampaignBench, scenario: Scenario, n: int, into_burst_ms: float) -> Attempt:
    return charge_without_end(rig, scenario) if scenario.name == "dose" else burst_without_end(rig, scenario)


_JUDGES: Final[dict[Effect, Callable[[CampaignBench, Scenario, int, float], Attempt]]] = {
    Effect.LATCHED: _goes_off,
    Effect.ENDED: _goes_off,
    Effect.NONE: no_effect,
    Effect.HARMLESS: no_effect,
    Effect.SILENT: no_burst_begins,
    Effect.NOT_EXECUTED: nothing_executed,
    Effect.BOUNDED: _bounded,
}
NOT_BASELINE: Final = ("cpu_hogs", "controller_starved")  # these take the processor away on purpose
BROKEN_IN_A_ROW: Final = 3
SPOILT_AT_MOST: Final = 4

Tell = Callable[[Scenario, int, Attempt | None], None]
"""Told before (None) and after every attempt."""


def simulated_campaign(
    transport: str,
    scenarios: Sequence[Scenario],
    repeat: int,
    folder: Path,
    tell: Tell,
    channel: str = "vcan0",
    *,
    closed_loop: bool = False,
) -> Campaign:
    """Run these scenarios on simulated devices, each ``repeat`` times; whatever ends it, nothing is left running.

    Args:
        folder: for the devices' records and the sessions' logs; must exist.
        channel: the interface's name for ``socketcan``.
        closed_loop: with a virtual patient, who feels what is delivered, in the place of a recorded walk.

    Raises:
        Unavailable: the transport is not to be had on this machine.
        CampaignBroken: three attempts in a row could not even be made.
    """
    with ExitStack() as stack:
        devices = start_devices(transport, folder, stack, channel, closed_loop=closed_loop)
        rig = CampaignBench(devices, devices.can_do | machine_can_do(), stack)
        return run_campaign(rig, transport, scenarios, repeat, tell)


def hardware_campaign(
    path: Path, calibration: Path, scenarios: Sequence[Scenario], repeat: int, folder: Path, tell: Tell
) -> Campaign:
    """Run these scenarios, which must be of the host's side, on the devices of a session file.

    Raises:
        ConfigError: the settings cannot be used, or nobody but the controller can hear the stimulator.
        BusError: the bus cannot be opened.
        CampaignBroken: three attempts in a row could not even be made.
    """
    session = hardware_session(path)
    with ExitStack() as stack:
        witness = BusWitness(stack.enter_context(Rogue(session.bus)))
        witness.start(stack)
        bench = Hardware(folder, path, calibration, session.stimulation.intensity, witness)
        rig = CampaignBench(bench, machine_can_do(), stack, by_hand=True)
        return run_campaign(rig, f"hardware ({path.name})", scenarios, repeat, tell)


def run_campaign(rig: CampaignBench, name: str, scenarios: Sequence[Scenario], repeat: int, tell: Tell) -> Campaign:
    """The rows, one after the other.

    Raises:
        CampaignBroken: three attempts in a row could not even be made.
    """
    started, begin_s = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
    with ExitStack() as stack:
        stack.callback(rig.close)
        baseline = Baseline()
        stack.callback(baseline.end)
        rig.gaps = baseline.gaps
        rows: list[Row] = []
        broken = 0
        for scenario in scenarios:
            row = Row(scenario)
            rows.append(row)
            if lacking := sorted(scenario.needs - rig.can_do):
                row.skipped = f"needs {', '.join(lacking)}"
                continue
            if scenario.name in NOT_BASELINE:
                baseline.leave_out(True)
            for n in range(scenario.attempts(repeat)):
                tell(scenario, n, None)
                try:
                    found = _undisturbed(rig, row, n)
                    broken = 0
                except (CampaignBroken, StimulatorLost, ImuLost, ProcessLookupError) as error:
                    broken += 1
                    found = Attempt(faults=(str(error),))
                    rig.end_session()
                    if broken >= BROKEN_IN_A_ROW:
                        raise CampaignBroken(f"{scenario.name}: {error}") from error
                row.attempts.append(found)
                tell(scenario, n, found)
            if scenario.name in NOT_BASELINE:
                baseline.leave_out(False)
        rig.close()
        lateness = baseline.end()
    seconds = time.monotonic() - begin_s
    return Campaign(name, tuple(rows), lateness, started, seconds, repeat, tuple(rig.unasked), tuple(rig.away))


def _undisturbed(rig: CampaignBench, row: Row, n: int) -> Attempt:
    """The n-th attempt; made again while the machine itself spoils it, a few times at most."""
    for _ in range(SPOILT_AT_MOST):
        found = attempt(rig, row.scenario, n)
        if not found.away:
            return found
        row.away.append(found.named)
    return found


def machine_can_do() -> frozenset[Needs]:
    """What this machine lets the campaign do."""
    found = {Needs.PROC} if Path("/proc/self/task").is_dir() else set()
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1 and _may_be_first():
        found.add(Needs.FIFO)
    return frozenset(found)


def _may_be_first() -> bool:
    """Whether SCHED_FIFO is granted; tried in a process of its own."""
    pid = os.fork()
    if not pid:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
            os._exit(0)
        except (OSError, AttributeError):
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def save_campaign(campaign: Campaign, folder: Path) -> tuple[Path, Path]:
    """Write ``hil.json`` and ``hil.md``; both paths."""
    as_json, as_text = folder / "hil.json", folder / "hil.md"
    as_json.write_text(json.dumps(campaign.to_dict(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    as_text.write_text(campaign.to_markdown(), encoding="utf-8")
    return as_json, as_text
