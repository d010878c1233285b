"""The numbers behind tables and report, against records whose numbers are known by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import report_records as make
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.live.operator import NO_STOP
from fes.report.findings import findings, merged, session_json
from fes.report.parameter_table import share_between
from fes.report.stimulation import build_timeline, command_columns, phases_between
from fes.report.strides import hand_rows
from fes.report.summary import summarise
from fes.report.text import plain, readable
from fes.session_log import Note, SampleArrays, SessionRecord
from fes.signals import OperatorAct, OperatorAction, StimAlive, StimCommand, StimStatus
from fes.walk_record import Finding
from statemachine.phases import Phase, PhaseChange, Transition


def record_of(*strides, **more) -> SessionRecord:
    record = SessionRecord(make.header(), complete=True, strides=list(strides), **more)
    record.phases = sorted((change for one in strides for change in make.phases_of(one)), key=lambda c: c.t_ns)
    return record


def alerts(record: SessionRecord) -> list[str]:
    return [finding.text for finding in findings(summarise(record)) if finding.level == "alert"]


def test_phase_durations_and_stance_until_the_next_heel_rise():
    first, second = summarise(record_of(make.stride(0, 1.0), make.stride(1, 1.0 + make.PERIOD_S))).strides
    assert (first.pre_swing_s, first.swing_s, first.loading_response_s) == pytest.approx((0.20, 0.45, 0.12))
    assert first.stance_s == pytest.approx(make.PERIOD_S - 0.77)
    assert math.isnan(second.stance_s)
    assert first.four_phases
    assert first.path == "T1 T2 T3 T4"
    assert first.start_s == pytest.approx(0.0)
    assert first.clearance_cm == pytest.approx(12.0)


def test_swing_that_ends_in_stance_is_t6_and_not_four_phases():
    stride = make.stride(0, 1.0, t_loading_response_ns=None)
    (row,) = summarise(record_of(stride)).strides
    assert not row.four_phases
    assert row.path == "T1 T2 T6"
    assert row.swing_s == pytest.approx(0.57)
    assert math.isnan(row.loading_response_s)
    assert summarise(record_of(stride)).feet["left_foot"].without_loading_response == 1


def test_heel_lifted_and_put_back_is_counted_on_the_stride_it_preceded():
    record = record_of(make.stride(0, 1.0))
    up, down = make.at(1.05), make.at(1.15)
    record.phases[:0] = [
        PhaseChange(up, "left_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING),
        PhaseChange(down, "left_foot", Transition.T5, Phase.PRE_SWING, Phase.STANCE),
    ]
    (row,) = summarise(record).strides
    assert row.path == "T1 T5 T1 T2 T3 T4"
    assert row.heel_lifts_put_back == 1
    assert row.four_phases


def test_phases_out_of_order_are_not_four_phases():
    stride = make.stride(0, 1.0)
    wrong = replace(stride, t_swing_ns=stride.t_stance_ns, t_stance_ns=stride.t_swing_ns)
    (row,) = summarise(SessionRecord(make.header(), strides=[wrong])).strides
    assert not row.four_phases


def test_invalid_strides_stay_out_of_the_averages():
    strides = [make.stride(i, 1.0 + i * make.PERIOD_S, length_m=length) for i, length in enumerate((0.6, 0.7, 9.0))]
    strides[2] = replace(strides[2], valid=False, reason="turned by 50°")
    foot = summarise(record_of(*strides)).feet["left_foot"]
    assert (foot.strides, foot.valid) == (3, 2)
    assert foot.stride_length_m.mean == pytest.approx(0.65)
    assert foot.stride_length_m.sd == pytest.approx(math.sqrt(0.005))
    assert foot.walking_speed_mps == pytest.approx(1.3 / 2.8)
    assert foot.cadence_steps_per_min == pytest.approx(120 / 1.4)


def test_speed_is_held_against_the_belt():
    summary = summarise(record_of(make.stride(0, 1.0), make.stride(0, 1.7, "right_foot")))
    assert summary.belt_speed_mps == make.BELT_MPS
    assert summary.speed_over_belt == pytest.approx(make.LENGTH_M / make.PERIOD_S / make.BELT_MPS)


def test_starting_and_stopping_do_not_bend_the_walking_speed():
    lengths = (0.2, 0.6, 0.63, 0.66, 0.3)
    strides = [make.stride(i, 1.0 + i * make.PERIOD_S, length_m=length) for i, length in enumerate(lengths)]
    foot = summarise(record_of(*strides)).feet["left_foot"]
    assert foot.walking_speed_mps == pytest.approx(0.63 / make.PERIOD_S)


def test_standing_does_not_count_as_stance():
    strides = [make.stride(0, 1.0), make.stride(1, 1.0 + make.PERIOD_S), make.stride(2, 30.0)]
    foot = summarise(record_of(*strides)).feet["left_foot"]
    assert foot.stance_s.n == 1
    assert foot.stance_s.mean == pytest.approx(make.PERIOD_S - 0.77)


def test_burst_onset_duration_peak_and_charge_from_commands():
    record = record_of(make.stride(0, 1.0))
    record.commands = make.burst(0, 1.36, 0.70)
    (item,) = summarise(record).strides[0].stimulation
    assert item.onset_after_pre_swing_ms == pytest.approx(10.0)
    assert item.duration_s == pytest.approx(0.70)
    assert item.peak_current_ma == 20.0
    # ramps of 4, 8, 12, 16 mA at both ends around 27 commands of 20 mA, 20 ms each, 250 µs at 40 Hz
    charge_uc = (2 * (4 + 8 + 12 + 16) + 27 * 20) * 0.02 * 40 * 0.25
    assert item.charge_uc == pytest.approx(charge_uc)
    assert not item.charge_counted_by_device


def test_charge_counted_by_the_device_is_preferred():
    record = record_of(make.stride(0, 1.0))
    record.commands = make.burst(0, 1.36, 0.20)
    record.statuses = [StimStatus(c.t_ns + 1, 0, 0, c.on, c.current_ma, 250.0, 40.0, 1, 3.5) for c in record.commands]
    channel = summarise(record).channels[0]
    assert channel.charge_counted_by_device
    assert channel.pulses == 11
    assert channel.charge_uc == pytest.approx(11 * 3.5)


def test_charge_follows_from_pulses_where_the_device_counts_only_those():
    record = record_of(make.stride(0, 1.0))
    record.commands = make.burst(0, 1.36, 0.20)
    record.statuses = [StimStatus(make.at(1.4), 0, 0, True, 20.0, 250.0, 40.0, 3)]
    assert summarise(record).channels[0].charge_uc == pytest.approx(3 * 20 * 0.25)


def test_lapsed_commands_end_a_burst_after_their_validity():
    commands = make.burst(0, 1.36, 0.10)[:-1] + make.burst(0, 2.0, 0.10)
    record = record_of(make.stride(0, 1.0), commands=commands)
    channel = summarise(record).channels[0]
    assert channel.bursts == 2
    assert channel.on_time_s == pytest.approx(0.08 + 0.06 + 0.10)


def test_stimulation_inside_its_phases_is_good_and_outside_is_an_alert():
    record = record_of(make.stride(0, 1.0))
    record.commands = make.burst(0, 1.35, 0.76)
    assert summarise(record).channels[0].outside_s == 0
    assert not alerts(record)
    record.commands = make.burst(0, 1.35, 0.94)  # stance begins 0.77 s after pre-swing
    channel = summarise(record).channels[0]
    assert channel.outside_s == pytest.approx(0.17)
    assert channel.bursts_outside == 1
    assert any("outside pre-swing … loading response" in text for text in alerts(record))


def test_a_device_that_is_on_without_a_command_is_an_alert():
    record = record_of(make.stride(0, 1.0), commands=make.burst(0, 1.35, 0.5))
    record.statuses = [StimStatus(make.at(1.5), 0, 0, True, 20.0, 250.0, 40.0)]
    assert not alerts(record)
    record.statuses.append(StimStatus(make.at(2.2), 0, 1, True, 20.0, 250.0, 40.0))
    assert summarise(record).channels[0].on_without_command == 1
    assert any("although no command asked" in text for text in alerts(record))


def test_refusals_are_grouped_by_their_words():
    def refused(seconds: float, number: int, reason: str) -> StimCommand:
        return StimCommand(make.at(seconds), number, False, 0.0, 0.0, 0.0, 60, reason)

    record = record_of(make.stride(0, 1.0))
    record.commands = [refused(1.1 + 0.02 * i, 0, f"data {40 + i} ms old") for i in range(5)]
    record.commands += [refused(1.5, 1, "not armed")]
    first, second = summarise(record).refusals
    assert (first.reason, first.count, first.channels) == ("data 40 ms old", 5, (0,))
    assert (second.reason, second.count) == ("not armed", 1)
    assert summarise(record).strides[0].refused == ("data 40 ms old",)


def test_latency_percentiles():
    record = SessionRecord(make.header(), latency_ns=np.arange(1, 101) * 10_000)
    record.latency_t_ns = np.arange(100)
    latency = summarise(record).latency
    assert (latency.count, latency.max_ms) == (100, 1.0)
    assert latency.p50_ms == pytest.approx(0.505)
    assert latency.p99_ms == pytest.approx(0.9901)


def test_data_quality_counts():
    t = make.at(0) + np.arange(100) * 10_000_000
    t = np.delete(t, [20, 21, 50])  # three samples missing in two gaps
    t = np.insert(t, 60, t[60])  # one stamp doubled
    acc = np.full((t.size, 3), 1.0)
    acc[5, 1] = np.nan
    record = SessionRecord(make.header(), samples={"left_foot": SampleArrays(t, t, acc, np.ones((t.size, 3)))})
    (sensor,) = summarise(record).sensors
    assert (sensor.missing, sensor.doubled, sensor.backward, sensor.not_a_number) == (3, 1, 0, 1)
    assert sensor.rate_hz == pytest.approx(100.0)
    assert sensor.longest_silence_ms == pytest.approx(30.0)


def test_faults_come_from_notes_status_and_heartbeat():
    record = SessionRecord(make.header(), complete=True)
    record.notes = [Note(5, "fault", "gate", "latched"), Note(1, "info", "runner", "started")]
    record.statuses = [StimStatus(7, 0, 0, False, 0, 0, 0, fault="electrode"), StimStatus(8, 0, 1, False, 0, 0, 0)]
    record.alive = [StimAlive(2, 1, 0), StimAlive(9, 2, 0), StimAlive(10, 2, 0, "overheated")]
    texts = [fault.text for fault in summarise(record).faults]
    assert texts == ["latched", "channel 0: electrode (1 answers)", "restarted (boot 1 → 2)", "overheated"]


def test_time_counts_from_where_the_loop_begins_as_on_the_live_page():
    record = record_of(make.stride(0, 1.0))
    record.notes = [Note(make.at(1.0) - 2_200_000_000, "info", "session", "opened")]
    assert summarise(record).strides[0].start_s == pytest.approx(0.0)


def act(action: OperatorAction, seconds: float, channel: float = 0.0) -> OperatorAct:
    return OperatorAct(make.at(seconds), action, channel)


TEST_BURST, TRIGGER, STOP = OperatorAction.TEST_BURST, OperatorAction.TRIGGER, OperatorAction.EMERGENCY_STOP


@pytest.mark.parametrize(
    ("action", "lasts_s", "words"), [(TEST_BURST, 0.6, "1 test burst"), (TRIGGER, 1.1, "1 manual burst")]
)
def test_a_burst_that_a_person_asked_for_is_listed_as_that_and_is_not_outside(
    action: OperatorAction, lasts_s: float, words: str
):
    record = record_of(make.stride(0, 9.0), commands=make.burst(0, 3.02, lasts_s))
    assert any("outside" in text for text in alerts(record))  # nobody asked for it
    record.acts = [act(action, 3.0)]
    summary = summarise(record)
    assert not [text for text in alerts(record) if "unanswered" not in text]
    (channel, _) = summary.channels
    assert (channel.bursts, channel.bursts_by_hand, channel.bursts_outside, channel.outside_s) == (1, 1, 0, 0.0)
    assert [(row.text, row.channel) for row in summary.by_hand] == [(words[2:], 0)]
    assert [f.level for f in findings(summary) if f.text == f"By hand: {words}."] == ["info"]


def test_only_the_burst_that_was_asked_for_is_by_hand():
    commands = [*make.burst(0, 3.02, 0.5), *make.burst(0, 6.0, 0.5)]
    for asked in ([], [act(TEST_BURST, 2.0)], [act(TEST_BURST, 3.0, 1.0)], [act(TEST_BURST, 3.1)]):
        record = record_of(make.stride(0, 9.0), commands=commands, acts=asked)
        assert any("2 of 2 bursts outside" in text for text in alerts(record)), asked
    record.acts = [act(TEST_BURST, 3.0)]
    assert any("1 of 2 bursts outside" in text for text in alerts(record))


def test_a_burst_by_hand_that_outlasts_what_was_asked_for_is_outside_from_then_on():
    record = record_of(make.stride(0, 9.0), commands=make.burst(0, 3.0, 2.0), acts=[act(TEST_BURST, 3.0)])
    (channel, _) = summarise(record).channels
    assert channel.bursts_outside == 1
    assert channel.outside_s == pytest.approx(2.0 - 0.5 - 0.1 - 0.1, abs=0.1)


def test_an_intensity_set_in_steps_and_what_a_person_told_the_tuning_are_by_hand():
    steps = [OperatorAct(make.at(3 + 0.1 * k), OperatorAction.SET_INTENSITY, 0.1 * k) for k in range(1, 6)]
    record = record_of(make.stride(0, 1.0), acts=[*steps, act(OperatorAction.FREEZE_TUNING, 5.0)])
    rows = summarise(record).by_hand
    assert [row.text for row in rows] == ["intensity 50%, less than the session's", "tuning frozen"]
    assert f"By hand: {rows[0].text} from {rows[0].time_s:.1f} s on." in [f.text for f in findings(summarise(record))]
    record.acts = [*record.acts, OperatorAct(make.at(6), OperatorAction.SET_INTENSITY, 1.0)]
    assert not any(f.text.startswith("By hand") for f in findings(summarise(record)))
    assert len(summarise(record).by_hand) == 3  # what was lowered for a while is not forgotten
    begins = OperatorAct(make.at(2), OperatorAction.SET_INTENSITY, 0.0), act(OperatorAction.ARM, 2.0)
    assert [row.text for row in hand_rows(record_of(acts=list(begins)), 0)] == ["armed"]
    assert [row.text for row in hand_rows(record_of(acts=steps), 0, 0.5)] == ["intensity 50%"]


def test_one_emergency_stop_is_one_event_and_no_fault():
    record = record_of(make.stride(0, 1.0), acts=[act(STOP, 5.0), act(STOP, 5.2)])
    record.notes = [
        Note(make.at(5), "fault", "session", "emergency stop (button)"),
        Note(make.at(5), "info", "session", "state running → stopped (emergency stop)"),
        Note(make.at(5), "fault", "gate", "off until armed again: emergency stop"),
        Note(make.at(5.2), "fault", "session", "emergency stop (key)"),
    ]
    summary = summarise(record)
    assert summary.faults == ()
    assert not alerts(record)
    assert [row.text for row in summary.by_hand] == ["emergency stop (button)"]
    assert "By hand: emergency stop (button) at 4.0 s." in [finding.text for finding in findings(summary)]
    record.acts = [act(STOP, 5.0), act(OperatorAction.ARM, 5.1), act(STOP, 5.2)]
    assert [row.text for row in summarise(record).by_hand] == [
        "emergency stop (button)",
        "armed",
        "emergency stop (key)",
    ]


@pytest.mark.parametrize("origin", ["button lost", NO_STOP])
def test_a_stop_that_nobody_made_is_one_fault(origin: str):
    record = record_of(make.stride(0, 1.0), acts=[act(STOP, 5.0)])
    record.notes = [
        Note(make.at(5), "fault", "session", f"emergency stop ({origin})"),
        Note(make.at(5), "fault", "gate", "off until armed again: emergency stop"),
    ]
    assert [fault.text for fault in summarise(record).faults] == [f"emergency stop ({origin})"]


def test_what_was_not_armed_was_not_armed_on_purpose():
    refused = [StimCommand(make.at(1), 0, False, 0, 0, 0, 60, why) for why in ("not armed", "emergency stop")]
    record = record_of(make.stride(0, 1.0), commands=refused)
    (level,) = [f.level for f in findings(summarise(record)) if f.text.startswith("The safety gate turned")]
    assert level == "info"
    record.commands.append(StimCommand(make.at(1), 0, False, 0, 0, 0, 60, "right_foot data 41 ms old, limit 40 ms"))
    (level,) = [f.level for f in findings(summarise(record)) if f.text.startswith("The safety gate turned")]
    assert level == "warning"


def test_unanswered_commands_are_an_alert():
    record = record_of(make.stride(0, 1.0))
    record.summary = {"wire": {"commands": 10, "matched": 8, "missing": 2, "different": 0}}
    assert any("left 2 unanswered" in text for text in alerts(record))
    record.summary["wire"] |= {"missing": 0, "matched": 10}
    assert not alerts(record)


def test_settings_from_another_version_leave_channels_without_a_name():
    record = record_of(make.stride(0, 1.0), commands=make.burst(3, 1.36, 0.2))
    record.header["session"] = {"name": "x", "unheard_of": 1}
    (channel,) = summarise(record).channels
    assert (channel.name, channel.foot, channel.bursts) == ("channel 3", "", 1)
    assert math.isnan(channel.outside_s)


@pytest.mark.parametrize("header", [{}, {"session": None, "recording": 3}, {"recording": {"belt_speed_mps": "fast"}}])
def test_a_poor_header_is_no_error(header):
    assert session_json(summarise(SessionRecord(header)))["belt_speed_mps"] is None


def test_json_keys_are_stable_and_nan_is_null():
    value = session_json(summarise(make.walk(4)))
    text = json.dumps(value, allow_nan=False)
    assert json.loads(text) == value
    assert set(value) - {"level", "verdict", "findings"} == {
        *("format", "name", "subject", "recording", "kind", "created", "fes_version", "complete", "lost"),
        *("duration_s", "belt_speed_mps", "walking_speed_mps", "speed_over_belt", "command_period_s", "feet"),
        *("channels", "refusals", "latency", "notices", "sensors", "run_summary", "strides", "dose", "tuning"),
        *("reached", "by_hand", "exercise", "measures", "marks", "thresholds"),
    }
    assert set(value["strides"][-1]) == {
        *("foot", "number", "start_s", "duration_s", "stride_length_m", "speed_mps", "clearance_cm"),
        *("toe_clearance_cm", "heel_clearance_cm", "height_gained_cm", "turn_deg", "pre_swing_s", "swing_s"),
        *("loading_response_s", "stance_s", "four_phases", "path", "heel_lifts_put_back", "valid", "reason"),
        *("stimulation", "refused", "live", "mark"),
    }
    assert set(value["strides"][-1]["stimulation"][0]) == {
        *("channel", "name", "bursts", "onset_after_pre_swing_ms", "duration_s", "peak_current_ma", "charge_uc"),
        "charge_counted_by_device",
    }
    assert value["strides"][0]["toe_clearance_cm"] is None
    assert value["format"] == 1


def test_plain_makes_anything_serialisable():
    odd = {1: np.array([1.0, np.nan]), "b": (np.int64(3), b"x", float("inf"), Phase.SWING), "c": {2}}
    assert plain(odd) == {"1": [1.0, None], "b": [3, "b'x'", None, 2], "c": [2]}


def test_phases_between_go_round_the_stride():
    assert phases_between("pre_swing", "loading_response") == (Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE)
    assert phases_between("loading_response", "pre_swing") == (Phase.LOADING_RESPONSE, Phase.STANCE, Phase.PRE_SWING)


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(1, 2_000_000_000), min_size=1, max_size=12),
    st.integers(0, 10**10),
    st.integers(0, 10**10),
)
def test_time_in_phases_adds_up_to_the_span(steps, a, b):
    times = np.cumsum(steps)
    order = [Phase.STANCE, Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE]
    changes = [
        PhaseChange(int(t), "left_foot", Transition.NONE, order[i % 4], order[(i + 1) % 4]) for i, t in enumerate(times)
    ]
    timeline = build_timeline(changes, "left_foot", 0, 10**10 + 10**9)
    low, high = np.array([min(a, b)]), np.array([max(a, b)])
    apart = sum(timeline.time_in([phase], low, high)[0] for phase in Phase)
    inside_session = (min(int(high[0]), int(timeline.end_ns[-1])) - int(low[0])) / 1e9
    assert apart == pytest.approx(inside_session, abs=1e-6)


def test_current_at_follows_the_commands_in_force():
    columns = command_columns(make.burst(0, 1.0, 0.20), 0)
    times = np.array([make.at(s) for s in (0.99, 1.0, 1.1, 1.1999, 1.2, 5.0)])
    assert columns.current_at(times).tolist() == [0.0, 4.0, 20.0, 4.0, 0.0, 0.0]
    width_us = columns.pulse_width_us[columns.on][0]
    expected_uc = [1e-3 * width_us * current_ma for current_ma in (0.0, 4.0, 20.0, 4.0, 0.0, 0.0)]
    assert columns.charge_per_phase_at(times) == pytest.approx(expected_uc)
    assert not columns.widths_vary
    wider = np.where(columns.on, columns.pulse_width_us + 10.0 * np.arange(len(columns.t_ns)), 0.0)
    assert replace(columns, pulse_width_us=wider).widths_vary


def test_what_several_sensors_say_alike_stands_once() -> None:
    """One silence of the computer is one warning, with how many sensors and which; effects with numbers stay apart."""

    def told(sensor: str, text: str, **about: str) -> Finding:
        return Finding("warning", f"Sensor {readable(sensor)}: {text}.", sensor=sensor, **about)

    names = ("left_foot", "right_foot", "left_shank", "right_shank")
    silences = [told(n, f"longest silence {310 + 4 * k} ms", code="silence") for k, n in enumerate(names)]
    missing = told("left_foot", "3 missing samples", code="stream")
    lies = [told(n, f"scale off. {k} m", code="scale", effect=f"{k} m") for k, n in enumerate(names[:2])]
    found = merged([silences[0], missing, *silences[1:], *lies])
    assert [each.count for each in found] == [4, 1, 1, 1]
    where = "left foot, right foot, left shank, right shank"
    assert found[0].text == f"4 sensors ({where}): longest silence 310 … 322 ms."
    assert found[0].sensor == ", ".join(names)
    assert found[1:] == (missing, *lies)


def test_a_sum_over_two_feet_says_so() -> None:
    one, two = record_of(make.stride(0, 1.0)), record_of(make.stride(0, 1.0), make.stride(0, 1.7, "right_foot"))
    passed = [next(f.text for f in findings(summarise(each)) if "passed all four" in f.text) for each in (one, two)]
    assert passed[0].startswith("1 of 1 stride passed")
    assert passed[1].startswith("Both feet together: 2 of 2 strides passed")


@pytest.mark.parametrize(("count", "of"), [(0, 7), (7, 7), (1, 40), (39, 40), (500, 1000)])
def test_interval_of_a_share_is_wilsons(count, of):
    from scipy.stats import binomtest

    wilson = binomtest(count, of).proportion_ci(0.95, method="wilson")
    assert share_between(count, of) == pytest.approx((wilson.low, wilson.high), abs=1e-12)
