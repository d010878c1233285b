"""Switches on a CAN bus between two openings of it, and on a serial line's inputs."""

from __future__ import annotations

import select
from collections.abc import Iterator

import can
import pytest
import serial

from drivers.stimulator.bus import open_bus
from drivers.switches import CanSwitch, SerialSwitch, SwitchFailed, open_switch
from drivers.virtual.can_node_spawn import free_bus, why_silent
from fes.config import Bus
from fes.config.devices import FootSwitch

NO_BUS = why_silent(free_bus())


@pytest.fixture
def bus() -> Iterator[tuple[Bus, can.BusABC]]:
    if NO_BUS:
        pytest.skip(f"no CAN on this machine: {NO_BUS}")
    settings = free_bus()
    with open_bus(settings) as other:
        yield settings, other


def settings(**more: object) -> FootSwitch:
    return FootSwitch.model_validate({"foot": "left_foot", "source": "can_bit", "identifier": 0x1F0, "bit": 11} | more)


@pytest.mark.parametrize(("pressed", "byte"), [("high", 0b1000), ("low", 0b11110111)])
def test_a_bit_of_a_frame_is_a_switch(bus: tuple[Bus, can.BusABC], pressed: str, byte: int) -> None:
    where, other = bus
    switch = open_switch(settings(pressed=pressed), where)
    assert isinstance(switch, CanSwitch)
    assert switch.read() is None

    def say(identifier: int, data: bytes) -> bool | None:
        other.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        ready, _, _ = select.select([switch.fileno()], [], [], 2.0)
        assert ready
        return switch.read()

    assert say(0x1F1, bytes([0, byte])) is None  # another's frame
    assert say(0x1F0, bytes([0])) is None  # too short to hold the bit
    assert say(0x1F0, bytes([0, byte])) is True
    assert say(0x1F0, bytes([0, byte ^ 0xFF])) is False
    switch.close()


class Inputs:
    def __init__(self) -> None:
        self.cts, self.dsr, self.closed = False, True, False

    def close(self) -> None:
        self.closed = True


def test_a_serial_lines_inputs_are_switches_and_a_lost_line_is_unknown() -> None:
    line = Inputs()
    assert SerialSwitch(line, "serial_cts", high=True).read() is False
    assert SerialSwitch(line, "serial_cts", high=False).read() is True
    assert SerialSwitch(line, "serial_dsr", high=True).read() is True

    class Gone:
        @property
        def cts(self) -> bool:
            raise serial.SerialException("unplugged")

    lost = SerialSwitch(Gone(), "serial_cts", high=True)
    assert lost.read() is None
    assert lost.fileno() is None


def test_a_line_that_is_not_there_is_named() -> None:
    with pytest.raises(SwitchFailed, match="/dev/not-here"):
        open_switch(settings(source="serial_cts", port="/dev/not-here"), Bus())
    with pytest.raises(SwitchFailed, match="0x1f0"):
        open_switch(settings(), Bus(interface="nonsense"))
