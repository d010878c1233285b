"""Options of a session's devices: what is no number, no whole number, or neither yes nor no is refused by name."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from replays import SETTINGS

from drivers.imu.open import open_imus
from drivers.imu.port import flag_option, seconds_option, whole_option
from drivers.stimulator.bus import LOOPBACK, BusError, open_bus
from drivers.stimulator.canopen_port import CanOpenSettings
from drivers.stimulator.open import open_stimulator
from fes.config import Bus, ConfigError, Session, StimulatorDevice, load_session, validate_session
from fes.config.session import ImuDevice, Options

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


@pytest.mark.parametrize(
    ("device", "option"), [("xbus", "configure"), ("ximu3", "library"), ("xsens_can", "group_counter")]
)
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


@pytest.mark.parametrize("value", [1.0, True, "1", 3])
def test_a_canopen_value_has_whole_bytes(value: str | float | bool) -> None:
    with pytest.raises(ValueError, match=r"value_bytes = .* must be 1, 2 or 4"):
        CanOpenSettings.from_options({**NODE, "value_bytes": value})


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


def test_true_is_no_number_of_seconds_for_a_watchdog() -> None:
    settings = StimulatorDevice(device="p24_mid_level", port="x", options={"accept_watchdog_s": True})
    with pytest.raises(ConfigError, match="accept_watchdog_s = True must be a number of seconds"):
        open_stimulator(settings, session(), 1)


def session() -> Session:
    return validate_session({"name": "options"}, Path("session.toml"), "")
