"""The same benches in real time, on simulated devices behind pseudo-terminals; and the person at the terminal."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drivers.imu.open import open_imus
from drivers.simulated.spawn import spawn_device, spawn_imu
from drivers.stimulator.open import open_session
from fes.qualify import sensor, stimulator
from fes.qualify.sensor import NotQualified, RealTime, SensorBench, TerminalPerson
from fes.qualify.simulated import sensor_settings, stimulator_session
from fes.qualify.stimulator import StimulatorBench
from fes.signals import NS_PER_S


class Obedient:
    """Is ready at once, strikes at once, and reads that nothing came."""

    def does(self, key: str, instruction: str) -> None:
        assert instruction

    def reads(self, key: str, question: str, unit: str) -> float:
        return 0.0

    def struck_ns(self) -> int | None:
        return RealTime().now_ns()


@pytest.mark.live
def test_a_sensor_on_a_line_is_heard_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("REST_S", "SIDE_S", "TURN_S", "SLOW_S", "SHAKE_S"):
        monkeypatch.setattr(sensor, name, 0.5)
    with spawn_imu("xbus") as imu:
        settings = sensor_settings("xbus").model_copy(update={"port": imu.port})
        port = open_imus([settings])[0]
        figures = SensorBench(settings, port, RealTime(), Obedient()).figures()
        port.close()
    assert figures["serial"] == figures["serial_again"] != ""
    assert figures["rate_hz"] == pytest.approx(100.0, rel=0.02)


@pytest.mark.live
def test_a_stimulator_on_a_line_gets_bursts_and_is_off_after_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stimulator, "AFTER_S", 0.4)
    monkeypatch.setattr(stimulator, "BURST_S", 0.4)
    with spawn_device("sciencemode4", record=tmp_path / "pulses.jsonl") as device:
        session = stimulator_session("p24_low_level")
        settings = session.stimulator.model_copy(update={"port": device.port})
        bench = StimulatorBench(
            session, lambda t_ns: open_session(settings, session, t_ns).port, RealTime(), Obedient()
        )
        figures = bench.figures()
        ended_ns = RealTime().now_ns()
        pulses = device.entries("pulse")
    assert figures["answers"] > 50
    assert {entry.channel for entry in pulses} == {0}
    assert max(entry.current_ma for entry in pulses) <= session.channels[0].limits.max_current_ma
    assert max(entry.t_ns for entry in pulses) < ended_ns
    assert figures["stop_refused_commands"] > 0


def test_a_person_at_the_terminal_is_asked_until_a_number_comes() -> None:
    reading, writing = os.pipe()
    os.write(writing, b"\nabout ten\n10,5\n\n")
    person = TerminalPerson(reading, lambda: 7 * NS_PER_S)
    person.does("rest", "Lay it down.")
    assert person.reads("ma", "height", "mA") == 10.5
    assert person.struck_ns() == 7 * NS_PER_S
    assert person.struck_ns() is None
    os.close(writing)
    with pytest.raises(NotQualified, match="nobody"):
        person.does("rest", "Lay it down.")
    os.close(reading)
