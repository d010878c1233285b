"""Clearance of toe and heel, and the foot's geometry found from walking, on a foot that turns about toe and heel."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pivoting_foot import ARMS, CONTACT_S, END_S, FOOT_OFF_S, arms, geometry_of, rotation, stride, upstairs

from benchmarks.lib.foot_paths import FootPath, each_path, join_paths
from fes.calibration.recording import calibrate_track
from fes.estimation.clearance.clearance import (
    AFTER,
    BEFORE,
    DIPS,
    HEEL,
    SENSOR,
    TOE,
    ContactLevels,
    FootArms,
    clearances,
    contact_heights,
    contact_levels,
)
from fes.estimation.clearance.geometry import (
    HEEL_BEHIND_M,
    PLAUSIBLE_HEEL_M,
    PLAUSIBLE_HEIGHT_M,
    PLAUSIBLE_TOE_M,
)
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import read_recording
from fes.signals import FloatArray

SMALL = st.floats(-0.1, 0.1)
SIM = Path(__file__).resolve().parents[2] / "sim_inputs"


def rise(path: FootPath, arm_m: tuple[float, float, float]) -> FloatArray:
    tilt = path.axes[:, 2, :] - path.axes[0, 2, :]
    return np.asarray(path.position_m[:, 2] + tilt @ np.array(arm_m))


def levels_of(paths: list[FootPath], arms: FootArms) -> ContactLevels | None:
    return contact_levels(contact_heights(join_paths(paths), arms))


def clearance(path: FootPath, arms: FootArms, levels: ContactLevels | None = None) -> FloatArray:
    return clearances(join_paths([path]), arms, levels)[0]


def test_steps_up_and_down_change_neither_geometry_nor_contacts() -> None:
    level = [stride(ARMS, landing_rad=angle) for angle in (0.3, 0.35, 0.4, 0.35, 0.3)]
    stairs = [upstairs(path, 0.34) for path in level]
    flat, up = geometry_of(level).geometry, geometry_of(stairs).geometry
    assert up.heel_forward_m == pytest.approx(flat.heel_forward_m, abs=1e-6)
    assert up.toe_forward_m == pytest.approx(flat.toe_forward_m, abs=1e-6)
    low, high = levels_of(level, ARMS), levels_of(stairs, ARMS)
    assert low is not None
    assert high is not None
    assert high.contact_m == pytest.approx(low.contact_m, abs=1e-6)
    assert clearance(stairs[0], ARMS, high)[HEEL] == pytest.approx(clearance(stairs[0], ARMS)[HEEL], abs=1e-6)


def test_clearances_are_those_of_the_points() -> None:
    path = stride(ARMS)
    toe, heel = (path.position_m + path.axes @ np.array(arm) for arm in (ARMS.toe_m, ARMS.heel_m))
    found = clearance(path, ARMS)
    off, contact = np.searchsorted(path.t_ns, (path.foot_off_ns or 0, path.contact_ns or 0))
    swing = slice(off, contact + 1)
    assert found[HEEL] == pytest.approx(float(heel[:, 2].max() + 0.06))
    assert found[SENSOR] == pytest.approx(float(path.position_m[:, 2].max()))
    assert max(found[BEFORE], found[AFTER]) == pytest.approx(float(toe[swing, 2].max() + 0.06))


def dipping(depth_m: float) -> FootPath:
    """Level feet whose height has peaks of 3 and 5 cm in swing and, between them, a dip."""
    t = np.linspace(0.0, 1.0, 201)
    knots = [0.0, 0.2, 0.4, 0.5, 0.7, 0.8, 1.0]
    height = np.interp(t, knots, [0.0, 0.0, 0.03, 0.03 - depth_m, 0.05, 0.05, 0.0])
    along = np.interp(t, [0.2, 0.5, 0.6, 0.8], [0.0, 0.3, 0.9, 1.2])
    way = np.column_stack([along, np.zeros_like(t), height])
    return FootPath(
        1, np.round(1e9 * t).astype(np.int64), way, np.tile(np.eye(3), (201, 1, 1)), 200_000_000, 800_000_000
    )


def test_minimum_toe_clearance_lies_between_the_peaks() -> None:
    found = clearance(dipping(0.015), ARMS)
    assert found[DIPS]
    assert found[TOE] == pytest.approx(0.015)
    assert found[BEFORE] == pytest.approx(0.03)
    assert found[AFTER] == pytest.approx(0.05)


def test_without_a_dip_the_height_at_the_greatest_speed_counts() -> None:
    found = clearance(dipping(0.0), ARMS)
    assert not found[DIPS]
    assert 0.03 <= found[TOE] <= 0.0405  # between 0.5 and 0.6 s
    assert found[AFTER] == pytest.approx(0.05)


@pytest.mark.parametrize("missing", ["foot_off_ns", "contact_ns"])
def test_without_a_swing_there_is_no_toe_clearance_but_a_heel(missing: str) -> None:
    path = stride(ARMS)
    path = replace(path, foot_off_ns=None) if missing == "foot_off_ns" else replace(path, contact_ns=None)
    found = clearance(path, ARMS, ContactLevels(0.5, 0.5, 0.5, 1.0, 1.0, 1.0))
    assert math.isnan(found[TOE])
    assert math.isnan(found[BEFORE])
    assert found[HEEL] == clearance(stride(ARMS), ARMS)[HEEL]
    assert levels_of([path] * 9, ARMS) is None


def drifting(path: FootPath, off_m: float, contact_m: float) -> FootPath:
    """The path with the height error that double integration leaves."""
    times = [0.0, FOOT_OFF_S, CONTACT_S, END_S]
    error = np.interp(1e-9 * path.t_ns, times, [0.0, off_m, contact_m, 0.0])
    return replace(path, position_m=path.position_m + np.column_stack([0 * error, 0 * error, error]))


def test_contact_levels_take_the_integrations_drift_out() -> None:
    rng = np.random.default_rng(5)
    true = clearance(stride(ARMS), ARMS)
    paths = [drifting(stride(ARMS, number=k), *rng.normal(0.0, 0.02, 2)) for k in range(40)]
    levels = levels_of(paths, ARMS)
    assert levels is not None
    assert min(levels.foot_off_weight, levels.contact_weight) > 0.9
    spread = {}
    for name, given_levels in (("without", None), ("with", levels)):
        found = [clearance(path, ARMS, given_levels) for path in paths]
        spread[name] = np.std(found, axis=0)[[TOE, HEEL, SENSOR]]
        assert np.mean(found, axis=0)[HEEL] == pytest.approx(true[HEEL], abs=0.01)
    assert all(after < 0.2 * before for before, after in zip(spread["without"], spread["with"], strict=True))


def test_what_is_too_large_for_drift_is_left_alone() -> None:
    levels = ContactLevels(0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    stumble = drifting(stride(ARMS), 0.2, -0.3)
    assert np.array_equal(clearance(stumble, ARMS, levels), clearance(stumble, ARMS))
    small = drifting(stride(ARMS), 0.02, -0.03)
    assert not np.array_equal(clearance(small, ARMS, levels), clearance(small, ARMS))


def test_level_ground_is_known_from_the_recording_and_a_slope_stays_one() -> None:
    rng = np.random.default_rng(8)
    for slope_m, kept_m in ((0.004, 0.0), (0.03, 0.03)):
        paths = [upstairs(stride(ARMS, number=k), slope_m + 0.012 * (-1) ** k) for k in range(20)]
        paths = [drifting(path, *rng.normal(0.0, 0.01, 2)) for path in paths]
        levels = levels_of(paths, ARMS)
        assert levels is not None
        assert levels.rise_m == pytest.approx(kept_m, abs=1e-6)
        assert levels.rise_weight > 0.9
        heights = contact_heights(join_paths(paths[:1]), ARMS)
        risen_m = 0.5 * (rise(paths[0], ARMS.toe_m)[-1] + rise(paths[0], ARMS.heel_m)[-1])
        assert heights[0, 2] == pytest.approx(risen_m)
        assert risen_m + levels.drifts(heights)[0, 2] == pytest.approx(kept_m, abs=0.002)


def test_strides_that_agree_are_left_alone() -> None:
    rng = np.random.default_rng(6)
    paths = [drifting(stride(ARMS, number=k), *rng.normal(0.0, 0.001, 2)) for k in range(20)]
    levels = levels_of(paths, ARMS)
    assert levels is not None
    assert levels.foot_off_weight == levels.contact_weight == 0.0
    assert np.array_equal(clearance(paths[0], ARMS, levels), clearance(paths[0], ARMS))


def test_one_stumble_does_not_move_the_level_and_four_strides_are_too_few() -> None:
    paths = [drifting(stride(ARMS, number=k), 0.01 * (-1) ** k, 0.0) for k in range(20)]
    calm, upset = levels_of(paths, ARMS), levels_of([*paths[:-1], drifting(paths[0], 1.0, 1.0)], ARMS)
    assert calm is not None
    assert upset is not None
    assert upset.foot_off_m == pytest.approx(calm.foot_off_m, abs=0.002)
    assert levels_of(paths[:4], ARMS) is None


def test_a_tracker_shows_the_path_of_every_valid_stride() -> None:
    recording = read_recording(SIM / "both_feet_200hz.parquet")
    track = recording.tracks["right_foot"]
    calibration = calibrate_track(track)
    chosen = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker("right_foot", chosen))
    block = tracker.track(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    strides, paths = block.strides(), each_path(block.paths())
    valid = [each for each in strides if each.valid]
    assert [path.number for path in paths] == [each.number for each in valid]
    assert len(paths) > 40
    for path, each in zip(paths, valid, strict=True):
        assert (path.t_ns[0], path.t_ns[-1]) == (each.t_start_ns, each.t_end_ns)
        x, y, z = path.position_m.T
        length2 = x[-1] ** 2 + y[-1] ** 2
        over = z - z[-1] * (x * x[-1] + y * y[-1]) / length2  # the line from stance to stance
        assert over.max() == pytest.approx(each.clearance_m)
    assert all(math.isnan(each.toe_clearance_m) for each in strides)


FORWARD = st.floats(0.03, 0.2)
SOLE = st.floats(0.19, 0.25)
HEIGHT = st.floats(0.035, 0.1)


@settings(deadline=None, max_examples=60)
@given(forward=FORWARD, sole=SOLE, height=HEIGHT)
def test_the_geometry_of_a_foot_that_turns_about_toe_and_heel_is_found(
    forward: float, sole: float, height: float
) -> None:
    true = arms(forward, sole, height)
    found = geometry_of([stride(true, landing_rad=angle) for angle in (0.3, 0.35, 0.4, 0.45)])
    assert found.observed, found.reason
    assert found.strides == 4
    heel = forward - sole - HEEL_BEHIND_M  # the foot here is not round: it touches the ground with its very heel
    assert -found.geometry.toe_up_m == pytest.approx(height, abs=0.005)
    assert found.geometry.heel_up_m == found.geometry.toe_up_m
    assert found.geometry.toe_forward_m == pytest.approx(forward, abs=0.010)
    assert found.geometry.heel_forward_m == pytest.approx(heel, abs=0.013)
    assert 0.003 < found.height_sd_m < 0.012
    assert 0.005 < found.toe_forward_sd_m < 0.02
    assert 0.005 < found.heel_forward_sd_m < 0.025


def test_later_foot_off_as_a_session_may_ask_for_finds_the_same_toe() -> None:
    paths = [stride(ARMS, landing_rad=angle) for angle in (0.3, 0.35, 0.4)]
    later = [replace(path, foot_off_ns=(path.foot_off_ns or 0) + 40_000_000) for path in paths]
    assert geometry_of(later).geometry == geometry_of(paths).geometry


def test_a_foot_that_lands_flat_shows_no_heel_and_gets_it_from_the_prior() -> None:
    flat = geometry_of([stride(ARMS, landing_rad=0.02)] * 8)
    assert not flat.observed
    assert "the heel shows in 0 strides" in flat.reason
    assert "toe" not in flat.reason
    assert flat.geometry.toe_forward_m == pytest.approx(0.12, abs=0.005)
    assert flat.geometry.heel_forward_m == pytest.approx(flat.geometry.toe_forward_m - 0.22, abs=0.003)
    assert flat.heel_forward_sd_m > 0.025


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_strides_give_the_prior(count: int) -> None:
    found = geometry_of([stride(ARMS)] * count)
    assert not found.observed
    assert "3 are needed" in found.reason
    assert found.geometry.toe_forward_m == pytest.approx(0.09)
    assert found.geometry.heel_forward_m == pytest.approx(-0.13)
    assert found.geometry.toe_up_m == found.geometry.heel_up_m == pytest.approx(-0.065)
    assert found.toe_forward_sd_m == pytest.approx(0.05)


@settings(deadline=None, max_examples=60)
@example(seed=1, size=0.1875, turn=0.0)
@given(seed=st.integers(0, 10_000), size=st.floats(0.0, 3.0), turn=st.floats(0.0, 2.0))
def test_no_path_gives_a_wild_arm(seed: int, size: float, turn: float) -> None:
    rng = np.random.default_rng(seed)
    paths = []
    for path in [stride(ARMS, number=number) for number in range(5)]:
        n = len(path.t_ns)
        axes = rotation(*(turn * rng.normal(size=(3, 1)) * np.linspace(0.0, 1.0, n))) @ path.axes
        paths.append(replace(path, position_m=path.position_m + size * rng.normal(size=(n, 3)), axes=axes))
    g = geometry_of(paths).geometry
    assert PLAUSIBLE_HEIGHT_M[0] < -g.toe_up_m < PLAUSIBLE_HEIGHT_M[1]
    assert PLAUSIBLE_TOE_M[0] < g.toe_forward_m < PLAUSIBLE_TOE_M[1]
    assert PLAUSIBLE_HEEL_M[0] - 0.05 < g.heel_forward_m < PLAUSIBLE_HEEL_M[1] + 0.05  # unseen, it follows the toe
    assert 0.14 < g.toe_forward_m - g.heel_forward_m < 0.33


def test_an_impossible_foot_is_refused_with_a_reason() -> None:
    short = arms(0.05, 0.1, 0.06)
    found = geometry_of([stride(short)] * 5)
    assert not found.observed
    assert "apart" in found.reason
    assert 0.15 < found.geometry.toe_forward_m - found.geometry.heel_forward_m < 0.3
