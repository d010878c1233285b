"""Controller and simulated serial stimulators in processes of their own, over pseudo-terminals and TCP.

The judge is the stimulator's end of the line: its record of every pulse, by the machine's one monotonic clock. Times
that depend on this machine's scheduler have wide margins; exact ones are proven on an injected clock in
``test_sciencemode_ports``.
"""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import pytest
from replays import SETTINGS

from drivers.imu.port import ImuLost
from drivers.simulated.spawn import (
    DeviceHandle,
    DeviceKind,
    NodeFailed,
    ProcessHandle,
    free_bus,
    spawn_device,
    spawn_imu,
    spawn_link,
    spawn_node,
    why_silent,
)
from drivers.stimulator.bus import LOOPBACK
from drivers.stimulator.open import Port, open_stimulator
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus, Channel, ConfigError, Session, StimulatorDevice, load_session
from fes.hil.closed_loop.bench import spawn_patient
from fes.hil.closed_loop.patient_process import Life
from fes.signals import StimAlive, StimCommand, StimStatus
from fes.simulation.forward import settings_for

MS = 1_000_000
PERIOD_NS = 20 * MS
MARGIN_NS = 150 * MS  # this machine's scheduler, not the device
Device = Literal["p24_low_level", "p24_mid_level", "rehastim2"]
DEVICES: tuple[Device, ...] = ("p24_low_level", "p24_mid_level", "rehastim2")
KIND: dict[Device, DeviceKind] = {
    "p24_low_level": "sciencemode4",
    "p24_mid_level": "sciencemode4",
    "rehastim2": "sciencemode2",
}
OFF_WITHIN_NS = {"p24_low_level": 0, "p24_mid_level": 2000 * MS, "rehastim2": 30 * MS}

# A controller that stimulates channel 0 at 50 commands a second until it is killed.
CONTROLLER = """
import sys, time
from drivers.stimulator.open import open_stimulator
from fes.config import Session, StimulatorDevice
from fes.signals import StimCommand, StimStatus

session = Session.model_validate_json(sys.argv[1], strict=False)
port = open_stimulator(session.stimulator, session, 1)
port.open(time.monotonic_ns(), timeout_s=15.0)
good, due_s = 0, time.monotonic()
while True:
    port.send(StimCommand(time.monotonic_ns(), 0, True, 20.0 + good % 2, 300.0, 40.0, 60))
    due_s += 0.02
    time.sleep(max(0.0, due_s - time.monotonic()))
    before = good
    good += sum(isinstance(event, StimStatus) and not event.fault for event in port.poll(time.monotonic_ns()))
    if before < 10 <= good:
        print("stimulating", flush=True)
"""


def session_for(device: Device, port: str) -> Session:
    options: dict[str, str | int | float | bool] = {"accept_watchdog_s": 2.0} if device == "p24_mid_level" else {}
    loaded = load_session(SETTINGS)
    channels = tuple(channel.model_copy(update={"never_with": ()}) for channel in loaded.channels[:1])
    assert [channel.number for channel in channels] == [0]
    stimulator = StimulatorDevice(device=device, port=port, options=options)
    return loaded.model_copy(update={"stimulator": stimulator, "channels": channels})


class Host:
    """The controller's side in this process, paced by the wall clock (:meth:`drive`) or answers (:meth:`deliver`)."""

    def __init__(self, device: Device, port: str) -> None:
        session = session_for(device, port)
        self.port: Port = open_stimulator(session.stimulator, session, 1)
        self._t_ns = self.written_ns = time.monotonic_ns()
        self.port.open(self._t_ns, timeout_s=15.0)
        self.statuses: list[StimStatus] = []
        self.alive: list[StimAlive] = []
        self.sent = 0

    def drive(self, for_s: float, until: Callable[[], bool] = lambda: False) -> None:
        end_s = time.monotonic() + for_s
        while time.monotonic() < end_s and not until():
            self._send(time.monotonic_ns(), on=True)
            time.sleep(0.02)
            self.poll(time.monotonic_ns())

    def deliver(self, commands: int, on: bool = True) -> None:
        """So many commands, 20 ms apart by a clock that stands still while an answer is waited for.

        So no answer is late, and none is withheld, because the machine was busy: any fault is one.
        """
        for _ in range(commands):
            self._send(self._t_ns, on)
            self.written_ns = time.monotonic_ns()
            self._t_ns += PERIOD_NS
            self.poll(self._t_ns)
            while self.port.outstanding:
                assert time.monotonic_ns() - self.written_ns < 10_000 * MS, "never answered"
                time.sleep(0.001)
                self.poll(self._t_ns)
            time.sleep(PERIOD_NS * 1e-9)  # now: after a late answer the next pulse would still have to queue

    def _send(self, t_ns: int, on: bool) -> None:
        levels = (20.0 + self.sent % 2, 300.0, 40.0) if on else (0.0, 0.0, 0.0)
        self.port.send(StimCommand(t_ns, 0, on, *levels, 60))
        self.sent += 1

    def poll(self, t_ns: int) -> None:
        for event in self.port.poll(t_ns):
            if isinstance(event, StimStatus):
                self.statuses.append(event)
            else:
                self.alive.append(event)

    @property
    def faults(self) -> list[str]:
        return [event.fault for event in [*self.statuses, *self.alive] if event.fault]

    def has_fault(self, words: str) -> Callable[[], bool]:
        return lambda: any(words in fault for fault in self.faults)


