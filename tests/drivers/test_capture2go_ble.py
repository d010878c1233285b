"""Capture2Go by radio: the port on a stand-in for bleak, whose notifications come from a simulated connection."""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator

import bleak_stand_in
import numpy as np
import pytest

from drivers.imu import capture2go_codec as c2g
from drivers.imu import capture2go_port as ble
from drivers.imu.open import open_imus
from drivers.imu.port import ImuLost, ImuPort
from drivers.simulated.imu.device import ImuSignal, Radio, SimulatedImu
from drivers.simulated.imu.serial_wires import Capture2GoWire
from fes.config.session import ImuDevice
from fes.signals import NS_PER_S, RawSample

MS = 1_000_000
COUNTED = ImuSignal(100.0, np.tile([0.0, 0.0, 9.81], (1000, 1)), np.linspace([0.0] * 3, [10.0, 0.0, 0.0], 1000))


class Client(bleak_stand_in.Client):
    notifies = ble.FROM_SENSOR

    async def write_gatt_char(self, characteristic: str, data: bytes, response: bool) -> None:
        assert characteristic == ble.TO_SENSOR
        assert response or data == c2g.pack(c2g.Header.CMD_GET_STATUS)  # of its time nobody waits for the answer
        Client.radio.receive(time.monotonic_ns(), data)


@pytest.fixture(autouse=True)
def radio(monkeypatch: pytest.MonkeyPatch) -> Iterator[Radio]:
    now_ns = time.monotonic_ns()
    imu = SimulatedImu(Capture2GoWire(100.0, None, "1234ab"), COUNTED, now_ns)
    Client.radio, Client.alive, Client.hangs = Radio(imu, now_ns), True, False
    bleak_stand_in.install(monkeypatch, Client, "IMU_1234ab", "00:11:22:33:44:55", [ble.SERVICE])
    yield Client.radio
    Client.alive = False


def device(port: str = "IMU_1234ab", **options: object) -> ImuDevice:
    values = {"sensor": "left_foot", "device": "capture2go_ble", "port": port, "rate_hz": 100.0, "options": options}
    return ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0})


def listen(port: ImuPort, seconds: float) -> list[RawSample]:
    found, end_s = [], time.monotonic() + seconds
    while time.monotonic() < end_s:
        time.sleep(0.005)
        found += port.read(time.monotonic_ns())
    return found


def test_eight_at_a_time_none_is_lost_and_their_age_is_the_radios(radio: Radio) -> None:
    (port,) = open_imus([device(packed=True)])
    assert port.serials == {"left_foot": "1234ab"}
    found = listen(port, 1.5)
    assert len(found) >= 100
    assert len(found) % 8 == 0
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    youngest_ms, oldest_ms = (
        pick(sample.t_host_ns - sample.t_device_ns for sample in found) / MS for pick in (min, max)
    )
    assert youngest_ms >= 0
    assert oldest_ms >= 70  # seven samples older than the newest of its package
    counts = port.counts["left_foot"]
    assert (counts.missing, counts.doubled, counts.backward, counts.bad_frames) == (0, 0, 0, 0)
    port.close()
    port.close()


def test_bad_reception_makes_samples_late_and_not_missing(radio: Radio) -> None:
    radio.fails, radio.interval_s = 0.1, 0.0075
    (port,) = open_imus([device()])
    listen(port, 0.3)
    radio.away_until_ns = time.monotonic_ns() + NS_PER_S // 2
    found = listen(port, 1.2)
    assert {b.t_device_ns - a.t_device_ns for a, b in itertools.pairwise(found)} == {10 * MS}
    assert max(sample.t_host_ns - sample.t_device_ns for sample in found) > 400 * MS
    assert port.counts["left_foot"].missing == 0
    port.close()


def test_notifications_that_the_system_loses_cost_their_packages_and_are_counted(radio: Radio) -> None:
    (port,) = open_imus([device(packed=True)])
    listen(port, 0.3)
    radio.lose = 2
    found = listen(port, 1.5)
    counts = port.counts["left_foot"]
    assert counts.missing >= 8
    assert counts.missing % 8 == 0
    assert len(found) >= 50
    port.close()


def test_a_connection_that_goes_is_lost_and_can_be_opened_again(radio: Radio) -> None:
    (port,) = open_imus([device("00:11:22:33:44:55")])
    listen(port, 0.2)
    radio.imu.set_fault(time.monotonic_ns(), "reboot", 1)  # out of power
    Client.alive = False
    with pytest.raises(ImuLost, match=r"the connection is gone\. Is it switched on"):
        listen(port, 2.0)
    Client.alive = True
    port.reopen()
    assert len(listen(port, 1.0)) >= 40
    port.close()


def test_who_is_not_there_or_never_answers_is_named_in_time() -> None:
    with pytest.raises(ImuLost, match="left_foot on IMU_other: is not found"):
        open_imus([device("IMU_other", find_s=0.2)])
    Client.hangs = True
    began_s = time.monotonic()
    with pytest.raises(ImuLost, match="TimeoutError"):
        open_imus([device(find_s=0.2)])
    assert time.monotonic() - began_s < 5.0


def test_without_bleak_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bleak", None)
    with pytest.raises(ImuLost, match=r"pip install 'fes-gait\[ble\]'"):
        open_imus([device()])


def test_one_at_a_time_and_asked_for_its_time_it_answers_within_what_the_radio_takes(radio: Radio) -> None:
    (port,) = open_imus([device()])
    found = listen(port, 1.5)
    assert len(found) >= 120
    told = port.clock_answers()
    assert len(told) >= 8
    assert port.clock_answers() == []
    # the clock was set when it was opened, some time before the command reached it: it shows less than the host's
    for sensor, asked_ns, said_ns in told:
        assert sensor == "left_foot"
        assert -100 * MS < asked_ns - said_ns < 100 * MS
    port.close()


def test_an_answer_that_is_lost_makes_no_later_one_count_for_more(radio: Radio) -> None:
    (port,) = open_imus([device()])
    listen(port, 0.3)
    port.clock_answers()
    radio.away_until_ns = time.monotonic_ns() + NS_PER_S
    listen(port, 1.5)
    oldest_ns = min(asked_ns for _, asked_ns, _ in port.clock_answers())
    assert oldest_ns < radio.away_until_ns - NS_PER_S // 2  # by when it was asked, not by when it was asked again
    port.close()
