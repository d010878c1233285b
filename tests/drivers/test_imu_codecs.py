"""Codecs of the inertial sensors: whole, byte by byte, with noise around; on CAN against a simulated sensor, too."""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dbc_imu import DBC, dbc_options
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.imu import xbus, ximu3
from drivers.imu.can_port import DbcSensor
from drivers.imu.port import LineCounts, LossCounter, StampClock, Unwrapper
from drivers.imu.xbus import Mid, Xdi
from drivers.simulated.imu.device import ImuSignal, SimulatedImu
from drivers.simulated.imu.wire import CAN_RECORD, DbcWire, Reading, Wire, XsensCanWire
from fes.config.session import ImuDevice
from fes.signals import G_MPS2, RawSample, Vector3

# counter 42581, time 5719854, then acceleration, rate and status as an MTi-300 sends them; laid out by hand
GOLDEN_DATA = bytes.fromhex(
    "102002a655 10600400 57472e 40200c bda21af8 be2a8e96 411d27a2 80200c bbb17d81 bb963200 3c01e841 e02004 00400003"
)
GOLDEN = bytes((0xFA, 0xFF, 0x36, len(GOLDEN_DATA))) + GOLDEN_DATA


def device(kind: str, **values: object) -> ImuDevice:
    base = {"sensor": "left_foot", "device": kind, "rate_hz": 100.0, "acc_range_g": 16.0, "gyr_range_dps": 2000.0}
    return ImuDevice.model_validate(base | values)


def golden() -> bytes:
    return GOLDEN + bytes((-sum(GOLDEN[1:]) % 256,))


def test_xbus_golden_measurement() -> None:
    (message,) = xbus.XbusDecoder().feed(golden())
    found = xbus.decode_measurement(message.data)
    assert (message.mid, found.counter, found.time_fine, found.status) == (Mid.MT_DATA2, 42581, 5719854, 0x00400003)
    assert found.acc_mps2 == pytest.approx((-0.07915300, -0.16655955, 9.82217598))
    assert found.gyr_radps == pytest.approx((-0.00541657, -0.00458360, 0.00792891), rel=1e-5)
    assert not found.clipped


def test_xbus_golden_commands() -> None:
    assert xbus.encode(Mid.GO_TO_CONFIG).hex() == "faff3000d1"
    assert xbus.encode(Mid.GO_TO_MEASUREMENT).hex() == "faff1000f1"
    assert xbus.encode(Mid.REQ_DID).hex() == "faff000001"
    assert xbus.output_configuration(400).hex() == "1020ffff1060ffffe020ffff4020019080200190"


def test_xbus_byte_by_byte_with_noise_around() -> None:
    decoder = xbus.XbusDecoder()
    stream = b"\x01\xfa\x02" + golden() + b"\xfa\xff" + golden() + b"\x00" + golden()
    found = [message for k in range(len(stream)) for message in decoder.feed(stream[k : k + 1])]
    assert [message.data for message in found] == [GOLDEN_DATA] * 3
    assert decoder.counts.bytes_skipped == 3 + 2 + 1


def test_xbus_wrong_checksum_costs_one_message() -> None:
    broken = bytearray(golden())
    broken[12] ^= 0x10
    decoder = xbus.XbusDecoder()
    assert len(decoder.feed(bytes(broken) + golden())) == 1
    assert decoder.counts.bad_frames >= 1


def test_xbus_extended_length() -> None:
    data = bytes(range(256)) + b"\x01"
    message = xbus.encode(Mid.MT_DATA2, data)
    assert message[3:6] == b"\xff\x01\x01"
    assert xbus.XbusDecoder().feed(message) == [xbus.XbusMessage(Mid.MT_DATA2, data)]


@pytest.mark.parametrize("number_format", [0, 1, 2, 3])
def test_xbus_number_formats(number_format: int) -> None:
    values = (-9.8125, 0.25, 1.5)
    data = xbus.block(Xdi.ACCELERATION | number_format, xbus.encode_reals(values, number_format))
    assert xbus.decode_measurement(data).acc_mps2 == values


def test_xbus_fp1632_sends_the_fraction_first() -> None:
    assert xbus.decode_reals("x", bytes.fromhex("80000000fffe"), 2, 1) == [-1.5]


def test_xbus_clipping_flag() -> None:
    for flag in (1 << 8, 1 << 13, 1 << 19):
        assert xbus.decode_measurement(xbus.block(Xdi.STATUS_WORD, struct.pack(">I", flag))).clipped


@pytest.mark.parametrize("data", [b"\x10", b"\x10\x20\x02\x00", b"\x10\x20\x01\x00", b"\x40\x20\x01\x00"])
def test_xbus_blocks_cut_off_are_rejected(data: bytes) -> None:
    with pytest.raises(xbus.XbusRejected):
        xbus.decode_measurement(data)


