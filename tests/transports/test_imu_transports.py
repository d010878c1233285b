"""Simulated inertial sensors in processes of their own, over real pseudo-terminals, sockets, a CAN bus and LSL."""

from __future__ import annotations

import itertools
import math
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import can
import pytest
from dbc_imu import dbc_options
from imu_reading import Taken, collect, collect_samples, collect_until, settings, until_lost

from drivers.imu.line import READS_AT_MOST, ByteLine
from drivers.imu.open import open_imus
from drivers.imu.port import ImuLost
from drivers.simulated.imu.device import walking_signal
from drivers.simulated.spawn import ImuKind, free_bus, spawn_imu, why_silent
from drivers.stimulator.bus import open_bus
from fes.control.clock_sync import SensorClock
from fes.live.source import SensorStream
from fes.signals import G_MPS2, NS_PER_S, Event, ImuSample, SystemFault

CLOCK_NS = 500_000  # two clocks 80 ppm apart for 3 s, and a stamp's steps of 0.1 ms
SETTLE_NS = 2 * NS_PER_S
TICK_NS = 500_000  # of the stamps that the DBC here describes
NO_BUS = why_silent(free_bus())


@pytest.mark.requirement("SR-28")
def test_an_mti_tells_its_serial_number() -> None:
    with spawn_imu("xbus", serial="037012AB") as imu:
        (port,) = open_imus([settings("xbus", imu.port)])
        assert port.serials == {"right_foot": "037012AB"}
        port.close()


def test_two_sensors_at_500_hz_lose_nothing_and_keep_their_own_clocks() -> None:
    with (
        spawn_imu("xbus", sensor="left_foot", rate_hz=500, offset_s=1000.0, drift_ppm=80) as left,
        spawn_imu("ximu3", sensor="right_foot", rate_hz=500, offset_s=5.0, drift_ppm=-80) as right,
    ):
        ports = open_imus(
            [
                settings("xbus", left.port, "left_foot", 500.0, baudrate=921600),
                settings("ximu3", right.port, "right_foot", 500.0),
            ]
        )
        found = collect_samples(ports, 1500)
        for port, taken in zip(ports, (Taken(left, 1000.0, 80), Taken(right, 5.0, -80)), strict=True):
            (sensor,) = port.sensors
            mine = [sample for sample in found if sample.sensor == sensor]
            counts = port.counts[sensor]
            assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, 0)
            steps = {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(mine)}
            assert steps == {2_000_000}  # of its own clock: every sample is there
            clock = SensorClock()
            for sample in mine:
                mapped_ns = clock.map(sample.t_host_ns, sample.t_device_ns)
            # it goes by the samples that waited least, of the first 2 s or of all
            settled = [taken.late_ns(sample) for sample in mine if sample.t_device_ns < mine[0].t_device_ns + SETTLE_NS]
            least_ns = min(map(taken.late_ns, mine))
            assert 0 <= least_ns <= min(settled)
            assert least_ns - CLOCK_NS < mapped_ns - taken.ns(mine[-1]) < min(settled) + CLOCK_NS
            signal = walking_signal(sensor, 500.0)
            assert all(taken.as_played(sample, signal) for sample in mine)
            port.close()


@pytest.mark.parametrize("kind", ["xbus", "ximu3"])
def test_faults_on_the_line_are_counted_and_survived(kind: ImuKind) -> None:
    with spawn_imu(kind, offset_s=10.0, line="tcp") as handle:
        (port,) = open_imus([settings(kind, handle.port)])
        counts, taken = port.counts["right_foot"], Taken(handle, 10.0)
        collect_samples([port], 10)
        handle.inject("drop", 3)
        collect_until([port], lambda: counts.missing >= 3)
        assert counts.missing == 3
        handle.inject("doubled", 2)
        collect_until([port], lambda: counts.doubled >= 2)
        assert counts.doubled == 2
        handle.inject("reorder", 1)
        collect_until([port], lambda: counts.backward >= 1)
        assert counts.backward == 1
        handle.inject("nan", 2)
        found = collect_until([port], lambda: counts.bad_values >= 2)
        assert len([sample for sample in found if math.isnan(sample.acc_mps2[0])]) == counts.bad_values == 2
        wrong = taken.since(port, handle.inject("unit", 1000.0), 20)
        assert all(math.isnan(sample.acc_mps2[0]) for sample in wrong)
        handle.clear()
        before = counts.bad_frames
        handle.inject("garble", 4)
        if kind == "xbus":
            collect_until([port], lambda: counts.bad_frames >= before + 4)
        after = taken.since(port, time.monotonic_ns(), 40)
        assert not any(math.isnan(sample.acc_mps2[0]) for sample in after[10:])  # of which four may have been garbled
        port.close()


