"""The foot's geometry found from walking, on a foot that turns about toe and heel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pivoting_foot import ARMS, arms, geometry_of, rotation, stride

from fes.estimation.clearance.geometry import (
    HEEL_BEHIND_M,
    PLAUSIBLE_HEEL_M,
    PLAUSIBLE_HEIGHT_M,
    PLAUSIBLE_TOE_M,
)

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