def test_ximu3_message_of_the_manual() -> None:
    """xioTechnologies/x-IMU3-User-Manual, Sections/communicationProtocol.tex: "Inertial message"."""
    golden = bytes.fromhex("c9 40420f0000000000" + "00" * 20 + "0000803f 0a")
    message = ximu3.Inertial(1_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert ximu3.Ximu3Decoder().feed(golden) == [message]
    assert ximu3.encode(message) == golden
    stuffed = ("4558414d504c45", "45dbdc414d504c45", "4558dbdd4d504c45", "4558414d50dbdddbdc")  # its "Byte stuffing"
    plain = ("4558414d504c45", "450a414d504c45", "4558db4d504c45", "4558414d50db0a")
    assert [ximu3.unescaped(bytes.fromhex(each)) for each in stuffed] == [bytes.fromhex(each) for each in plain]


def test_ximu3_escapes_and_noise() -> None:
    message = ximu3.Inertial(0x0ADB0A, (1.0, -2.0, 3.0), (0.0, 0.5, 1.0))
    raw = ximu3.encode(message)
    assert raw[:9].hex() == "c9dbdcdbdddbdc0000"
    decoder = ximu3.Ximu3Decoder()
    stream = b"noise\n" + raw + b'{"ping":null}\r\n' + raw[:-4] + b"\n" + raw
    assert [m for k in range(len(stream)) for m in decoder.feed(stream[k : k + 1])] == [message, message]
    assert (decoder.counts.bad_frames, decoder.counts.bytes_skipped) == (1, 6)


def test_stamps_run_over_but_restarts_stay_steps_back() -> None:
    clock = StampClock(32, 100_000)
    top = clock.time_ns(2**32 - 5)
    assert clock.time_ns(5) - top == 10 * 100_000
    assert clock.time_ns(2**32 - 2) - top == 3 * 100_000  # late, from before the turn
    other = StampClock(32, 100_000)
    assert other.time_ns(1_000_000) > other.time_ns(3)
    counter = Unwrapper(8)
    assert [counter.unwrap(raw) for raw in (254, 255, 1, 0)] == [254, 255, 257, 256]


def test_losses_by_counter_and_by_stamp() -> None:
    counts = LineCounts()
    losses = LossCounter(counts, 100.0, 16)
    for stamp_ms, counter in ((0, 65534), (10, 65535), (40, 2), (40, 2), (30, 1)):
        losses.note(stamp_ms * 1_000_000, counter)
    assert (counts.missing, counts.doubled, counts.backward) == (2, 1, 1)
    bare = LineCounts()
    losses = LossCounter(bare, 100.0)
    for stamp_ms in (0, 10, 41, 50):
        losses.note(stamp_ms * 1_000_000)
    assert bare.missing == 2


def xsens(part: DbcSensor, k: int, *, without: int = -1) -> list[RawSample]:
    frames = [
        (0x05, struct.pack(">I", 100 * k)),
        (0x32, struct.pack(">3h", 512, -1024, k)),
        (0x34, struct.pack(">3h", 256 * k, 0, 2560)),
    ]
    found = [part.receive(7, number, data) for number, data in frames if number != without]
    return [sample for sample in found if sample is not None]


def test_xsens_can_pairs_frames_of_one_sample_and_never_mixes() -> None:
    part = DbcSensor(device("xsens_can"))
    (sample,) = xsens(part, 1)
    assert sample.acc_mps2 == (1.0, 0.0, 10.0)
    assert sample.gyr_radps == (1.0, -2.0, 1 / 512)
    assert (sample.t_host_ns, sample.t_device_ns) == (7, 10_000_000)
    for lost in (0x05, 0x32, 0x34):
        assert xsens(part, 2, without=lost) == []
        (after,) = xsens(part, 3)
        assert after.acc_mps2[0] == 3.0
        assert after.gyr_radps[2] == 3 / 512
    assert part.counts.bad_frames >= 3
    assert part.receive(7, 0x34, b"\x00") is None


# --- a sensor by any DBC ------------------------------------------------------------------------------------


FLOAT_CLOCK = DBC.replace("Clock: 3", "Clock: 5").replace("0|16@1+", "0|32@1-").replace("16|8@1+", "32|8@1+")
FLOAT_CLOCK += "SIG_VALTYPE_ 400 Stamp : 1;\n"
EXTENDED = DBC.replace("BO_ 256 Acc", f"BO_ {0x80000000 + 256} Acc")
MULTIPLEXED = DBC.replace("Temperature :", "Mode M :").replace("Acc: 8 A\n SG_ X :", "Acc: 8 A\n SG_ X m1 :")
LONG = DBC.replace("400 Clock: 3", "400 Clock: 12")
vectors = st.tuples(*[st.floats(-15.0, 15.0)] * 3)


def sensor(given_options: dict[str, str | int | float | bool]) -> DbcSensor:
    values = {"sensor": "right_foot", "device": "dbc_can", "rate_hz": 100.0, "options": dict(given_options)}
    return DbcSensor(ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0}))


