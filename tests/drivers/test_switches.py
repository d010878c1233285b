"""Switches on a CAN bus between two openings of it, and on a serial line's inputs."""

from __future__ import annotations

import math
import os
import select
import termios
from collections.abc import Iterator
from dataclasses import dataclass, field

import can
import pytest
import serial
from replays import SETTINGS

from drivers.imu.open import open_imus
from drivers.imu.port import flag_option, seconds_option, whole_option
from drivers.simulated.spawn import free_bus, why_silent
from drivers.stimulator.bus import LOOPBACK, BusError, open_bus
from drivers.stimulator.open import open_stimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.serial_line import LineSettings, open_line
from drivers.switches import SILENT_NS, CanSwitch, SerialSwitch, SwitchFailed, open_switch
from fes.config import Bus, ConfigError, StimulatorDevice, load_session
from fes.config.session import FootSwitch, ImuDevice, Options
from fes.live.commands import OperatorCommand
from fes.live.inputs import FootSwitchInput, StopSwitch
from fes.signals import Event, FootSwitchEvent

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


class Frames:
    """A bus of frames put there by hand, and the time at which they are read."""

    def __init__(self) -> None:
        self.queue: list[can.Message] = []
        self.t_ns = 10**12

    def say(self, pressed: bool, **more: bool) -> None:
        data = None if more.get("is_remote_frame") else bytes((pressed << 3,))
        self.queue.append(can.Message(**{"arbitration_id": 0x1F0, "data": data, "is_extended_id": False} | more))

    def recv(self, timeout: float) -> can.Message | None:
        return self.queue.pop(0) if self.queue else None

    def switch(self) -> CanSwitch:
        return CanSwitch(self, 0x1F0, 3, high=True, clock_ns=lambda: self.t_ns)


def test_a_stop_button_that_falls_silent_on_the_bus_is_a_stop() -> None:
    bus = Frames()
    commands: list[str] = []

    def execute(command: OperatorCommand, t_ns: int) -> list[Event]:
        commands.append(command.origin)
        return []

    button = StopSwitch(bus.switch(), execute)
    for _ in range(50):
        bus.say(False)
        button.read_events(bus.t_ns)
        bus.t_ns += 100_000_000
    assert (commands, button.not_ready()) == ([], "")
    bus.t_ns += SILENT_NS
    button.read_events(bus.t_ns)
    assert commands == ["button lost"]
    assert "nothing is heard" in button.not_ready()
    bus.say(False)
    button.read_events(bus.t_ns)
    assert (commands, button.not_ready()) == (["button lost"], "")  # heard again: a person may arm


@pytest.mark.parametrize("kind", ["is_extended_id", "is_remote_frame", "is_error_frame"])
def test_another_kind_of_frame_with_the_same_number_releases_nothing(kind: str) -> None:
    bus = Frames()
    switch = bus.switch()
    bus.say(True)
    assert switch.read() is True
    bus.say(False, **{kind: True})
    assert switch.read() is True
    bus.t_ns += SILENT_NS + 1
    bus.say(False, **{kind: True})
    assert switch.read() is None  # nor does it count as a word from the switch


def test_a_foot_switch_back_from_silence_tells_only_what_was_seen_to_change() -> None:
    """A release during the silence may be long past when it is heard of: no step begins with it."""
    bus = Frames()
    foot = FootSwitchInput("left_foot", bus.switch())

    def said(pressed: bool) -> list[Event]:
        bus.say(pressed)
        return foot.read_events(bus.t_ns)

    assert said(True) == [FootSwitchEvent(bus.t_ns, "left_foot", True)]
    bus.t_ns += SILENT_NS + 1
    assert foot.read_events(bus.t_ns) == [FootSwitchEvent(bus.t_ns, "left_foot", None)]
    assert foot.read_events(bus.t_ns) == []
    assert said(False) == []
    assert said(True) == []
    assert said(False) == [FootSwitchEvent(bus.t_ns, "left_foot", False)]
    bus.t_ns += SILENT_NS + 1
    assert foot.read_events(bus.t_ns) == [FootSwitchEvent(bus.t_ns, "left_foot", None)]
    assert foot.read_events(bus.t_ns) == []
    assert said(True) == [FootSwitchEvent(bus.t_ns, "left_foot", True)]  # late, but it ends what is on


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


def test_a_switch_leaves_a_line_alone_that_another_device_has() -> None:
    """Opening it would set its speed to 9600 baud, and a stimulator on it would hear nothing any more."""
    master, line = os.openpty()
    port = os.ttyname(line)
    try:
        stimulator = open_line(port, LineSettings(460800))
        speed = termios.tcgetattr(stimulator.fileno())[4]
        with pytest.raises(SwitchFailed, match="has nobody else opened it"):
            open_switch(settings(source="serial_cts", port=port), Bus())
        assert termios.tcgetattr(stimulator.fileno())[4] == speed == termios.B460800
        stimulator.close()
        switches = [open_switch(settings(source=source, port=port), Bus()) for source in ("serial_cts", "serial_dsr")]
        with pytest.raises(StimulatorLost, match="cannot be opened"):
            open_line(port, LineSettings(460800))
        for switch in switches:
            switch.close()
        open_line(port, LineSettings(460800)).close()
    finally:
        os.close(master)
        os.close(line)


