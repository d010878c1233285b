"""Stimulator ports hear intact messages that make no sense: they report faults, or that the device is lost, no more."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import can
import pytest
from examples import examples
from spoiled import no_longer_than
from test_can_port import Bench as CanBench
from test_can_port import command as can_command
from test_sciencemode_ports import KINDS, MS, Bench, command

from drivers.stimulator import can_codec
from drivers.stimulator import p24_port as sm4
from drivers.stimulator import rehastim2_port as sm2
from drivers.stimulator.can_codec import Alive, Charge, Frame, Result, Status
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.sciencemode import Packet


class Chatty:
    """A line on which, beside the device, somebody says anything that is well framed."""

    def __init__(self, line: Any, encode: Callable[[Packet], bytes], numbers: int, chance: random.Random) -> None:
        self._line, self._encode, self._numbers, self._chance = line, encode, numbers, chance

    def __getattr__(self, name: str) -> Any:
        return getattr(self._line, name)

    def read(self) -> bytes:
        """What the device sent, and now and then something else before it or instead."""
        heard: bytes = self._line.read()
        if self._chance.random() > 0.1:
            return heard
        number, kind = self._chance.randrange(self._numbers), self._chance.randrange(70)
        said = self._encode(Packet(number, kind, self._chance.randbytes(self._chance.randrange(12))))
        return said if self._chance.random() < 0.2 else said + heard


@pytest.mark.requirement("SR-15")
@pytest.mark.parametrize("kind", KINDS)
def test_well_framed_nonsense(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    chance = random.Random(5)
    encode, numbers = (sm2.encode, 256) if kind == "rehastim2" else (sm4.encode, 64)
    sessions, lost, faults = examples(15, 1_500), 0, 0
    for _ in range(sessions):
        bench = Bench(kind)
        line: Any = Chatty(bench.line, encode, numbers, chance)
        bench.port._line = line
        try:
            with no_longer_than(20):
                for _ in range(25):
                    bench._turn((command(bench.t_ns, on=chance.random() < 0.8),), 20)
        except StimulatorLost:
            lost += 1
        faults += bool(bench.faults)
        for status in bench.statuses:
            assert status.channel == 1
            assert 0.0 <= status.current_ma <= 20.0
            assert 0.0 <= status.charge_uc <= status.pulses * 20.0 * 0.3 + 1e-9
    assert faults > 0
    with capsys.disabled():
        print(f"\n{kind}: {sessions} sessions of half a second with nonsense, {faults} noticed, {lost} ended")


def nonsense(chance: random.Random) -> Frame:
    """An intact frame of the node's with anything in it, half of the time of the open session."""
    session_id = chance.choice((0x1234, chance.randrange(65_536)))
    counter, channel = chance.randrange(16), chance.choice((1, chance.randrange(8)))
    match chance.randrange(3):
        case 0:
            levels = (chance.randrange(512) * 0.5 % 255, float(chance.randrange(512)), float(chance.randrange(128)))
            on = chance.random() < 0.5
            return can_codec.encode(Status(counter, session_id, channel, on, *levels, chance.choice(list(Result))))
        case 1:
            total = chance.randrange(can_codec.CHARGE_TOTAL_STEPS)
            return can_codec.encode(Charge(counter, session_id, channel, chance.randrange(256), total))
        case _:
            boot_id, flags = chance.choice((77, chance.randrange(65_536))), chance.choice((0, chance.randrange(256)))
            return can_codec.encode(Alive(counter, 1, boot_id, session_id, chance.randrange(256), flags))


@pytest.mark.requirement("SR-15")
def test_intact_nonsense_on_can(capsys: pytest.CaptureFixture[str]) -> None:
    chance = random.Random(6)
    sessions, lost, faults = examples(10, 1_000), 0, 0
    for number in range(sessions):
        bench = CanBench(name=f"nonsense {number}")
        try:
            bench.port.open(0, clock_ns=bench.clock)
            with no_longer_than(20):
                for _ in range(25):
                    bench.port.send(can_command(on=chance.random() < 0.8))
                    bench.turn(bench.t_ns + 20 * MS)
                    if chance.random() < 0.5:
                        identifier, data = nonsense(chance)
                        bench.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
                    for event in bench.port.poll(bench.t_ns):
                        faults += bool(event.fault)
        except StimulatorLost:
            lost += 1
        finally:
            bench.close()
    assert faults > 0
    with capsys.disabled():
        print(f"\nCAN: {sessions} sessions of half a second with nonsense, {faults} faults told, {lost} sessions ended")