def frames(wire: DbcWire, reading: Reading) -> list[tuple[int, bytes]]:
    return [
        (number, data[:length])
        for record in wire.encode(reading)
        for number, length, data in CAN_RECORD.iter_unpack(record)
    ]


def sample_of(part: DbcSensor, wire: DbcWire, reading: Reading) -> RawSample | None:
    found = [part.receive(7, number, data) for number, data in frames(wire, reading)]
    assert found[:-1] == [None, None]
    return found[-1]


def test_the_bytes_are_as_the_dbc_lays_them_out(tmp_path: Path) -> None:
    reading = Reading(0x1FE, 150_000_000, (G_MPS2, -2 * G_MPS2, 0.0), (math.radians(1.0), 0.0, math.radians(-2000.0)))
    assert frames(DbcWire(dbc_options(tmp_path)), reading) == [
        (402, struct.pack("<HB", 300, 0xFE)),
        (258, struct.pack(">4h", 2048, -4096, 0, 0)),
        (302, struct.pack("<3h", 16, 0, -32000)),
    ]


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.lists(st.tuples(vectors, vectors), min_size=1, max_size=5), st.integers(0, 10**14))
def test_the_driver_reads_what_was_said(tmp_path: Path, values: list[tuple[Vector3, Vector3]], start_ns: int) -> None:
    wire, part = DbcWire(dbc_options(tmp_path)), sensor(dbc_options(tmp_path))
    stamps = []
    for number, (acc_g, gyr_radps) in enumerate(values):
        acc = (acc_g[0] * G_MPS2, acc_g[1] * G_MPS2, acc_g[2] * G_MPS2)
        sample = sample_of(part, wire, Reading(number, start_ns + number * 10_000_000, acc, gyr_radps))
        assert sample is not None
        assert sample.acc_mps2 == pytest.approx(acc, abs=0.00048828125 / 2 * G_MPS2 + 1e-9)
        assert sample.gyr_radps == pytest.approx(gyr_radps, abs=math.radians(0.0625 / 2) + 1e-9)
        stamps.append(sample.t_device_ns)
    assert all(b - a == 10_000_000 for a, b in itertools.pairwise(stamps))
    assert (part.counts.missing, part.counts.backward, part.counts.bad_values) == (0, 0, 0)


def test_without_time_the_counter_gives_the_stamps(tmp_path: Path) -> None:
    options = dbc_options(tmp_path, time="")
    wire, part = DbcWire(options), sensor(options)
    stamps = []
    for number in (254, 255, 258):
        sample = sample_of(part, wire, Reading(number, 0, (G_MPS2, 0.0, -G_MPS2), (math.radians(90.0), 0.0, 0.0)))
        assert sample is not None
        assert (sample.acc_mps2, sample.gyr_radps) == ((G_MPS2, 0.0, -G_MPS2), (math.radians(90.0), 0.0, 0.0))
        stamps.append(sample.t_device_ns)
    assert [b - a for a, b in itertools.pairwise(stamps)] == [10_000_000, 30_000_000]
    assert part.counts.missing == 2


