"""The virtual patient as a device: the same samples however late it is woken, only delivered pulses felt."""

from __future__ import annotations

import json
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from drivers.imu import xbus
from drivers.simulated.record import Pulse, PulseInlet, PulseOutlet, RecordEntry, pulses_of
from drivers.simulated.stimulator.firmware import StimulatorNode
from fes.hil.closed_loop.patient_process import HELD, Life, PatientDevice
from fes.signals import NS_PER_S
from fes.simulation.forward import DeliveredPulse, VirtualPatient, settings_for
from fes.simulation.forward.closed_loop import INTERVENTIONS, intervene
from fes.simulation.forward.settings import MuscleSettings, from_plain

MS = 1_000_000
START_NS = 7_000_000_123
SETTINGS = settings_for("severe", seed=4, stand_s=1.0, sensors=("left_foot", "right_foot"))


def train(from_s: float, to_s: float, current_ma: float = 30.0) -> list[Pulse]:
    """40 Hz on the host's clock."""
    times = np.arange(round(from_s * NS_PER_S), round(to_s * NS_PER_S), 25 * MS).tolist()
    return [Pulse(START_NS + t_ns, 0, current_ma, 300.0) for t_ns in times]


def lived(wakes_ms: int, pulses: list[Pulse], seconds: float = 4.0) -> tuple[PatientDevice, dict[str, bytes]]:
    """Woken every so many ms, told each pulse at the first waking after it."""
    device = PatientDevice(SETTINGS, START_NS)
    out = dict.fromkeys(SETTINGS.sensors, b"")
    waiting = list(pulses)
    for t_ns in range(START_NS, START_NS + round(seconds * NS_PER_S) + 1, wakes_ms * MS):
        told = [pulse for pulse in waiting if pulse.t_ns <= t_ns]
        waiting = waiting[len(told) :]
        for sensor, messages in device.advance(t_ns, told).items():
            out[sensor] += b"".join(messages)
    return device, out


def samples(stream: bytes) -> list[xbus.XbusMessage]:
    return [message for message in xbus.XbusDecoder().feed(stream) if message.mid == xbus.Mid.MT_DATA2]


def test_its_lines_carry_what_the_patient_feels_and_nothing_depends_on_when_it_is_woken() -> None:
    pulses = train(1.2, 3.6)
    device, out = lived(10, pulses)
    assert device.counts.intervals == 400
    assert len(samples(out["right_foot"])) == len(samples(out["left_foot"])) == 400
    _, finely = lived(2, pulses)
    assert finely == out
    late, lately = lived(20, pulses)  # less late than the muscle's delay
    assert lately == out
    assert (late.counts.pulses_late, late.counts.late_5ms, late.counts.latest_ms) == (0, 200, 10.0)
    patient = VirtualPatient(SETTINGS)
    felt = [DeliveredPulse(p.t_ns - START_NS, p.channel, p.current_ma, p.pulse_width_us) for p in pulses]
    for step in range(1, 401):
        due = [pulse for pulse in felt if (step - 1) * 10 * MS < pulse.t_ns <= step * 10 * MS]
        patient.advance(step * 10 * MS, due)
    assert device.patient.strides == patient.strides
    assert device.counts.charge_uc == pytest.approx(9.0 * len(pulses))


def test_without_pulses_it_walks_otherwise_and_a_pulse_told_too_late_is_counted() -> None:
    assert lived(10, train(1.2, 3.6))[1] != lived(10, [])[1]
    device, _ = lived(10, [])
    device.advance(START_NS + 4 * NS_PER_S, [Pulse(START_NS + 3 * NS_PER_S, 0, 30.0, 300.0)])
    device.advance(START_NS + 4 * NS_PER_S, [Pulse(START_NS + 4 * NS_PER_S - 20 * MS, 0, 30.0, 300.0)])
    assert (device.counts.pulses, device.counts.pulses_late) == (2, 1)
    for nonsense in (float("nan"), float("inf")):
        device.advance(START_NS + 4 * NS_PER_S, [Pulse(START_NS + 4 * NS_PER_S, 0, nonsense, 300.0)])
    device.advance(START_NS + 4 * NS_PER_S, [Pulse(START_NS - 1, 0, 30.0, 300.0)])  # before it lived
    assert device.counts.pulses == 2


def test_its_time_begins_when_it_is_told_to() -> None:
    device = PatientDevice(SETTINGS, HELD)
    assert not any(device.advance(START_NS + 9 * NS_PER_S, []).values())
    device.begin(START_NS)
    assert device.next_deadline_ns() == START_NS + 10 * MS
    assert all(len(messages) == 5 for messages in device.advance(START_NS + 50 * MS, []).values())
    with pytest.raises(ValueError, match="begun already"):
        device.begin(START_NS)


def test_a_cycle_of_walking_and_standing_goes_on_and_on() -> None:
    device = PatientDevice(SETTINGS, 0, Life((4.0, 2.0)))
    device.advance(40 * NS_PER_S, [])
    walks = device.patient.walks
    assert len(walks) >= 4
    assert walks[0][0] == pytest.approx(2.0, abs=0.02)
    for (begin_s, end_s), (again_s, _) in pairwise(walks):
        assert end_s - begin_s >= 4.0
        assert again_s - end_s == pytest.approx(2.0, abs=0.03)


def test_one_who_walks_in_turns_can_be_held_standing() -> None:
    device = PatientDevice(SETTINGS, 0, Life((5.0, 2.0)))
    device.advance(4 * NS_PER_S, [])
    assert len(device.patient.walks) == 1
    device.held = True
    device.advance(30 * NS_PER_S, [])
    assert not device.patient.walking
    assert len(device.patient.walks) == 1
    device.held = False
    device.advance(30 * NS_PER_S + 20 * MS, [])
    assert len(device.patient.walks) == 2


