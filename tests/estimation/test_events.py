"""IC and FO, off-line and causal, on made signals and on the bundled trials' truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.analysis.parameters.gait import gait_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.calibration.recording import calibrate_track
from fes.cli.simulate import command
from fes.estimation.events.causal import RETUNE_STRIDES, Decision, OnlineEvent, OnlineEvents, Rule, gyr_threshold
from fes.estimation.events.offline import GaitEvents, find_events, foot_strike_angles, stance_instants
from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Track, read_recording
from fes.signals import FOOT_SENSORS, G_MPS2, FloatArray, IntArray
from fes.simulation.truth import Truth, load_truth

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
HEEL_STRIKES = ("both_feet_100hz", "both_feet_200hz", "misaligned")
FOREFOOT = ("negard_patient1", "negard_patient2")
STRIDE_S = 1.2
# bumps of the toe-down rate: height in rad/s, time in the stride and width in s
PUSH_OFF, SWING, LOADING = (9.0, 0.40, 0.070), (-6.0, 0.60, 0.080), (5.0, 0.80, 0.030)
AXIS = np.array([0.6, 0.0, 0.8])

Feet = dict[str, tuple[Track, FootCalibration]]


@cache
def bundled(name: str) -> tuple[Feet, Truth]:
    recording = read_recording(TRIALS / f"{name}.parquet")
    return {f: (t, calibrate_track(t)) for f, t in recording.tracks.items()}, load_truth(TRIALS / f"{name}.parquet")


def calibration(axis: FloatArray = AXIS, rate_hz: float = 200.0, peak_radps: float = 9.0) -> FootCalibration:
    x, y, z = (float(v) for v in axis)
    return FootCalibration(
        sensor="right_foot",
        rate_hz=rate_hz,
        up=(-z, 0.0, x),
        toe_down=(x, y, z),
        acc_bias_mps2=(0.0, 0.0, 0.0),
        gyr_bias_radps=(0.0, 0.0, 0.0),
        push_off_radps=peak_radps,
        fall_radps=peak_radps + 6.0,
        stride_s=STRIDE_S,
        contact_jerk_mps3=2000.0,
        axis_confidence=1.0,
        strides=10,
        standing=True,
    )


def made_walk(
    strides: int = 12, rate_hz: float = 200.0, scale: float = 1.0, axis: FloatArray = AXIS, late_scale: float = 1.0
) -> tuple[IntArray, FloatArray, FloatArray]:
    """A standing second, then strides of three bumps each; the second half scaled by ``late_scale``."""
    t = np.arange(0.0, 1.0 + strides * STRIDE_S + 1.0, 1.0 / rate_hz)
    rate = np.zeros_like(t)
    for k in range(strides):
        size = scale * (late_scale if k >= strides // 2 else 1.0)
        for height, at, width in (PUSH_OFF, SWING, LOADING):
            rate += size * height * np.exp(-0.5 * ((t - 1.0 - k * STRIDE_S - at) / width) ** 2)
    acc = np.tile(G_MPS2 * np.array([-axis[2], 0.0, axis[0]]), (len(t), 1))
    return np.round(t * 1e9).astype(np.int64), acc, rate[:, None] * axis


def decide(walk: tuple[IntArray, FloatArray, FloatArray], c: FootCalibration, rule: Rule) -> list[Decision]:
    return OnlineEvents(c, rule).advance(*walk)


def times(decisions: list[Decision], event: OnlineEvent) -> FloatArray:
    return np.array([d.t_ns for d in decisions if d.event is event]) * 1e-9


def seconds(track: Track, t_ns: IntArray) -> FloatArray:
    return np.asarray((t_ns - track.t_sensor_ns[0]) * 1e-9)


def nearest(estimated: FloatArray, true: FloatArray) -> FloatArray:
    return np.array([estimated[np.abs(estimated - t).argmin()] - t for t in true])


def offline(name: str, foot: str) -> tuple[GaitEvents, Track, FootCalibration]:
    track, c = bundled(name)[0][foot]
    return find_events(track.t_sensor_ns, track.acc_mps2, track.gyr_radps, c), track, c


def truth_of(name: str, foot: str) -> tuple[FloatArray, FloatArray]:
    strides = bundled(name)[1].strides_of(foot)
    return np.array([s.t_loading_response_s for s in strides]), np.array([s.t_swing_s for s in strides])


def each_foot(names: tuple[str, ...]) -> list[tuple[str, str]]:
    return [(name, foot) for name in names for foot in bundled(name)[0]]


# --- off-line -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "foot"), each_foot(HEEL_STRIKES + FOREFOOT))
def test_offline_events_of_bundled_trials_are_all_there_and_near_the_truth(name: str, foot: str) -> None:
    events, track, _ = offline(name, foot)
    ic, fo = truth_of(name, foot)
    assert len(events) == len(ic)
    contact, off = nearest(seconds(track, events.ic_ns), ic), nearest(seconds(track, events.fo_ns), fo)
    assert abs(contact.mean()) < 0.008
    assert contact.std() < 0.005
    assert abs(off.mean()) < 0.006
    assert off.std() < 0.002
    assert events.heel_strike.all() if name in HEEL_STRIKES else not events.heel_strike.any()


def test_a_contact_too_soft_for_the_accelerometer_is_found_by_the_dropping_heel() -> None:
    events, track, _ = offline("soft_contact", "right_foot")
    ic, fo = truth_of("soft_contact", "right_foot")
    assert np.abs(nearest(seconds(track, events.fo_ns), fo)).max() < 0.005
    contact = nearest(seconds(track, events.ic_ns), ic)
    assert len(events) == len(ic)
    assert abs(np.median(contact)) < 0.01
    assert np.count_nonzero(np.abs(contact) < 0.04) >= 29


@pytest.mark.parametrize(("name", "foot"), each_foot((*HEEL_STRIKES, *FOREFOOT, "soft_contact", "not_walking")))
def test_exactly_one_contact_and_one_foot_off_between_two_mid_swings(name: str, foot: str) -> None:
    events, _, _ = offline(name, foot)
    assert len(events.fo_ns) == len(events.mid_swing_ns) == len(events.ic_ns) == len(events.heel_strike)
    in_order = np.column_stack([events.fo_ns, events.mid_swing_ns, events.ic_ns]).ravel()
    assert np.all(np.diff(in_order) > 0)


@pytest.mark.parametrize(
    ("name", "foot"), [*each_foot(("negard_patient1", "negard_patient2", "both_feet_100hz", "soft_contact"))]
)
def test_the_loading_response_lasts_until_heel_and_border_are_down(name: str, foot: str) -> None:
    """Patient 1 lands on the forefoot's outer border; pitch alone within 5° called that flat after a third of it."""
    events, track, c = offline(name, foot)
    _, flats_ns = stance_instants(track.t_sensor_ns, track.gyr_radps, events.fo_ns, events.ic_ns, c)
    flats_s, contacts_s = seconds(track, flats_ns[:-1]), seconds(track, events.ic_ns[:-1])
    true = [s for s in bundled(name)[1].strides_of(foot) if s.walking]
    errors = []
    for stride in true:
        at = int(np.abs(contacts_s - stride.t_loading_response_s).argmin())
        if abs(contacts_s[at] - stride.t_loading_response_s) < 0.1:
            errors.append((flats_s[at] - contacts_s[at]) - (stride.t_stance_s - stride.t_loading_response_s))
    assert len(errors) >= len(true) - 2
    assert abs(np.median(errors)) < 0.04


