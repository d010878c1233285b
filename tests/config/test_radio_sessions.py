"""A session with a channel beside a sensor by radio: what it must say, and what it may not."""

from __future__ import annotations

from pathlib import Path

import pytest

from fes import limits
from fes.config import ConfigError, Session, load_session
from fes.config.session import load_exercise
from fes.hil.settings import patient_session_text
from fes.simulation.forward import settings_for

PATIENT = settings_for("moderate", sensors=("right_foot",))
GOOD = patient_session_text(PATIENT, ports={"right_foot": "IMU_1234ab"}, sensors="capture2go_ble")
EXERCISE = "\n[exercise]\non_s = 0.3\noff_s = 1.0\nrise_s = 0.2\nfall_s = 0.1\ncount = 3\n"


def load(tmp_path: Path, text: str) -> Session:
    path = tmp_path / "session.toml"
    path.write_text(text, encoding="utf-8")
    return load_session(path)


def test_what_the_simulation_writes_is_a_session_by_radio(tmp_path: Path) -> None:
    session = load(tmp_path, GOOD)
    assert session.by_radio == {"right_foot"}
    assert load(tmp_path, GOOD.replace("capture2go_ble", "movella_dot")).by_radio == {"right_foot"}
    (tmp_path / "session.toml").write_text(GOOD + EXERCISE, encoding="utf-8")
    assert load_exercise(tmp_path / "session.toml").stimulation.max_data_age_ms == limits.MAX_DATA_AGE_MS


@pytest.mark.requirement("SR-29")
@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("validity_ms = 40", "validity_ms = 60", "by radio validity_ms is 40 at most, not 60"),
        ("max_on_s = 1.5", "max_on_s = 1.6", r"channel .*: by radio max_on_s is 1\.5 at most, not 1\.6"),
        ("max_current_ma = 50.0", "max_current_ma = 61.0", "by radio max_current_ma is 60 at most"),
        ("phase_uc = 15.0", "phase_uc = 20.5", "by radio max_charge_per_phase_uc is 20 at most"),
        ("minute_mc = 30.0", "minute_mc = 31.0", "by radio max_charge_per_minute_mc is 30 at most"),
        ("max_data_age_ms = 120", "max_data_age_ms = 121", "max_data_age_ms"),
        ("capture2go_ble", "witmotion", r"max_data_age_ms = 120 is over 40; up to 120 is only for sensors by radio"),
        ("capture2go_ble", "capture2go", r"max_data_age_ms = 120 is over 40; up to 120 is only for sensors by radio"),
    ],
)
def test_what_a_radio_does_not_allow_is_refused_by_name(tmp_path: Path, old: str, new: str, says: str) -> None:
    assert GOOD.count(old) == 1
    with pytest.raises(ConfigError, match=says):
        load(tmp_path, GOOD.replace(old, new))


@pytest.mark.requirement("SR-29")
def test_nothing_is_tuned_by_radio(tmp_path: Path) -> None:
    tuned = patient_session_text(PATIENT, ports={"right_foot": "/dev/ttyUSB0"})
    text = tuned.replace('"xbus"', '"capture2go_ble"').replace("intensity = 1.0", "intensity = 1.0\nvalidity_ms = 40")
    text = text.replace("max_on_s = 3.0", "max_on_s = 1.5").replace("minute_mc = 40.0", "minute_mc = 30.0")
    with pytest.raises(ConfigError, match="by radio nothing is tuned"):
        load(tmp_path, text)
