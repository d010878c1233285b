"""A session file that cannot be used says where, what and what would be right."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest
from replays import SETTINGS, cut, replay, trial

from fes.cli.cohort import apply_best
from fes.cli.common import Problem
from fes.cohort.sweep.table import Combination
from fes.config import ConfigError, Session, load_session
from fes.config.thresholds import changed_thresholds, describe_thresholds, with_thresholds_table
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import calibration_from_dict
from fes.estimation.tracking.phase_features import FOLLOW, LEAST, MOST
from fes.recording import write_recording
from fes.report.findings import findings
from fes.report.page import render_report
from fes.report.summary import summarise
from statemachine.guards import Thresholds

GOOD = """\
name = "morning"
subject = "S1"

[stimulation]
intensity = 0.8
command_rate_hz = 50

[[channels]]
name = "left dorsiflexors"
number = 0
foot = "left_foot"
electrode_area_cm2 = 25.0
current_ma = 24.0
pulse_width_us = 300.0
frequency_hz = 40.0
never_with = [1]

[channels.limits]
max_current_ma = 30.0
max_pulse_width_us = 300.0
max_frequency_hz = 50.0
max_charge_per_phase_uc = 9.0
max_charge_per_minute_mc = 50.0
max_current_density_ma_per_cm2 = 1.0
max_rise_ma_per_s = 250.0
max_on_s = 2.0
min_off_s = 0.1

[[channels]]
name = "left calf"
number = 1
foot = "left_foot"
electrode_area_cm2 = 25.0
current_ma = 20.0
pulse_width_us = 250.0
frequency_hz = 30.0
start_phase = "stance"
stop_phase = "swing"

[channels.limits]
max_current_ma = 30.0
max_pulse_width_us = 300.0
max_frequency_hz = 50.0
max_charge_per_phase_uc = 9.0
max_charge_per_minute_mc = 50.0
max_current_density_ma_per_cm2 = 1.0
max_rise_ma_per_s = 250.0
max_on_s = 2.5
min_off_s = 0.2

[bus.options]
port = 43113

[treadmill]
belt_speed_mps = 0.4

[geometry.left_foot]
toe_forward_m = 0.1
toe_up_m = -0.08
heel_forward_m = -0.15
heel_up_m = -0.08
"""


def message(tmp_path: Path, text: str) -> str:
    path = tmp_path / "session.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_session(path)
    return str(caught.value).replace(f"{tmp_path}/", "")


def with_line(old: str, new: str, occurrence: int = 1) -> tuple[str, int]:
    """The good session with the nth line ``old`` replaced, and that line's number."""
    lines = GOOD.split("\n")
    at = [i for i, line in enumerate(lines) if line == old][occurrence - 1]
    lines[at] = new
    return "\n".join(lines), at + 1


