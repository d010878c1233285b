"""The fault campaign's judge, table and tools, without any process."""

from __future__ import annotations

import json
import math
import os
import select
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.bus_guests import StopButton, flipped, random_frames
from drivers.simulated.can_link import LinkLoop, SlcanDecoder, SlcanFront, encode_frame, waiting_frames
from drivers.simulated.imu.device import ImuSignal, SimulatedImu
from drivers.simulated.imu.wire import LSL_RECORD, LslWire
from drivers.simulated.lines import CanEnd, DeviceLoop, PtyEnd
from drivers.simulated.record import RecordEntry, RecordReader
from drivers.simulated.stimulator.can_node import NodeDevice
from drivers.simulated.stimulator.firmware import StimulatorNode
from drivers.stimulator.bus import open_bus
from drivers.stimulator.can_codec import COMMAND_ID, FrameRejected, decode, encode_command
from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.port import PulseTrain
from drivers.switches import CanSwitch
from fes.cli import main
from fes.config import Bus, StimulatorDevice, load_session
from fes.hil.attempts import refusal_attempt
from fes.hil.baseline import Baseline, Lateness
from fes.hil.campaign_bench import CampaignBench
from fes.hil.controller import Child, ScriptedOperator
from fes.hil.devices import TRANSPORTS, Devices, Hardware, set_link
from fes.hil.injections import INJECTIONS
from fes.hil.results import (
    MS,
    Attempt,
    Campaign,
    Output,
    Outputs,
    Row,
    Verdict,
    began_after,
    length_ms,
    off_after_ms,
    output_at,
    overlap_ms,
    resumed_after,
    with_late_pulses,
)
from fes.hil.scenarios import BY_NAME, SCENARIOS, Effect
from fes.hil.sensor_faults import RealSensor
from fes.hil.settings import BUTTON_ID, CURRENT_MA, FREQUENCY_HZ, INTENSITY, PULSE_WIDTH_US, Walker, session_text
from fes.live.status import Status
from fes.signals import StimCommand

PROJECT = Path(__file__).resolve().parents[2]


def can_entry(t_ms: float, event: str, current_ma: float = 0.0, pulses: int = 0, channel: int = 0) -> RecordEntry:
    t_ns = int(t_ms * MS)
    return RecordEntry(t_ns, event, channel, current_ma, 300.0, 40.0, t_ns, pulses, t_ns)


def pulse_entry(t_ms: float) -> RecordEntry:
    return RecordEntry(int(t_ms * MS), "pulse", 0, 20.0, 300.0, 0.0, int(t_ms * MS), 1, int(t_ms * MS))


def record_outputs(entries: list[RecordEntry], now_ns: int) -> list[Output]:
    """All stretches of current of a whole record, oldest first."""
    found = Outputs()
    found.add(entries)
    return found.stretches(now_ns)


BURST = [
    can_entry(100, "on", 5.0, 1),
    can_entry(150, "level", 20.0, 3),
    can_entry(400, "off", 0.0, 13),
]


def test_a_burst_by_its_levels() -> None:
    (output,) = record_outputs(BURST, 1000 * MS)
    assert (output.on_ns, output.off_ns, output.ended_by) == (100 * MS, 400 * MS, "off")
    assert output.charge_uc == pytest.approx(2 * 5.0 * 0.3 + 10 * 20.0 * 0.3)
    assert output_at([output], 99 * MS) is None
    assert output_at([output], 250 * MS) is output
    assert off_after_ms([output], 250 * MS) == 150.0
    assert off_after_ms([output], 500 * MS) == 0.0


@pytest.mark.parametrize("event", ["lease_expired", "on_time", "fault"])
def test_whatever_ends_it_is_an_end(event: str) -> None:
    assert off_after_ms(record_outputs([*BURST[:2], can_entry(300, event)], 1000 * MS), 250 * MS) == 50.0


def test_a_restart_ends_every_channel() -> None:
    entries = [can_entry(100, "on", 5.0), can_entry(110, "on", 5.0, channel=3), can_entry(200, "boot", channel=-1)]
    assert [output.off_ns for output in record_outputs(entries, 1000 * MS)] == [200 * MS, 200 * MS]


