"""A walking session's own commands through the ScienceMode ports to the simulated devices, on an injected clock."""

from __future__ import annotations

import random

import pytest
from replays import Burst, bursts, replay, write_cut

from drivers.simulated.record import RecordEntry
from drivers.simulated.stimulator.in_process import DeviceLine
from drivers.simulated.stimulator.sciencemode2 import ScienceMode2Device
from drivers.simulated.stimulator.sciencemode4 import ScienceMode4Device
from drivers.stimulator.p24_port import LowLevelStimulator, MidLevelStimulator
from drivers.stimulator.rehastim2_port import RehaStim2
from drivers.stimulator.sciencemode import ScienceModePort
from fes.signals import StimCommand, StimStatus
from fes.stimulation.dose import DoseLedger

MS = 1_000_000
KINDS = ("low", "mid", "rehastim2")
DELIVERED_WITHIN_NS = {"low": 0, "mid": 0, "rehastim2": 12 * MS}
SILENT_WITHIN_NS = {"low": 0, "mid": 2000 * MS, "rehastim2": 12 * MS}


@pytest.fixture(scope="module")
def commands(tmp_path_factory: pytest.TempPathFactory) -> list[StimCommand]:
    """All of channel 0 in thirty seconds of a bundled trial, on a clock that begins at one second."""
    folder = tmp_path_factory.mktemp("session")
    made = [one for one in replay(write_cut(folder, end_s=30.0), folder).commands if one.channel == 0]
    first_ns = made[0].t_ns - 1000 * MS
    return [
        StimCommand(
            one.t_ns - first_ns,
            0,
            one.on,
            one.current_ma,
            one.pulse_width_us,
            one.frequency_hz,
            one.validity_ms,
        )
        for one in made
    ]


def deliver(
    kind: str, commands: list[StimCommand], then_ns: int = 0
) -> tuple[list[RecordEntry], list[StimStatus], list[str]]:
    """The pulses, the statuses and the faults; after the last command only time passes."""
    begin_ns = commands[0].t_ns - 1000 * MS
    device = ScienceMode2Device(begin_ns) if kind == "rehastim2" else ScienceMode4Device(begin_ns)
    line = DeviceLine(device, begin_ns)
    port: ScienceModePort
    if kind == "low":
        port = LowLevelStimulator(line, 1)
    elif kind == "mid":
        port = MidLevelStimulator(line, 1, accept_watchdog_s=2.0)
    else:
        port = RehaStim2(line, 1, (0,))
    port.open(0, timeout_s=0.9, clock_ns=line.clock_ns)
    statuses: list[StimStatus] = []
    faults: list[str] = []
    for command in commands:
        while line.t_ns + 2 * MS < command.t_ns:  # the loop polls at every sample
            line.advance(line.t_ns + 2 * MS)
            for event in port.poll(line.t_ns):
                faults += [event.fault] if event.fault else []
                statuses += [event] if isinstance(event, StimStatus) else []
        line.advance(command.t_ns)
        port.send(command)
    line.advance(line.t_ns + then_ns)
    return [e for e in line.device.take_record() if e.event == "pulse"], statuses, faults


def burst_of(pulse: RecordEntry, made: list[Burst], slack_ns: int) -> Burst | None:
    return next((b for b in made if b.t_on_ns <= pulse.t_ns < b.t_off_ns + slack_ns), None)


@pytest.mark.parametrize("kind", KINDS)
def test_a_session_is_delivered_as_the_controller_commanded(kind: str, commands: list[StimCommand]) -> None:
    pulses, statuses, faults = deliver(kind, commands, 500 * MS)
    made = bursts(commands)
    assert len(made) >= 5
    assert faults == []
    slack_ns = max(DELIVERED_WITHIN_NS[kind], 1)
    for pulse in pulses:
        burst = burst_of(pulse, made, slack_ns)
        assert burst is not None, f"a pulse at {pulse.t_ns / 1e9:.3f} s outside of every burst"
        newest = max(c.current_ma for c in commands if -60 * MS <= c.t_ns - pulse.t_ns <= 0)
        assert pulse.current_ma <= newest
        assert pulse.detail == ""
    on_s = sum(burst.t_off_ns - burst.t_on_ns for burst in made) * 1e-9
    # 40 Hz while it is on, less the first steps of each rise, which are below the device's finest step
    assert 40.0 * on_s - 4 * len(made) <= len(pulses) <= 40.0 * on_s + 1.5 * len(made)
    if kind != "mid":
        assert sum(status.pulses for status in statuses) == len(pulses)
    peaks = {burst: max(p.current_ma for p in pulses if burst_of(p, [burst], slack_ns)) for burst in made}
    step_ma = 1.0 if kind == "rehastim2" else 0.5
    assert all(burst.peak_ma - peak < step_ma for burst, peak in peaks.items())


@pytest.mark.parametrize("kind", KINDS)
def test_a_controller_that_dies_anywhere_in_a_session(kind: str, commands: list[StimCommand]) -> None:
    """Cut the commands off at forty places within bursts: no pulse later than the device's own rule."""
    chosen = random.Random(4)
    inside = [at for at, command in enumerate(commands) if command.on]
    worst_ns = 0
    for at in chosen.sample(inside, 40):
        pulses, _, _ = deliver(kind, commands[max(0, at - 60) : at + 1], 3000 * MS)
        if pulses:
            worst_ns = max(worst_ns, pulses[-1].t_ns - commands[at].t_ns)
    print(f"{kind}: last pulse at most {worst_ns / MS:.1f} ms after the last command")
    assert worst_ns <= SILENT_WITHIN_NS[kind]
    assert kind != "mid" or worst_ns > 1500 * MS


@pytest.mark.parametrize("kind", KINDS)
def test_the_dose_ledger_books_the_charge_that_the_device_delivered(kind: str, commands: list[StimCommand]) -> None:
    """Against the sum over the device's own pulses, one phase each; only mid level must estimate."""
    pulses, statuses, _ = deliver(kind, commands, 500 * MS)
    ledger = DoseLedger([0])
    for status in statuses:
        ledger.book(status)
    delivered_uc = sum(1e-3 * pulse.current_ma * pulse.pulse_width_us for pulse in pulses)
    booked = ledger.electrodes[0]
    assert booked.estimated == (kind == "mid")
    assert booked.session_uc == pytest.approx(delivered_uc, rel=0.1 if kind == "mid" else 1e-9)