def test_good_session_survives_being_written_and_read_again(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text(GOOD, encoding="utf-8")
    session = load_session(path)
    assert [channel.number for channel in session.channels] == [0, 1]
    assert session.channels[0].never_with == (1,)
    assert session.channels[1].limits.min_off_s == 0.2
    assert session.bus.options == {"port": 43113}
    assert Session.model_validate(session.model_dump(mode="json")) == session


def test_byte_order_mark_is_no_obstacle(tmp_path: Path) -> None:
    path = tmp_path / "session.toml"
    path.write_text(GOOD, encoding="utf-8-sig")
    assert load_session(path).name == "morning"


@pytest.mark.parametrize(
    ("old", "new", "occurrence", "key", "value", "allowed"),
    [
        ("intensity = 0.8", "intensity = 1.5", 1, "stimulation.intensity", "1.5", "less than or equal to 1"),
        ("intensity = 0.8", "intensity = true", 1, "stimulation.intensity", "True", "valid number"),
        ("intensity = 0.8", "intensity = nan", 1, "stimulation.intensity", "nan", "finite"),
        ("command_rate_hz = 50", "command_rate_hz = 500", 1, "stimulation.command_rate_hz", "500", "to 100"),
        ('name = "left calf"', 'name = ""', 1, "channels[1].name", "''", "at least 1 character"),
        ("number = 1", "number = 8", 1, "channels[1].number", "8", "less than or equal to 7"),
        ("number = 1", "number = 1.5", 1, "channels[1].number", "1.5", "valid integer"),
        ("never_with = [1]", 'never_with = ["calf"]', 1, "channels[0].never_with[0]", "'calf'", "valid integer"),
        ("never_with = [1]", "never_with = 1", 1, "channels[0].never_with", "1", "valid tuple"),
        ('foot = "left_foot"', 'foot = "leg"', 2, "channels[1].foot", "'leg'", "'left_foot' or 'right_foot'"),
        ('start_phase = "stance"', 'start_phase = "heel"', 1, "channels[1].start_phase", "'heel'", "'pre_swing'"),
        ("current_ma = 24.0", 'current_ma = "24"', 1, "channels[0].current_ma", "'24'", "valid number"),
        ("current_ma = 24.0", "current_ma = 131", 1, "channels[0].current_ma", "131", "less than or equal to 130"),
        ("electrode_area_cm2 = 25.0", "electrode_area_cm2 = 0", 2, "channels[1].electrode_area_cm2", "0", "than 0"),
        ("max_on_s = 2.5", "max_on_s = 3.5", 1, "channels[1].limits.max_on_s", "3.5", "less than or equal to 3"),
        ("max_current_ma = 30.0", "max_current_ma = -1", 2, "channels[1].limits.max_current_ma", "-1", "than 0"),
        ("min_off_s = 0.2", "min_off_s = 0.0", 1, "channels[1].limits.min_off_s", "0.0", "equal to 0.05"),
        ("port = 43113", "port = [1]", 1, "bus.options.port", "[1]", "text, a number, true or false"),
        ("belt_speed_mps = 0.4", "belt_speed_mps = inf", 1, "treadmill.belt_speed_mps", "inf", "finite"),
        ("toe_up_m = -0.08", "toe_up_m = 8", 1, "geometry.left_foot.toe_up_m", "8", "less than or equal to 0.1"),
        ('subject = "S1"', "subjekt = 1", 1, "subjekt", "1", "allowed are name, subject"),
        ('foot = "left_foot"', "feet = 2", 2, "channels[1].feet", "2", "allowed are name, number, foot"),
        ("max_on_s = 2.5", "max_on = 2.5", 1, "channels[1].limits.max_on", "2.5", "allowed are max_current_ma"),
        ("toe_up_m = -0.08", "toe_up = 1", 1, "geometry.left_foot.toe_up", "1", "allowed are toe_forward_m"),
    ],
)
def test_bad_value_names_line_key_value_and_remedy(
    tmp_path: Path, old: str, new: str, occurrence: int, key: str, value: str, allowed: str
) -> None:
    text, line = with_line(old, new, occurrence)
    said = message(tmp_path, text).split("\n")
    assert any(one.startswith(f"session.toml:{line}: {key} = {value}: ") and allowed in one for one in said), said


@pytest.mark.parametrize(
    ("old", "occurrence", "key", "header", "nth"),
    [
        ('foot = "left_foot"', 2, "channels[1].foot", "[[channels]]", 2),
        ("max_on_s = 2.0", 1, "channels[0].limits.max_on_s", "[channels.limits]", 1),
        ("max_on_s = 2.5", 1, "channels[1].limits.max_on_s", "[channels.limits]", 2),
        ("belt_speed_mps = 0.4", 1, "treadmill.belt_speed_mps", "[treadmill]", 1),
    ],
)
def test_missing_setting_points_at_its_table(
    tmp_path: Path, old: str, occurrence: int, key: str, header: str, nth: int
) -> None:
    text, _ = with_line(old, "", occurrence)
    _, line = with_line(header, header, nth)
    assert message(tmp_path, text) == f"session.toml:{line}: {key}: is required and missing"


def test_missing_top_level_name_is_not_mistaken_for_a_channels(tmp_path: Path) -> None:
    text, _ = with_line('name = "morning"', "")
    assert message(tmp_path, text) == "session.toml: name: is required and missing"


@pytest.mark.requirement("SR-17")
def test_missing_limits_are_a_refusal(tmp_path: Path) -> None:
    """The first channel has lost its limits; the second channel's table must not be blamed."""
    lines = GOOD.split("\n")
    start = lines.index("[channels.limits]")
    del lines[start : start + 10]
    assert message(tmp_path, "\n".join(lines)) == "session.toml:8: channels[0].limits: is required and missing"


@pytest.mark.requirement("SR-17")
@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("current_ma = 24.0", "current_ma = 31.0", "current_ma is 31 mA, over this channel's limit of 30 mA"),
        ("pulse_width_us = 300.0", "pulse_width_us = 310.0", "pulse_width_us is 310 µs, over this channel's limit"),
        ("frequency_hz = 40.0", "frequency_hz = 60.0", "frequency_hz is 60 Hz, over this channel's limit of 50 Hz"),
        ("max_charge_per_phase_uc = 9.0", "max_charge_per_phase_uc = 7.0", "is 7.2 µC per phase, over"),
        ("electrode_area_cm2 = 25.0", "electrode_area_cm2 = 1.0", "current density is 3.718 mA/cm² r.m.s., over"),
        ("max_rise_ma_per_s = 250.0", "max_rise_ma_per_s = 100.0", "current_ma / rise_s is 160 mA/s, over"),
        ("never_with = [1]", "never_with = [0]", "never_with names the channel itself (0)"),
        ("number = 0", 'number = 0\nstop_phase = "pre_swing"', "start_phase and stop_phase are both 'pre_swing'"),
    ],
)
def test_plan_that_breaks_the_channels_own_limits(tmp_path: Path, old: str, new: str, said: str) -> None:
    text, _ = with_line(old, new)
    complaint = message(tmp_path, text)
    assert complaint.startswith("session.toml:8: channels[0]: ")
    assert said in complaint


