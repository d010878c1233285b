"""What the report says of the walking: parameters, curves, the feet side by side, and which strides want care."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import report_records as make
from click.testing import CliRunner
from replays import TRIALS
from report_records import channel, header, walk

from fes.analysis.hemiparetic.walk import hemiparetic_walk
from fes.analysis.parameters.definitions import DEFINITIONS
from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.cli.main import main
from fes.recording import read_recording
from fes.report.figures import strides
from fes.report.figures.strides import butterfly_figures, projected, space_figure
from fes.report.figures.svg import Figure, Plot
from fes.report.figures.timeseries import chart_data
from fes.report.gait import foot_curves, gait_of_strides
from fes.report.html import css_text
from fes.report.page import render_report
from fes.report.parameter_table import (
    flags_touching,
    hemiparetic_section,
    parameter_rows,
    temporal_symmetry,
    terms,
    walk_rows,
)
from fes.report.quality import (
    CLIPPED_ACC,
    CLIPPED_GYR,
    LOST,
    UNSURE,
    all_flags,
    describe_flags,
    sensor_flags,
    stride_flags,
)
from fes.report.summary import summarise_session
from fes.report.text import number, slug
from fes.session_log import SampleArrays, SessionRecord
from fes.signals import FloatArray, StrideResult


@pytest.fixture(scope="module")
def walked() -> Analysis:
    recording, found = calibrations_of(read_recording(TRIALS / "both_feet_100hz.parquet"))
    return analyse(recording, found.calibrations)


def shown_rows(html: str) -> dict[str, list[str]]:
    """The cells of the table of gait parameters, by parameter."""
    rows = re.findall(r'<tr data-parameter="(\w+)">(.*?)</tr>', html, re.S)
    return {key: re.findall(r"<td[^>]*>(.*?)</td>", row, re.S) for key, row in rows}


def test_the_report_shows_the_numbers_of_the_json(walked):
    hemiparetic = hemiparetic_walk(walked)
    gait = hemiparetic.parameters
    record = walked.walk_record("2026-11-20T10:00:00+00:00")
    html = render_report(record, paths=walked.paths, gait=gait, hemiparetic=hemiparetic)
    told_json = json.loads(json.dumps(gait.to_json(), allow_nan=False))
    rows, feet, sides = shown_rows(html), told_json["feet"], told_json["sides"]
    assert len(rows) > 15
    for key, cells in rows.items():
        known = DEFINITIONS[key]
        digits = {"cm": 1, "°": 1, "%": 1}.get(known.shown, 2)
        expected = [known.shown]
        for foot in ("left_foot", "right_foot"):
            value = feet[foot][key]
            size = [math.nan if value[name] is None else value[name] for name in ("mean", "sd", "cv")]
            expected += [number(known.factor * v, digits) for v in size[:2]] + [number(100.0 * size[2], 1)]
            expected.append(str(value["n"]))
        both = [sides.get(key, {}).get(name) for name in ("ratio", "index_percent")]
        expected += [number(math.nan if v is None else v, d) for v, d in zip(both, (2, 1), strict=True)]
        plain = [re.sub(r"\s*<a.*?</a>", "", cell) for cell in cells]
        assert plain == expected, key
    speed = told_json["walk"]["walking_speed_mps"]
    assert f">{speed:.2f} m/s</td>" in html


def test_a_hemiparetic_walk_has_its_section(walked):
    record, walk = walked.walk_record("2026-11-20T10:00:00+00:00"), hemiparetic_walk(walked)
    html = render_report(record, gait=walk.parameters, hemiparetic=walk)
    assert "Paretic side: not sure" in html  # the simulated person has none
    assert "Strides between zero-velocity windows" in html
    assert html.count('data-space="') == 2
    assert "do not go by them here" in html  # a brisk treadmill walk is not what the windows were made for
    level = re.findall(r"<td class=\"text\">(\d+) level</td>", html)
    assert [int(count) for count in level] == [sum(s.foot == foot for s in walked.strides) for foot in walk.terrain]
    given = hemiparetic_walk(walked, paretic="right")
    section = hemiparetic_section(given)
    assert section["heading"].startswith("Paretic side: right, as given")
    assert not section["sure"]
    sure = replace(given, side=replace(given.side, score=0.9, agreeing=4, votes=dict.fromkeys(given.side.votes, -0.9)))
    assert hemiparetic_section(sure)["sure"]
    assert 'id="hemiparetic"' not in render_report(record, gait=walk.parameters)


@pytest.mark.slow
def test_the_command_hands_over_what_it_found(tmp_path):
    trial = str(TRIALS / "both_feet_100hz.parquet")
    done = CliRunner().invoke(main, ["analyse", trial, "--json", "--paretic-side", "left", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    speed = json.loads(done.stdout)["parameters"]["walk"]["walking_speed_mps"]
    (report,) = tmp_path.glob("*/report.html")
    html = report.read_text(encoding="utf-8")
    assert f">{speed:.2f} m/s</td>" in html
    assert "From the samples, off-line" in html
    assert "Paretic side: left" in html


def test_a_logs_parameters_are_those_of_its_strides():
    record = make.walk(12)
    gait = gait_of_strides(record.strides, make.BELT_MPS)
    for foot, found in gait.feet.items():
        own = [stride for stride in record.strides if stride.foot == foot and stride.valid]
        assert found["swing_s"].mean == pytest.approx(
            np.mean([(s.t_loading_response_ns - s.t_swing_ns) / 1e9 for s in own])
        )
        assert found["stride_time_s"].n == len(own) - 1
        assert found["stride_time_s"].mean == pytest.approx(make.PERIOD_S, abs=0.02)
        assert found["deviation_m"].mean == pytest.approx(0.02, abs=0.001)
        assert found["heel_rotation_rad"].mean == pytest.approx(math.radians(58), abs=0.02)
        assert found["orientation_variation_rad"].n == 0
    # the path sways to the left: outwards on the left foot only
    assert gait.feet["left_foot"]["circumduction_m"].mean > 0.015
    assert gait.feet["right_foot"]["circumduction_m"].mean < 0.005
    assert gait.walk.belt_ratio == pytest.approx(1.0, abs=0.03)
    assert "step_length_m" not in shown_rows(render_report(record))


def test_live_and_off_line_parameters_of_one_walk_agree(walked):
    off_line = gait_parameters(walked)
    live = gait_of_strides(walked.strides, 1.2)
    for foot in ("left_foot", "right_foot"):
        for key, near in (
            ("stride_length_common_m", 0.01),
            ("stride_time_s", 0.01),
            ("lift_m", 0.002),
            ("deviation_m", 0.004),
        ):
            assert live.feet[foot][key].mean == pytest.approx(off_line.feet[foot][key].mean, abs=near), key
        assert live.feet[foot]["swing_s"].mean == pytest.approx(off_line.feet[foot]["swing_s"].mean, abs=0.05)


@pytest.mark.parametrize("gone", ["left out", "not seen"])
def test_a_missing_stride_makes_no_long_one(walked, gone):
    """Neither of the foot that it is missing of, nor a long step of the other foot."""
    strides = list(walked.strides)
    at = [i for i, s in enumerate(strides) if s.foot == "left_foot"][10]
    if gone == "left out":
        strides[at] = replace(strides[at], valid=False, reason="samples missing")
    else:
        del strides[at]
        counted = iter(range(1, len(strides) + 1))
        strides = [replace(s, number=next(counted)) if s.foot == "left_foot" else s for s in strides]
    whole, torn = gait_of_strides(walked.strides), gait_of_strides(strides)
    for foot, key in (("left_foot", "stride_time_s"), ("left_foot", "stance_s"), ("right_foot", "step_time_s")):
        assert torn.feet[foot][key].sd == pytest.approx(whole.feet[foot][key].sd, rel=0.1), key
        assert whole.feet[foot][key].n - torn.feet[foot][key].n in (1, 2)


def test_temporal_symmetry_counts_from_the_paretic_side(walked):
    gait = gait_of_strides(walked.strides)
    assert temporal_symmetry(replace(gait, paretic="right")) == pytest.approx(1.0 / temporal_symmetry(gait))
    assert math.isnan(temporal_symmetry(gait_of_strides([s for s in walked.strides if s.foot == "left_foot"])))
    by_key = {row.key: row for row in walk_rows(gait)}
    assert by_key["walking_speed_mps"].norm == "0.94 … 1.43 m/s"
    assert "Bohannon" in by_key["walking_speed_mps"].norm_detail
    assert by_key["cadence_per_min"].norm == ""


def test_every_parameter_and_number_has_its_definition(walked):
    html = render_report(walked.walk_record("2026-11-20T10:00:00+00:00"))
    anchors = set(re.findall(r'<dt id="([^"]+)">', html))
    links = set(re.findall(r'class="term[^"]*" href="#([^"]+)"', html))
    assert links <= anchors
    assert {slug(key) for key in shown_rows(html)} <= links
    assert set(terms()) == anchors
    for key, known in DEFINITIONS.items():
        assert known.text.split(";")[0][1:] in terms()[slug(key)].text


def shaky(record, foot="left_foot"):
    """The foot's sensor reaches 30 m/s² and 6 rad/s at two instants and is silent for 60 ms at another."""
    samples = record.samples[foot]
    keep = np.ones(samples.t_ns.size, bool)
    keep[1500:1530] = False
    acc, gyr = np.clip(samples.acc_mps2, -25.0, 25.0), np.clip(samples.gyr_radps, -5.5, 5.5)
    acc[700:706, 0], gyr[2500:2508, 1] = 30.0, -6.0
    record.samples[foot] = SampleArrays(samples.t_ns[keep], samples.t_sensor_ns[keep], acc[keep], gyr[keep])
    return record