def test_mute_delay_reboot_and_jump_reach_the_clock() -> None:
    with spawn_imu("xbus", offset_s=10.0) as handle:
        (port,) = open_imus([settings("xbus", handle.port)])
        clock, taken = SensorClock(), Taken(handle, 10.0)

        def pass_on(number: int) -> int:
            """So many samples to the clock; the stamp of the last one."""
            found = collect_samples([port], number)
            for sample in found:
                clock.map(sample.t_host_ns, sample.t_device_ns)
            return found[-1].t_device_ns

        pass_on(50)
        told_ns = handle.inject("mute")
        assert all(taken.ns(sample) < told_ns for sample in collect([port], 0.3))
        handle.clear()
        pass_on(50)
        handle.inject("reboot")
        assert any(pass_on(1) < 10_000_000_000 for _ in range(100))
        assert clock.resets == 1
        handle.inject("jump", 100.0)
        assert any(pass_on(1) > 100_000_000_000 for _ in range(100))
        assert clock.resets == 2
        port.close()


@pytest.mark.parametrize(("kind", "line"), [("xbus", "pty"), ("ximu3", "pty"), ("ximu3", "tcp")])
def test_an_unplugged_line_is_lost_and_says_so(kind: ImuKind, line: Literal["pty", "tcp"]) -> None:
    with spawn_imu(kind, line=line) as handle:
        (port,) = open_imus([settings(kind, handle.port)])
        collect_samples([port], 1)
        handle.inject("unplug")
        assert "Check cable" in until_lost(port)
        with pytest.raises(ImuLost):
            port.reopen()
        port.close()


def test_an_mti_that_has_not_the_rate_is_refused() -> None:
    with spawn_imu("xbus", rate_hz=100) as handle, pytest.raises(ImuLost, match="rate_hz"):
        open_imus([settings("xbus", handle.port, rate_hz=200.0)])


def test_nobody_there() -> None:
    with pytest.raises(ImuLost, match="right_foot on /dev/nothing"):
        open_imus([settings("ximu3", "/dev/nothing")])
    with pytest.raises(ValueError, match="baud"):
        open_imus([settings("xbus", "/dev/nothing", rate_hz=1000.0)])


@pytest.mark.parametrize(
    ("kind", "option", "has"),
    [
        ("xbus", "baud", "baudrate, configure"), ("ximu3", "baud", "baudrate"), ("lsl", "acc_units", "acc_unit"),
        ("dbc_can", "acc_units", "acc_unit"), ("xsens_can", "acc_unit", "id_offset, group_counter"),
    ],
)  # fmt: skip
def test_an_option_that_the_device_has_not_is_refused_before_any_line_is_opened(
    kind: str, option: str, has: str
) -> None:
    with pytest.raises(ValueError, match=rf"right_foot: device '{kind}' has no option {option}; it has .*{has}"):
        open_imus([settings(kind, "/dev/nothing", **{option: "g"})])


@pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")
def test_two_sensors_on_one_can_bus() -> None:
    bus = free_bus()
    with (
        spawn_imu("xsens_can", sensor="left_foot", rate_hz=200, bus=bus) as left,
        spawn_imu("xsens_can", sensor="right_foot", rate_hz=200, bus=bus, id_offset=0x100) as right,
    ):
        ports = open_imus(
            [
                settings("xsens_can", "bus", "left_foot", 200.0, group_counter=True),
                settings("xsens_can", "bus", "right_foot", 200.0, group_counter=True, id_offset=0x100),
            ],
            bus,
        )
        assert len(ports) == 1
        collect_samples(ports, 200)
        for sensor in ("left_foot", "right_foot"):
            assert ports[0].counts[sensor].missing == 0
            assert ports[0].counts[sensor].bad_values == 0
        left.inject("drop", 1)
        right.clear()
        collect_until(ports, lambda: ports[0].counts["left_foot"].missing >= 1)
        assert (ports[0].counts["left_foot"].missing, ports[0].counts["right_foot"].missing) == (1, 0)
        ports[0].close()


@pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")
def test_frames_that_come_while_the_program_is_held_up_wait_for_it() -> None:
    """A quarter of a second of two sensors at 200 Hz; the system's usual room is for 256 frames."""
    bus = free_bus()
    with open_bus(bus) as reader, open_bus(bus) as sender:
        for number in range(400):
            sender.send(can.Message(arbitration_id=0x080, data=number.to_bytes(8, "big"), is_extended_id=False))
        heard = [reader.recv(timeout=1.0) for _ in range(400)]
        assert [message and int.from_bytes(message.data, "big") for message in heard] == list(range(400))


