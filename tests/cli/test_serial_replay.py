"""A serial port told again what it was told and what it heard sends the same bytes, whatever its device did."""

from __future__ import annotations

import pytest
from test_sciencemode_ports import KINDS, MS, Bench, command

from drivers.stimulator.p24_port import LowLevelStimulator, MidLevelStimulator
from drivers.stimulator.rehastim2_port import RehaStim2
from drivers.stimulator.sciencemode import ScienceModePort
from fes.cli.replay.stimulators import LoggedLine
from fes.signals import WireFrame


@pytest.mark.parametrize("silent", [(), (20, 24), (20, 40)], ids=["well", "two answers lost", "mute for 0.4 s"])
@pytest.mark.parametrize("kind", KINDS)
def test_what_was_heard_decides_what_goes_out(kind: str, silent: tuple[int, ...]) -> None:
    bench, line = Bench(kind), LoggedLine()
    if kind == "low":
        again: ScienceModePort = LowLevelStimulator(line, 7)
    elif kind == "mid":
        again = MidLevelStimulator(line, 7, accept_watchdog_s=2.0)
    else:
        again = RehaStim2(line, 7, (1,))
    again.resume(bench.handshake.frames)
    sent: list[WireFrame] = []
    repeated: list[WireFrame] = []
    withheld = 0  # pulses that the queue had no room for
    for turn in range(60):
        bench.line.faults.set("mute", float(bool(silent) and silent[0] <= turn < silent[1]))
        one = command(bench.t_ns, on=turn % 30 < 25, current_ma=5.0 + turn % 3)
        sent.append(bench.port.send(one))
        repeated.append(again.send(one))
        for _ in range(10):
            bench.line.advance(bench.t_ns + 2 * MS)
            events = bench.port.poll(bench.t_ns)
            withheld += sum("none was added" in event.fault for event in events)
            line.brings += bench.port.heard
            assert again.poll(bench.t_ns) == events
    assert repeated == sent
    assert bool(withheld) == bool(silent)
