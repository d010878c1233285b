"""A campaign: every fault of the table, one after the other, on one transport; and the judgement of each attempt.

An attempt: walk, inject in mid-burst, observe the stimulator's end, ask the session, mend. In most rows the output must
go off and stay off. In some nothing may come of the fault: the session goes on, no foreign frame acts, no burst begins.
In two nothing is injected: the walk itself asks for more than is allowed.
"""

import json
import math
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from drivers.imu.port import ImuLost
from drivers.simulated.bus_guests import Rogue
from drivers.simulated.record import RecordEntry
from drivers.simulated.spawn import ImuKind
from drivers.stimulator.port import StimulatorLost
from fes.config import WIRELESS
from fes.hil.baseline import Baseline
from fes.hil.campaign_bench import (
    ALLOWED,
    LATCHED,
    CampaignBench,
    CampaignBroken,
    is_latched,
    reason_faults,
    stated_reason,
)
from fes.hil.devices import BusWitness, Hardware, PlayedRecording, hardware_session, start_devices
from fes.hil.injections import INJECTIONS
from fes.hil.results import (
    MS,
    Attempt,
    Campaign,
    Row,
    began_after,
    length_ms,
    off_after_ms,
    output_at,
    resumed_after,
    with_late_pulses,
)
from fes.hil.scenarios import Effect, Moment, Needs, Scenario, by_radio
from fes.hil.sensor_faults import PULSE_BY_PULSE, RealSensor
from fes.hil.settings import CHANNEL, CURRENT_MA, DOSE_MC, FREQUENCY_HZ, INTENSITY, PULSE_WIDTH_US
from fes.session_log import SessionLogError, read_session
from fes.signals import NS_PER_S

INTO_BURST_MS: Final = (60.0, 100.0, 140.0, 180.0, 80.0, 120.0, 160.0)  # by turns; a swing lasts 400 ms
INTO_STANCE_MS: Final = (60.0, 180.0, 300.0)  # after the burst's end; a stance lasts 600 ms
RESTS_S: Final = 0.5
STRIDE_S: Final = 1.0  # a fault that may take a stride to tell may see a further burst begin
TRIES: Final = 4  # a burst may have ended by itself while the fault was on its way
LOST_MS: Final = 250.0
END_S: Final = 15.0
ORPHANS_S: Final = 3.0
BEFORE_NS: Final = NS_PER_S // 5  # a moment of the machine's that began so long before the fault still counts
AGAIN_S: Final = 12.0
DISARM_S: Final = 0.3
NAMED_S: Final = 15.0  # five strides, with the stand after every four
ARM_TRIED_S: Final = 8.0  # they come to a stand, and rest for a second
FRAMES_LOST_SHARE: Final = 0.02  # a bus over UDP may lose some on the way
CHECKED_SHARE: Final = 1 / 256  # of random frames have the right CRC (docs/can.md) and are looked at at all
LATCHES_WITHIN_NS: Final = NS_PER_S // 10  # after the first refused command the session has heard of it
SESSION: Final = "session"  # the record's word for one that was opened
NO_CRC: Final = ("wrong CRC", "bytes instead")
USUAL_S: Final = 15.0  # several walks of four strides, after which the controller knows how long a burst lasts …
STUCK_S: Final = 20.0  # … and as many with a stand behind each, in which the stance does not end
STUCK_LATE_MS: Final = 150.0  # and a quarter of the usual length: so much later a burst may end that nothing ends
DOSE_WAIT_S: Final = 60.0
DOSE_TRIES: Final = 4
DOSE_ROUNDING_UC: Final = 12.0  # one command's and one pulse's charge