def test_current_that_does_not_end_or_comes_back_is_no_time() -> None:
    assert math.isinf(off_after_ms(record_outputs(BURST[:2], 1000 * MS), 250 * MS))
    again = [*BURST, can_entry(900, "on", 5.0), can_entry(1100, "off")]
    assert off_after_ms(record_outputs(again, 2000 * MS), 250 * MS) == 850.0
    assert began_after(record_outputs(again, 2000 * MS), 250 * MS) == 1


def test_a_train_of_pulses_ends_with_its_last() -> None:
    entries = [pulse_entry(t) for t in (100, 125, 150, 900, 925)]
    first, second = record_outputs(entries, 1000 * MS)
    assert (first.on_ns, first.off_ns, first.pulses) == (100 * MS, 150 * MS, 3)
    assert first.charge_uc == pytest.approx(18.0)
    assert output_at([first], 160 * MS) is first  # the next pulse was due at 175
    assert output_at([first], 250 * MS) is None
    assert second.off_ns == 925 * MS
    assert record_outputs(entries, 960 * MS)[1].off_ns is None  # another pulse may be due


def test_the_longest_on_time_is_that_of_one_burst() -> None:
    """A heel lifted once more: 0.3 s of pulses, a pause of 80 ms, and then the stance that does not end, 3 s."""
    entries = [pulse_entry(t) for t in [*range(0, 301, 25), *range(380, 3381, 25)]]
    before, stuck = record_outputs(entries, 5000 * MS)
    assert length_ms([before], 5000 * MS) == 300.0
    assert length_ms(with_late_pulses([before, stuck], stuck), 5000 * MS) == 3000.0
    # and what comes so soon after it that it may be its own is not left out
    *_, again = late = record_outputs([*entries, pulse_entry(3480)], 5000 * MS)
    assert length_ms(with_late_pulses(late, stuck), 5000 * MS) == 3100.0
    assert again.on_ns == 3480 * MS
    assert with_late_pulses(record_outputs([*entries, pulse_entry(3600)], 5000 * MS), stuck) == [stuck]


@pytest.mark.parametrize(("pause_ms", "began", "resumed"), [(50, 0, 0), (60, 1, 0), (150, 1, 0), (151, 1, 1)])
def test_a_late_pulse_is_no_current_again_but_its_time_counts(pause_ms: int, began: int, resumed: int) -> None:
    stretches = record_outputs([pulse_entry(t) for t in (100, 125, 150, 150 + pause_ms)], 1000 * MS)
    assert began_after(stretches, 155 * MS) == began
    assert resumed_after(stretches, 155 * MS) == resumed
    assert off_after_ms(stretches, 155 * MS) == max(pause_ms - 5, 0)
    again = [*BURST, can_entry(410, "on", 5.0), can_entry(450, "off")]  # a record of levels knows no late pulses
    assert resumed_after(record_outputs(again, 2000 * MS), 250 * MS) == 1


@given(st.lists(st.integers(-7, 7), min_size=80, max_size=80), st.integers(50, 200), st.integers(0, 19))
def test_a_burst_is_one_and_two_are_two(late_ms: list[int], pause_ms: int, at_ms: int) -> None:
    """Pulses as the driver asks for them, commands late and early by 7 ms; between bursts the pause that must be."""
    train, entries, asked = PulseTrain(), [], []
    for number, late in enumerate(late_ms):
        if number == 40:
            train.off()
        begin_ms = 0 if number < 40 else at_ms + pause_ms + 20
        t_ms = begin_ms + number * 20 + (0 if number == 40 else late)
        if train.due(t_ms * MS, FREQUENCY_HZ):
            entries.append(pulse_entry(t_ms))
            asked.append(number < 40)
    stretches = record_outputs(entries, 10_000 * MS)
    assert [output.pulses for output in stretches] == [asked.count(True), asked.count(False)]


@given(st.lists(st.integers(1, 3000), min_size=1, max_size=40, unique=True), st.integers(0, 3000))
def test_off_is_never_before_the_last_pulse(times: list[int], fault_ms: int) -> None:
    stretches = record_outputs([pulse_entry(t) for t in sorted(times)], 10_000 * MS)
    assert off_after_ms(stretches, fault_ms * MS) == max(0, max(times) - fault_ms)