def test_datagrams_that_come_while_the_program_is_held_up_wait_for_it() -> None:
    line = ByteLine("right_foot", "udp://127.0.0.1:0", 0)
    with socket.socket(fileno=os.dup(line.fileno())) as same, socket.socket(type=socket.SOCK_DGRAM) as sensor:
        for number in range(400):
            sensor.sendto(number.to_bytes(60, "big"), same.getsockname())
    assert line.read() == b"".join(number.to_bytes(60, "big") for number in range(400))
    line.close()


@pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")
def test_a_sensor_by_any_dbc(tmp_path: Path) -> None:
    bus, options = free_bus(), dbc_options(tmp_path)
    with spawn_imu("dbc_can", rate_hz=200, bus=bus, options=options, offset_s=3.0, drift_ppm=60.0) as handle:
        (port,) = open_imus([settings("dbc_can", "bus", rate_hz=200.0, **options)], bus)
        counts, taken = port.counts["right_foot"], Taken(handle, 3.0, 60.0)
        collect_samples([port], 1)  # the group that was under way when the bus was opened has passed
        begun = counts.bad_frames
        found = collect_samples([port], 100)
        assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {5_000_000}
        assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, begun)
        signal = walking_signal("right_foot", 200.0)
        assert all(taken.as_played(sample, signal, 5e-3, 1e-3) for sample in found)  # whole numbers on the wire
        handle.inject("drop", 1)  # a frame, and with it a sample
        collect_until([port], lambda: counts.missing >= 1)
        assert counts.missing == 1
        with pytest.raises(ImuLost, match=r"refused: .*fault 'nan' does not exist here"):
            handle.inject("nan", 2)
        for sample in taken.since(port, handle.inject("full") + TICK_NS, 20):  # what such a sensor has instead
            assert max(map(abs, sample.acc_mps2)) == pytest.approx(16.0 * G_MPS2, rel=1e-3)
        handle.clear()
        told_ns = handle.inject("mute")
        assert all(taken.ns(sample) < told_ns + TICK_NS for sample in collect([port], 0.3))
        port.close()


def test_a_wireless_sensor_over_udp() -> None:
    with spawn_imu("ximu3", rate_hz=400, line="udp", offset_s=20.0) as handle:
        assert handle.port.startswith("udp://127.0.0.1:")
        (port,) = open_imus([settings("ximu3", handle.port, rate_hz=400.0)])
        with pytest.raises(ImuLost, match="in use"):
            open_imus([settings("ximu3", handle.port, "left_foot", rate_hz=400.0)])
        counts, taken = port.counts["right_foot"], Taken(handle, 20.0)
        found = collect_samples([port], 150)
        while min(map(taken.late_ns, found)) >= 5_000_000:  # of many samples one meets a machine with time for it
            found += collect_samples([port], 100)
        steps = {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)}
        assert steps == {2_500_000}
        assert (counts.missing, counts.bad_frames, counts.bytes_skipped) == (0, 0, 0)
        assert min(map(taken.late_ns, found)) >= 0
        handle.inject("drop", 3)
        collect_until([port], lambda: counts.missing >= 3)
        assert counts.missing == 3
        told_ns = handle.inject("unplug")
        assert all(taken.ns(sample) < told_ns for sample in collect([port], 0.3))  # nobody tells that the end is gone
        port.reopen()
        assert collect([port], 0.1) == []
        port.close()


def test_a_sensor_by_radio_whose_notifications_come_over_a_line() -> None:
    with spawn_imu("capture2go_ble", rate_hz=100, offset_s=50.0, drift_ppm=40, serial="1234ab") as handle:
        (port,) = open_imus([settings("capture2go_ble", handle.port)])
        assert port.serials == {"right_foot": "1234ab"}
        stream = SensorStream(port, SensorClock, ImuLost, frozenset({"right_foot"}), frozenset({"right_foot"}))
        counts, found = port.counts["right_foot"], list[Event]()

        def until(enough: Callable[[], bool]) -> None:
            end_s = time.monotonic() + 30.0
            found.clear()
            while not enough():
                assert time.monotonic() < end_s, "it did not come"
                found.extend(stream.read(time.monotonic_ns()))
                found.extend(stream.supervise(time.monotonic_ns()))
                time.sleep(0.003)

        until(lambda: len(found) >= 300)
        assert all(isinstance(each, ImuSample) and each.t_sensor_ns <= each.t_ns for each in found)
        assert (counts.missing, counts.bad_frames) == (0, 0)
        handle.inject("away", 0.5)  # first in, first out: they come late, and their stamps say so
        until(lambda: any(isinstance(each, ImuSample) and each.t_ns - each.t_sensor_ns > 400_000_000 for each in found))
        assert counts.missing == 0
        handle.inject("lose", 2)
        until(lambda: counts.missing > 0)
        handle.inject("reboot")  # out of power and on again: it waits to be asked, and the line is opened anew
        until(lambda: any(isinstance(each, SystemFault) for each in found))
        until(lambda: any(isinstance(each, ImuSample) for each in found))
        stream.close()


