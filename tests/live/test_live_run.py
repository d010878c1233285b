"""`fes run` refuses what cannot run, and its loop loads nothing heavy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from replays import SETTINGS

from fes.cli.common import UNUSABLE
from fes.cli.run.command import command
from fes.cli.run.devices import stop_switch_settings
from fes.config import ConfigError

SENSOR = (
    '[[sensors]]\nsensor = "right_foot"\ndevice = "xbus"\nport = "/dev/nothing-here"\nrate_hz = 100\n'
    "acc_range_g = 16\ngyr_range_dps = 2000\n"
)
LIMITS = [
    "max_current_ma",
    "max_pulse_width_us",
    "max_frequency_hz",
    "max_charge_per_phase_uc",
    "max_current_density_ma_per_cm2",
    "max_rise_ma_per_s",
    "max_on_s",
    "min_off_s",
]


def run(folder: Path, text: str, *options: str) -> tuple[int, str]:
    path = folder / "session.toml"
    path.write_text(text)
    done = CliRunner().invoke(command, [str(path), "--out", str(folder / "out"), *options])
    return done.exit_code, done.output


@pytest.mark.parametrize("limit", LIMITS)
def test_a_missing_limit_means_refusing_to_start(tmp_path: Path, limit: str) -> None:
    text = "\n".join(line for line in SETTINGS.read_text().splitlines() if not line.startswith(limit))
    code, said = run(tmp_path, f"{text}\n{SENSOR}")
    assert code == UNUSABLE
    assert f"{limit}: is required and missing" in said
    assert not (tmp_path / "out").exists()


def test_a_session_without_sensors_is_refused(tmp_path: Path) -> None:
    code, said = run(tmp_path, SETTINGS.read_text())
    assert code == UNUSABLE
    assert "[[sensors]]" in said


def test_a_channel_on_a_foot_without_a_sensor_is_refused(tmp_path: Path) -> None:
    code, said = run(tmp_path, SETTINGS.read_text() + SENSOR.replace("right", "left"))
    assert code == UNUSABLE
    assert "right_foot" in said


def test_a_sensor_that_cannot_be_opened_is_named(tmp_path: Path) -> None:
    code, said = run(tmp_path, f"{SETTINGS.read_text()}\n{SENSOR}")
    assert code == UNUSABLE
    assert "/dev/nothing-here" in said
    assert "Traceback" not in said


def test_a_calibration_that_is_none_is_refused(tmp_path: Path) -> None:
    other = tmp_path / "c.json"
    other.write_text("{}")
    code, said = run(tmp_path, f"{SETTINGS.read_text()}\n{SENSOR}", "--calibration", str(other))
    assert code == UNUSABLE
    assert "c.json" in said


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("can_bit:0x1F0:3", ("can_bit", 0x1F0, 3, "high")),
        ("can_bit:496:3:low", ("can_bit", 496, 3, "low")),
        ("serial_cts:/dev/ttyUSB0", ("serial_cts", 0, 0, "high")),
        ("serial_dsr:socket://host:5000:low", ("serial_dsr", 0, 0, "low")),
    ],
)
def test_a_stop_button_is_described_in_one_word(text: str, expected: tuple[str, int, int, str]) -> None:
    settings = stop_switch_settings(text)
    assert (settings.source, settings.identifier, settings.bit, settings.pressed) == expected
    if text.startswith("serial"):
        assert settings.port == text.removesuffix(":low").split(":", 1)[1]


@pytest.mark.parametrize("text", ["", "can_bit", "can_bit:9999:1", "can_bit:1:64", "can_bit:x:1", "gpio:3"])
def test_what_is_no_stop_button_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="must be can_bit"):
        stop_switch_settings(text)


def test_the_live_loop_loads_nothing_heavy() -> None:
    heavy = ("pandas", "pyarrow", "jinja2", "scipy.linalg", "scipy.signal", "rich.live", "matplotlib")
    code = f"import fes.cli.run.command, sys; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"