def test_waiting_means_waiting() -> None:
    device = PatientDevice(SETTINGS, 0, Life(waits=True))
    device.advance(20 * NS_PER_S, [])
    assert device.patient.walks == []
    intervene(device.patient, "walk")
    device.advance(26 * NS_PER_S, [])
    strides = device.new_strides()
    assert {stride.foot for stride in strides} == {"right_foot"}
    assert device.new_strides() == []
    for intervention in INTERVENTIONS:
        intervene(device.patient, intervention, 0.5)
    with pytest.raises(ValueError, match="cannot be done"):
        intervene(device.patient, "jump")


def test_its_sensors_have_the_faults_of_simulated_ones() -> None:
    device = PatientDevice(SETTINGS, 0)
    device.set_fault("right_foot", 0, "stuck", 1.0)
    out = device.advance(2 * NS_PER_S, [])
    values = {bytes(message.data[12:]) for message in samples(b"".join(out["right_foot"]))}
    others = {bytes(message.data[12:]) for message in samples(b"".join(out["left_foot"]))}
    assert len(values) == 1
    assert len(others) > 100
    device.set_fault("right_foot", 2 * NS_PER_S, "reboot", 1.0)
    quiet = device.advance(2 * NS_PER_S + 250 * MS, [])
    assert samples(b"".join(quiet["right_foot"])) == []
    assert len(samples(b"".join(quiet["left_foot"]))) == 25
    with pytest.raises(ValueError, match="no sensor 'hand'"):
        device.set_fault("hand", 0, "stuck", 1.0)
    assert device.receive("left_foot", 0, xbus.encode(xbus.Mid.GO_TO_CONFIG)) != []


def test_it_can_live_for_long_and_remembers_a_minute() -> None:
    patient = VirtualPatient(SETTINGS, remember_s=10.0)
    whole = VirtualPatient(SETTINGS)
    for each in (patient, whole):
        for step in range(1, 301):
            each.advance(step * 100 * MS)
    kept, all_of_it = patient.trace("right_foot"), whole.trace("right_foot")
    assert 10.0 <= len(kept["t_s"]) * 0.005 < 11.0
    assert kept["t_s"].tolist() == all_of_it["t_s"][-len(kept["t_s"]) :].tolist()
    assert kept["toe_m"].tolist() == all_of_it["toe_m"][-len(kept["toe_m"]) :].tolist()
    assert patient.strides == whole.strides


def test_a_patient_is_the_same_behind_a_line_of_text() -> None:
    other = settings_for("mild", muscle=MuscleSettings(fatigue_s=float("inf")), sensors=("right_shank",), seed=2**40)
    for settings in (SETTINGS, other):
        assert from_plain(json.loads(json.dumps(asdict(settings)))) == settings
    with pytest.raises((ValueError, TypeError)):
        from_plain({"wheels": 4})


# --- the pulses' way -------------------------------------------------------------------------------------


def test_every_pulse_of_a_stage_is_told_by_its_own_time_even_when_the_node_was_late(tmp_path: Path) -> None:
    inlet, outlet = PulseInlet(tmp_path / "p"), PulseOutlet(tmp_path / "p")
    node = StimulatorNode(1, 0)
    node.channels[2].drive(0, (20.0, 250.0, 40.0), 60)
    node.advance(55 * MS)  # three pulses at once
    outlet.send(node.take_pulses())
    assert inlet.receive() == [Pulse(t_ms * MS, 2, 20.0, 250.0) for t_ms in (0, 25, 50)]
    node.advance(500 * MS)  # the lease has ended
    outlet.send(node.take_pulses())
    outlet.send(pulses_of([RecordEntry(5, "pulse", 1, 18.0, 300.0), RecordEntry(6, "off", 1)]))
    assert inlet.receive() == [Pulse(5, 1, 18.0, 300.0)]
    inlet.close()
    outlet.send([Pulse(7, 0, 1.0, 1.0)])  # nobody is there any more
    assert outlet.lost == 1
    outlet.close()
    assert not (tmp_path / "p").exists()
    PulseOutlet(None).send([Pulse(7, 0, 1.0, 1.0)])


def test_nothing_but_pulses_comes_out_of_the_socket(tmp_path: Path) -> None:
    import socket

    inlet = PulseInlet(tmp_path / "p")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        for datagram in (b"", b"x", b"x" * 27, b"x" * 29, b"x" * 2000):
            stranger.sendto(datagram, str(tmp_path / "p"))
        assert inlet.receive() == []
    assert (tmp_path / "p").stat().st_mode & 0o077 == 0
    inlet.close()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_after_a_walk_it_stands_as_still_as_before(seed: int) -> None:
    settings = settings_for("severe", seed=seed, compensation=0.3, stand_s=2.0)
    patient = VirtualPatient(settings)
    before = np.array([sample.gyr_radps for sample in patient.advance(2 * NS_PER_S)[400:]])
    patient.advance((12 + seed) * NS_PER_S)
    patient.stop()
    patient.advance(21 * NS_PER_S)
    still = np.array([sample.gyr_radps for sample in patient.advance(23 * NS_PER_S)])
    assert not patient.walking
    assert np.abs(still - np.median(still, axis=0)).max() < 0.1
    assert still.std() < 1.5 * before.std()
    patient.walk()
    begins = patient.advance(23 * NS_PER_S + 500 * MS)
    waits = np.array([np.linalg.norm(sample.acc_mps2) for sample in begins if sample.sensor == "right_foot"])
    assert np.abs(waits - 9.81).max() < 1.5  # the waiting leg keeps its weight as the other one begins
