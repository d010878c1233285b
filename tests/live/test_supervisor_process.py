"""A controller that is not right, in a process of its own, and what a simulated stimulator records of it.

It asks the real supervisor, as `fes run` does, but has no gate of its own: a corrupted one.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from processes import gone_after_s
from replays import SETTINGS

from drivers.simulated.record import RecordEntry, read_record
from drivers.simulated.spawn import NodeHandle, spawn_node

MS = 1_000_000
LEASE_MS, MARGIN_MS = 60, 30
SWITCHED_OFF_MS = 45 + MARGIN_MS  # 40 ms of silence, noticed within 5; margin: this machine's
ON_MA = 10.0
pytestmark = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc on this machine")

CONTROLLER = """
import sys, time
from dataclasses import replace
from pathlib import Path
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus, load_session
from fes.live.processes import fixed_priority
from fes.live.supervision import SupervisorProcess
from fes.signals import ImuSample, OperatorAct, OperatorAction, StimCommand

settings, channel, port, stop_file, evil = sys.argv[1:]
bus = Bus(interface="udp_multicast", channel=channel, options={"port": int(port), "hop_limit": 0})
session = load_session(Path(settings)).model_copy(update={"bus": bus})
first = session.channels[0]
foot, MS = str(first.foot), 1_000_000
now = time.monotonic_ns
faults = []


def command(current_ma, on=True):
    width_us = min(first.pulse_width_us, 300.0)
    return StimCommand(now(), first.number, on, current_ma * on, width_us * on, 40.0 * on, 60)


