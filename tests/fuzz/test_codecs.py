"""Every codec and reader on spoiled input: the error it declares or a sound value, never a crash, never a hang.

What a codec accepts must pass its check by another way than the codec's own: the frame made anew from what it read
stands in the input, byte for byte. 3,000 inputs a codec in ``make test``, a million in all in ``make nightly``.
"""

from __future__ import annotations

import contextlib
import math
import random
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest
from examples import examples
from spoiled import no_longer_than, spoiled
from test_can_port import Bench as CanBench
from test_can_port import command as can_command
from test_sciencemode_ports import KINDS, MS, Bench, command

from drivers.imu import capture2go_codec as c2g
from drivers.imu import witmotion, xbus, ximu3
from drivers.imu.can_port import DbcSensor
from drivers.stimulator import can_codec, canopen_port
from drivers.stimulator import p24_port as sm4
from drivers.stimulator import rehastim2_port as sm2
from drivers.stimulator.can_codec import Alive, Charge, Command, Frame, Result, SessionOpen, Status
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.sciencemode import Packet
from fes.config import ImuDevice
from fes.recording import RecordingError, read_recording, write_recording
from fes.session_log import SessionLogError, SessionWriter, read_session
from fes.session_log.codec import decode as decode_record
from fes.session_log.codec import encode as encode_record
from fes.session_log.framing import MAGIC, RecordType, framed
from fes.session_log.reader import iter_events
from fes.signals import (
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    StrideResult,
    SystemFault,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange, Transition

Try = Callable[[bytes], int]  # how many values one input gave
TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
ON = StimCommand(5, 1, True, 20.0, 300.0, 40.0, 60)


def crc_by_division(data: bytes) -> int:
    """CRC-8H2F bit by bit, sharing nothing with the codec's table."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ 0xFF


# --- frames on CAN ------------------------------------------------------------------------------------------

CAN_FRAMES = [
    can_codec.encode_command(ON, 3, 0x1234),
    can_codec.encode_command(StimCommand(0, 7, False, 0, 0, 0, 60), 15, 9),
    can_codec.encode_open(77, 0x1234),
    can_codec.encode(Status(3, 0x1234, 1, True, 20.0, 300.0, 40.0, Result.OK)),
    can_codec.encode(Charge(3, 0x1234, 1, 9, 4000)),
    can_codec.encode(Alive(3, 1, 77, 0x1234, 0, 0)),
]


def named(identifier: int, data: bytes) -> bytes:
    """Identifier and data in one, so that both get spoiled."""
    return identifier.to_bytes(2, "big") + data


def again(message: Command | Status | Charge | Alive | SessionOpen) -> tuple[int, bytes]:
    match message:
        case Command():
            levels = (message.current_ma, message.pulse_width_us, message.frequency_hz)
            issued_ns = message.issued_ms * 1_000_000
            command = StimCommand(issued_ns, message.channel, message.on, *levels, 60)
            return can_codec.encode_command(command, message.counter, message.session_id)
        case SessionOpen():
            return can_codec.encode(message)
    return can_codec.encode(message)


def can_frame(data: bytes) -> int:
    identifier, payload = int.from_bytes(data[:2], "big"), data[2:]
    try:
        message = can_codec.decode(identifier, payload)
    except can_codec.FrameRejected:
        return 0
    assert len(payload) == 8
    assert payload[0] == crc_by_division(payload[1:] + data[:2])
    off_with_levels = isinstance(message, Command) and not message.on
    no_session = isinstance(message, (Command, SessionOpen)) and message.session_id == 0
    assert off_with_levels or no_session or again(message) == (identifier, payload)
    return 1


OPEN_NODE = canopen_port.CanOpenSettings(5, 0x2000, 0x2001, 0.5, 1.0, 130.0, 500.0)
OPEN_SDO = OPEN_NODE.sdo(0, 1, 40)
OPEN_ANSWERS = [
    named(0x585, struct.pack("<BHBI", 0x60, 0x2000, 2, 0)),
    named(0x585, struct.pack("<BHBI", 0x80, 0x2000, 2, 0x06090030)),
]


def canopen_answer(data: bytes) -> int:
    message = can.Message(arbitration_id=int.from_bytes(data[:2], "big"), data=data[2:10], is_extended_id=False)
    if not OPEN_NODE.answers(OPEN_SDO, message):
        return 0
    assert data[:2] == b"\x05\x85"
    assert data[3:6] == b"\x00\x20\x02"
    assert bool(OPEN_NODE.refusal(message)) is (data[2] == 0x80)
    return 1


XSENS = ImuDevice(sensor="left_foot", device="xsens_can", rate_hz=100.0, acc_range_g=16.0, gyr_range_dps=2000.0)
XSENS_PART = DbcSensor(XSENS)
XSENS_FRAMES = [named(number, bytes(range(8))) for number in sorted(XSENS_PART.identifiers)]


def xsens_frame(data: bytes) -> int:
    numbers = sorted(XSENS_PART.identifiers)
    identifier = numbers[int.from_bytes(data[:2], "big") % len(numbers)]
    sample = XSENS_PART.receive(0, identifier, data[2:])
    if sample is None:
        return 0
    assert math.isnan(sample.acc_mps2[0]) or max(map(abs, sample.acc_mps2)) <= 16 * 9.81 * 1.06
    return 1


# --- frames on serial lines ---------------------------------------------------------------------------------

SM4_STREAM = [
    sm4.encode(sm4.low_pulse(3, 1, sm4.biphasic(20.0, 300.0))),
    sm4.encode(Packet(4, sm4.Code.LOW_PULSE + 1, b"\0\1\2")) + sm4.encode(Packet(5, sm4.Code.LOW_INIT, b"\0")),
    sm4.encode(sm4.mid_update(9, {2: sm4.Train(sm4.biphasic(10.0, 200.0), 50, 3)})),
]
SM2_STREAM = [sm2.encode(Packet(7, 30, bytes(range(20)))) + sm2.encode(Packet(8, 31, b"\xf0\x0f\x81")), b"\xf0" * 9]
XBUS_STREAM = [
    xbus.encode(0x36, xbus.block(0x4020, struct.pack(">3f", 1, 2, 3)) + xbus.block(0x1020, b"\0\1")),
    xbus.encode(0x3E) + xbus.encode(0x42, b"text"),
]


def science_mode_4(data: bytes) -> int:
    decoder = sm4.Decoder()
    packets = decoder.feed(data)
    assert all(sm4.encode(packet) in data for packet in packets)
    assert len(decoder._buffer) <= decoder.max_length
    return len(packets)


def science_mode_2(data: bytes) -> int:
    decoder = sm2.Decoder()
    packets = decoder.feed(data)
    assert all(sm2.encode(packet) in data for packet in packets)
    assert len(decoder._buffer) <= decoder.max_length
    return len(packets)


def xbus_stream(data: bytes) -> int:
    messages = xbus.XbusDecoder().feed(data)
    for message in messages:
        short = xbus.encode(message.mid, message.data)
        body = bytes((xbus.BUS_ID, message.mid, 0xFF)) + len(message.data).to_bytes(2, "big") + message.data
        extended = bytes((0xFA,)) + body + bytes((-sum(body) % 256,))
        assert short in data or extended in data
        with contextlib.suppress(xbus.XbusRejected):
            xbus.decode_measurement(message.data)
    return len(messages)


def xbus_measurement(data: bytes) -> int:
    try:
        found = xbus.decode_measurement(data)
    except xbus.XbusRejected:
        return 0
    assert found.counter is None or found.counter.to_bytes(2, "big") in data
    return 1


def ximu3_stream(data: bytes) -> int:
    """Its protocol has no check: what counts is that only whole lines become samples."""
    found = ximu3.Ximu3Decoder().feed(data)
    assert len(found) <= data.count(b"\n")
    for message in found:
        if not any(map(math.isnan, message.gyr_dps + message.acc_g)):
            assert ximu3.encode(message)[:-1] in data
    return len(found)


C2G_STREAM = [
    c2g.pack(c2g.Header.DATA_FULL_6D_FIXED_100HZ, {"timestamp": 7, "gyr": (1, 2, 3)})
    + c2g.pack(c2g.Header.DATA_STATUS),
    c2g.pack(c2g.Header.DATA_FULL_PACKED_200HZ) + b"\x02" * 9 + c2g.pack(c2g.Header.ERROR, {"command": 0x0150}),
]


def capture2go_stream(data: bytes) -> int:
    packages = c2g.Capture2GoDecoder().feed(data)
    for package in packages:
        assert c2g.encode(package.header, package.payload) in data
        c2g.unpack(package)
        c2g.samples(package)
    return len(packages)


WITMOTION_STREAM = [
    bytes.fromhex("5550000000000528950168 55510c0093026d08b7077a 5552000000000000b70765") * 2,
    bytes.fromhex("555f0700090006001400de"),
]


def witmotion_stream(data: bytes) -> int:
    decoder = witmotion.WitmotionDecoder()
    found = decoder.feed(data)
    assert decoder.counts.bytes_skipped <= len(data) - 11 * len(found)
    return len(found)


# --- the session log's records ------------------------------------------------------------------------------

RECORDS = [
    encode_record(value)
    for value in (
        Tick(1),
        OperatorAct(1, OperatorAction.ARM, 0.5),
        StimStatus(1, 2, 3, True, 20.0, 300.0, 40.0, 5, 6.0, "electrode"),
        StimAlive(1, 77, 3, "voltage"),
        StimOpened(1, 99),
        FootSwitchEvent(1, "left_foot", True),
        FootSwitchEvent(1, "left_foot", None),
        SystemFault(1, "stalled"),
        ON,
        WireFrame(1, 0x120, b"12345678"),
        PhaseChange(1, "left_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING),
        StrideResult("left_foot", 1, 0, 9, 1.0, 0.1, 0.0, 0.0, 1.0, 1, 2, 3, 4),
    )
]
DECLARED = (
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
)  # what fes.session_log.codec.decode says it raises


def record(data: bytes) -> int:
    """One record's payload, behind its type."""
    if not data:
        return 0
    try:
        decode_record(data[0] % 18, memoryview(data[1:]))
    except DECLARED:
        return 0
    return 1


@dataclass(frozen=True)
class Codec:
    """A codec, inputs to spoil, and its share of the nightly million."""

    name: str
    seeds: Sequence[bytes]
    one: Try
    nightly: int


CODECS = (
    Codec("stimulator on CAN", [named(*frame) for frame in CAN_FRAMES], can_frame, 250_000),
    Codec("CANopen answers", OPEN_ANSWERS, canopen_answer, 80_000),
    Codec("ScienceMode4", SM4_STREAM, science_mode_4, 150_000),
    Codec("ScienceMode2", SM2_STREAM, science_mode_2, 120_000),
    Codec("Xbus", XBUS_STREAM, xbus_stream, 120_000),
    Codec("Xbus measurements", [stream[4:-1] for stream in XBUS_STREAM[:1]], xbus_measurement, 80_000),
    Codec("x-IMU3", [ximu3.encode(ximu3.Inertial(5, (1, 2, 3), (0, 0, 1))) * 3], ximu3_stream, 80_000),
    Codec("Capture2Go", C2G_STREAM, capture2go_stream, 80_000),
    Codec("WitMotion", WITMOTION_STREAM, witmotion_stream, 80_000),
    Codec("IMU on CAN", XSENS_FRAMES, xsens_frame, 60_000),
    Codec("log records", [bytes((kind,)) + payload for kind, payload in RECORDS], record, 60_000),
)


@pytest.mark.requirement("SR-15")
@pytest.mark.parametrize("codec", CODECS, ids=lambda codec: codec.name.replace(" ", "-"))
def test_spoiled_bytes(codec: Codec, capsys: pytest.CaptureFixture[str]) -> None:
    count = examples(3_000, codec.nightly)
    with no_longer_than(examples(60, 1800)):
        accepted = sum(codec.one(data) for data in spoiled(codec.seeds, count, seed=len(codec.name)))
    assert sum(codec.one(data) for data in codec.seeds) > 0, "the seeds themselves are read"
    with capsys.disabled():
        print(f"\n{codec.name}: {count} spoiled inputs, {accepted} values accepted, each behind a good check")


# --- files --------------------------------------------------------------------------------------------------


def a_log(folder: Path) -> bytes:
    path = folder / "good.feslog"
    writer = SessionWriter(path, {"name": "x", "started": "now"})
    for k in range(20):
        t_ns = k * 10_000_000
        writer.event(ImuSample(t_ns, "left_foot", t_ns, (0.1, 0.2, 9.8 + 1e-3 * k), (0.0, 0.1, 0.2)))
    for value in (Tick(1), StimAlive(1, 77, 3), SystemFault(1, "stalled")):
        writer.event(value)
    writer.close({"strides": 3})
    return path.read_bytes()


def refitted(data: bytes, chance: random.Random) -> bytes:
    """Records cut out of the bytes at random and framed anew with a good checksum: damage that the checksum misses."""
    parts = [bytes(data[at : at + 40]) for at in range(len(MAGIC), len(data), 40)]
    kinds = [RecordType.HEADER] + [chance.choice(list(RecordType)) for _ in parts]
    bodies = [
        chance.choice((b'{"name":"x"}', b"[1]", b"{", b"[" * 100_000)) if chance.random() < 0.5 else b"{}",
        *parts,
    ]
    return MAGIC + b"".join(framed(kind, body) for kind, body in zip(kinds, bodies, strict=True))


@pytest.mark.requirement("SR-15")
def test_spoiled_session_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, path, chance = a_log(tmp_path), tmp_path / "spoiled.feslog", random.Random(7)
    count, read = examples(300, 20_000), 0
    for number, data in enumerate(spoiled([good], count, seed=7, most=1 << 16)):
        path.write_bytes(refitted(data, chance) if number % 3 == 0 else data)
        with contextlib.suppress(SessionLogError), no_longer_than(10):
            read_session(path)
            read += 1
        with contextlib.suppress(SessionLogError), no_longer_than(10):
            for _ in iter_events(path):
                pass
    with capsys.disabled():
        print(f"\nsession logs: {count} spoiled files, {read} read up to their damage")


def recordings(folder: Path) -> list[Path]:
    """Half a second of walking as CSV and Parquet, and CAN logs in three formats."""
    from test_recording_can import log

    rows = (TRIALS / "example_csv.csv").read_text().splitlines()[:120]
    table = folder / "walk.csv"
    table.write_text("\n".join(rows) + "\n")
    table.with_suffix(".toml").write_text((TRIALS / "example_csv.toml").read_text())
    write_recording(read_recording(table), folder / "table.parquet")
    paths = [table, folder / "table.parquet"]
    for suffix in (".asc", ".blf", ".log"):
        (folder / suffix[1:]).mkdir()
        paths.append(log(folder / suffix[1:], suffix))
    for path in paths:
        read_recording(path)
    return paths


@pytest.mark.requirement("SR-15")
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("suffix", [".csv", ".parquet", ".asc", ".blf", ".log", ".toml"])
def test_spoiled_recordings(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = {path.suffix: path for path in recordings(tmp_path)}
    path = paths.get(suffix, paths[".csv"])
    spoil = path.with_suffix(suffix)
    good = spoil.read_bytes()
    count, read = examples(60, 1_500), 0
    for data in spoiled([good], count, seed=11, most=1 << 20):
        spoil.write_bytes(data)
        with contextlib.suppress(RecordingError), no_longer_than(20):
            recording = read_recording(path)
            read += 1
            for track in recording.tracks.values():
                assert all(map(math.isfinite, (*track.acc_mps2.ravel().tolist(), *track.gyr_radps.ravel().tolist())))
    with capsys.disabled():
        print(f"\nrecordings ({suffix}): {count} spoiled files, {read} read, the rest named their fault")


# --- Stimulator ports hear intact messages that make no sense: they report faults, or that the device is lost ---


class Chatty:
    """A line on which, beside the device, somebody says anything that is well framed."""

    def __init__(self, line: Any, encode: Callable[[Packet], bytes], numbers: int, chance: random.Random) -> None:
        self._line, self._encode, self._numbers, self._chance = line, encode, numbers, chance

    def __getattr__(self, name: str) -> Any:
        return getattr(self._line, name)

    def read(self) -> bytes:
        """What the device sent, and now and then something else before it or instead."""
        heard: bytes = self._line.read()
        if self._chance.random() > 0.1:
            return heard
        number, kind = self._chance.randrange(self._numbers), self._chance.randrange(70)
        said = self._encode(Packet(number, kind, self._chance.randbytes(self._chance.randrange(12))))
        return said if self._chance.random() < 0.2 else said + heard


@pytest.mark.requirement("SR-15")
@pytest.mark.parametrize("kind", KINDS)
def test_well_framed_nonsense(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    chance = random.Random(5)
    encode, numbers = (sm2.encode, 256) if kind == "rehastim2" else (sm4.encode, 64)
    sessions, lost, faults = examples(15, 1_500), 0, 0
    for _ in range(sessions):
        bench = Bench(kind)
        line: Any = Chatty(bench.line, encode, numbers, chance)
        bench.port._line = line
        try:
            with no_longer_than(20):
                for _ in range(25):
                    bench._turn((command(bench.t_ns, on=chance.random() < 0.8),), 20)
        except StimulatorLost:
            lost += 1
        faults += bool(bench.faults)
        for status in bench.statuses:
            assert status.channel == 1
            assert 0.0 <= status.current_ma <= 20.0
            assert 0.0 <= status.charge_uc <= status.pulses * 20.0 * 0.3 + 1e-9
    assert faults > 0
    with capsys.disabled():
        print(f"\n{kind}: {sessions} sessions of half a second with nonsense, {faults} noticed, {lost} ended")


def nonsense(chance: random.Random) -> Frame:
    """An intact frame of the node's with anything in it, half of the time of the open session."""
    session_id = chance.choice((0x1234, chance.randrange(65_536)))
    counter, channel = chance.randrange(16), chance.choice((1, chance.randrange(8)))
    match chance.randrange(3):
        case 0:
            levels = (chance.randrange(512) * 0.5 % 255, float(chance.randrange(512)), float(chance.randrange(128)))
            on = chance.random() < 0.5
            return can_codec.encode(Status(counter, session_id, channel, on, *levels, chance.choice(list(Result))))
        case 1:
            total = chance.randrange(can_codec.CHARGE_TOTAL_STEPS)
            return can_codec.encode(Charge(counter, session_id, channel, chance.randrange(256), total))
        case _:
            boot_id, flags = chance.choice((77, chance.randrange(65_536))), chance.choice((0, chance.randrange(256)))
            return can_codec.encode(Alive(counter, 1, boot_id, session_id, chance.randrange(256), flags))


@pytest.mark.requirement("SR-15")
def test_intact_nonsense_on_can(capsys: pytest.CaptureFixture[str]) -> None:
    chance = random.Random(6)
    sessions, lost, faults = examples(10, 1_000), 0, 0
    for number in range(sessions):
        bench = CanBench(name=f"nonsense {number}")
        try:
            bench.port.open(0, clock_ns=bench.clock)
            with no_longer_than(20):
                for _ in range(25):
                    bench.port.send(can_command(on=chance.random() < 0.8))
                    bench.turn(bench.t_ns + 20 * MS)
                    if chance.random() < 0.5:
                        identifier, data = nonsense(chance)
                        bench.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
                    for event in bench.port.poll(bench.t_ns):
                        faults += bool(event.fault)
        except StimulatorLost:
            lost += 1
        finally:
            bench.close()
    assert faults > 0
    with capsys.disabled():
        print(f"\nCAN: {sessions} sessions of half a second with nonsense, {faults} faults told, {lost} sessions ended")