def test_channels_must_be_distinct_and_partners_known(tmp_path: Path) -> None:
    assert "different numbers, got [0, 0]" in message(tmp_path, with_line("number = 1", "number = 0")[0])
    assert "never_with names no channel: [5]" in message(tmp_path, with_line("never_with = [1]", "never_with = [5]")[0])


def test_validity_must_outlast_two_command_periods(tmp_path: Path) -> None:
    complaint = message(tmp_path, with_line("intensity = 0.8", "validity_ms = 39")[0])
    assert complaint.startswith("session.toml:4: stimulation: validity_ms = 39 must be at least two command periods")


def test_several_faults_are_all_listed(tmp_path: Path) -> None:
    text = GOOD.replace("max_on_s = 2.0", "max_on_s = 9").replace("[treadmill]", "[treadmil]")
    said = message(tmp_path, text).split("\n")
    assert len(said) == 2
    assert any("channels[0].limits.max_on_s = 9" in one for one in said)
    assert any("treadmil: is not a setting" in one for one in said)


def test_unknown_foot_in_geometry(tmp_path: Path) -> None:
    text = GOOD.replace("[geometry.left_foot]", "[geometry.left_hand]").replace("toe_up_m", "toe_up")
    said = message(tmp_path, text)
    line = GOOD.split("\n").index("[geometry.left_foot]") + 1
    assert f"session.toml:{line}: geometry.left_hand = 'left_hand': Input should be 'left_foot'" in said
    assert f"session.toml:{line + 2}: geometry.left_hand.toe_up = -0.08: is not a setting; allowed are toe_" in said


@pytest.mark.parametrize("limits", ["limits = { max_on_s = 9 }", "limits.max_on_s = 9", '"limits".max_on_s = 9'])
def test_other_ways_of_writing_a_table_still_find_the_line(tmp_path: Path, limits: str) -> None:
    text = 'name = """\n[[channels]]\n"""\n[[channels]]\n' + limits + "\n"
    assert re.search(r"session\.toml:5: channels\[0\]\.limits\.max_on_s = 9", message(tmp_path, text))


