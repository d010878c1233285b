"""Settings of the tuning: off by default, nothing without bounds and a target, never over the channel's limits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from replays import SETTINGS
from tuning_plant import BAND, BOUNDS, channel, tuning

from fes.config import ConfigError, Session, Tuning, load_session, refuse_blind_targets

TUNED = """
[channels.tuning]
mode = "suggest"
toe_clearance_m = { low = 0.012, high = 0.035 }

[channels.tuning.bounds]
current_ma = { low = 10.0, high = 36.0 }
pulse_width_us = { low = 200.0, high = 350.0 }
start_delay_s = { low = 0.0, high = 0.2 }
extension_s = { low = 0.0, high = 0.1 }
"""
GEOMETRY = """
[geometry.right_foot]
toe_forward_m = 0.12
toe_up_m = -0.06
heel_forward_m = -0.14
heel_up_m = -0.06
"""
EARLY = BOUNDS | {"extension_s": {"low": -0.1, "high": 0.1}}
PITCH = {"low": 4.0, "high": 25.0}


def test_an_end_before_contact_is_allowed_where_its_effect_is_measured() -> None:
    bounds = channel(tuning(bounds=EARLY, pitch_at_contact_deg=PITCH)).tuning
    assert bounds is not None
    assert bounds.bounds is not None
    assert bounds.bounds.extension_s.low == -0.1
    with pytest.raises(ValidationError):
        channel(extension_s=-0.05)  # the channel's own, without a tuning that learns when contact comes


@pytest.mark.parametrize(
    ("phases", "said"),
    [
        ({"start_phase": "pre_swing", "stop_phase": "swing", "extension_s": 0.0}, 'not to stop_phase = "swing"'),
        ({"start_phase": "stance", "stop_phase": "swing", "extension_s": 0.0}, 'start in "pre_swing" or "swing"'),
    ],
)
def test_a_channel_that_lifts_no_foot_is_not_tuned(phases: dict[str, Any], said: str) -> None:
    """Such as one on the calf, which pulls the toe down: it is stimulated at the session's own settings."""
    with pytest.raises(ValidationError, match=said):
        channel(tuning(), **phases)
    channel(tuning(mode="off"), **phases)


def test_tuning_is_off_unless_asked_for() -> None:
    assert Tuning().mode == "off"
    assert load_session(SETTINGS).channels[0].tuning is None


def test_a_session_without_tuning_reads_as_it_did_before_there_was_any() -> None:
    session = load_session(SETTINGS)
    assert "tuning" not in session.model_dump_json()
    assert Session.model_validate(session.model_dump()) == session


def test_a_session_file_can_ask_for_it(tmp_path: Path) -> None:
    path = tmp_path / "tuned.toml"
    path.write_text(SETTINGS.read_text() + TUNED + GEOMETRY)
    session = load_session(path)
    refuse_blind_targets(session, path)
    tuned = session.channels[0].tuning
    assert tuned is not None
    assert tuned.mode == "suggest"
    assert tuned.bounds is not None
    assert tuned.bounds.current_ma.high == 36.0
    assert Session.model_validate_json(session.model_dump_json()) == session


def test_a_target_that_nothing_can_measure_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "tuned.toml"
    path.write_text(SETTINGS.read_text() + TUNED)
    with pytest.raises(ConfigError, match=r"cannot be measured without \[geometry\.right_foot\]"):
        refuse_blind_targets(load_session(path), path)
    stand_in = "sensor_clearance_m = { low = 0.1, high = 0.2 }\n\n[channels.tuning.bounds]"
    for text in (TUNED.replace('"suggest"', '"off"'), TUNED.replace("[channels.tuning.bounds]", stand_in)):
        path.write_text(SETTINGS.read_text() + text)
        refuse_blind_targets(load_session(path), path)


def test_a_misspelt_setting_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "tuned.toml"
    path.write_text(SETTINGS.read_text() + TUNED.replace("extension_s", "extention_s"))
    with pytest.raises(ConfigError, match=r"tuned\.toml:\d+: .*extention_s.*is not a setting"):
        load_session(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"bounds": None}, "needs bounds"),
        ({"toe_clearance_m": None}, "needs a target"),
        ({"toe_clearance_m": {"low": 0.03, "high": 0.01}}, "must be below"),
        ({"toe_clearance_m": {"low": 20.0, "high": 50.0}}, "toe_clearance_m is in metres, at most 0.2, got 20 to 50"),
        ({"sensor_clearance_m": {"low": 10.0, "high": 20.0}}, "sensor_clearance_m is in metres, at most 1"),
        ({"bounds": BOUNDS | {"current_ma": {"low": 40.0, "high": 10.0}}}, "must not be above"),
        ({"bounds": BOUNDS | {"extension_s": {"low": -0.2, "high": 0.1}}}, "greater than or equal to -0.1"),
        ({"bounds": BOUNDS | {"start_delay_s": {"low": -0.1, "high": 0.1}}}, "greater than or equal to 0"),
        ({"max_change_ma": 0.0}, "greater than 0"),
        ({"max_change_ma": 20.0}, "less than or equal to 5"),
        ({"gain": 1.5}, "less than or equal to 1"),
        ({"mode": "on"}, "'off', 'suggest' or 'act'"),
    ],
)
def test_a_tuning_that_says_too_little_or_too_much_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        tuning(**changes)


@pytest.mark.parametrize(
    ("tuned", "changes", "said"),
    [
        ({"bounds": BOUNDS | {"current_ma": {"low": 10.0, "high": 50.0}}}, {}, "max_current_ma = 45"),
        ({"bounds": BOUNDS | {"current_ma": {"low": 31.0, "high": 40.0}}}, {}, "must contain the channel's 30"),
        ({"method": "learning", "bounds": BOUNDS | {"pulse_width_us": {"low": 100.0, "high": 460.0}}}, {}, "450"),
        ({}, {"pulse_width_us": 400.0, "current_ma": 20.0, "rise_s": 0.09}, "max_rise_ma_per_s"),
        ({}, {"start_phase": "stance", "stop_phase": "swing"}, "start in"),
        ({"bounds": BOUNDS | {"extension_s": {"low": 0.0, "high": 0.9}}}, {}, "extension_s to 0.5"),
        ({"bounds": EARLY}, {}, "needs pitch_at_contact_deg"),
        ({"bounds": EARLY, "pitch_at_contact_deg": PITCH}, {"stop_phase": "stance"}, 'stop_phase = "loading_response"'),
    ],
)
def test_a_tuning_that_could_leave_the_limits_is_refused(
    tuned: dict[str, Any], changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(ValidationError, match=said):
        channel(tuning(**tuned), **changes)


def test_what_is_off_needs_nothing() -> None:
    assert channel(Tuning()).tuning == Tuning(mode="off")
    assert BAND["low"] < BAND["high"]