@pytest.mark.parametrize(("kind", "rate_hz"), [("witmotion", 100.0), ("movella_dot", 60.0)])
def test_makers_of_whom_only_documents_were_at_hand(kind: ImuKind, rate_hz: float) -> None:
    with spawn_imu(kind, rate_hz=rate_hz, offset_s=50.0, drift_ppm=40) as handle:
        (port,) = open_imus([settings(kind, handle.port, rate_hz=rate_hz)])
        found = collect_samples([port], 150)
        counts = port.counts["right_foot"]
        assert (counts.missing, counts.doubled, counts.bad_frames, counts.bad_values) == (0, 0, 0, 0)
        steps_ms = {round((b.t_device_ns - a.t_device_ns) / 1e6) for a, b in itertools.pairwise(found)}
        assert steps_ms == {round(1000 / rate_hz)}
        assert len(port.clock_answers()) == (kind == "movella_dot")
        handle.inject("reboot")
        port.reopen()
        assert collect_samples([port], 50)
        port.close()


def test_a_flooded_line_lets_go_of_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    line = ByteLine("right_foot", "udp://127.0.0.1:0", 0)
    monkeypatch.setattr("drivers.imu.line.os.read", lambda descriptor, most: b"x")  # there is always one more
    assert len(line.read()) == READS_AT_MOST
    line.close()


def test_a_stream_of_lab_streaming_layer() -> None:
    pytest.importorskip("pylsl", reason="pylsl is not installed", exc_type=RuntimeError)
    name = f"imu-{time.monotonic_ns()}"
    with spawn_imu("lsl", rate_hz=100, offset_s=50.0, name=name) as handle:
        try:
            (port,) = open_imus([settings("lsl", name, timeout_s=10.0)])
        except ImuLost as error:
            pytest.skip(f"LSL streams are not found on this machine: {error}")
        found = collect_samples([port], 100)
        assert port.counts["right_foot"].missing == 0
        signal = walking_signal("right_foot", 100.0)
        assert all(Taken(handle, 50.0).as_played(sample, signal) for sample in found)
        handle.inject("unplug")
        assert until_lost(port)
        port.close()


def test_a_capture2go_is_read_through_drops_bad_reception_and_a_loss_of_power() -> None:
    with spawn_imu("capture2go", rate_hz=200, offset_s=10.0, serial="1234ab") as handle:
        (port,) = open_imus([settings("capture2go", handle.port, rate_hz=200.0)])
        counts = port.counts["right_foot"]
        assert port.serials == {"right_foot": "1234ab"}
        signal = walking_signal("right_foot", 200.0)
        began_ns = handle.t0_ns
        found = collect_samples([port], 300)
        for sample in found:
            assert sample.t_device_ns < sample.t_host_ns < sample.t_device_ns + NS_PER_S  # it was set to this clock
            acc_mps2, gyr_radps = signal.sample(round((sample.t_device_ns - began_ns) * 200 / NS_PER_S))
            assert math.dist(sample.acc_mps2, acc_mps2) < 0.005  # a step has 0.0048 m/s²
            assert math.dist(sample.gyr_radps, gyr_radps) < 0.002
        assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, 0)
        handle.inject("drop", 3)
        handle.inject("garble", 2)
        collect_until([port], lambda: counts.missing >= 5)
        assert (counts.missing, counts.bad_frames >= 2) == (5, True)
        handle.inject("backlog")
        assert len(collect([port], 0.5)) < 20
        told_ns = handle.inject("backlog", 0.0)
        held = [sample for sample in collect([port], 0.2) if sample.t_device_ns < told_ns]
        assert len(held) > 80
        assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(held)} == {5_000_000}
        handle.inject("reboot")
        assert len(collect([port], 1.0)) < 40
        port.reopen()
        collect_samples([port], 50)
        handle.inject("unplug")
        assert "Check cable" in until_lost(port)
        port.close()
