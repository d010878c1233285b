"""The fault campaign's judge, table and tools, without any process."""

from __future__ import annotations

import json
import math
import socket
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.stimulator.can_codec import COMMAND_ID, FrameRejected, decode, encode_command
from drivers.stimulator.can_port import CanStimulator
from drivers.virtual.can_node import NodeLoop
from drivers.virtual.node_clock import RealClock
from drivers.virtual.node_record import RecordEntry, RecordWriter
from drivers.virtual.rogue import flipped, random_frames
from drivers.virtual.slcan import SlcanDecoder, encode_frame
from drivers.virtual.stimulator_node import StimulatorNode
from fes.cli import main
from fes.config import Bus, StimulatorDevice, load_session
from fes.hil.baseline import Lateness
from fes.hil.control import ScriptedOperator
from fes.hil.devices import TRANSPORTS, point
from fes.hil.injections import INJECTIONS
from fes.hil.judge import MS, began_after, off_after_ms, on_at, outputs
from fes.hil.results import Attempt, Campaign, Row, Verdict
from fes.hil.scenarios import BY_NAME, SCENARIOS, Effect
from fes.hil.settings import CURRENT_MA, INTENSITY, session_text
from fes.live.status import Status
from fes.signals import StimCommand


def can_entry(t_ms: float, event: str, current_ma: float = 0.0, pulses: int = 0, channel: int = 0) -> RecordEntry:
    t_ns = int(t_ms * MS)
    return RecordEntry(t_ns, event, channel, current_ma, 300.0, 40.0, t_ns, pulses, t_ns)


def pulse_entry(t_ms: float) -> RecordEntry:
    return RecordEntry(int(t_ms * MS), "pulse", 0, 20.0, 300.0, 0.0, int(t_ms * MS), 1, int(t_ms * MS))


BURST = [
    can_entry(100, "on", 5.0, 1),
    can_entry(150, "level", 20.0, 3),
    can_entry(400, "off", 0.0, 13),
]


def test_a_burst_by_its_levels() -> None:
    (output,) = outputs(BURST, 1000 * MS)
    assert (output.on_ns, output.off_ns, output.ended_by) == (100 * MS, 400 * MS, "off")
    assert output.charge_uc == pytest.approx(2 * 5.0 * 0.3 + 10 * 20.0 * 0.3)
    assert on_at([output], 99 * MS) is None
    assert on_at([output], 250 * MS) is output
    assert off_after_ms([output], 250 * MS) == 150.0
    assert off_after_ms([output], 500 * MS) == 0.0


@pytest.mark.parametrize("event", ["lease_expired", "on_time", "fault"])
def test_whatever_ends_it_is_an_end(event: str) -> None:
    assert off_after_ms(outputs([*BURST[:2], can_entry(300, event)], 1000 * MS), 250 * MS) == 50.0


def test_a_restart_ends_every_channel() -> None:
    entries = [can_entry(100, "on", 5.0), can_entry(110, "on", 5.0, channel=3), can_entry(200, "boot", channel=-1)]
    assert [output.off_ns for output in outputs(entries, 1000 * MS)] == [200 * MS, 200 * MS]


def test_current_that_does_not_end_or_comes_back_is_no_time() -> None:
    assert math.isinf(off_after_ms(outputs(BURST[:2], 1000 * MS), 250 * MS))
    again = [*BURST, can_entry(900, "on", 5.0), can_entry(1100, "off")]
    assert off_after_ms(outputs(again, 2000 * MS), 250 * MS) == 850.0
    assert began_after(outputs(again, 2000 * MS), 250 * MS) == 1


def test_a_train_of_pulses_ends_with_its_last() -> None:
    entries = [pulse_entry(t) for t in (100, 125, 150, 900, 925)]
    first, second = outputs(entries, 1000 * MS)
    assert (first.on_ns, first.off_ns, first.pulses) == (100 * MS, 150 * MS, 3)
    assert first.charge_uc == pytest.approx(18.0)
    assert on_at([first], 160 * MS) is first  # the next pulse was due at 175
    assert on_at([first], 250 * MS) is None
    assert second.off_ns is None  # another pulse may be due
    assert outputs(entries, 1200 * MS)[1].off_ns == 925 * MS


@given(st.lists(st.integers(1, 3000), min_size=1, max_size=40, unique=True), st.integers(0, 3000))
def test_off_is_never_before_the_last_pulse(times: list[int], fault_ms: int) -> None:
    stretches = outputs([pulse_entry(t) for t in sorted(times)], 10_000 * MS)
    assert off_after_ms(stretches, fault_ms * MS) == max(0, max(times) - fault_ms)


# --- the table -------------------------------------------------------------------------------------------


def test_every_row_can_be_brought_about_and_every_injection_has_a_row() -> None:
    assert set(INJECTIONS) == set(BY_NAME)
    assert len(BY_NAME) == len(SCENARIOS)


def test_what_must_go_off_has_a_deadline() -> None:
    for scenario in SCENARIOS:
        if scenario.effect in (Effect.LATCHED, Effect.ENDED):
            assert scenario.deadline_ms, scenario.name


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


@pytest.mark.parametrize("variant", ["", "stance", "dose", "view"])
def test_its_sessions_can_be_run(tmp_path: Path, variant: str) -> None:
    path = tmp_path / "session.toml"
    bus = Bus(interface="slcan", channel="/dev/x", options={"bitrate": 500000, "timeout": 0})
    path.write_text(session_text(variant, "/dev/sensor", bus, StimulatorDevice()))
    session = load_session(path)
    assert session.bus == bus
    assert session.stimulation.intensity * session.channels[0].current_ma == CURRENT_MA * INTENSITY
    assert session.channels[0].start_phase == ("stance" if variant == "stance" else "swing")
    serial = StimulatorDevice.model_validate({"device": "rehastim2", "port": "/dev/y"})
    path.write_text(session_text(variant, "/dev/sensor", None, serial))
    assert load_session(path).stimulator == serial


def test_the_scripted_operator_orders_and_listens(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as session:
        session.bind(str(tmp_path / "session"))
        operator = ScriptedOperator(tmp_path / "session", tmp_path / "me")
        operator.order("arm")
        asked, sender = session.recvfrom(1024)
        assert json.loads(asked) == {"ask": "arm", "value": 0.0, "confirm": True}
        session.sendto(b'{"ok":false,"why":"no"}', sender)
        session.sendto(Status(5, "armed").encode(), sender)
        session.sendto(b"noise", sender)
        status = operator.listen()
        assert status is not None
        assert status.state == "armed"
        assert operator.refusals == ["no"]
        operator.close()
    assert not (tmp_path / "me").exists()


def test_a_name_that_stays_when_what_is_behind_it_changes(tmp_path: Path) -> None:
    for target in ("one", "two"):
        (tmp_path / target).write_text(target)
        point(tmp_path / "name", str(tmp_path / target))
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
    loop = NodeLoop(StimulatorNode(1, 0), can.Bus(interface="virtual"), RecordWriter(None), [], RealClock())
    loop._fault("mute", 1.0)
    with pytest.raises(ValueError):
        loop._fault("mute", -1.0)


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