@given(st.lists(st.integers(0, 5), max_size=30), st.lists(st.integers(1, 6), min_size=1, max_size=10))
def test_a_record_read_bit_by_bit_tells_the_same_as_at_once(kinds: list[int], cuts: list[int]) -> None:
    events = ("on", "level", "off", "pulse", "lease_expired", "boot")
    entries = [
        RecordEntry(k * 40 * MS, events[kind], -1 if kind == 5 else k % 2, 9.0, 300.0, 40.0, 0, k, k * 40 * MS)
        for k, kind in enumerate(kinds)
    ]
    found, at = Outputs(), 0
    for cut in cuts:
        found.add(entries[at : at + cut])
        found.stretches(entries[at].t_ns if at < len(entries) else 0)
        at += cut
    found.add(entries[at:])
    now_ns = 2000 * MS
    assert found.stretches(now_ns) == record_outputs(entries, now_ns)
    recent = [each for each in record_outputs(entries, now_ns) if each.off_ns is None or each.off_ns >= 600 * MS]
    assert [each for each in found.stretches(now_ns, 600 * MS) if each in recent] == recent
    before = found.stretches(now_ns)
    found.forget(0)
    assert found.stretches(now_ns) == before
    found.forget(now_ns)
    assert [each for each in before if each.off_ns is None] == [
        each for each in found.stretches(now_ns) if each.off_ns is None
    ]


def test_a_record_is_read_once_and_only_whole_lines(tmp_path: Path) -> None:
    path = tmp_path / "record.jsonl"
    tail = RecordReader(path)
    assert tail.new_entries() == []
    with path.open("w") as file:
        file.write('{"t_ns":1,"event":"boot"}\n{"t_ns":2,"ev')
        file.flush()
        assert [entry.t_ns for entry in tail.new_entries()] == [1]
        assert tail.new_entries() == []
        file.write('ent":"off"}\nnoise\n')
    with pytest.raises(ValueError, match=r"record.jsonl:3"):
        tail.new_entries()


# --- the table -------------------------------------------------------------------------------------------


def test_every_row_can_be_brought_about_and_every_injection_has_a_row() -> None:
    assert set(INJECTIONS) == {scenario.injected for scenario in SCENARIOS}
    assert len(BY_NAME) == len(SCENARIOS)


def test_axes_of_a_simulated_sensor_keep_one_value_to_the_bit_or_alive() -> None:
    count = np.arange(20.0)
    device = SimulatedImu(LslWire(), ImuSignal(100.0, np.stack([count] * 3, 1), np.stack([-count] * 3, 1)), 0)
    device.advance(50_000_000)
    device.set_fault(50_000_000, "held", 1 + 32)
    shown = []
    for t_ns in (50_000_000, 80_000_000, 110_000_000):
        device.advance(t_ns)
        shown.append(device._reading(0))
    assert len({(reading.acc_mps2[0], reading.gyr_radps[2]) for reading in shown}) == 1
    assert len({(reading.acc_mps2[1], reading.gyr_radps[0]) for reading in shown}) == 3
    device.set_fault(10**9, "held", 0.0)
    device._reading(0)
    device.set_fault(10**9, "held_alive", 7)
    alive = []
    for t_ns in range(10**9, 2 * 10**9, 10_000_000):
        device.advance(t_ns)
        alive.append(device._reading(0).acc_mps2[0])
    assert len(set(alive)) > 50
    assert max(alive) - min(alive) <= 0.1


def test_one_triad_of_a_simulated_sensor_is_scaled_alone() -> None:
    device = SimulatedImu(LslWire(), ImuSignal(100.0, np.full((20, 3), 3.0), np.full((20, 3), 2.0)), 0)
    for fault, acc, gyr in (("force_scaled", 1.5, 2.0), ("rate_scaled", 3.0, 1.0)):
        device.set_fault(0, fault, 0.5)
        device.advance(10**8)
        assert device._reading(0).acc_mps2 == (acc,) * 3
        assert device._reading(0).gyr_radps == (gyr,) * 3
        device.set_fault(0, fault, 0.0)


def test_a_sensor_that_dangles_feels_the_pull_of_its_cable_alone_and_turns() -> None:
    device = SimulatedImu(LslWire(), ImuSignal(100.0, np.full((20, 3), 3.0), np.full((20, 3), 2.0)), 0)
    device.set_fault(0, "dangling", 1.0)
    shown = []
    for t_ns in range(0, 3 * 10**9, 10_000_000):
        device.advance(t_ns)
        shown.append(device._reading(0))
    force, rate = np.array([each.acc_mps2 for each in shown]), np.array([each.gyr_radps for each in shown])
    assert np.abs(force[:, 1:]).max() < 0.1
    assert force[:, 0].min() > 8.0
    assert force[:, 0].max() < 12.0
    assert np.ptp(rate[:, 1]) > 2.0