def test_its_clock_and_its_counter_run_over_unseen(tmp_path: Path) -> None:
    wire, part = DbcWire(dbc_options(tmp_path)), sensor(dbc_options(tmp_path))
    stamps = []
    for number in range(4500):  # 45 s; the clock turns after 32.768 s
        sample = sample_of(part, wire, Reading(number, number * 10_000_000, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        assert sample is not None
        stamps.append(sample.t_device_ns)
    assert {b - a for a, b in itertools.pairwise(stamps)} == {10_000_000}
    assert (part.counts.missing, part.counts.backward, part.counts.doubled) == (0, 0, 0)


FLOAT_DBC = """VERSION ""
BU_: A
BO_ 300 Gyr: 8 A
 SG_ X : 0|32@1- (1,0) [0|0] "rad/s" A
 SG_ Y : 32|32@1- (1,0) [0|0] "rad/s" A
BO_ 256 Acc: 8 A
 SG_ X : 0|32@1- (1,0) [0|0] "m/s2" A
 SG_ Y : 32|32@1- (1,0) [0|0] "m/s2" A
BO_ 257 Rest: 8 A
 SG_ AccZ : 0|32@1- (1,0) [0|0] "m/s2" A
 SG_ GyrZ : 32|32@1- (1,0) [0|0] "rad/s" A
BO_ 400 Clock: 3 A
 SG_ Stamp : 0|16@1+ (0.5,-100) [0|0] "ms" A
 SG_ Count : 16|8@1+ (1,0) [0|0] "" A
SIG_VALTYPE_ 300 X : 1;
SIG_VALTYPE_ 300 Y : 1;
SIG_VALTYPE_ 256 X : 1;
SIG_VALTYPE_ 256 Y : 1;
SIG_VALTYPE_ 257 AccZ : 1;
SIG_VALTYPE_ 257 GyrZ : 1;
"""
IN_FLOATS = {"acc_z": "Rest.AccZ", "gyr_z": "Rest.GyrZ", "acc_unit": "m/s2", "gyr_unit": "rad/s"}


def at_rest(wire: Wire) -> SimulatedImu:
    return SimulatedImu(wire, ImuSignal(100.0, np.array([[0.0, 0.0, 9.8]]), np.zeros((1, 3))), 0)


def test_a_sensor_of_whole_numbers_has_no_nan_and_says_so(tmp_path: Path) -> None:
    for wire in (DbcWire(dbc_options(tmp_path)), XsensCanWire()):
        imu = at_rest(wire)
        for name in ("nan", "inf"):
            with pytest.raises(ValueError, match=rf"fault '{name}' does not exist here: .*full .*mute"):
                imu.set_fault(0, name, 3.0)
            imu.set_fault(0, name, 0.0)  # ended is ended
        imu.set_fault(0, "full", 1.0)
        assert imu.advance(0)


@pytest.mark.parametrize("bad", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -math.inf)])
def test_no_number_stands_for_what_is_none(tmp_path: Path, bad: Vector3) -> None:
    good: Vector3 = (0.0, 0.0, 0.0)
    for wire in (DbcWire(dbc_options(tmp_path)), XsensCanWire()):
        assert wire.encode(Reading(0, 0, bad, good)) == wire.encode(Reading(0, 0, good, bad)) == []
        assert wire.encode(Reading(0, 0, good, good))


@pytest.mark.parametrize("name", ["nan", "inf"])
def test_a_sensor_of_floating_point_has_both(tmp_path: Path, name: str) -> None:
    options = dbc_options(tmp_path, FLOAT_DBC, **IN_FLOATS)
    wire, part = DbcWire(options), sensor(options)
    assert wire.carries_nan
    imu = at_rest(wire)
    imu.set_fault(0, name, 1.0)
    found = []
    for record in imu.advance(10_000_000):
        identifier, length, data = CAN_RECORD.unpack(record)
        found.append(part.receive(0, identifier, data[:length]))
    spoilt, whole = [sample for sample in found if sample is not None]
    assert math.isnan(spoilt.acc_mps2[0])
    assert whole.acc_mps2 == pytest.approx((0.0, 0.0, 9.8))
    assert part.counts.bad_values == 1


@pytest.mark.parametrize("value", [1e9, -1e9])
def test_what_no_signal_can_carry_is_refused_by_the_driver(tmp_path: Path, value: float) -> None:
    wide = DBC.replace("0.00048828125", "0.01")  # ± 327 g, far beyond the sensor's range
    wire, part = DbcWire(dbc_options(tmp_path, wide)), sensor(dbc_options(tmp_path, wide))
    sample = sample_of(part, wire, Reading(0, 0, (value, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert sample is not None
    assert math.isnan(sample.acc_mps2[0])
    assert part.counts.bad_values == 1


@pytest.mark.parametrize(
    ("change", "text", "said"),
    [
        ({"acc_x": "Acc.Nope"}, DBC, "acc_x"),
        ({"gyr_z": ""}, DBC, "gyr_z"),
        ({"time": "", "counter": ""}, DBC, "time or counter"),
        ({"acc_unit": "feet"}, DBC, "feet"),
        ({"id_offset": 2000}, DBC, "id_offset"),
        ({"id_offset": 1.5}, DBC, "id_offset = 1.5 must be a whole number"),
        ({}, "nonsense", "cannot be read"),
        ({"dbc": "/nowhere.dbc"}, DBC, "nowhere"),
        ({}, LONG, "12 bytes"),
    ],
)
@pytest.mark.parametrize("reader", [DbcWire, sensor])
def test_the_option_that_does_not_fit_is_named(
    tmp_path: Path,
    reader: Callable[[dict[str, str | int | float | bool]], object],
    change: dict[str, str | float],
    text: str,
    said: str,
) -> None:
    with pytest.raises(ValueError, match=said):
        reader(dbc_options(tmp_path, text, **change))


@pytest.mark.parametrize(
    ("text", "said"), [(FLOAT_CLOCK, "integer"), (EXTENDED, "29 bit"), (MULTIPLEXED, "multiplexed")]
)
def test_a_dbc_that_gives_no_samples_is_refused_at_once(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        sensor(dbc_options(tmp_path, text))


def test_a_dbc_by_which_nothing_can_be_sent_is_refused_at_once(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be sent"):
        DbcWire(dbc_options(tmp_path, MULTIPLEXED))
