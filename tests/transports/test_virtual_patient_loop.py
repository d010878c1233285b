"""A virtual patient between processes: `fes run` on real lines, pulses back to the patient, and the same as in one.

What "the same" means between a run in real time and one on injected time, over 42 s that begin with stumbles, is what
the loop itself makes of the pulses' timing (benchmarks/loop_pulses.py --runs 100): bursts up to 12 ms later, two of
three with a pulse more or less, move phases by up to two samples, the toe by 4.2 mm, and the last current by 2 mA (of
29.5) at most, by more than 1 mA in one run of sixteen. Pulses that jitter by 3 ms move the toe by up to 3.5 mm and
the current by 0.5 mA. A sample and a step more are allowed here:

- every phase change, by the patient's clock, within three sampling intervals (30 ms) and a millisecond or so that the
  line and the machine take to deliver a sample;
- every burst begins within one command period and one sampling interval (30 ms) of the other's;
- the same strides, but for one judged otherwise (dragged or stumbled), toe clearance within 6 mm;
- the last tuning change within 2.5 mA.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
import tomllib
from contextlib import ExitStack
from pathlib import Path

import pytest

from drivers.imu.port import ImuLost
from drivers.stimulator.open import Port, open_stimulator
from drivers.virtual.can_node_spawn import free_bus, why_silent
from drivers.virtual.node_record import read_record
from fes.calibrations import load
from fes.cli.demo_loop import CURRENT_MA, patient
from fes.config import load_session, validate_session
from fes.hil.baseline import Baseline
from fes.hil.campaign import run_campaign
from fes.hil.course import course
from fes.hil.devices import start_devices
from fes.hil.one_process import run_in_one_process
from fes.hil.patient_bench import PatientBench, start_patient_bench
from fes.hil.patient_session import calibration_of, session_text
from fes.hil.patient_spawn import spawn_patient
from fes.hil.processes import Ran, SwitchedOff, run_between_processes
from fes.hil.rig import LOST_TIME, Rig
from fes.hil.scenarios import SCENARIOS
from fes.journal import SessionRecord, read_session
from fes.patient.virtual import VirtualStride
from fes.signals import NS_PER_S, StimCommand

MS = 1_000_000
SECONDS = 42.0
CHANGE = re.compile(r"current ([\d.]+) → ([\d.]+) mA")


def in_one_process(folder: Path) -> tuple[SessionRecord, list[VirtualStride]]:
    settings = patient()
    text = session_text(settings, current_ma=CURRENT_MA)
    session = validate_session(tomllib.loads(text), folder / "session.toml", text)
    log = folder / "one.feslog"
    lived = run_in_one_process(settings, session, calibration_of(settings).calibrations, course(SECONDS), log, "")
    return read_session(log), [stride for stride in lived.strides if stride.foot == settings.affected_foot]


def between_processes(folder: Path, stimulator: str) -> tuple[SessionRecord, Ran, int]:
    """The log, the run, and when the patient's time began. Skips where the computer took the processor away."""
    with ExitStack() as stack:
        bench = start_patient_bench(patient(), folder, stack, stimulator=stimulator, current_ma=CURRENT_MA, held=True)
        idle = Baseline()
        stack.callback(idle.end)
        try:
            ran = run_between_processes(bench, course(SECONDS))
        except SwitchedOff as off:
            if any(word in off.reason for word in LOST_TIME) and idle.gaps(bench.patient.start_ns):
                pytest.skip(f"this computer was away, an idle loop beside it as well: {off.reason}")
            raise
        return read_session(ran.log), ran, bench.patient.start_ns


def bursts_ms(record: SessionRecord, start_ns: int) -> list[float]:
    """When each burst of channel 0 began, by the patient's clock."""
    begins, on = [], False
    for command in record.commands:
        if command.on and not on:
            begins.append((command.t_ns - start_ns) / MS)
        on = command.on
    return begins


def phases_ms(record: SessionRecord, start_ns: int) -> dict[tuple[str, str], list[float]]:
    found: dict[tuple[str, str], list[float]] = {}
    for change in record.phases:
        found.setdefault((change.foot, change.transition.name), []).append((change.t_ns - start_ns) / MS)
    return found


def changes_ma(record: SessionRecord) -> list[tuple[float, float]]:
    found = [CHANGE.search(note.text) for note in record.notes if note.source == "tuning"]
    return [(float(one[1]), float(one[2])) for one in found if one]


@pytest.mark.slow
@pytest.mark.parametrize("stimulator", ["can", "p24_low_level"])
def test_between_processes_as_in_one(tmp_path: Path, stimulator: str) -> None:
    log, ran, start_ns = between_processes(tmp_path, stimulator)
    fast, strides = in_one_process(tmp_path)
    assert ran.punctuality["pulses_late"] == 0
    # the patient's strides
    pairs = list(zip(ran.strides, strides, strict=False))
    assert len(pairs) >= 20
    assert abs(len(ran.strides) - len(strides)) <= 1  # the last may be complete in one only
    judged = sum((one.dragged, one.stumbled) != (other.dragged, other.stumbled) for one, other in pairs)
    apart_mm = max(abs(one.toe_clearance_m - other.toe_clearance_m) * 1e3 for one, other in pairs)
    # the controller's decisions
    live_ms, fast_ms = phases_ms(log, start_ns), phases_ms(fast, 0)
    assert live_ms.keys() == fast_ms.keys()
    phase_ms = 0.0
    for key, times in fast_ms.items():
        assert abs(len(times) - len(live_ms[key])) <= 1
        phase_ms = max(phase_ms, *(abs(a - b) for a, b in zip(times, live_ms[key], strict=False)))
    one_ms, other_ms = bursts_ms(log, start_ns), bursts_ms(fast, 0)
    assert min(len(one_ms), len(other_ms)) >= 18
    assert abs(len(one_ms) - len(other_ms)) <= 1
    burst_ms = max(abs(a - b) for a, b in zip(one_ms, other_ms, strict=False))
    tuned, expected = changes_ma(log), changes_ma(fast)
    print(
        f"{stimulator}: {len(pairs)} strides, toe clearance within {apart_mm:.2f} mm, phases {phase_ms:.1f} ms, "
        f"{len(one_ms)} bursts {burst_ms:.1f} ms; tuning {tuned} and {expected}; patient {ran.punctuality}"
    )
    assert judged <= 1
    assert apart_mm <= 6.0
    assert phase_ms <= 31.5
    assert burst_ms <= 30.0
    assert min(len(tuned), len(expected)) >= 5
    assert abs(tuned[-1][1] - expected[-1][1]) <= 2.5