# --- Options of a session's devices ---


NO_WHOLE = (1.5, 1.0, True, "1", math.nan, math.inf)
NODE: Options = {
    "node_id": 5,
    "current_index": 0x3200,
    "width_index": 0x3201,
    "current_step_ma": 0.5,
    "width_step_us": 10.0,
    "max_current_ma": 100.0,
    "max_width_us": 400.0,
}


@dataclass(frozen=True)
class Sensor:
    """Settings that nothing has checked."""

    device: str
    options: Options = field(default_factory=dict)
    rate_hz: float = 100.0
    sensor: str = "left_foot"
    port: str = "/dev/nowhere"
    acc_range_g: float = 16.0
    gyr_range_dps: float = 2000.0


@pytest.mark.parametrize("value", NO_WHOLE)
@pytest.mark.parametrize(
    ("device", "option"), [("xbus", "baudrate"), ("ximu3", "baudrate"), ("xsens_can", "id_offset")]
)
def test_what_is_no_whole_number_is_never_made_one(device: str, option: str, value: str | float | bool) -> None:
    with pytest.raises(ValueError, match=rf"left_foot: options\.{option} = .* must be a whole number"):
        open_imus([Sensor(device, {option: value}, port="bus" if device == "xsens_can" else "/dev/nowhere")])


def test_identifiers_may_be_moved_down_as_well() -> None:
    device = ImuDevice(sensor="left_foot", device="xsens_can", rate_hz=100.0, acc_range_g=16.0, gyr_range_dps=2000.0)
    assert whole_option(device.model_copy(update={"options": {"id_offset": -3}}), "id_offset", 0, -0x7FF) == -3
    with pytest.raises(ValueError, match="leaves the identifiers 0 to 0x7ff"):
        open_imus([device.model_copy(update={"options": {"id_offset": -300}})])


@pytest.mark.parametrize("value", [0, -1])
def test_a_line_has_a_speed(value: int) -> None:
    with pytest.raises(ValueError, match=r"options\.baudrate = .* of at least 1"):
        open_imus([Sensor("ximu3", {"baudrate": value})])


def test_an_mti_is_not_asked_for_another_rate_than_the_session_names() -> None:
    with pytest.raises(ValueError, match=r"left_foot: rate_hz = 99\.6 must be whole"):
        open_imus([Sensor("xbus", rate_hz=99.6)])


@pytest.mark.parametrize(("device", "option"), [("xbus", "configure"), ("xsens_can", "group_counter")])
def test_the_text_false_is_not_true(device: str, option: str) -> None:
    with pytest.raises(ValueError, match=rf"options\.{option} = 'false' must be true or false"):
        open_imus([Sensor(device, {option: "false"}, port="bus" if device == "xsens_can" else "/dev/nowhere")])
    assert flag_option(Sensor(device, {option: False}), option, True) is False
    assert flag_option(Sensor(device), option, True) is True


@pytest.mark.parametrize("value", [0, -5.0, math.nan, math.inf, True, "5"])
def test_a_time_is_above_0(value: str | float | bool) -> None:
    with pytest.raises(ValueError, match=r"options\.timeout_s = .* must be a number of seconds above 0"):
        seconds_option(Sensor("lsl", {"timeout_s": value}), "timeout_s", 5.0)
    assert seconds_option(Sensor("lsl", {"timeout_s": 2}), "timeout_s", 5.0) == 2


@pytest.mark.parametrize("value", [40000.5, True, "40000"])
def test_a_loopback_bus_has_a_whole_port(value: str | float | bool) -> None:
    with pytest.raises(BusError, match="the port must be a whole number"):
        open_bus(Bus(interface=LOOPBACK, options={"port": value}))


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"max_current_ma": 39.0}, "current_ma = 40.0; this stimulator takes 0 to 39"),
        ({"max_width_us": 399.0}, "pulse_width_us = 400.0; this stimulator takes 0 to 399"),
        ({"current_step_ma": 0.1}, "current_ma = 40.0 does not fit an entry of 1 bytes"),
    ],
)
def test_a_session_may_not_allow_more_than_a_canopen_stimulator_delivers(limits: dict[str, float], said: str) -> None:
    """Its channel asks for 30 mA and 300 µs, but its own limits are 40 mA and 400 µs."""
    settings = StimulatorDevice(device="canopen", options={**NODE, **limits})
    with pytest.raises(ConfigError, match=rf"'Tibialis anterior, right': its limits allow more .*: {said}"):
        open_stimulator(settings, load_session(SETTINGS), 1)


def test_a_bus_by_its_other_name_is_no_second_bus() -> None:
    """Else two feet with the same identifiers would both be fed by the same frames."""
    bus = Bus(interface="virtual", channel="feet")
    feet = [Sensor("xsens_can", port="bus"), Sensor("xsens_can", port="virtual:feet", sensor="right_foot")]
    with pytest.raises(ValueError, match="right_foot and left_foot both use the identifier"):
        open_imus(feet, bus)
    feet[1].options["id_offset"] = 0x40
    (port,) = open_imus(feet, bus)
    assert port.sensors == ("left_foot", "right_foot")
    port.close()