def test_clipping_and_gaps_are_told_without_knowing_the_ranges():
    record = shaky(make.walk(6, rate_hz=500.0))
    sensors = all_flags(record, None)
    left, right = sensors["left_foot"], sensors["right_foot"]
    assert left.limits == {"acc": 30.0, "gyr": 6.0}
    assert (left.at_limit["acc"].sum(), left.at_limit["gyr"].sum(), left.lost.sum()) == (6, 8, 30)
    assert not left.known
    assert not right.at_limit["acc"].any()
    assert not right.lost.any()
    spans = left.spans(make.T0)
    assert [span["kind"] for span in spans] == ["clipped", "clipped", "lost"]
    assert (spans[2]["start_s"], spans[2]["end_s"]) == pytest.approx((3.0, 3.06), abs=0.005)
    assert chart_data(summarise_session(record), sensors)["feet"][0]["wrong"] == spans


def test_a_known_range_is_believed_and_short_gaps_are_not_told():
    samples = make.walk(4, rate_hz=500.0).samples["left_foot"]
    samples.gyr_radps[300:303] = np.nan  # 8 ms
    samples.gyr_radps[900:930] = np.nan  # 62 ms
    flags = sensor_flags(samples, {"acc": 20.0, "gyr": 35.0})
    assert flags.known
    assert flags.at_limit["acc"].sum() == (np.abs(samples.acc_mps2) >= 0.999 * 20.0).any(axis=1).sum() > 0
    assert flags.lost.sum() == 30


