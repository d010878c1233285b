"""The ScienceMode ports against the simulated devices, on an injected clock."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from replays import SETTINGS

from drivers.simulated.record import RecordEntry
from drivers.simulated.stimulator.in_process import DeviceLine
from drivers.simulated.stimulator.sciencemode2 import ScienceMode2Device
from drivers.simulated.stimulator.sciencemode4 import ScienceMode4Device
from drivers.simulated.stimulator.serial_device import SimulatedDevice
from drivers.stimulator import p24_port as sm4
from drivers.stimulator import rehastim2_port as sm2
from drivers.stimulator.p24_port import LowLevelStimulator, MidLevelStimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.rehastim2_port import RehaStim2
from drivers.stimulator.sciencemode import Packet, ScienceModePort
from fes.config import load_session
from fes.gate import SafetyGate
from fes.signals import StimAlive, StimCommand, StimStatus, WireFrame

MS = 1_000_000
KINDS = ("low", "mid", "rehastim2")


def command(t_ns: int, channel: int = 1, on: bool = True, **values: Any) -> StimCommand:
    levels: dict[str, Any] = {"current_ma": 20.0, "pulse_width_us": 300.0, "frequency_hz": 40.0, "validity_ms": 60}
    return StimCommand(t_ns=t_ns, channel=channel, on=on, **(levels | values))


class Bench:
    """Port and device; a turn sends commands, lets 20 ms pass in steps of 2 ms, and polls at each."""

    def __init__(self, kind: str, channels: tuple[int, ...] = (1,), t_ns: int = 0) -> None:
        self.device: SimulatedDevice
        self.device = ScienceMode2Device(t_ns) if kind == "rehastim2" else ScienceMode4Device(t_ns)
        self.line = DeviceLine(self.device, t_ns)
        self.port: ScienceModePort
        if kind == "low":
            self.port = LowLevelStimulator(self.line, 7)
        elif kind == "mid":
            self.port = MidLevelStimulator(self.line, 7, accept_watchdog_s=2.0)
        else:
            self.port = RehaStim2(self.line, 7, channels)
        self.handshake = self.port.open(0, clock_ns=self.line.clock_ns)
        self.frames: list[WireFrame] = []
        self.statuses: list[StimStatus] = []
        self.alive: list[StimAlive] = []
        self.record: list[RecordEntry] = []
        self.lost = ""

    @property
    def t_ns(self) -> int:
        return self.line.t_ns

    def turn(self, *commands: StimCommand, for_ms: int = 20) -> None:
        """Once the port says that the device has restarted, nobody drives any more; time passes all the same."""
        try:
            self._turn(commands, for_ms)
        except StimulatorLost as error:
            self.lost = str(error)
            self.line.advance(self.line.t_ns + for_ms * MS)
        self.record += self.device.take_record()

    def _turn(self, commands: tuple[StimCommand, ...], for_ms: int) -> None:
        self.frames += [self.port.send(one) for one in commands]
        for _ in range(for_ms // 2):
            self.line.advance(self.line.t_ns + 2 * MS)
            for event in self.port.poll(self.line.t_ns):
                if isinstance(event, StimStatus):
                    self.statuses.append(event)
                else:
                    self.alive.append(event)

    def drive(self, turns: int, **values: Any) -> None:
        for _ in range(turns):
            self.turn(command(self.t_ns, **values))

    @property
    def pulses(self) -> list[RecordEntry]:
        return [entry for entry in self.record if entry.event == "pulse"]

    @property
    def faults(self) -> list[str]:
        return [event.fault for event in [*self.statuses, *self.alive] if event.fault]


@pytest.mark.parametrize("kind", KINDS)
def test_two_seconds_are_delivered_as_commanded(kind: str) -> None:
    bench = Bench(kind)
    bench.drive(100)
    begin_ns = bench.frames[0].t_ns
    bench.drive(5, on=False)
    assert bench.faults == []
    assert len(bench.pulses) == pytest.approx(80, abs=1)
    assert {(p.channel, p.current_ma, p.pulse_width_us, p.detail) for p in bench.pulses} == {(1, 20.0, 300.0, "")}
    assert bench.pulses[-1].t_ns < begin_ns + 100 * 20 * MS + 15 * MS
    assert bench.port.outstanding == 0
    assert bench.alive or kind == "rehastim2"
    if bench.port.one_pulse_per_command:
        assert sum(s.pulses for s in bench.statuses) == len(bench.pulses)
        assert sum(s.charge_uc for s in bench.statuses) == pytest.approx(6.0 * len(bench.pulses))
    levels = {(s.on, s.current_ma, s.pulse_width_us, s.frequency_hz) for s in bench.statuses if s.on}
    assert levels == {(True, 20.0, 300.0, 40.0)}


@pytest.mark.parametrize("kind", KINDS)
def test_statuses_carry_the_counter_of_their_command(kind: str) -> None:
    bench = Bench(kind)
    for step in range(40):
        sent = len(bench.statuses)
        bench.turn(command(bench.t_ns, current_ma=10.0 + step % 7, on=step % 10 != 9))
        for status in bench.statuses[sent:]:
            assert status.counter == step % 128


@pytest.mark.parametrize("kind", ["low", "rehastim2"])
def test_without_commands_there_are_no_pulses(kind: str) -> None:
    """The controller died; whatever it had sent last is all there is."""
    bench = Bench(kind)
    bench.drive(10)
    delivered = len(bench.pulses)
    bench.turn(for_ms=5000)
    assert len(bench.pulses) == delivered
    assert bench.port.outstanding == 0


def test_mid_level_goes_on_for_its_watchdog_and_no_longer() -> None:
    bench = Bench("mid")
    bench.drive(50)
    last_ns = bench.frames[-1].t_ns
    bench.turn(for_ms=5000)
    after_ms = (bench.pulses[-1].t_ns - last_ns) / MS
    assert 1700 < after_ms <= 2000
    assert bench.record[-1].event == "watchdog"


def test_mid_level_must_be_accepted() -> None:
    for accepted in (0.0, 1.9, float("nan")):
        with pytest.raises(ValueError, match="accept_watchdog_s = 2"):
            MidLevelStimulator(DeviceLine(ScienceMode4Device(0)), 7, accept_watchdog_s=accepted)


def test_mid_level_asks_well_within_its_watchdog_and_only_with_a_command() -> None:
    bench = Bench("mid")
    bench.drive(200)
    asked = [f.t_ns for f in bench.frames if f.identifier == bench.port.identifiers + sm4.Code.MID_CURRENT_DATA]
    assert all(b - a <= 260 * MS for a, b in pairwise(asked))
    assert (
        sum(f.identifier == bench.port.identifiers + sm4.Code.MID_UPDATE for f in bench.frames) == 1
    )  # on change only
    assert not any(e.event == "watchdog" for e in bench.record)


def test_mid_level_off_is_at_once() -> None:
    bench = Bench("mid")
    bench.drive(10)
    off_ns = bench.t_ns
    bench.turn(command(off_ns, on=False), for_ms=400)
    assert bench.pulses[-1].t_ns <= off_ns
    assert not bench.statuses[-1].on


def test_mid_level_that_does_not_stop_is_a_fault_and_is_stopped() -> None:
    bench = Bench("mid")
    bench.drive(2)
    device = bench.device
    assert isinstance(device, ScienceMode4Device)
    other = sm4.mid_update(60, {1: sm4.Train(sm4.biphasic(20, 300), 50), 3: sm4.Train(sm4.biphasic(20, 300), 50)})
    device.receive(bench.t_ns, sm4.encode(other))
    bench.drive(20)
    assert any("goes on though" in s.fault for s in bench.statuses if s.channel == 3)
    count = len([p for p in bench.pulses if p.channel == 3])
    bench.drive(5, on=False)
    assert len([p for p in bench.pulses if p.channel == 3]) <= count


@pytest.mark.parametrize("kind", ["low", "mid"])
def test_an_open_lead_is_told_from_15_ma_on(kind: str) -> None:
    bench = Bench(kind)
    bench.device.set_fault(bench.t_ns, "electrode", 1)
    bench.drive(20, current_ma=14.0)
    assert bench.faults == []  # the device cannot tell
    bench.drive(20, current_ma=16.0)
    assert any("electrode" in s.fault for s in bench.statuses if s.channel == 1)
    assert bench.pulses == []
    assert not any(s.on for s in bench.statuses if s.fault)


def test_rehastim2_electrode_and_emergency_switch() -> None:
    bench = Bench("rehastim2")
    bench.device.set_fault(bench.t_ns, "electrode", 1)
    bench.drive(3)
    assert any("electrode" in a.fault for a in bench.alive)
    bench = Bench("rehastim2")
    bench.drive(5)
    pressed_ns, delivered = bench.t_ns, len(bench.pulses)
    bench.line.faults.send(pressed_ns, bench.device.set_fault(pressed_ns, "emergency", 1))
    bench.drive(5)
    assert any("emergency switch" in a.fault for a in bench.alive)
    assert any("wrong mode" in s.fault for s in bench.statuses)
    assert len(bench.pulses) == delivered


@pytest.mark.parametrize("kind", KINDS)
def test_a_restart_is_noticed(kind: str) -> None:
    bench = Bench(kind)
    bench.drive(10)
    boot_id = bench.handshake.boot_id
    bench.device.set_fault(bench.t_ns, "reboot", 1)
    delivered = len(bench.pulses)
    bench.drive(30)
    assert any(a.boot_id != boot_id and "restarted" in a.fault for a in bench.alive)
    assert "restarted" in bench.lost
    assert len(bench.pulses) == delivered


@pytest.mark.parametrize("kind", KINDS)
def test_a_restart_is_noticed_while_everything_is_off(kind: str) -> None:
    bench = Bench(kind)
    bench.drive(5, on=False)
    bench.device.set_fault(bench.t_ns, "reboot", 1)
    bench.drive(40, on=False)
    assert any("restarted" in a.fault for a in bench.alive)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("fault", ["drop", "garble"])
def test_a_lost_answer_is_a_fault_within_its_time(kind: str, fault: str) -> None:
    bench = Bench(kind)
    bench.drive(4)
    bench.line.faults.set(fault, 1.0)
    begin_ns = bench.t_ns
    for step in range(10):
        bench.turn(command(bench.t_ns, current_ma=20.0 + step))
    found = [e for e in [*bench.statuses, *bench.alive] if "no answer within 100 ms" in e.fault]
    assert len(found) == 1
    assert 100 * MS <= found[0].t_ns - begin_ns <= 160 * MS


@pytest.mark.parametrize("kind", KINDS)
def test_a_late_answer_is_a_fault_twice(kind: str) -> None:
    """First it is missing, then it comes and nobody waits for it."""
    bench = Bench(kind)
    bench.drive(4)
    bench.line.faults.set("delay", 0.15)
    bench.turn(command(bench.t_ns, current_ma=25.0), for_ms=140)
    assert any("no answer" in fault for fault in bench.faults)
    bench.turn(for_ms=60)
    assert any("to no command of ours" in fault for fault in bench.faults)


@pytest.mark.parametrize("kind", ["low", "mid"])
def test_answers_out_of_turn_are_a_fault(kind: str) -> None:
    bench = Bench(kind)
    bench.drive(4)
    bench.line.faults.set("reorder", 1.0)
    bench.turn(
        command(bench.t_ns, channel=0, current_ma=25.0), command(bench.t_ns, channel=2, current_ma=25.0), for_ms=100
    )
    assert any("out of turn" in fault for fault in bench.faults)


@pytest.mark.parametrize("kind", ["low", "rehastim2"])
def test_a_silent_device_never_has_more_than_two_pulses_of_a_channel_waiting(kind: str) -> None:
    bench = Bench(kind)
    bench.drive(4)
    bench.line.faults.set("mute", 1.0)
    before = len(bench.pulses)
    for _ in range(4):
        bench.turn(command(bench.t_ns, frequency_hz=100.0))
    assert len(bench.pulses) - before == 2
    assert any("unanswered" in s.fault for s in bench.statuses)


def test_a_slow_device_s_queue_is_never_filled() -> None:
    bench = Bench("low")
    bench.device.set_fault(0, "slow", 0.09)
    for _ in range(30):
        bench.turn(*(command(bench.t_ns, channel=channel, frequency_hz=50.0) for channel in range(8)))
    assert not any(e.event == "refused" for e in bench.record)
    assert any("queue" in s.fault for s in bench.statuses)


def test_the_simulated_queue_refuses_the_eleventh() -> None:
    device = ScienceMode4Device(0)
    device.receive(0, sm4.encode(Packet(0, sm4.Code.LOW_INIT, b"\0")))
    pulses = b"".join(sm4.encode(sm4.low_pulse(n, 0, sm4.biphasic(20, 300))) for n in range(12))
    answers = sm4.Decoder().feed(b"".join(device.receive(0, pulses)))
    assert [a.data[0] for a in answers] == [0, sm4.Result.BUSY]  # one at once, ten queued, one refused
    assert len(sm4.Decoder(4096).feed(b"".join(device.advance(1000 * MS)))) == 10


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize("kind", KINDS)
def test_faults_latch_the_gate(kind: str) -> None:
    """The commands go past this gate, so that it is told of no pulses: it would ask who wanted them."""

    def told_after(t_ns: int) -> None:
        for event in sorted([*bench.statuses, *bench.alive], key=lambda e: e.t_ns):
            if event.t_ns > t_ns:
                gate.observe(replace(event, pulses=0) if isinstance(event, StimStatus) else event)

    channel = load_session(SETTINGS).channels[0].model_copy(update={"number": 1})
    gate = SafetyGate((channel,), max_data_age_ms=40, validity_ms=60)
    bench = Bench(kind)
    bench.drive(3)
    told_after(0)
    assert gate.latched == ""
    bench.device.set_fault(bench.t_ns, "reboot", 1)
    seen_ns = bench.t_ns
    bench.drive(30)
    told_after(seen_ns)
    assert "stimulator" in gate.latched


def test_rehastim2_sends_one_list_for_all_channels_of_a_step() -> None:
    bench = Bench("rehastim2", channels=(4, 2))
    for _ in range(50):
        bench.turn(command(bench.t_ns, channel=4, current_ma=30.5), command(bench.t_ns, channel=2, frequency_hz=25.0))
    starts = [f for f in bench.frames if f.identifier == bench.port.identifiers + sm2.Code.LIST_START]
    by_channel = {number: [p for p in bench.pulses if p.channel == number] for number in (2, 4)}
    assert len(by_channel[4]) == pytest.approx(40, abs=1)
    assert len(by_channel[2]) == pytest.approx(25, abs=1)
    assert len(starts) < len(by_channel[2]) + len(by_channel[4])
    assert {p.current_ma for p in by_channel[4]} == {30.0}  # whole mA, rounded down
    assert bench.faults == []


def test_rehastim2_delivers_nothing_of_a_step_that_broke_off() -> None:
    bench = Bench("rehastim2", channels=(1, 2))
    bench.turn(command(bench.t_ns, channel=1))  # the last channel's command does not come
    bench.turn(command(bench.t_ns, channel=2, on=False), for_ms=100)
    assert bench.pulses == []


def test_rehastim2_delivers_nothing_when_all_is_switched_off_in_the_middle_of_a_step() -> None:
    bench = Bench("rehastim2", channels=(4, 2))
    gathered = command(bench.t_ns, channel=4)
    bench.turn(gathered, *(command(bench.t_ns, channel=number, on=False) for number in (4, 2)), for_ms=100)
    assert bench.pulses == []


def test_rehastim2_is_kept_alive_by_commands_alone() -> None:
    bench = Bench("rehastim2")
    bench.drive(150, on=False)
    assert not any(e.event == "watchdog" for e in bench.record)
    sent_ns = [f.t_ns for f in bench.frames if f.identifier == bench.port.identifiers + sm2.Code.GET_MODE]
    assert len(sent_ns) > 10
    assert all(b - a <= 270 * MS for a, b in pairwise(sent_ns))
    assert len(bench.alive) >= len(sent_ns) - 1  # each is answered: it is known to be there while nothing is stimulated
    bench.turn(for_ms=3000)
    assert any(e.event == "watchdog" for e in bench.record)
    assert any("restarted, or its watchdog" in a.fault for a in bench.alive)


def test_a_repeating_rehastim2_list_runs_on_for_its_watchdog() -> None:
    """Why lists are one-shot: with any other main interval it is 1.2 s until silence."""
    bench = Bench("rehastim2")
    device = bench.device
    device.receive(bench.t_ns, sm2.encode(Packet(9, sm2.Code.LIST_STOP)))
    device.receive(bench.t_ns, sm2.encode(sm2.list_init(10, (1,), interval=48)))
    device.receive(bench.t_ns, sm2.encode(sm2.list_start(11, [(300, 20)])))
    begin_ns = bench.t_ns
    device.advance(begin_ns + 5000 * MS)
    times_ns = [e.t_ns for e in device.take_record() if e.event == "pulse"]
    assert times_ns[1] - times_ns[0] == 25 * MS
    assert 1170 * MS <= times_ns[-1] - begin_ns < 1200 * MS


@pytest.mark.parametrize("kind", KINDS)
def test_nobody_there_says_what_to_check(kind: str) -> None:
    bench = Bench(kind)
    bench.line.faults.set("mute", 1.0)
    with pytest.raises(StimulatorLost, match=r"simulated device: no .*switched on"):
        bench.port.open(0, timeout_s=1.0, clock_ns=bench.line.clock_ns)


@pytest.mark.parametrize("kind", KINDS)
def test_a_pulled_cable_is_a_lost_stimulator(kind: str) -> None:
    bench = Bench(kind)
    bench.line.unplugged = True
    with pytest.raises(StimulatorLost, match="cable"):
        bench.port.poll(0)
    with pytest.raises(StimulatorLost, match="cable"):
        bench.port.send(command(bench.t_ns + 1000 * MS))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "bad", [{"current_ma": 131.0}, {"current_ma": float("nan")}, {"channel": 9}, {"frequency_hz": float("nan")}]
)
def test_a_command_that_cannot_be_expressed_changes_nothing(kind: str, bad: dict[str, Any]) -> None:
    bench = Bench(kind)
    bench.drive(2)
    outstanding = bench.port.outstanding
    with pytest.raises(ValueError):
        bench.port.send(command(bench.t_ns, **bad))
    assert bench.port.outstanding == outstanding
    before = len(bench.statuses)
    for step in range(2, 12):  # the counter did not move
        bench.turn(command(bench.t_ns, current_ma=20.0 + step))
    assert {s.counter for s in bench.statuses[before:]} <= {step % 16 for step in range(2, 12)}
    assert bench.faults == []


def test_off_for_an_unknown_channel_is_never_refused() -> None:
    for kind in KINDS:
        bench = Bench(kind)
        bench.turn(command(bench.t_ns, channel=-1, on=False))
        assert bench.faults == []


def test_a_handshake_after_another_session_of_mid_level_silences_it() -> None:
    device = ScienceMode4Device(0)
    line = DeviceLine(device)
    mid = MidLevelStimulator(line, 1, accept_watchdog_s=2.0)
    mid.open(0, clock_ns=line.clock_ns)
    mid.send(command(0))
    line.advance(300 * MS)
    assert device.level == 3
    LowLevelStimulator(line, 2).open(line.t_ns, clock_ns=line.clock_ns)
    device.take_record()
    line.advance(line.t_ns + 1000 * MS)
    assert device.take_record() == []


def test_device_refusals_are_told_at_the_handshake() -> None:
    class Refusing(ScienceMode4Device):
        def receive(self, t_ns: int, data: bytes) -> list[bytes]:
            return [sm4.encode(Packet(p.number, p.command + 1, b"\x08")) for p in self._decoder.feed(data)]

    line = DeviceLine(Refusing(0))
    with pytest.raises(StimulatorLost, match="high voltage"):
        LowLevelStimulator(line, 1).open(0, clock_ns=line.clock_ns)


def test_device_errors_unasked_reach_the_controller() -> None:
    bench = Bench("low")
    bench.line.faults.send(bench.t_ns, [sm4.encode(Packet(0, sm4.Code.GENERAL_ERROR, b"\x08"))])
    bench.turn()
    assert bench.alive[-1].rejected == 1
    assert "high voltage" in bench.alive[-1].fault