def make_attempt(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """Bring a scenario about for the n-th time and judge the answer. CampaignBroken: it could not be brought about."""
    bench.value = scenario.value(n)
    judge = _JUDGES[scenario.effect] if scenario.moment is Moment.SWING else _lies_before_a_burst
    found = judge(bench, scenario, n)
    return replace(found, value=f"{bench.value:g} {scenario.unit}") if scenario.values else found


def _goes_off(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    inject, heal = INJECTIONS[scenario.injected]
    for _ in range(TRIES):
        bench.prepare(scenario.variant)
        bench.in_burst(INTO_BURST_MS[n % len(INTO_BURST_MS)])
        t_ns = inject(bench, n)
        deadline_s = (scenario.deadline_ms or 0.0) * 1e-3
        bench.observe(max(0.0, t_ns * 1e-9 + deadline_s - time.monotonic()) + scenario.watch_s)
        if scenario.effect is Effect.ENDED:
            faults = _ended(bench, t_ns)
            named = next((line for line in bench.session().printed().splitlines() if "ALARM" in line), "").strip("\a")
        else:
            faults, named = [], stated_reason(bench)
        heal(bench)
        if not scenario.restart:
            bench.observe(0.4)
            named = named or stated_reason(bench)  # one that was held up itself speaks when it is let go
            status = bench.status()
            if not bench.session().alive:
                faults = [f"the session has ended: {bench.session().printed()[-300:]}"]
            elif status is None or status.state not in LATCHED:
                if deadline_s >= STRIDE_S and bench.stood_since(t_ns):
                    continue  # it was the walk's last step: a foot that stays on the ground has nothing to lie about
                faults.append(f"not latched: the session is {status.state if status else 'gone'}")
        stretches = bench.outputs(t_ns - NS_PER_S)
        if output_at(stretches, t_ns) is None:
            continue
        last_ms = max((o.last_pulse_ns - t_ns) / MS for o in stretches)
        off_ms = off_after_ms(stretches, t_ns)
        told_ns = t_ns + (int(deadline_s * NS_PER_S) if deadline_s >= STRIDE_S else 0)
        if resumed_after(stretches, told_ns):
            faults.append("current again without arming")
        misnamed = reason_faults(named, scenario) if scenario.effect is Effect.LATCHED else []
        machine_only = misnamed and not faults and off_ms <= deadline_s * 1e3
        if machine_only and bench.was_away(named, t_ns - BEFORE_NS, t_ns + int(deadline_s * NS_PER_S)):
            return Attempt(off_ms, last_ms, named, away=True)
        faults += misnamed
        if scenario.restart:
            faults += _left_behind(bench, scenario, t_ns)
        elif bench.session().alive:
            faults += bench.go_on()
        wrong_ms = bench.wrong_phase_ms(stretches, t_ns)
        return Attempt(off_ms, last_ms, named, tuple(faults), wrong_ms=wrong_ms)
    raise CampaignBroken(f"no burst lasted until the fault was there, or no step came after it, {TRIES} times")


def _lies_before_a_burst(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """Brought about where no current flows: within a stride of walking none may, and it is latched and named."""
    inject, heal = INJECTIONS[scenario.injected]
    rests = scenario.moment is Moment.REST
    deadline_s = (scenario.deadline_ms or 0.0) * 1e-3
    for _ in range(TRIES):
        bench.prepare(scenario.variant, walks=not rests)
        if rests:
            bench.observe(RESTS_S)
            inject(bench, n)
            bench.observe(RESTS_S)
            t_ns = time.monotonic_ns()
            bench.stand(False)
        else:
            bench.in_burst(INTO_BURST_MS[0])
            bench.out_of_burst()
            bench.observe(1e-3 * INTO_STANCE_MS[n % len(INTO_STANCE_MS)])
            t_ns = inject(bench, n)
        bench.observe(max(0.0, t_ns * 1e-9 + deadline_s - time.monotonic()) + scenario.watch_s)
        named, latched = stated_reason(bench), is_latched(bench)
        told = latched or not bench.stood_since(t_ns)
        stretches = bench.outputs(t_ns - NS_PER_S)
        heal(bench)
        if told:  # else it was the walk's last stance: a foot that stays on the ground has nothing to lie about
            break
    faults = [] if latched else ["not latched"]
    if latched and reason_faults(named, scenario) and bench.was_away(named, t_ns - BEFORE_NS, time.monotonic_ns()):
        return Attempt(named=named, away=True)
    faults += reason_faults(named, scenario)
    wrong_ms = bench.wrong_phase_ms(stretches, t_ns)
    pulses_ms = [(output.last_pulse_ns - t_ns) / MS for output in stretches if output.last_pulse_ns > t_ns]
    if bench.session().alive:
        faults += bench.go_on()
    return Attempt(off_after_ms(stretches, t_ns), max(pulses_ms, default=-1.0), named, tuple(faults), wrong_ms=wrong_ms)


def _left_behind(bench: CampaignBench, scenario: Scenario, t_ns: int) -> list[str]:
    """The next session is started; meanwhile nothing of a killed one may go on."""
    orphans, bench.orphans = bench.orphans, []
    bench.start(scenario.variant)
    if not orphans:
        return []
    bench.observe(max(0.0, t_ns * 1e-9 + ORPHANS_S - time.monotonic()))
    left = [child for child in orphans if child.runs]
    for child in left:
        child.kill()
    return [f"{ORPHANS_S:g} s later still running: {', '.join(child.module for child in left)}"] if left else []


def _ended(bench: CampaignBench, t_ns: int) -> list[str]:
    """What is wrong with how the session ended."""
    session = bench.session()
    status = session.wait(END_S)
    if status is None:
        return ["the session goes on"]
    faults = [] if status == 3 else [f"exit code {status} instead of 3"]
    if "ALARM" not in session.printed():
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


def _no_effect(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """The walk goes on with the next burst."""
    inject, heal = INJECTIONS[scenario.injected]
    bench.prepare(scenario.variant)
    bench.in_burst(INTO_BURST_MS[n % len(INTO_BURST_MS)])
    t_ns = inject(bench, n)
    bench.observe(scenario.watch_s)
    bench.observe(AGAIN_S, lambda: resumed_after(bench.outputs(t_ns), t_ns) > 0 or is_latched(bench))
    latched, named, ended = is_latched(bench), stated_reason(bench), not bench.session().alive
    bursts = resumed_after(bench.outputs(t_ns), t_ns)
    heal(bench)
    if latched and scenario.effect is Effect.HARMLESS and not ended:
        bench.arm()
        return Attempt(named=named, notice="off, armed again by hand")
    if latched and bench.was_away(named, t_ns, time.monotonic_ns()):
        return Attempt(named=named, away=True)
    if ended:
        return Attempt(faults=("the session has ended",))
    faults = [f"went off: {named}"] if latched else [] if bursts else ["no burst after it"]
    return Attempt(faults=tuple(faults), notice=f"goes on: {bursts} bursts after it")


def _no_burst_begins(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """Brought about while the patient stands, armed: they walk, and nothing is stimulated; nor can it be armed."""
    inject, heal = INJECTIONS[scenario.injected]
    bench.prepare(scenario.variant, walks=False)
    t_ns = inject(bench, n)
    bench.stand(False)
    bench.observe(scenario.watch_s)
    named = stated_reason(bench)
    faults = ["a burst began"] if began_after(bench.outputs(t_ns), t_ns) else []
    if not faults and named and bench.was_away(named, t_ns, time.monotonic_ns()):
        heal(bench)
        return Attempt(named=named, away=True)
    bench.command("disarm")
    bench.stand(True)
    bench.observe(DISARM_S)

    def arms_or_says_why_not() -> bool:
        bench.keep_armed()
        status = bench.status()
        return status is not None and (status.state in ALLOWED or not reason_faults(status.message, scenario))

    bench.observe(ARM_TRIED_S, arms_or_says_why_not)
    status = bench.status()
    if status is None or status.state in ALLOWED:
        faults.append("can be armed though it is not mended")
    refusal = status.message if status is not None else ""
    faults += reason_faults(refusal, scenario)
    heal(bench)
    bench.arm()
    return Attempt(named=named or refusal, faults=tuple(faults), notice="no burst began, arming refused")


def _named_in_passing(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """The patient walks, and within some strides a notice says what is wrong; from then on no burst begins."""
    begin_ns = time.monotonic_ns()
    bench.prepare(scenario.variant)
    notice: list[str] = []

    def named() -> bool:
        status = bench.status()
        notice.extend(each for each in (status.notices if status else ()) if not reason_faults(each, scenario))
        return bool(notice)

    bench.observe(NAMED_S, named)
    t_ns = time.monotonic_ns()
    bench.observe(scenario.watch_s)
    faults = [] if notice else [f"not named within {NAMED_S:g} s"]
    faults += ["a burst began"] if began_after(bench.outputs(t_ns), t_ns) else []
    stated = stated_reason(bench)
    if stated and bench.was_away(stated, begin_ns, time.monotonic_ns()):
        return Attempt(named=stated, away=True)
    return Attempt(named=stated or notice[0] if notice else "", faults=tuple(faults), notice="named, no burst after it")


def _nothing_executed(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """What others send is refused by the stimulator, and it does nothing that the session did not ask for."""
    inject, heal = INJECTIONS[scenario.injected]
    for _ in range(TRIES):
        bench.prepare(scenario.variant)
        bench.in_burst(INTO_BURST_MS[n % len(INTO_BURST_MS)])
        bench.sent = 0
        bench.outputs()
        recorded: list[RecordEntry] = []
        bench.recorded = recorded
        t_ns = inject(bench, n)
        bench.observe(scenario.watch_s)
        bench.outputs()
        bench.recorded = None
        named = stated_reason(bench)
        heal(bench)
        if bench.sent:
            entries = [entry for entry in recorded if entry.t_ns >= t_ns]
            own = _opened_by_itself(bench) if any(entry.event == SESSION for entry in entries) else frozenset()
            return refusal_attempt(entries, bench.sent, named, random="random" in scenario.name, own_sessions=own)
    raise CampaignBroken(f"the controller sent no command in the burst, {TRIES} times")


def _opened_by_itself(bench: CampaignBench) -> frozenset[str]:
    """The sessions that the controller has opened again since its start, by its log, as the record names them.

    It does that when it hears no heartbeat for a while, or a false one that chance gave the right CRC.
    """
    log = bench.session().log()
    try:
        reopened = read_session(log).reopened if log is not None else []
    except SessionLogError:
        return frozenset()
    return frozenset(f"session {opened.session_id}" for opened in reopened)


def refusal_attempt(
    entries: list[RecordEntry], sent: int, named: str, *, random: bool, own_sessions: frozenset[str] = frozenset()
) -> Attempt:
    """What the stimulator's record since the injection says of ``sent`` foreign frames under its own identifiers.

    ``named``: the session's reason for being off, if it is. Of ``random`` frames a share passes the CRC by chance; more
    than that share must not. ``own_sessions``: that the controller itself has opened.
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
    return Attempt(named=named, faults=tuple(faults), notice=remark)


def _odd(entry: RecordEntry) -> bool:
    """Whether the stimulator did what the campaign's session never asks for."""
    right = entry.channel == CHANNEL and entry.pulse_width_us == PULSE_WIDTH_US and entry.frequency_hz == FREQUENCY_HZ
    right = right and entry.current_ma <= CURRENT_MA * INTENSITY + 1e-6
    return entry.event == SESSION or (entry.event in ("on", "level") and not right)


def _burst_without_end(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """A stance that does not end: the burst must, a quarter and some 100 ms after the length of those in walking."""
    bench.prepare(scenario.variant)
    bench.observe(USUAL_S)
    begin_ns = time.monotonic_ns()
    bench.observe(STUCK_S)
    named, now_ns = stated_reason(bench), time.monotonic_ns()
    stretches = [each for each in bench.outputs(begin_ns) if each.on_ns > begin_ns]
    if is_latched(bench) and bench.was_away(named, begin_ns, now_ns):
        return Attempt(named=named, away=True)
    lengths_ms = [length_ms(with_late_pulses(stretches, each), now_ns) for each in stretches]
    if is_latched(bench) or not lengths_ms:
        return Attempt(named=named, faults=(f"off: {named}" if named else "no burst",))
    usual_ms, longest_ms = float(np.median(lengths_ms)), max(lengths_ms)
    if longest_ms < 1.1 * usual_ms:
        raise CampaignBroken(f"no stance lasted longer than usual for {STUCK_S:g} s")
    late = longest_ms > 1.25 * usual_ms + STUCK_LATE_MS
    faults = [f"{longest_ms:.0f} ms where {usual_ms:.0f} ms are usual"] if late else []
    return Attempt(longest_ms, named=named, faults=tuple(faults), notice=f"usual are {usual_ms:.0f} ms")


def _charge_without_end(bench: CampaignBench, scenario: Scenario, n: int) -> Attempt:
    """Step after step: the charge of a minute must end it, and not a moment later."""
    begin_ns = time.monotonic_ns()
    bench.prepare(scenario.variant)
    for _ in range(DOSE_TRIES):
        bench.until(lambda status: status.state in LATCHED, None, DOSE_WAIT_S, "the charge is not capped")
        named, now_ns = stated_reason(bench), time.monotonic_ns()
        if not reason_faults(named, scenario) or not bench.was_away(named, now_ns - NS_PER_S, now_ns):
            break
        bench.away.append(named)  # not what is asked here; its charge still counts
        bench.arm()
    bench.observe(scenario.watch_s)
    charge_uc = sum(output.charge_uc for output in bench.outputs(begin_ns) if output.on_ns >= begin_ns)
    faults = reason_faults(named, scenario)
    if not 0.0 < charge_uc <= 1e3 * DOSE_MC + DOSE_ROUNDING_UC:
        faults.append(f"{charge_uc:.0f} µC delivered, limit {1e3 * DOSE_MC:.0f} µC")
    return Attempt(named=named, faults=tuple(faults), notice=f"{charge_uc:.0f} µC of {1e3 * DOSE_MC:.0f} µC allowed")


_JUDGES: Final[dict[Effect, Callable[[CampaignBench, Scenario, int], Attempt]]] = {
    Effect.LATCHED: _goes_off,
    Effect.ENDED: _goes_off,
    Effect.NONE: _no_effect,
    Effect.HARMLESS: _no_effect,
    Effect.SILENT: _no_burst_begins,
    Effect.UNSEEN: _named_in_passing,
    Effect.NOT_EXECUTED: _nothing_executed,
    Effect.BOUNDED: _burst_without_end,
    Effect.DOSED: _charge_without_end,
}


NOT_BASELINE: Final = ("cpu_hogs", "controller_starved")  # these take the processor away on purpose
BROKEN_IN_A_ROW: Final = 3
SPOILT_AT_MOST: Final = 4

Progress = Callable[[Scenario, int, Attempt | None], None]
"""Called before (None) and after every attempt."""


def simulated_campaign(
    transport: str,
    scenarios: Sequence[Scenario],
    repeat: int,
    folder: Path,
    progress: Progress,
    channel: str,
    closed_loop: bool,
    played: PlayedRecording | None = None,
    sensors: ImuKind = "xbus",
) -> Campaign:
    """Run these scenarios on simulated devices, each ``repeat`` times; whatever ends it, nothing is left running.

    The folder, for records and logs, must exist. ``channel``: the interface for ``socketcan``. ``closed_loop``: with a
    virtual patient, who feels what is delivered, in the place of a recorded walk. ``played``: a recording, and its
    calibrations, in the place of the simulated patient's walk. ``sensors``: which kind is simulated.

    Raises:
        Unavailable: the transport is not to be had on this machine.
        RecordingError, CalibrationError: the recording cannot be used.
        CampaignBroken: three attempts in a row could not even be made.
    """
    with ExitStack() as stack:
        devices = start_devices(
            transport, folder, stack, channel, closed_loop=closed_loop, played=played, sensors=sensors
        )
        bench = CampaignBench(devices, devices.capabilities | machine_capabilities(), stack)
        if sensors in WIRELESS:
            scenarios = list(map(by_radio, scenarios))
        about = [played[0].name] if played else []
        about += [sensors] if sensors != "xbus" else []  # which is the usual
        name = f"{transport} ({', '.join(about)})" if about else transport
        return run_campaign(bench, name, scenarios, repeat, progress)


def hardware_campaign(
    path: Path,
    calibration: Path,
    scenarios: Sequence[Scenario],
    repeat: int,
    folder: Path,
    progress: Progress,
    *,
    walking: bool = False,
) -> Campaign:
    """Run these scenarios, which must be :func:`~fes.hil.devices.on_hardware`, on the devices of a session file.

    ``walking``: somebody walks with the sensors and stands by turns; else they rest, and bursts are triggered by hand.

    Raises:
        ConfigError: the settings cannot be used, or do not allow to tell a burst's end.
        BusError: the bus cannot be opened.
        CampaignBroken: three attempts in a row could not even be made.
    """
    session = hardware_session(path)
    capabilities = machine_capabilities() | {Needs.SENSOR, Needs.REALS, Needs.UNSOUND}
    if session.by_radio:
        scenarios = list(map(by_radio, scenarios))
    with ExitStack() as stack:
        witness = None
        if session.stimulator.device == "can":
            witness = BusWitness(stack.enter_context(Rogue(session.bus)))
            witness.start(stack)
            capabilities |= {Needs.HEARD}
        imu = RealSensor(pulses=None if witness else session.stimulator.device in PULSE_BY_PULSE)
        stack.callback(imu.close)
        hardware = Hardware(folder, path, calibration, session.stimulation.intensity, imu, witness)
        bench = CampaignBench(
            hardware, capabilities | ({Needs.MOVES} if walking else set()), stack, by_hand=not walking
        )
        return run_campaign(bench, f"hardware ({path.name})", scenarios, repeat, progress)


def run_campaign(
    bench: CampaignBench, name: str, scenarios: Sequence[Scenario], repeat: int, progress: Progress
) -> Campaign:
    """The rows, one after the other. CampaignBroken: three attempts in a row could not even be made."""
    started, begin_s = datetime.now(UTC).isoformat(timespec="seconds"), time.monotonic()
    with ExitStack() as stack:
        stack.callback(bench.end_session)
        baseline = Baseline()
        stack.callback(baseline.end)
        bench.gaps = baseline.gaps
        rows: list[Row] = []
        broken = 0
        for scenario in scenarios:
            row = Row(scenario)
            rows.append(row)
            if lacking := sorted(scenario.needs - bench.capabilities):
                row.skipped = f"needs {', '.join(lacking)}"
                continue
            if scenario.name in NOT_BASELINE:
                baseline.leave_out(True)
            for n in range(scenario.attempts(repeat)):
                progress(scenario, n, None)
                try:
                    for _ in range(SPOILT_AT_MOST):  # made again while the machine itself spoils it
                        if not (found := make_attempt(bench, scenario, n)).away:
                            break
                        row.away.append(found.named)
                    broken = 0
                except (CampaignBroken, StimulatorLost, ImuLost, ProcessLookupError) as error:
                    broken += 1
                    found = Attempt(faults=(str(error),))
                    bench.end_session()
                    if broken >= BROKEN_IN_A_ROW:
                        raise CampaignBroken(f"{scenario.name}: {error}") from error
                row.attempts.append(found)
                progress(scenario, n, found)
            if scenario.name in NOT_BASELINE:
                baseline.leave_out(False)
        bench.end_session()
        lateness = baseline.end()
    seconds = time.monotonic() - begin_s
    return Campaign(name, tuple(rows), lateness, started, seconds, repeat, tuple(bench.unasked), tuple(bench.away))


def machine_capabilities() -> frozenset[Needs]:
    """What this machine lets the campaign do."""
    found = {Needs.PROC} if Path("/proc/self/task").is_dir() else set()
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) > 1 and _grants_fifo():
        found.add(Needs.FIFO)
    return frozenset(found)


def _grants_fifo() -> bool:
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
