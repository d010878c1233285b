"""A simulated sensor by a DBC against the driver's decoder, and the DBCs that no sample can be made of."""

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

from drivers.imu.can_port import DbcSensor
from drivers.simulated.imu.device import ImuSignal, SimulatedImu
from drivers.simulated.imu.wire import CAN_RECORD, DbcWire, Reading, Wire, XsensCanWire
from fes.config.session import ImuDevice
from fes.signals import G_MPS2, RawSample, Vector3

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