def wait_for(what: Callable[[], object], timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < end_s, "it did not come"
        time.sleep(0.01)


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> Device:
    named: Device = request.param
    return named


@pytest.fixture
def stimulator(device: Device, tmp_path: Path) -> Iterator[DeviceHandle]:
    with spawn_device(KIND[device], record=tmp_path / "device.jsonl") as handle:
        yield handle


@pytest.fixture
def host(device: Device, stimulator: DeviceHandle) -> Iterator[Host]:
    made = Host(device, stimulator.port)
    yield made
    made.port.close()


def test_what_is_commanded_is_delivered_and_off_is_off(host: Host, stimulator: DeviceHandle) -> None:
    host.deliver(50)
    host.deliver(1, on=False)
    off_ns = host.written_ns
    host.deliver(14, on=False)
    assert host.faults == []
    pulses = stimulator.entries("pulse")
    assert {pulse.current_ma for pulse in pulses} == {20.0, 21.0}
    assert all(pulse.detail == "" for pulse in pulses)
    assert pulses[-1].t_ns < off_ns + MARGIN_NS
    assert len(pulses) >= 30
    if host.port.one_pulse_per_command:
        assert len(pulses) <= 40 * 50 * 0.02 + 1  # by the commands' clock
        assert sum(status.pulses for status in host.statuses) == len(pulses)
    else:
        assert len(pulses) <= 40 * 1e-9 * (pulses[-1].t_ns - pulses[0].t_ns) + 1.5  # by its own


@pytest.mark.requirement("SR-12")
def test_killed_controller(device: Device, stimulator: DeviceHandle) -> None:
    """kill -9 in mid-burst: no pulse later than the device's own rule allows."""
    settings = session_for(device, stimulator.port).model_dump_json()
    process = subprocess.Popen([sys.executable, "-c", CONTROLLER, settings], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        ready, _, _ = select.select([process.stdout], [], [], 40.0)
        assert ready
        assert process.stdout.readline() == "stimulating\n"
        os.kill(process.pid, signal.SIGKILL)
        process.wait(10)
        blow_ns = time.monotonic_ns()
    finally:
        process.kill()
        process.communicate(timeout=10)
    if device == "p24_mid_level":
        wait_for(lambda: stimulator.entries("watchdog"))
    time.sleep(0.5 if device == "p24_mid_level" else 1.5)
    pulses = stimulator.entries("pulse")
    assert len(pulses) >= 5
    after_ns = pulses[-1].t_ns - blow_ns
    print(f"{device}: last pulse {after_ns / MS:.1f} ms after the controller was dead")
    assert after_ns <= OFF_WITHIN_NS[device] + MARGIN_NS
    if device == "p24_mid_level":
        assert after_ns > 1000 * MS  # the tail that the session had to accept
    # and the next controller finds a device that it can use
    again = Host(device, stimulator.port)
    again.deliver(15)
    assert again.faults == []
    assert len(stimulator.entries("pulse")) > len(pulses)
    again.port.close()


@pytest.mark.parametrize("device", ["p24_low_level", "rehastim2"], indirect=True)
def test_a_controller_that_hangs(host: Host, stimulator: DeviceHandle, device: Device) -> None:
    host.drive(0.5)
    hung_ns = time.monotonic_ns()
    time.sleep(1.5)  # no command: no pulse, no keep-alive
    assert stimulator.entries("pulse")[-1].t_ns <= hung_ns + OFF_WITHIN_NS[device] + MARGIN_NS
    if device == "rehastim2":
        wait_for(lambda: stimulator.entries("watchdog"))
        (ended,) = stimulator.entries("watchdog")
        assert ended.t_ns >= hung_ns + 700 * MS  # 1.2 s after the last packet
        told = host.has_fault("watchdog ended our session")
        wait_for(lambda: host.poll(time.monotonic_ns()) or told())
        with pytest.raises(StimulatorLost, match="opened again"):
            host.poll(time.monotonic_ns())


def test_a_device_that_restarts(host: Host, stimulator: DeviceHandle) -> None:
    host.drive(0.3)
    told_ns = stimulator.inject("reboot")
    with pytest.raises(StimulatorLost, match=r"restarted.*must be opened again"):
        host.drive(5.0)
    assert host.has_fault("restarted")()
    assert len({alive.boot_id for alive in host.alive}) > 1 or host.alive[-1].boot_id > 1
    assert stimulator.entries("pulse")[-1].t_ns <= told_ns


def test_a_cable_pulled(host: Host, stimulator: DeviceHandle, device: Device) -> None:
    host.drive(0.3)
    told_ns = stimulator.inject("unplug")
    with pytest.raises(StimulatorLost, match="Check cable"):
        host.drive(5.0)
    time.sleep(0.3)
    if device != "p24_mid_level":
        assert stimulator.entries("pulse")[-1].t_ns <= told_ns + OFF_WITHIN_NS[device] + MARGIN_NS


def test_an_open_lead(host: Host, stimulator: DeviceHandle) -> None:
    host.drive(0.2)
    stimulator.inject("electrode", 0)
    host.drive(5.0, until=host.has_fault("electrode"))
    assert host.has_fault("electrode")()


@pytest.mark.parametrize(
    ("fault", "value", "words"),
    [
        ("garble", 1, "no answer"),
        ("drop", 1, "no answer"),
        ("delay", 0.3, "no answer"),
        ("mute", 1, "no answer"),
    ],
)
def test_answers_that_do_not_come_as_they_should(
    host: Host, stimulator: DeviceHandle, fault: str, value: float, words: str
) -> None:
    host.drive(0.2)
    stimulator.inject(fault, value)
    host.drive(5.0, until=host.has_fault(words))
    assert host.has_fault(words)()


@pytest.mark.parametrize("device", ["rehastim2"], indirect=True)
def test_the_emergency_switch(host: Host, stimulator: DeviceHandle) -> None:
    host.drive(0.3)
    told_ns = stimulator.inject("emergency")
    host.drive(5.0, until=host.has_fault("emergency"))
    assert host.has_fault("emergency")()
    host.drive(0.2)
    assert stimulator.entries("pulse")[-1].t_ns <= told_ns + 5 * MS


@pytest.mark.parametrize("device", ["p24_low_level", "rehastim2"], indirect=True)
def test_over_tcp(device: Device, tmp_path: Path) -> None:
    with spawn_device(KIND[device], record=tmp_path / "device.jsonl", line="tcp") as stimulator:
        host = Host(device, stimulator.port)
        host.deliver(20)
        assert host.faults == []
        assert len(stimulator.entries("pulse")) >= 10
        host.port.close()
        again = Host(device, stimulator.port)
        again.deliver(10)
        assert again.faults == []
        again.port.close()


def test_a_fault_that_nobody_knows_is_refused() -> None:
    with spawn_device("sciencemode4") as stimulator:
        with pytest.raises(NodeFailed, match="is not known"):
            stimulator.inject("smoke")
        assert stimulator.inject("slow", 0.0) > 0
        assert stimulator.stop() == 0
    with pytest.raises(NodeFailed, match="NAME=NUMBER"):
        spawn_device("sciencemode4", faults="electrode")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (StimulatorDevice(device="p24_mid_level", port="/dev/none"), "accept_watchdog_s = 2"),
        (StimulatorDevice(device="p24_mid_level", port="x", options={"accept_watchdog_s": "yes"}), "number of seconds"),
        (StimulatorDevice(device="p24_mid_level", port="x", options={"accept_watchdog_s": True}), "number of seconds"),
        (StimulatorDevice(device="p24_low_level", port="x", options={"modell": "p24"}), "it has baudrate, model"),
        (StimulatorDevice(device="p24_low_level", port="x", options={"model": "p25"}), "one of: p24, rehamove3"),
        (StimulatorDevice(device="p24_low_level", port="x", options={"baudrate": True}), "whole number"),
        (StimulatorDevice(device="rehastim2", port="x", options={"baudrate": 9600}), "it has none"),
        (StimulatorDevice(device="can", options={"x": 1}), "it has none"),
        (StimulatorDevice(device="canopen", options={"node_id": 1}), "missing"),
    ],
)
def test_settings_that_cannot_be_served(settings: StimulatorDevice, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        open_stimulator(settings, session_for("p24_low_level", "x"), 1)


def changed(**values: object) -> Session:
    session = session_for("p24_low_level", "x")
    channel: Channel = session.channels[0].model_copy(update=values)
    return session.model_copy(update={"channels": (channel,)})


def test_sessions_that_cannot_be_served() -> None:
    low = StimulatorDevice(device="p24_low_level", port="x")
    with pytest.raises(ConfigError, match="one pulse for each, and command_rate_hz = 50"):
        open_stimulator(low, changed(frequency_hz=60.0), 1)
    small = low.model_copy(update={"options": {"model": "rehamove3"}})
    with pytest.raises(ConfigError, match="a rehamove3 has 0 to 3"):
        open_stimulator(small, changed(number=4), 1)
    empty = changed().model_copy(update={"channels": ()})
    with pytest.raises(ConfigError, match="there are none"):
        open_stimulator(StimulatorDevice(device="rehastim2", port="x"), empty, 1)
    with pytest.raises(StimulatorLost, match="cannot be opened"):
        open_stimulator(low, changed(), 1)


# --- Every kind of simulated device in its process: what it is told, what it answers ---


NO_BUS = why_silent(free_bus(LOOPBACK))
needs_bus = pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")

START: dict[str, Callable[[Path], ProcessHandle]] = {
    "node": lambda folder: spawn_node(bus=free_bus(LOOPBACK), record=folder / "record.jsonl"),
    "serial": lambda folder: spawn_device("sciencemode4", record=folder / "record.jsonl"),
    "sensor": lambda folder: spawn_imu("xbus"),
    "line": lambda folder: spawn_link(free_bus(LOOPBACK), front=free_bus(LOOPBACK)),
    "patient": lambda folder: spawn_patient(folder / "pulses", WALKER, Life()),
}
WALKER = settings_for("moderate", seed=3, sensors=("right_foot",), rate_hz=100.0)
A_FAULT = {"node": "mute", "serial": "mute", "sensor": "mute", "line": "cut", "patient": "mute"}
kinds = pytest.mark.parametrize("kind", [pytest.param("node", marks=needs_bus), "serial", "sensor", "line", "patient"])


@kinds
def test_all_of_them_start_take_faults_and_end_alike(tmp_path: Path, kind: str) -> None:
    with START[kind](tmp_path) as handle:
        first_ns, second_ns = handle.inject(A_FAULT[kind]), handle.inject(A_FAULT[kind], 0.0)
        assert 0 < first_ns < second_ns
        with pytest.raises((NodeFailed, ImuLost), match=r"refused: .*smoke.* is not known"):
            handle.inject("smoke")
        with pytest.raises((NodeFailed, ImuLost), match="refused"):
            handle.request({"no": "fault"})
        assert handle.inject(A_FAULT[kind], 0.0) > second_ns  # and it goes on
        assert handle.stop() == 0
        assert handle.stop() == 0
        with pytest.raises((NodeFailed, ImuLost), match="has been stopped"):
            handle.inject("mute")
    assert [entry.event for entry in handle.entries("boot")] == (["boot"] if handle.record else [])


def test_one_that_was_killed_is_gone_and_its_status_is_told(tmp_path: Path) -> None:
    with START["serial"](tmp_path) as handle:
        handle.process.kill()
        with pytest.raises(NodeFailed, match="is gone; it said: nothing; it ended with status -9"):
            handle.inject("mute")


def test_what_a_patient_says_unasked_is_no_answer_and_none_of_it_is_lost(tmp_path: Path) -> None:
    with spawn_patient(tmp_path / "pulses", WALKER, Life()) as patient:
        strides, end_s = patient.new_strides(), time.monotonic() + 30.0
        while len(strides) < 2 and time.monotonic() < end_s:
            assert patient.punctuality()["pulses"] == 0  # an answer, whatever came before it
            strides += patient.new_strides()
        assert [stride.foot for stride in strides[:2]] == [WALKER.affected_foot] * 2
        intervals = patient.punctuality()["intervals"]
        assert patient.summary == {}
        assert patient.stop() == 0
        assert patient.summary["intervals"] >= intervals


@contextmanager
def taken_port() -> Iterator[Bus]:
    """A bus whose UDP port is another program's, which does not share it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        yield Bus(interface=LOOPBACK, options={"port": other.getsockname()[1]})


def test_a_port_that_is_taken_is_named() -> None:
    with taken_port() as bus:
        port = bus.options["port"]
        with pytest.raises(NodeFailed, match=rf"stimulator did not start \(.*--port {port}.*\); it said: .*in use"):
            spawn_node(bus=bus)


def test_a_recording_that_cannot_be_played_is_named(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_bytes(b"\x00\xff" * 99)
    with pytest.raises(ImuLost, match=r"sensor did not start \(.*\); it said: imu_process: .*walk.csv: is binary"):
        spawn_imu("xbus", recording=path)


def test_a_record_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(NodeFailed, match=r"it said: sciencemode2: .*No such file.*nowhere"):
        spawn_device("sciencemode2", record=tmp_path / "nowhere" / "record.jsonl")


def test_one_that_is_not_ready_in_time_is_ended_and_that_is_said(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "record.jsonl")  # it waits until somebody reads its record
    with pytest.raises(NodeFailed, match=r"it said: nothing within 0.2 s"):
        spawn_device("sciencemode4", record=tmp_path / "record.jsonl", timeout_s=0.2)