def test_flags_stand_at_the_strides_the_plots_and_the_parameters():
    record = shaky(make.walk(6, rate_hz=500.0))
    torn = record.strides[2]
    assert torn.foot == "left_foot"
    view = summarise_session(record)
    flags = stride_flags(record, view.summary.strides, all_flags(record, None))
    kinds = {key: {flag.kind for flag in own} for key, own in flags.items()}
    assert set().union(*kinds.values()) == {CLIPPED_ACC, CLIPPED_GYR, LOST}
    assert all(foot == "left_foot" for foot, _ in kinds)
    html = render_report(record)
    assert html.count('class="badge"') == sum(len(own) for own in flags.values())
    assert html.count('class="ring"') == 3  # lengths, clearance, phases of the left foot
    rows = {row.key: row.sides[0].flagged for row in parameter_rows(gait_of_strides(record.strides), flags)}
    everything = sum(CLIPPED_ACC in own or CLIPPED_GYR in own or LOST in own for own in kinds.values())
    assert rows["lift_m"] == everything
    assert rows["heel_rotation_rad"] < everything  # the accelerometer's limit does not touch an angle
    assert rows["swing_s"] == sum(LOST in own for own in kinds.values()) > 0
    assert "accelerometer at its limit of 30 m/s²" in html
    assert "found in the samples" in html


def test_a_phase_that_was_not_seen_makes_times_unsure():
    record = make.walk(5)
    stride = record.strides[4]
    record.strides[4] = replace(stride, t_loading_response_ns=None)
    flags = stride_flags(record, summarise_session(record).summary.strides, {})
    assert {key: [flag.kind for flag in own] for key, own in flags.items()} == {(stride.foot, stride.number): [UNSURE]}
    assert describe_flags(flags.values()) == "a phase not seen in 1"
    assert UNSURE in flags_touching("swing_s")
    assert UNSURE not in flags_touching("lift_m")


