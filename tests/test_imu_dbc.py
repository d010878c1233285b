"""A simulated sensor by a DBC against the driver's decoder, and the DBCs that no sample can be made of."""

from __future__ import annotations

import itertools
import math
import struct
from pathlib import Path

import pytest
from dbc_imu import DBC, dbc_options
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.imu.can_codec import DbcSensor
from drivers.imu.port import RawSample
from drivers.virtual.imu_dbc import DbcWire, Options
from drivers.virtual.imu_wire import CAN_RECORD, Reading
from fes.config.devices import ImuDevice
from fes.signals import G_MPS2, Vector3

FLOAT_CLOCK = DBC.replace("Clock: 3", "Clock: 5").replace("0|16@1+", "0|32@1-").replace("16|8@1+", "32|8@1+")
FLOAT_CLOCK += "SIG_VALTYPE_ 400 Stamp : 1;\n"
EXTENDED = DBC.replace("BO_ 256 Acc", f"BO_ {0x80000000 + 256} Acc")
MULTIPLEXED = DBC.replace("Temperature :", "Mode M :").replace("Acc: 8 A\n SG_ X :", "Acc: 8 A\n SG_ X m1 :")
LONG = DBC.replace("400 Clock: 3", "400 Clock: 12")
vectors = st.tuples(*[st.floats(-15.0, 15.0)] * 3)


def sensor(given_options: Options) -> DbcSensor:
    values = {"sensor": "right_foot", "device": "dbc_can", "rate_hz": 100.0, "options": dict(given_options)}
    return DbcSensor(ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0}))


def frames(wire: DbcWire, reading: Reading) -> list[tuple[int, bytes]]:
    return [
        (number, data[:length]) for record in wire.say(reading) for number, length, data in [CAN_RECORD.unpack(record)]
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


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e9])
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
        ({}, "nonsense", "cannot be read"),
        ({}, LONG, "12 bytes"),
        ({}, MULTIPLEXED, "cannot be sent"),
    ],
)
def test_a_simulated_sensor_names_the_option_that_does_not_fit(
    tmp_path: Path, change: dict[str, str | int], text: str, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        DbcWire(dbc_options(tmp_path, text, **change))


@pytest.mark.parametrize(
    ("text", "said"), [(FLOAT_CLOCK, "integer"), (EXTENDED, "29 bit"), (MULTIPLEXED, "multiplexed"), (LONG, "12 bytes")]
)
def test_a_dbc_that_gives_no_samples_is_refused_at_once(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        sensor(dbc_options(tmp_path, text))