with SupervisorProcess() as supervisor:
    line = supervisor.line_of(session, {}, {}, stop_file, StimulatorLost)
    line.on_fault = faults.append
    line.open(now())
    fixed_priority()
    begin_ns, n = now(), 0

    def tell(ms, samples=True):
        global n
        for _ in range(ms // 5):
            time.sleep(0.005)
            n += 1
            t, noise = now(), 1e-6 * (n % 997)
            if samples:
                line.observe(ImuSample(t, foot, t, (noise, 0.0, 9.8), (0.0, 0.0, noise + (n % 30 == 0))))
            line.poll(t)

    tell(600)
    line.observe(OperatorAct(now(), OperatorAction.ARM))
    line.send(command(0.0, on=False))
    tell(120)
    current_ma = 0.5
    for k in range(25):
        line.send(command(current_ma))
        current_ma = min(10.0, current_ma + 1.0)
        tell(20)
    print("ON", supervisor.process.pid, flush=True)
    if evil == "over":
        line.send(command(1000.0))
    elif evil == "garbage":
        line._link.send(bytes(range(200)))
    elif evil == "stale":
        for _ in range(3):
            line.send(command(10.0))
            tell(20, samples=False)
        line.send(command(10.0))
    elif evil == "late":
        line.send(replace(command(10.0), t_ns=now() - 50 * MS))
    print("EVIL", now(), flush=True)
    for k in range(10_000):
        try:
            line.send(command(10.0))
            tell(20)
        except StimulatorLost as error:
            print("LOST", error, flush=True)
            time.sleep(0.02)
        if faults:
            print("FAULT", faults[0], flush=True)
            faults.clear()
"""


@dataclass
class Corrupted:
    process: subprocess.Popen[str]
    supervisor: int
    node: NodeHandle

    def said(self, word: str) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(word):
                return line.removeprefix(word).strip()
        raise AssertionError(f"it ended without {word}")

    def entries(self) -> list[RecordEntry]:
        assert self.node.record is not None
        return [entry for entry in read_record(self.node.record) if entry.channel >= 0]

    def last_pulse_after_ms(self, blow_ns: int) -> float:
        """How long after the blow the last pulse left, once it is off."""
        end_s = time.monotonic() + 5.0
        while time.monotonic() < end_s:
            if (entries := self.entries())[-1].current_ma == 0.0:
                return (entries[-1].last_pulse_ns - blow_ns) / MS
            time.sleep(0.005)
        raise AssertionError("it is still on")


@contextmanager
def controller(folder: Path, evil: str) -> Iterator[Corrupted]:
    with spawn_node(record=folder / "node.jsonl") as node:
        bus = node.bus
        if bus.interface != "udp_multicast":
            pytest.skip("needs a multicast bus")
        arguments = SETTINGS, bus.channel, str(bus.options["port"]), folder / "stop", evil
        process = subprocess.Popen((sys.executable, "-c", CONTROLLER, *arguments), stdout=subprocess.PIPE, text=True)
        corrupted = Corrupted(process, 0, node)
        try:
            corrupted.supervisor = int(corrupted.said("ON"))
            yield corrupted
        finally:
            process.kill()
            process.wait(10)


@pytest.mark.requirement("SR-24")
@pytest.mark.parametrize(
    ("evil", "names"),
    [("over", "1000 mA"), ("garbage", "no record"), ("stale", "ms old"), ("late", "50 ms late")],
)
def test_what_a_corrupted_controller_asks_for_never_gets_through(tmp_path: Path, evil: str, names: str) -> None:
    with controller(tmp_path, evil) as corrupted:
        evil_ns = int(corrupted.said("EVIL"))
        assert names in corrupted.said("FAULT")
        time.sleep(1.0)  # in which it goes on asking
        entries = corrupted.entries()
        assert entries[-1].event == "off", "told to, not by its lease"
        assert corrupted.last_pulse_after_ms(evil_ns) <= LEASE_MS + MARGIN_MS
        assert not [entry for entry in entries if entry.t_ns > evil_ns + SWITCHED_OFF_MS * MS and entry.current_ma]
        assert max(entry.current_ma for entry in entries) == ON_MA


@pytest.mark.requirement("SR-24")
def test_a_stopped_controller_is_off_within_its_guard_and_stays_off_when_it_goes_on(tmp_path: Path) -> None:
    with controller(tmp_path, "none") as corrupted:
        corrupted.said("EVIL")
        time.sleep(0.1)
        corrupted.process.send_signal(signal.SIGSTOP)
        blow_ns = time.monotonic_ns()
        after_ms = corrupted.last_pulse_after_ms(blow_ns)
        ended = corrupted.entries()[-1]
        print(
            f"last pulse {after_ms:.1f} ms after it was stopped, {ended.event} after {(ended.t_ns - blow_ns) / MS:.1f}"
        )
        assert after_ms <= SWITCHED_OFF_MS
        time.sleep(0.3)
        corrupted.process.send_signal(signal.SIGCONT)
        goes_on_ns = time.monotonic_ns()
        assert "stalled" in corrupted.said("FAULT")
        time.sleep(0.5)
        assert not [entry for entry in corrupted.entries() if entry.t_ns > goes_on_ns and entry.current_ma]


@pytest.mark.requirement("SR-24")
def test_a_killed_controller_is_off_at_once_and_leaves_no_supervisor(tmp_path: Path) -> None:
    with controller(tmp_path, "none") as corrupted:
        corrupted.said("EVIL")
        time.sleep(0.1)
        corrupted.process.kill()
        blow_ns = time.monotonic_ns()
        after_ms = corrupted.last_pulse_after_ms(blow_ns)
        ended = corrupted.entries()[-1]
        print(f"last pulse {after_ms:.1f} ms after the kill, {ended.event} after {(ended.t_ns - blow_ns) / MS:.1f} ms")
        assert after_ms <= MARGIN_MS
        print(f"gone after {gone_after_s([corrupted.supervisor], blow_ns, 3.0):.2f} s")


@pytest.mark.requirement("SR-24")
def test_a_killed_supervisor_is_the_end_of_the_line_and_the_lease_ends_the_burst(tmp_path: Path) -> None:
    with controller(tmp_path, "none") as corrupted:
        corrupted.said("EVIL")
        time.sleep(0.1)
        os.kill(corrupted.supervisor, signal.SIGKILL)
        blow_ns = time.monotonic_ns()
        assert corrupted.last_pulse_after_ms(blow_ns) <= LEASE_MS + MARGIN_MS
        while "start a new session" not in (lost := corrupted.said("LOST")):
            assert "does not answer" in lost  # it is on its way out: its locked memory is freed first