def test_curves_bring_heel_rise_and_foot_flat_together():
    """However long a foot waits in stance before and after, the mean of the swing is not smeared."""
    record = make.walk(8, ("left_foot",))
    late = [
        replace(stride, t_start_ns=stride.t_start_ns, trajectory_m=moved(stride.trajectory_m, shift), pitch_rad=moved(
            stride.pitch_rad, shift), **later(stride, shift))
        for shift, stride in zip(np.linspace(-8, 8, 8).round().astype(int), record.strides, strict=True)
    ]  # fmt: skip
    one = foot_curves(record.strides, None, ["left_foot"])["left_foot"]
    other = foot_curves(late, None, ["left_foot"])["left_foot"]
    tallest = 100 * one.path_m.mean(axis=0)[:, 2].max()
    assert 100 * other.path_m.mean(axis=0)[:, 2].max() == pytest.approx(tallest, rel=0.03)
    smeared = np.mean([stride.trajectory_m[:, 2] for stride in late], axis=0).max() * 100
    assert smeared < 0.9 * tallest
    seconds = np.mean([(s.t_end_ns - s.t_start_ns) / 1e9 for s in record.strides])
    way = one.speed_mps.mean(axis=0).mean() * seconds
    assert way == pytest.approx(np.mean([s.trajectory_m[-1, 0] for s in record.strides]), rel=0.1)


def moved(values, by):
    """Later by so many of 101 points; what comes in at the ends is what stood there."""
    return values[np.clip(np.arange(len(values)) - by, 0, len(values) - 1)]


def later(stride, by):
    step_ns = (stride.t_end_ns - stride.t_start_ns) // 100
    names = ("t_pre_swing_ns", "t_swing_ns", "t_loading_response_ns", "t_stance_ns")
    return {name: getattr(stride, name) + by * step_ns for name in names}


def test_the_butterflys_wings_are_the_two_feet():
    curves = foot_curves(make.walk(6).strides, None, ["left_foot", "right_foot"])
    side, above = butterfly_figures(curves)
    assert "no force is measured" in side.caption
    means = re.findall(
        r'<path d="M([\d.]+) [^"]*L([\d.]+) [\d.]+" fill="none" stroke="(#\w+)" stroke-width="3"', side.svg
    )
    (left_from, left_to, left_color), (right_from, right_to, right_color) = means
    assert float(left_from) == float(right_from)
    assert float(left_to) < float(left_from) < float(right_to)
    assert (left_color, right_color) == ("#0072B2", "#D55E00")
    assert "circumduction" in above.caption
    alone = butterfly_figures({"left_foot": curves["left_foot"]})
    assert [figure.title for figure in alone] == ["Path, from the side", "Path, from above"]
    assert butterfly_figures({}) == []


def test_the_space_figure_is_drawn_as_the_script_would_turn_it():
    curves = foot_curves(make.walk(6).strides, None, ["left_foot", "right_foot"])
    space = space_figure(curves)
    assert space is not None
    data = space.to_data()
    assert space.figure.svg.count("<path") == len(data["lines"])
    assert space.figure.svg.count("<text") == len(data["texts"])
    assert projected(np.array([[1.0, 2.0, 3.0]]), 0.0, 0.0).tolist() == [[1.0, 3.0]]  # from behind
    np.testing.assert_allclose(projected(np.array([[1.0, 2.0, 3.0]]), -math.pi / 2, 0.0), [[2.0, 3.0]])  # from the side
    np.testing.assert_allclose(projected(np.array([[1.0, 2.0, 3.0]]), 0.0, math.pi / 2), [[1.0, 2.0]], atol=1e-12)
    assert space_figure({}) is None


def test_a_running_head_cannot_end_its_style_sheet():
    hostile = '"; } </style><script>alert(1)</script> é\n'
    escaped = css_text(hostile)
    assert re.fullmatch(r'"(?:[A-Za-z0-9]|\\[0-9a-f]+ )*"', escaped)
    record = make.walk(3)
    record.header = make.header(name=hostile)
    html = render_report(record)
    assert html.count("</style>") == 1


# --- Pitch and roll through the swing, in the report: which strides, which foot, which target ---


TUNED = {
    "mode": "act",
    "pitch_at_contact_deg": {"low": 4.0, "high": 25.0},
    "bounds": {
        "current_ma": {"low": 5.0, "high": 40.0},
        "pulse_width_us": {"low": 250.0, "high": 250.0},
        "start_delay_s": {"low": 0.0, "high": 0.0},
        "extension_s": {"low": 0.0, "high": 0.1},
    },
}