def test_what_was_played_says_when_the_foot_was_in_stance() -> None:
    played: list[tuple[int, int]] = []
    signal = ImuSignal(100.0, np.zeros((20, 3)), np.zeros((20, 3)))
    device = SimulatedImu(LslWire(), signal, 0, jumped=lambda t_ns, sample: played.append((t_ns, sample)))
    device.set_fault(0, "stand", 0.05)
    device.advance(120 * MS)  # 13 samples: 0 to 4 twice, 0 to 2
    device.set_fault(120 * MS, "stand", 0.0)
    device.advance(400 * MS)
    assert played == [(0, 0), (50 * MS, 0), (100 * MS, 0), (130 * MS, 5), (280 * MS, 0)]
    in_stance = np.arange(20) < 8
    in_stance[15:] = True
    walked = Walker(Path("walk"), Path("calibration"), in_stance)
    spans = walked.stances_ns(played, 60 * MS, 350 * MS)
    assert [(a // MS, b // MS) for a, b in spans] == [(60, 100), (100, 130), (130, 160), (230, 280), (280, 350)]
    current = [Output(150 * MS, 260 * MS, 260 * MS), Output(340 * MS, None, 340 * MS)]
    assert overlap_ms(current, spans, 345 * MS) == 10.0 + 30.0 + 5.0


def test_a_walk_that_ended_has_stood_and_a_step_has_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only where the foot stayed on the ground is a lying sensor brought about once more."""
    devices = object.__new__(Devices)
    bench = CampaignBench(devices, frozenset(), ExitStack())
    monkeypatch.setattr("fes.hil.campaign_bench.time.monotonic_ns", lambda: 2000 * MS)
    for stances_ms, stood in [([(500, 2000)], True), ([(500, 1200), (1210, 2000)], True), ([(500, 1400)], False)]:
        spans = [(begin * MS, end * MS) for begin, end in stances_ms]
        monkeypatch.setattr(Devices, "stances_ns", lambda self, since_ns, until_ns, spans=spans: spans)
        assert bench.stood_since(500 * MS) is stood
    monkeypatch.setattr(Devices, "stances_ns", lambda self, since_ns, until_ns: None)  # a virtual patient: nobody knows
    assert not bench.stood_since(500 * MS)


def test_what_must_go_off_has_a_deadline() -> None:
    for scenario in SCENARIOS:
        if scenario.effect in (Effect.LATCHED, Effect.ENDED):
            assert scenario.deadline_ms, scenario.name


def test_each_value_of_a_fault_comes_at_least_once() -> None:
    stale = BY_NAME["stale_data"]
    assert [stale.value(n) for n in range(stale.attempts(1))] == [0.06, 0.1, 0.2, 0.5]
    assert stale.attempts(10) == 10
    assert stale.value(9) == 0.1
    assert BY_NAME["imu_nan"].attempts(1) == 1
    assert all(
        f"{value:g}" in scenario.fault or scenario.unit == "s" for scenario in SCENARIOS for value in scenario.values
    )


def campaign(rows: list[Row], machine_ms: float = 0.0) -> Campaign:
    return Campaign("loopback", tuple(rows), Lateness(100, p999_ms=machine_ms), "now", 60.0, 1)


def test_verdicts() -> None:
    silent = BY_NAME["imu_silent"]
    in_time, late = Attempt(99.0), Attempt(104.0)
    assert Row(silent, [in_time]).verdict(0.0) is Verdict.MET
    assert Row(silent, [in_time, late]).verdict(3.0) is Verdict.FAILED
    assert Row(silent, [in_time, late]).verdict(5.0) is Verdict.JITTER
    assert Row(silent, [Attempt(math.inf)]).verdict(1e9) is Verdict.FAILED
    assert Row(silent, [Attempt(50.0, faults=("current again without arming",))]).verdict(5.0) is Verdict.FAILED
    assert Row(silent).verdict(5.0) is Verdict.FAILED  # nothing was shown
    assert Row(silent, skipped="needs a line").verdict(0.0) is Verdict.SKIPPED
    assert campaign([Row(silent, [in_time]), Row(silent, [late])]).failed


def test_a_machine_that_was_away_is_no_success() -> None:
    row = Row(BY_NAME["imu_nan"], [Attempt(20.0, 1.0, "controller stalled for 51 ms", away=True)], away=["x", "y"])
    assert row.verdict(1e9) is Verdict.FAILED
    made_again = Row(BY_NAME["imu_nan"], [Attempt(20.0)], away=["controller stalled for 51 ms"])
    assert made_again.verdict(0.0) is Verdict.MET
    (notice,) = campaign([made_again]).notices
    assert "Machine away 1 times" in notice
    assert notice in campaign([made_again]).to_markdown()


def test_lost_time_counts_as_the_machines_only_where_an_idle_loop_lost_it_too() -> None:
    bench = CampaignBench(Hardware(Path(), Path(), Path(), 1.0, RealSensor(pulses=False)), frozenset(), ExitStack())
    assert not bench.was_away("controller stalled for 51 ms", 0, 10**12)
    bench.gaps = lambda since_ns: [(1000 * MS, 50.0)]
    assert bench.was_away("controller stalled for 51 ms", 1040 * MS, 1100 * MS)
    assert not bench.was_away("controller stalled for 51 ms", 1060 * MS, 1100 * MS)
    assert not bench.was_away("controller stalled for 51 ms", 900 * MS, 990 * MS)
    assert bench.was_away(
        "stimulator fault on channel 0: 2 pulses are unanswered; none was added", 1040 * MS, 1100 * MS
    )
    assert not bench.was_away("non-finite sample from right_foot", 900 * MS, 1100 * MS)


def level(t_ms: float, event: str, current_ma: float = 18.0, detail: str = "") -> RecordEntry:
    return RecordEntry(int(t_ms * MS), event, 0, current_ma, PULSE_WIDTH_US, FREQUENCY_HZ, detail=detail)


def test_foreign_frames_are_judged_by_what_the_stimulator_noted() -> None:
    refused = [level(10.0 + k, "refused", detail="bad_counter") for k in range(3)]
    assert refusal_attempt([level(5, "on"), *refused], 3, "command refused", random=False).faults == ()
    assert "only 3 of 4 refused" in refusal_attempt(refused, 4, "", random=False).faults
    assert refusal_attempt([*refused, level(20, "level", 40.0)], 3, "", random=False).faults
    assert refusal_attempt([*refused, level(200, "on")], 3, "", random=False).faults == ()  # the session goes on
    assert refusal_attempt([*refused, level(200, "on")], 3, "command refused", random=False).faults
    noise = [level(k, "refused", detail="STIM_COMMAND: wrong CRC") for k in range(2000)]
    few, many = ([level(k, "refused", detail="bad_session") for k in range(count)] for count in (8, 40))
    assert refusal_attempt(noise + few, 2008, "", random=True).faults == ()
    assert "have a right CRC" in refusal_attempt(noise + many, 2040, "", random=True).faults[0]
    opened = RecordEntry(50, "session", detail="session 77")
    assert "executed" in refusal_attempt([*refused, opened], 3, "", random=False).faults[0]
    own = frozenset({"session 77"})
    assert refusal_attempt([*refused, opened], 3, "", random=False, own_sessions=own).faults == (), (
        "the controller's own"
    )


def result(transport: str, rows: list[Row]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(campaign(rows).to_dict())) | {"transport": transport}
    return found


def test_several_campaigns_make_one_table(tmp_path: Path) -> None:
    silent, flipped_ = BY_NAME["imu_silent"], BY_NAME["commands_flipped"]
    one = result("slcan", [Row(silent, [Attempt(40.0), Attempt(90.0)]), Row(flipped_, skipped="needs CAN")])
    two = result("slcan", [Row(silent, [Attempt(101.0)])])
    three = result("serial", [Row(silent, [Attempt(math.inf)]), Row(flipped_, [Attempt(notice="fine")])])
    paths = []
    for number, data in enumerate((one, two, three)):
        paths.append(tmp_path / f"{number}.json")
        paths[-1].write_text(json.dumps(data))
    command = [sys.executable, str(PROJECT / "benchmarks/safety/hil_table.py")]
    said = subprocess.run([*command, *map(str, paths)], capture_output=True, text=True, check=True).stdout
    assert "| fault | off within | slcan | serial |" in said
    assert "| sensor silent | 100 ms | **101.0 ms, 2 of 3** | **still on, 0 of 1** |" in said
    assert f"| {flipped_.fault} | – | – | 1 of 1 |" in said
    subprocess.run([*command, str(paths[2]), "--json", str(tmp_path / "kept.json")], check=True)
    assert (tmp_path / "kept.json").read_text(encoding="utf-8").count("sensor silent") == 1
    paths[0].write_text("{}")
    refused = subprocess.run([*command, str(paths[0])], capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert "0.json" in refused.stderr


def test_the_table_says_it_all_and_the_data_are_json() -> None:
    rows = [Row(BY_NAME["imu_silent"], [Attempt(37.0, 20.0, "right_foot data 41 ms old"), Attempt(math.inf)])]
    rows.append(Row(BY_NAME["link_lost"], skipped="needs a line that can be cut"))
    text = campaign(rows).to_markdown()
    assert "| sensor silent |" in text
    assert "37.0" not in text.split("verdict")[0]
    assert "still on" in text
    assert "1 of 2" in text
    assert "needs a line that can be cut" in text
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1
    data = json.loads(json.dumps(campaign(rows).to_dict(), allow_nan=False))
    assert data["rows"][0]["attempts"][1]["off_ms"] == "never"
    assert data["rows"][0]["verdict"] == "FAILED"


# --- its sessions, its operator --------------------------------------------------------------------------


@pytest.mark.parametrize("variant", ["", "stance", "dose", "seen", "button"])
def test_its_sessions_can_be_run(tmp_path: Path, variant: str) -> None:
    path = tmp_path / "session.toml"
    bus = Bus(interface="slcan", channel="/dev/x", options={"bitrate": 500000, "timeout": 0})
    path.write_text(session_text(variant, "/dev/sensor", bus, StimulatorDevice()))
    session = load_session(path)
    assert session.bus == bus
    assert (session.live.stop_button is not None) == (variant == "button")
    assert session.live.stop_button is None or session.live.stop_button.identifier == BUTTON_ID
    assert session.stimulation.intensity * session.channels[0].current_ma == CURRENT_MA * INTENSITY
    assert session.channels[0].start_phase == ("stance" if variant == "stance" else "swing")
    serial = StimulatorDevice.model_validate({"device": "rehastim2", "port": "/dev/y"})
    path.write_text(session_text(variant, "/dev/sensor", None, serial))
    assert load_session(path).stimulator == serial


def test_the_scripted_operator_orders_and_listens(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as session:
        session.bind(str(tmp_path / "session"))
        operator = ScriptedOperator(tmp_path / "session", tmp_path / "me")
        operator.send_command("arm")
        asked, sender = session.recvfrom(1024)
        assert json.loads(asked) == {"ask": "arm", "value": 0.0, "confirm": True}
        session.sendto(b'{"ok":false,"why":"no"}', sender)
        session.sendto(Status(5, "armed").encode(), sender)
        session.sendto(b"noise", sender)
        status = operator.receive_status()
        assert status is not None
        assert status.state == "armed"
        assert operator.refusals == ["no"]
        operator.close()
    assert not (tmp_path / "me").exists()


def test_a_name_that_stays_when_what_is_behind_it_changes(tmp_path: Path) -> None:
    for target in ("one", "two"):
        (tmp_path / target).write_text(target)
        set_link(tmp_path / "name", str(tmp_path / target))
        assert (tmp_path / "name").read_text() == target


# --- who else is on the bus ------------------------------------------------------------------------------


def test_all_flips_of_a_command_and_none_is_intact() -> None:
    frame = encode_command(StimCommand(0, 0, True, 20.0, 300.0, 40.0, 60), 3, 77)
    frames = list(flipped(frame))
    assert len(frames) == len(set(frames)) == 64 + 64 * 63 // 2
    for identifier, data in frames:
        with pytest.raises(FrameRejected):
            decode(identifier, data)


def test_random_frames_are_the_same_for_the_same_seed() -> None:
    assert list(random_frames(50, 1)) == list(random_frames(50, 1)) != list(random_frames(50, 2))
    assert {identifier for identifier, _ in random_frames(50, 3, (COMMAND_ID,))} == {COMMAND_ID}


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.binary(max_size=20))
def test_slcan_frames_survive_the_line_after_any_noise(identifier: int, data: bytes, noise: bytes) -> None:
    decoder = SlcanDecoder()
    message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
    assert decoder.feed(encode_frame(message)) == []  # the channel is not open
    decoder.feed(noise + b"\rO\r")
    (found,) = decoder.feed(encode_frame(message))
    assert (found.arbitration_id, bytes(found.data)) == (identifier, data)


@pytest.mark.parametrize("line", [b"t12", b"t1239", b"t1232AA", b"tXYZ0", b"q", b"", b"t\xff\xff\xff0"])
def test_what_is_no_frame_is_passed_over(line: bytes) -> None:
    decoder = SlcanDecoder()
    assert decoder.feed(b"O\r" + line + b"\r") == []


def write_much(descriptor: int) -> None:
    """More than a little: the kernel may just have moved some of a full buffer on, and have room for a moment."""
    for _ in range(2000):
        os.write(descriptor, b"t1208\r")


def test_a_full_adapter_refuses_writes_and_takes_new_ones_afterwards() -> None:
    end = PtyEnd()
    host = os.open(end.port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        end.clog(True)
        assert end.descriptors() == []
        with pytest.raises(BlockingIOError):
            write_much(host)
        end.clog(False)
        os.write(host, b"new")
        heard = b""
        while not heard.endswith(b"new"):
            assert select.select(end.descriptors(), [], [], 1.0)[0]
            heard += end.read()
    finally:
        os.close(host)
        end.unplug()


def test_a_serial_adapter_that_is_bus_off_refuses_every_frame(tmp_path: Path) -> None:
    front = SlcanFront(tmp_path / "adapter")
    host = os.open(tmp_path / "adapter", os.O_RDWR | os.O_NOCTTY)
    try:
        front.bus_off(True)
        os.write(host, b"O\rt12020102\rt12020102\r")
        assert front.read() == []
        assert os.read(host, 16) == b"\a\a"
        front.bus_off(False)
        os.write(host, b"t12020102\r")
        assert [frame.arbitration_id for frame in front.read()] == [0x120]
    finally:
        os.close(host)
        front.plug(False)


def test_the_line_exchanges_pairs_of_commands(tmp_path: Path) -> None:
    bus = Bus(interface="virtual", channel=f"exchange {tmp_path}")
    with open_bus(bus, frozenset()) as here, open_bus(bus, frozenset()) as there:
        front = SlcanFront(tmp_path / "adapter")
        line = LinkLoop(front, here, -1)
        line._inject("reorder", 2)
        for number in range(6):
            line._pass_on(can.Message(arbitration_id=COMMAND_ID, data=[number], is_extended_id=False))
        assert [frame.data[0] for frame in waiting_frames(there)] == [1, 0, 3, 2, 4, 5]
        with pytest.raises(ValueError, match="coffee"):
            line._inject("coffee", 1)
        front.plug(False)


def feeling(seconds: float = 1.0) -> SimulatedImu:
    """A sensor whose x counts its samples, 100 a second."""
    count = np.arange(int(100 * seconds), dtype=float)
    acc = np.stack([count, count + 0.25, count + 0.5], axis=1)
    return SimulatedImu(LslWire(), ImuSignal(100.0, acc, np.zeros((len(acc), 3))), 0, acc_range_g=100.0)


def felt(imu: SimulatedImu, until_ms: int) -> list[tuple[float, ...]]:
    return [LSL_RECORD.unpack(message)[:4] for message in imu.advance(until_ms * MS)]


def test_a_wearer_stays_standing_and_walks_on_when_told() -> None:
    imu = feeling()
    imu.set_fault(0, "stand", 0.2)
    assert [x for _, x, _, _ in felt(imu, 399)] == [*range(20), *range(20)]
    imu.set_fault(0, "stand", 0.0)
    assert [x for _, x, _, _ in felt(imu, 1199)][:3] == [20, 21, 22]
    imu.set_fault(0, "stand", 0.2)  # it walks now: to its end, then it stands
    assert max(x for _, x, _, _ in felt(imu, 1400)) == 99 or felt(imu, 3000)[-1][1] < 20


def test_faults_of_values_axes_and_stamps() -> None:
    imu = feeling()
    imu.set_fault(0, "axes", 1.0)
    assert felt(imu, 5)[0][1:] == (0.25, 0.5, 0.0)
    imu.set_fault(0, "axes", 0.0)
    imu.set_fault(0, "inf", 1.0)
    assert not any(map(math.isfinite, felt(imu, 15)[0][1:]))
    assert all(map(math.isfinite, felt(imu, 25)[0][1:]))
    imu.set_fault(0, "jumping", 0.2)
    stamps = [t_s for t_s, *_ in felt(imu, 995)]
    ahead = [t_s for k, t_s in enumerate(stamps, start=3) if t_s > 0.01 * k + 0.1]
    assert 0.05 < len(ahead) / len(stamps) < 0.2


def test_a_stop_button_says_what_it_is(tmp_path: Path) -> None:
    bus = Bus(interface="virtual", channel=f"button {tmp_path}")
    with open_bus(bus, frozenset()) as host, StopButton(bus, BUTTON_ID) as button:
        switch = CanSwitch(host, BUTTON_ID, 0, high=True)
        first = host.recv(timeout=2.0)
        assert first is not None
        assert first.data == b"\0"
        button.press()
        assert switch.read() is True


def test_the_idle_loops_tell_when_the_machine_was_away() -> None:
    baseline = Baseline()
    try:
        assert baseline.gaps(2**62) == []
        baseline.leave_out(True)
        assert isinstance(baseline.gaps(0), list)
    finally:
        found = baseline.end()
    assert found.most_ms >= found.p50_ms >= 0.0


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked for in /proc")
def test_a_child_is_known_until_it_has_ended() -> None:
    process = subprocess.Popen([sys.executable, "-c", "input()", "fes.example"], stdin=subprocess.PIPE)
    child = Child.running(process.pid)
    assert child is not None
    assert child.runs
    assert not Child(child.pid, "another time", child.module).runs
    child.kill()
    process.wait(5.0)
    assert not child.runs
    assert Child.running(process.pid) is None


def test_the_node_takes_its_faults_while_it_runs() -> None:
    node = StimulatorNode(1, 0)
    node.set_fault(0, "electrode", 2)
    assert node.faults.electrode == 2
    node.set_fault(0, "weak", 1)
    assert (node.faults.electrode, node.faults.weak) == (2, 1)
    node.set_fault(0, "reboot", 0.5)
    node.advance(499 * MS)
    assert node.boot_id == 1
    node.advance(500 * MS)
    assert node.boot_id == 2
    with pytest.raises(ValueError, match="not known"):
        node.set_fault(0, "coffee", 1)


def test_a_node_loop_knows_the_faults_of_its_line() -> None:
    end = CanEnd(Bus(interface="virtual"))
    loop = DeviceLoop(NodeDevice(StimulatorNode(1, 0)), end, -1)
    loop.inject("mute", 1.0)
    loop.inject("weak", 1.0)
    with pytest.raises(ValueError):
        loop.inject("mute", -1.0)
    end.unplug()


def test_a_port_on_an_adapter_that_is_gone_closes_all_the_same() -> None:
    class Gone(can.BusABC):
        def __init__(self) -> None:
            self.channel_info = "gone"

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("cannot write")

        def shutdown(self) -> None:
            raise can.CanOperationError("cannot write")

    port = CanStimulator(Gone(), 7)
    port.close()
    port.close()


# --- the command -----------------------------------------------------------------------------------------


def run(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main(arguments, prog_name="fes")
    said = capsys.readouterr()
    return int(ended.value.code or 0), said.out + said.err


def test_it_lists_its_faults(capsys: pytest.CaptureFixture[str]) -> None:
    code, said = run(["hil", "--list"], capsys)
    assert code == 0
    assert all(scenario.name in said for scenario in SCENARIOS)


def test_an_unknown_fault_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, said = run(["hil", "--only", "coffee", "--out", str(tmp_path)], capsys)
    assert code == 2
    assert "--list" in said
    assert not list(tmp_path.iterdir())


def test_a_transport_that_is_not_there_is_named(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert "socketcan" in TRANSPORTS
    arguments = ["hil", "--transport", "socketcan", "--channel", "nocan9", "--only", "stop_key", "--out", str(tmp_path)]
    code, said = run(arguments, capsys)
    assert code == 2
    assert "nocan9" in said
    assert "--transport loopback" in said