@pytest.mark.parametrize("rate_hz", [100.0, 204.8, 500.0, 1000.0])
def test_offline_events_do_not_depend_on_the_sampling_rate(rate_hz: float) -> None:
    reference = find_events(*made_walk(rate_hz=2000.0), calibration(rate_hz=2000.0))
    events = find_events(*made_walk(rate_hz=rate_hz), calibration(rate_hz=rate_hz))
    assert len(events) == len(reference) == 12
    for found, expected in ((events.ic_ns, reference.ic_ns), (events.fo_ns, reference.fo_ns)):
        assert np.abs(found - expected).max() < 2_000_000


@settings(max_examples=20, deadline=None)
@given(st.floats(0.3, 3.0), st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_neither_the_size_of_the_rates_nor_the_mounting_matters(scale: float, direction: tuple[float, ...]) -> None:
    axis = np.array(direction) / np.linalg.norm(direction)
    reference = find_events(*made_walk(), calibration())
    events = find_events(*made_walk(scale=scale, axis=axis), calibration(axis))
    assert np.abs(events.ic_ns - reference.ic_ns).max() < 1000
    assert np.abs(events.fo_ns - reference.fo_ns).max() < 1000


def test_made_push_off_and_turn_are_where_they_were_put() -> None:
    events = find_events(*made_walk(), calibration())
    start = 1.0 + STRIDE_S * np.arange(12)
    fine = np.arange(0.6, 0.8, 1e-4)
    rate = sum(h * np.exp(-0.5 * ((fine - at) / width) ** 2) for h, at, width in (PUSH_OFF, SWING, LOADING))
    turn = fine[np.argmax(rate > 0.0)]
    assert np.abs(events.ic_ns * 1e-9 - start - turn).max() < 0.006
    # push-off falls to 75 % 0.04 s after its peak
    assert np.abs(events.fo_ns * 1e-9 - start - 0.42).max() < 0.005


def test_a_swing_cut_off_by_the_end_is_left_out() -> None:
    t_ns, acc, gyr = made_walk(strides=6)
    cut = int(np.searchsorted(t_ns, (1.0 + 5 * STRIDE_S + 0.62) * 1e9))
    assert len(find_events(t_ns[:cut], acc[:cut], gyr[:cut], calibration())) == 5


@pytest.mark.parametrize("rebound", [-1.0, 0.3])
def test_a_foot_that_stimulation_snaps_up_before_it_swings_has_swung_once(rebound: float) -> None:
    t_ns, acc, gyr = made_walk()
    t = 1e-9 * t_ns
    for k in range(12):  # an earlier push-off, the snap at its end, and little until the swing's own turn
        for height, at, width in ((9.0, 0.10, 0.05), (-9.0, 0.40, 0.07), (-6.0, 0.18, 0.02), (rebound, 0.3, 0.03)):
            gyr = gyr + (height * np.exp(-0.5 * ((t - 1.0 - k * STRIDE_S - at) / width) ** 2))[:, None] * AXIS
    events = find_events(t_ns, acc, gyr, calibration())
    start = 1.0 + STRIDE_S * np.arange(12)
    assert len(events) == 12
    assert np.abs(1e-9 * events.fo_ns - start - 0.12).max() < 0.03
    assert np.abs(1e-9 * events.mid_swing_ns - start - 0.60).max() < 0.02
    assert np.abs(1e-9 * events.ic_ns - start - 0.73).max() < 0.03


def test_nothing_comes_of_standing_still_or_of_too_little() -> None:
    t_ns, acc, gyr = made_walk()
    assert len(find_events(t_ns, acc, 0.0 * gyr, calibration())) == 0
    assert len(find_events(t_ns[:50], acc[:50], gyr[:50], calibration())) == 0
    with pytest.raises(ValueError, match="9 samples are too few to filter: more than 9"):
        find_events(t_ns[:9], acc[:9], gyr[:9], calibration(rate_hz=5.0))
    assert len(find_events(t_ns[:10], acc[:10], gyr[:10], calibration(rate_hz=5.0))) == 0


def test_arrays_that_do_not_fit_or_are_not_finite_are_refused() -> None:
    t_ns, acc, gyr = made_walk()
    with pytest.raises(ValueError, match=r"right_foot: \d+ times"):
        find_events(t_ns[1:], acc, gyr, calibration())
    gyr[7, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        find_events(t_ns, acc, gyr, calibration())


# --- causal ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "foot"), each_foot((*HEEL_STRIKES, *FOREFOOT, "soft_contact")))
def test_causal_decisions_come_soon_and_none_is_missed(name: str, foot: str) -> None:
    track, c = bundled(name)[0][foot]
    decisions = decide((track.t_sensor_ns, track.acc_mps2, track.gyr_radps), c, Rule.INSTANTS)
    begin = track.t_sensor_ns[0] * 1e-9
    for event, true in zip((OnlineEvent.IC, OnlineEvent.FO), truth_of(name, foot), strict=True):
        estimated = times(decisions, event) - begin
        assert len(estimated) == len(true)
        delay = nearest(estimated, true)
        assert np.median(delay) < (0.03 if name == "soft_contact" else 0.02)
        assert np.percentile(delay, 95) < 0.05
        assert np.abs(delay).max() < 0.15


@pytest.mark.parametrize("rule", list(Rule))
@pytest.mark.parametrize("name", ["both_feet_200hz", "not_walking"])
def test_events_take_turns(name: str, rule: Rule) -> None:
    for track, c in bundled(name)[0].values():
        decisions = decide((track.t_sensor_ns, track.acc_mps2, track.gyr_radps), c, rule)
        assert all(d.t_feature_ns <= d.t_ns for d in decisions)
        middles = [k for k, d in enumerate(decisions) if d.event is OnlineEvent.MID_SWING]
        assert len(middles) > 5
        for k, m in pairwise(middles):
            between = [d.event for d in decisions[k + 1 : m]]
            assert between.count(OnlineEvent.IC) == 1
            # a heel lifted and put back is told as a foot off that no swing follows
            assert between[-1] is OnlineEvent.FO
            assert between[0] is OnlineEvent.IC
        if name != "not_walking":
            assert all(m - k == 3 for k, m in pairwise(middles))


@pytest.mark.parametrize("rule", list(Rule))
@settings(max_examples=15, deadline=None)
@given(cuts=st.lists(st.integers(1, 3000), max_size=12))
def test_it_does_not_matter_where_the_blocks_are_cut(rule: Rule, cuts: list[int]) -> None:
    t_ns, acc, gyr = made_walk()
    whole = decide((t_ns, acc, gyr), calibration(), rule)
    machine, parts = OnlineEvents(calibration(), rule), []
    for begin, end in pairwise([0, *sorted({c for c in cuts if c < len(t_ns)}), len(t_ns)]):
        parts += machine.advance(t_ns[begin:end], acc[begin:end], gyr[begin:end])
    assert parts == whole
    assert len(whole) > 30


@pytest.mark.parametrize("rule", list(Rule))
def test_decisions_do_not_know_the_future(rule: Rule) -> None:
    t_ns, acc, gyr = made_walk()
    whole = decide((t_ns, acc, gyr), calibration(), rule)
    for end in range(300, len(t_ns), 171):
        other = gyr.copy()
        other[end:] = 20.0  # whatever comes later
        known = [d for d in decide((t_ns, acc, other), calibration(), rule) if d.t_ns < t_ns[end]]
        assert known == [d for d in whole if d.t_ns < t_ns[end]]


@pytest.mark.parametrize("rate_hz", [100.0, 204.8, 500.0, 1000.0])
def test_causal_instants_do_not_depend_on_the_sampling_rate(rate_hz: float) -> None:
    reference = decide(made_walk(rate_hz=2000.0), calibration(rate_hz=2000.0), Rule.INSTANTS)
    decisions = decide(made_walk(rate_hz=rate_hz), calibration(rate_hz=rate_hz), Rule.INSTANTS)
    assert [d.event for d in decisions] == [d.event for d in reference]
    late = np.array([d.t_ns - r.t_ns for d, r in zip(decisions, reference, strict=True)])
    assert np.abs(late).max() < 1.5e9 / rate_hz + 3e6


@pytest.mark.parametrize("guess", [0.5, 2.0])
def test_a_wrong_first_guess_is_tuned_away(guess: float) -> None:
    machine = OnlineEvents(calibration(peak_radps=9.0 * guess))
    walk = made_walk(strides=12)
    decisions = machine.advance(*walk)
    assert np.count_nonzero([d.event is OnlineEvent.IC for d in decisions]) == 12
    assert machine._state["typical_peak"] == pytest.approx(9.0, rel=0.05)
    assert machine.thresholds[1] == pytest.approx(STRIDE_S / 3.0, rel=0.02)


def test_tuning_follows_a_walker_who_weakens() -> None:
    machine = OnlineEvents(calibration())
    decisions = machine.advance(*made_walk(strides=30, late_scale=0.45))
    assert [d.event for d in decisions] == [OnlineEvent.FO, OnlineEvent.MID_SWING, OnlineEvent.IC] * 30
    assert machine._state["typical_peak"] == pytest.approx(0.45 * 9.0, rel=0.05)


@pytest.mark.parametrize("rule", list(Rule))
def test_thresholds_change_with_every_fourth_stride_only(rule: Rule) -> None:
    t_ns, acc, gyr = made_walk(strides=17)
    machine = OnlineEvents(calibration(peak_radps=7.0), rule)
    contacts, seen = 0, [machine.thresholds]
    changed_at = []
    for k in range(len(t_ns)):
        before = machine.thresholds
        decisions = machine.advance(t_ns[k : k + 1], acc[k : k + 1], gyr[k : k + 1])
        contacts += sum(d.event is OnlineEvent.IC for d in decisions)
        if machine.thresholds != before:
            changed_at.append(contacts)
            seen.append(machine.thresholds)
    # the first contact has no stride before it to measure
    assert changed_at
    assert all((n - 1) % RETUNE_STRIDES == 0 for n in changed_at)
    assert seen[-1][0] == pytest.approx(gyr_threshold(6.0), rel=0.1)


def test_the_papers_threshold_is_what_it_prints_in_rad_per_s() -> None:
    assert gyr_threshold(7.0) == pytest.approx(7.0**0.7)
    assert gyr_threshold(1.0) == 1.0


def test_the_papers_rule_decides_late_on_heel_strikes() -> None:
    track, c = bundled("both_feet_200hz")[0]["right_foot"]
    walk = (track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    ic, fo = truth_of("both_feet_200hz", "right_foot")
    paper = decide(walk, c, Rule.PEAKS)
    begin = track.t_sensor_ns[0] * 1e-9
    assert np.median(nearest(times(paper, OnlineEvent.IC) - begin, ic)) > 0.1
    assert 0.05 < np.median(nearest(times(paper, OnlineEvent.FO) - begin, fo)) < 0.1


def test_useless_samples_change_nothing() -> None:
    t_ns, acc, gyr = made_walk()
    clean = decide((t_ns, acc, gyr), calibration(), Rule.INSTANTS)
    at = np.arange(50, len(t_ns), 37)
    spoilt = np.full((len(at), 3), np.nan)
    with_nan = (
        np.insert(t_ns, at, t_ns[at] - 1),
        np.insert(acc, at, spoilt, axis=0),
        np.insert(gyr, at, spoilt, axis=0),
    )
    doubled = (np.insert(t_ns, at, t_ns[at - 1]), np.insert(acc, at, 90.0, axis=0), np.insert(gyr, at, 9.0, axis=0))
    assert decide(with_nan, calibration(), Rule.INSTANTS) == clean
    assert decide(doubled, calibration(), Rule.INSTANTS) == clean


def test_after_a_silence_it_begins_anew_with_what_it_has_learnt() -> None:
    t_ns, acc, gyr = made_walk(strides=20)
    lost = (t_ns > (1.0 + 10 * STRIDE_S + 0.5) * 1e9) & (t_ns < (1.0 + 10 * STRIDE_S + 1.0) * 1e9)
    decisions = decide((t_ns[~lost], acc[~lost], gyr[~lost]), calibration(), Rule.INSTANTS)
    events = [d.event for d in decisions]
    assert events.count(OnlineEvent.IC) == 19
    assert events.count(OnlineEvent.FO) == 20


# --- foot-strike angle ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "foot"), each_foot(HEEL_STRIKES + FOREFOOT))
def test_foot_strike_angle_of_bundled_trials(name: str, foot: str) -> None:
    events, track, c = offline(name, foot)
    angles = np.degrees(foot_strike_angles(track.t_sensor_ns, track.gyr_radps, events, c))
    true = np.array([s.foot_strike_deg for s in bundled(name)[1].strides_of(foot)])
    error = (angles - true)[np.isfinite(angles)]
    assert len(error) >= len(true) - 1
    assert abs(error.mean()) < 2.5
    assert error.std() < 1.0


def test_foot_strike_angle_is_free_of_the_gyroscopes_calibrated_bias_and_unknown_at_the_end() -> None:
    t_ns, acc, gyr = made_walk()
    c = calibration()
    events = find_events(t_ns, acc, gyr, c)
    angles = foot_strike_angles(t_ns, gyr, events, c)
    bias = (0.05, -0.02, 0.03)
    biased = replace(c, gyr_bias_radps=bias)
    assert foot_strike_angles(t_ns, gyr + np.array(bias), events, biased) == pytest.approx(angles, nan_ok=True)
    assert np.all(angles[:-1] > 0.0)  # loading turns the foot toe-down until it is flat
    cut = int(np.searchsorted(t_ns, events.ic_ns[-1])) + 5
    assert np.isnan(foot_strike_angles(t_ns[:cut], gyr[:cut], events, c)[-1])


# --- IC and FO of feet that strong stimulation lifts: off-line and by the path ---


NEAR_S = 0.07  # the off-line IC of a slow foot is up to 65 ms early; the path sets it right
PATH_S = 0.03
LIFTED_S = 0.05  # foot off by the path where a burst lifts the ball before the toe: at 0.6 m/s half of them 46 ms early


@pytest.mark.parametrize("speed", ["0.4", "0.6", "0.8"])
def test_every_stimulated_stride_has_one_foot_off_and_one_contact(speed: str, tmp_path: Path) -> None:
    asked = ("--speed", speed, "--seconds", "24", "--stimulate", "phase", "--name", "walk", "--json")
    result = CliRunner().invoke(command, [*asked, "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    recording, found = calibrations_of(read_recording(tmp_path / "walk.parquet"))
    analysis = analyse(recording, found.calibrations)
    parameters, truth = gait_parameters(analysis), load_truth(tmp_path / "walk.parquet")
    for foot in FOOT_SENSORS:
        events, strides = analysis.events[foot], truth.strides_of(foot)
        off = np.array([stride.t_swing_s for stride in strides])
        contact = np.array([stride.t_loading_response_s for stride in strides])
        found_off, found_contact = 1e-9 * events.fo_ns, 1e-9 * events.ic_ns
        # a swing that the recording cuts off may be in either
        inside = (off < recording.tracks[foot].duration_s - 2.0) & (contact < recording.tracks[foot].duration_s - 2.0)
        assert inside.sum() >= 7
        for found_s, true_s, near_s in ((found_off, off, PATH_S), (found_contact, contact, NEAR_S)):
            apart = np.abs(found_s[:, None] - true_s[inside][None, :])
            assert (apart.min(axis=0) < near_s).all()
            assert (np.count_nonzero(apart < 0.4, axis=0) == 1).all(), "one for every stride"
        mine = parameters.strides[foot]
        assert len(mine) >= inside.sum() - 1
        for stride in mine:  # NaN, no times, is not below
            assert np.abs(off - stride["t_foot_off_s"]).min() < LIFTED_S
            assert np.abs(contact - stride["t_contact_s"]).min() < PATH_S
