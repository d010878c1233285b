"""A serial port told again what it was told and what it heard sends the same bytes, whatever its device did."""

from __future__ import annotations

import pytest
from test_sciencemode_ports import KINDS, MS, TestBench, command

from drivers.stimulator.sciencemode.port import ScienceModePort
from drivers.stimulator.sciencemode.port2 import RehaStim2
from drivers.stimulator.sciencemode.port4 import LowLevelStimulator, MidLevelStimulator
from fes.cli.replay.stimulators import LoggedLine
from fes.signals import WireFrame


@pytest.mark.parametrize("silent", [(), (20, 24), (20, 40)], ids=["well", "two answers lost", "mute for 0.4 s"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_was_heard_decides_what_goes_out(kind: str, silent: tuple[int, ...]) -> None:
    rig, line = TestBench(kind), LoggedLine()
    if kind == "low":
        again: ScienceModePort = LowLevelStimulator(line, 7)
    elif kind == "mid":
        again = MidLevelStimulator(line, 7, accept_watchdog_s=2.0)
    else:
        again = RehaStim2(line, 7, (1,))
    again.resume(rig.handshake.frames)
    sent: list[WireFrame] = []
    repeated: list[WireFrame] = []
    withheld = 0  # pulses that the queue had no room for
    for turn in range(60):
        rig.line.faults.set("mute", float(bool(silent) and silent[0] <= turn < silent[1]))
        one = command(rig.t_ns, on=turn % 30 < 25, current_ma=5.0 + turn % 3)
        sent.append(rig.port.send(one))
        repeated.append(again.send(one))
        for _ in range(10):
            rig.line.advance(rig.t_ns + 2 * MS)
            events = rig.port.poll(rig.t_ns)
            withheld += sum("none was added" in event.fault for event in events)
            line.brings += rig.port.heard
            assert again.poll(rig.t_ns) == events
    assert repeated == sent
    assert bool(withheld) == bool(silent)
