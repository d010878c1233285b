"""Foot off of slow walks, from the stride's path: where the quiet roll ends, not where something merely trembles."""

from __future__ import annotations

import numpy as np
import pytest

from fes.analysis.parameters.contacts import swings_of
from fes.analysis.parameters.motion import pitches
from fes.estimation.clearance.clearance import FootPath, join_paths
from fes.estimation.events.offline import GaitEvents
from fes.signals import NS_PER_S

LEAVES_S, OFFLINE_S, LANDS_S, END_S = 0.6, 0.66, 1.0, 1.4


def path(rate_hz: float, *, drops: float = 0.0, pulled: float = 0.0, bump: float = 0.0, brisk: float = 0.0) -> FootPath:
    """A foot that turns evenly over its forefoot and leaves at ``LEAVES_S``.

    It then turns toe-down with ``drops`` rad/s², or is pulled up with ``pulled`` m/s². ``bump`` (m/s²) shakes it 60 ms
    before for a moment, ``brisk`` (m/s²) drives it all the time before.
    """
    t = np.arange(0.0, END_S, 1.0 / rate_hz)
    after = np.clip(t - LEAVES_S, 0.0, 0.2)
    pitch = -0.8 * np.clip(t - 0.2, 0.0, 0.5) - 0.5 * drops * after**2
    acceleration = pulled * ((t >= LEAVES_S) & (t < LEAVES_S + 0.1)) + brisk * ((t > 0.3) & (t < LEAVES_S))
    acceleration += bump * (np.abs(t - (LEAVES_S - 0.06)) < 0.012)
    height = np.cumsum(np.cumsum(acceleration)) / rate_hz**2
    position = np.column_stack([0.1 * t, np.zeros_like(t), height])
    c, s, zero, one = np.cos(pitch), np.sin(pitch), np.zeros_like(t), np.ones_like(t)
    axes = np.stack(
        [np.column_stack([c, zero, -s]), np.column_stack([zero, one, zero]), np.column_stack([s, zero, c])], 1
    )
    return FootPath(1, np.rint(t * NS_PER_S).astype(np.int64), position, axes, None, None)


def foot_off_s(way: FootPath) -> float:
    at = [np.array([round(s * NS_PER_S)], dtype=np.int64) for s in (OFFLINE_S, 0.85, LANDS_S)]
    events = GaitEvents(fo_ns=at[0], mid_swing_ns=at[1], ic_ns=at[2], heel_strike=np.array([False]))
    paths = join_paths([way])
    swings = swings_of(paths, pitches(paths), events, None)
    assert swings.seen.tolist() == [True]
    assert swings.contact_ns[0] == at[2][0], "no heel strike: contact stays"
    return float(swings.foot_off_ns[0]) / NS_PER_S


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 400.0])
@pytest.mark.parametrize("leaves", [{"drops": 60.0}, {"pulled": 6.0}])
def test_the_end_of_the_quiet_is_foot_off_at_every_rate(rate_hz: float, leaves: dict[str, float]) -> None:
    # a step is smeared by the means and differences over two samples and a half
    assert foot_off_s(path(rate_hz, **leaves)) == pytest.approx(LEAVES_S, abs=max(2.5 / rate_hz, 0.015))


def test_a_tremble_is_no_foot_off() -> None:
    assert foot_off_s(path(200.0, drops=60.0, bump=2.0)) == pytest.approx(LEAVES_S, abs=0.02)


def test_a_foot_that_goes_on_rolling_keeps_its_event() -> None:
    assert foot_off_s(path(200.0)) == OFFLINE_S
    assert foot_off_s(path(200.0, drops=5.0)) == OFFLINE_S


def test_a_brisk_push_off_keeps_its_event() -> None:
    assert foot_off_s(path(200.0, brisk=6.0, pulled=12.0)) == OFFLINE_S