def session(roll_deg: Callable[[int], float] = lambda number: 0.0, count: int = 30) -> SessionRecord:
    """The left foot tuned and stimulated from stride 2 on, the right one not; a left stride rolls by so much."""
    record = walk(count)

    def rolled(stride: StrideResult) -> StrideResult:
        own = roll_deg(stride.number) if stride.foot == "left_foot" else 45.0
        return replace(stride, roll_rad=np.radians(np.full(len(stride.pitch_rad), own)))

    left = [command for command in record.commands if command.channel == 0]
    return replace(
        record,
        header=header([channel(0, "left_foot", "TA left", tuning=TUNED)]),
        strides=[rolled(stride) for stride in record.strides],
        commands=left,
        statuses=[status for status in record.statuses if status.channel == 0],
    )


def figures_of(record: SessionRecord) -> list[Figure]:
    return strides.swing_figures(summarise_session(record))


def test_pitch_and_roll_of_the_stimulated_foot_with_the_target_it_has() -> None:
    pitch, roll = figures_of(session())
    assert (pitch.title, roll.title) == ("Pitch through the swing, left foot", "Roll through the swing, left foot")
    for figure in (pitch, roll):
        assert "Dashed: the first 5 stimulated strides; solid: the last 10; mean ± SD." in figure.caption
    assert "Green: the target at contact, 4 to 25°." in pitch.caption
    assert "Green" not in roll.caption
    assert strides.BAND_COLOR in pitch.svg
    assert strides.BAND_COLOR not in roll.svg
    page = render_report(session())
    assert page.count("Roll through the swing, left foot") >= 1
    assert "through the swing, right foot" not in page


def test_the_evertors_target_is_drawn_as_inversion() -> None:
    bounds = TUNED["bounds"]
    everts = {"mode": "act", "eversion_at_contact_deg": {"low": -3.0, "high": 6.0}, "bounds": bounds}
    record = session()
    channels = [channel(0, "left_foot", "TA left", tuning=TUNED), channel(1, "left_foot", "Peronei", tuning=everts)]
    pitch, roll = figures_of(replace(record, header=header(channels)))
    assert "Green: the target at contact, -6 to 3°." in roll.caption
    assert "Green: the target at contact, 4 to 25°." in pitch.caption


def test_the_mean_is_of_the_first_five_and_of_the_last_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[str, FloatArray, FloatArray]] = []

    class Seen(Plot):
        def line(self, x: FloatArray, y: FloatArray, color: str, **how: Any) -> None:
            drawn.append((self.label, x, y))

    monkeypatch.setattr(strides, "Plot", Seen)
    record = session(lambda number: 10.0 if number < 2 else float(number), count=30)  # stimulated: 2 … 29
    figures_of(record)
    first, last = (y for label, _, y in drawn if label.startswith("Roll"))
    assert first == pytest.approx(np.full(51, np.mean([2, 3, 4, 5, 6])))
    assert last == pytest.approx(np.full(51, np.mean(range(20, 30))))
    x = drawn[0][1]
    assert (x[0], x[-1]) == (0.0, 100.0)
    pitch = next(y for label, _, y in drawn if label.startswith("Pitch"))
    left = [stride for stride in record.strides if stride.foot == "left_foot"][2:7]
    for at, entry in ((0, "t_swing_ns"), (-1, "t_loading_response_ns")):
        shares = [(getattr(one, entry) - one.t_start_ns) / (one.t_end_ns - one.t_start_ns) for one in left]
        wanted = [
            np.interp(share, np.linspace(0, 1, 101), one.pitch_rad) for share, one in zip(shares, left, strict=True)
        ]
        assert pitch[at] == pytest.approx(np.degrees(np.mean(wanted)))


def test_what_is_not_there_is_not_drawn() -> None:
    record = session()
    old = [replace(stride, roll_rad=np.zeros(0)) for stride in record.strides]
    assert [figure.title for figure in figures_of(replace(record, strides=old))] == [
        "Pitch through the swing, left foot"
    ]
    bare = [replace(stride, pitch_rad=np.zeros(0), roll_rad=np.zeros(0)) for stride in record.strides]
    assert figures_of(replace(record, strides=bare)) == []
    assert figures_of(replace(record, commands=[], statuses=[])) == []
    dropped = [replace(stride, t_loading_response_ns=None) for stride in record.strides]
    assert figures_of(replace(record, strides=dropped)) == []
    few = replace(record, strides=[stride for stride in record.strides if stride.number < 5])
    assert "the first 3 stimulated strides; mean ± SD" in figures_of(few)[0].caption