def test_file_that_is_no_session(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.toml: cannot be read: No such file"):
        load_session(tmp_path / "absent.toml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_session(tmp_path)
    (tmp_path / "bytes.toml").write_bytes(b"name = \xff")
    with pytest.raises(ConfigError, match=r"bytes\.toml: is not text \(byte 7\)"):
        load_session(tmp_path / "bytes.toml")
    assert re.match(r"session\.toml: is not valid TOML: .*line 2", message(tmp_path, 'name = "a"\nb = = 2\n'))


def test_table_where_a_value_belongs_and_the_other_way_round(tmp_path: Path) -> None:
    assert message(tmp_path, 'name = "a"\nchannels = 3\n').startswith("session.toml:2: channels = 3: ")
    assert message(tmp_path, 'name = "a"\nstimulation = "on"\n').startswith("session.toml:2: stimulation = 'on': ")
    assert message(tmp_path, "[name]\nx = 1\n").startswith("session.toml:1: name: Input should be a valid string")


# --- ``[thresholds]``: what may be set, what it does, where it is shown, and that the log keeps every value ---


def session(folder: Path, table: str) -> Path:
    path = folder / "session.toml"
    path.write_text(f"{SETTINGS.read_text()}\n[thresholds]\n{table}\n")
    return path


def test_numbers_factors_and_flags() -> None:
    own = Thresholds()._replace(fall_radps=10.0)
    new = changed_thresholds(
        own, {"fall_radps": "x1.2", "heel_rise_share": 0.3, "swing_at_reversal": True, "origin": "somebody"}
    )
    assert new == own._replace(fall_radps=12.0, heel_rise_share=0.3, swing_at_reversal=True)
    assert changed_thresholds(own, {}) == own


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("heel_rise = 0.3", "heel_rise is no threshold; perhaps heel_rise_"),
        ("heel_rise_share = 5.0", "outside 0.25 to 4 times the default"),
        ('fall_radps = "x9"', "outside 0.25 to 4 times the default"),
        ('fall_radps = "many"', "must be a number, 0 or more"),
        ("swing_at_reversal = 1.0", "must be true or false"),
        ("rest_share = true", "must be a number, 0 or more"),
        ("rest_share = -1.0", "must be a number, 0 or more"),
    ],
)
def test_what_is_refused_and_with_which_words(tmp_path: Path, table: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_session(session(tmp_path, table))


def test_a_session_that_sets_none_reads_as_it_did() -> None:
    assert "thresholds" not in load_session(SETTINGS).model_dump_json()


def test_a_file_gets_a_new_table_and_loses_the_old_one() -> None:
    text = with_thresholds_table("a = 1\n[thresholds]\nrest_share = 0.2\n\n[live]\nb = 2\n", {"fall_radps": "x1.2"})
    assert text == 'a = 1\n[live]\nb = 2\n\n[thresholds]\nfall_radps = "x1.2"\n'
    assert (
        describe_thresholds({"rest_share": 0.2, "origin": "me"})
        == "thresholds of the session: rest_share 0.2 (from: me)"
    )
    assert describe_thresholds({}) == describe_thresholds({"origin": "me"}) == ""


def test_they_hold_in_a_session_are_shown_and_every_value_is_in_the_log(tmp_path: Path) -> None:
    path = tmp_path / "walk.parquet"
    write_recording(cut(trial("negard_patient2"), 0.0, 30.0), path)
    usual = replay(path, tmp_path / "a")
    table = 'flat_rad = 0.02\nfall_radps = "x1.1"\norigin = "a test"'
    record = replay(path, tmp_path / "b", session(tmp_path, table))
    assert [c.t_ns for c in record.phases] != [c.t_ns for c in usual.phases], "they decide"
    summary = summarise(record)
    line = "Thresholds of the session: flat_rad 0.02, fall_radps x1.1 (from: a test)."
    assert line in [finding.text for finding in findings(summary)]
    page = render_report(record)
    assert line[:-1] in page
    assert "These measures followed the strides" in page

    foot = calibration_from_dict(record.header["calibration"]["right_foot"])
    assert isinstance(foot, FootCalibration)
    calibration = foot.thresholds()
    landings = [change for change in record.phases if change.destination.name == "STANCE"]
    notes = [note for note in record.notes if note.source == "thresholds"]
    assert [note.t_ns for note in notes] == [change.t_ns for change in landings], "one at each landing"
    rows = {row.name: row for row in summary.measures}
    assert rows["fall_radps"].begin == pytest.approx(1.1 * calibration.fall_radps)
    for row in rows.values():
        assert row.strides == len(landings)
        assert (
            LEAST * row.begin <= row.bounds[0] <= row.least <= row.last <= row.most <= row.bounds[1] <= MOST * row.begin
        )
    falls = [float(note.text.split("fall_radps ")[1].split(",")[0]) for note in notes]
    steps = [abs(b - a) for a, b in pairwise(falls)]
    assert max(steps) > 0.0
    assert max(steps) < FOLLOW * 1.6 * max(falls)
    assert not [notice for notice in summary.notices if notice.source == "thresholds"], "a table, not hundreds of notes"


def combination(**settings: object) -> Combination:
    return Combination({name.replace("__", "."): value for name, value in settings.items()}, {}, 1, 0, ())


def test_the_best_of_a_sweep_is_written_with_its_origin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "best.toml"
    with pytest.raises(Problem, match="nothing to write"):
        apply_best([combination(), combination(thresholds__jerk_share=0.2)], SETTINGS, target, 1)
    best = combination(thresholds__jerk_share=0.2, thresholds__fall_radps="x1.1", phases__swing_begins="reversal")
    apply_best([best, combination()], session(tmp_path, "rest_share = 0.2\njerk_share = 0.9"), target, 3)
    assert load_session(target).thresholds == {
        "rest_share": 0.2,
        "jerk_share": 0.2,
        "fall_radps": "x1.1",
        "origin": "fes sweep: best of 2 combinations on 3 cases",
    }
    assert load_session(target).phases.swing_begins == "peak"
    assert "no thresholds: phases.swing_begins" in capsys.readouterr().out
    apply_best([best, combination()], SETTINGS, target, 3, as_json=True)
    assert capsys.readouterr().out == "", "stdout holds the JSON alone"
    with pytest.raises(Problem, match=r"outside 0\.25 to 4 times"):
        apply_best([combination(thresholds__jerk_share=9.0)], SETTINGS, target, 1)