@pytest.mark.parametrize(("stimulator", "fault"), [("can", "weak"), ("p24_low_level", "electrode")])
def test_the_patient_feels_what_is_delivered_and_nothing_else(tmp_path: Path, stimulator: str, fault: str) -> None:
    """Commanded by hand, then with a stimulator that delivers half of it, or nothing, whatever it is told."""
    with ExitStack() as stack:
        bench = start_patient_bench(patient(), tmp_path, stack, stimulator=stimulator, waits=True)
        session = load_session(bench.session)
        port = open_stimulator(session.stimulator, session, 77)
        stack.callback(port.close)
        port.open(time.monotonic_ns())
        assert bench.patient.punctuality()["pulses"] == 0
        whole = felt_of(bench, port)
        assert whole["pulses"] >= 10
        assert whole["charge_uc"] == pytest.approx(6.0 * whole["pulses"])  # 20 mA for 300 µs
        bench.stimulator.tell(fault, session.channels[0].number)
        less = felt_of(bench, port)
        if fault == "weak":
            assert less["charge_uc"] == pytest.approx(3.0 * less["pulses"])
            assert less["pulses"] >= 10
        else:
            assert less["pulses"] == 0
        port.send(StimCommand(time.monotonic_ns(), 0, False, 0.0, 0.0, 0.0, 60))
        assert bench.stimulator.stop() == 0
        assert bench.patient.stop() == 0


def felt_of(bench: PatientBench, port: Port) -> dict[str, float]:
    """What reached the patient of half a second of commands and the silence after it."""
    before = bench.patient.punctuality()
    end_ns = time.monotonic_ns() + NS_PER_S // 2
    while (now_ns := time.monotonic_ns()) < end_ns:
        port.send(StimCommand(now_ns, 0, True, 20.0, 300.0, 40.0, 60))
        port.poll(now_ns)
        time.sleep(0.005)
    port.send(StimCommand(time.monotonic_ns(), 0, False, 0.0, 0.0, 0.0, 60))
    time.sleep(0.2)
    port.poll(time.monotonic_ns())
    after = bench.patient.punctuality()
    return {key: after[key] - before[key] for key in ("pulses", "charge_uc")}


def test_a_patient_that_does_not_start_says_why(tmp_path: Path) -> None:
    with pytest.raises(ImuLost, match=r"did not start.*No such file"):
        spawn_patient(tmp_path / "no" / "folder", patient())


@pytest.mark.slow
def test_fes_simulate_live_tells_how_to_meet_it(tmp_path: Path) -> None:
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from fes.cli import main; main(prog_name='fes')",
            "simulate",
            "--live",
            "--severity",
            "severe",
            "--seconds",
            "5",
            "--out",
            str(tmp_path),
            "--stimulator",
            "p24_low_level",
        ],
        capture_output=True,
        text=True,
        timeout=120,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (session,) = tmp_path.glob("simulated-001/session.toml")
    assert f"fes run {session} --calibration {session.with_name('patient.calibration.json')}" in done.stdout
    assert "0 pulses" in done.stdout
    settings = load_session(session)
    assert len(settings.sensors) == 4
    calibrated = load(session.with_name("patient.calibration.json")).calibrations
    assert {str(channel.foot) for channel in settings.channels} <= calibrated.keys()


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["loopback", "serial"])
def test_a_campaign_on_a_patient_who_feels_the_stimulation(tmp_path: Path, transport: str) -> None:
    if transport == "loopback" and (why := why_silent(free_bus("loopback"))):
        pytest.skip(f"no loopback multicast on this machine: {why}")
    names = ("imu_unplugged", "controller_killed")
    with ExitStack() as stack:
        devices = start_devices(transport, tmp_path, stack, closed_loop=True)
        rig = Rig(devices, devices.can_do, stack)
        scenarios = [scenario for scenario in SCENARIOS if scenario.name in names]
        done = run_campaign(rig, transport, scenarios, 1, lambda scenario, n, found: None)
        assert devices.patient is not None
        felt = devices.patient.punctuality()
        assert devices.patient.process.poll() is None  # the same patient all along
    assert felt["pulses"] >= 4  # two bursts, each cut off after a tenth of a second
    if transport == "serial":  # where the stimulator's own record is of pulses
        record = read_record(tmp_path / "stimulator.jsonl")
        assert felt["pulses"] == sum(entry.event == "pulse" for entry in record)
    assert [row.scenario.name for row in done.rows] == list(names)
    for row in done.rows:
        (attempt,) = row.attempts
        print(transport, row.scenario.name, attempt, done.baseline)
        assert attempt.faults == ()
        assert attempt.off_ms is not None
        assert attempt.off_ms <= (row.scenario.deadline_ms or 0.0) + done.baseline.most_ms
