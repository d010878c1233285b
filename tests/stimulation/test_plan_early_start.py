"""A burst that begins before its phase: off at once if that does not come, and never longer for having begun early."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_plan import LOADING, MS, PRE_SWING, STANCE, SWING, Walk, make_channel

from fes.signals import StimRequest
from fes.stimulation.onset import FALSE_NS

FALSE_MS = FALSE_NS // MS
PRE_MS, SWING_MS, REST_MS = 300, 500, 600


def early(**changes: Any) -> Walk:
    """20 mA, 100 ms up and down; 60 ms past contact."""
    return Walk(make_channel(onset="predicted", **changes))


def begin(walk: Walk, foot: str = "left_foot") -> bool:
    begun = walk.plan.begin_early(foot, walk.t_ms * MS, walk.intensity)
    walk.requests()
    return begun


def step(walk: Walk, lead_ms: int = 0, pre_ms: int = PRE_MS, swing_ms: int = SWING_MS) -> dict[int, float]:
    """One stride, its burst begun ``lead_ms`` before T1; the current by ms since T1, until 400 ms after contact."""
    walk.current(walk.t_ms + REST_MS)
    if lead_ms:
        assert begin(walk)
    rise_ms, found = walk.t_ms + lead_ms, dict[int, float]()
    at = {rise_ms: PRE_SWING, rise_ms + pre_ms: SWING, rise_ms + pre_ms + swing_ms: LOADING}
    for ms in range(walk.t_ms, rise_ms + pre_ms + swing_ms + 400):
        walk.current(ms)
        if ms in at:
            walk.enter(at[ms])
        found[ms - rise_ms] = walk.current(ms)
    walk.enter(STANCE)
    walk.current(walk.t_ms)
    return found


def on(found: dict[int, float]) -> list[int]:
    return [ms for ms, current in found.items() if current > 0.0]


@pytest.mark.parametrize("lead_ms", [1, 20, 40, 60])
def test_it_begins_and_ends_as_much_earlier(lead_ms: int) -> None:
    walk = early()
    detected = step(walk)
    predicted = step(walk, lead_ms)
    assert on(predicted)[0] == -lead_ms
    assert {ms + lead_ms: current for ms, current in predicted.items() if current} == {
        ms: current for ms, current in detected.items() if current
    }
    assert step(walk) == detected  # the next one is as ever


@pytest.mark.parametrize(("lead_ms", "swing_ms"), [(100, SWING_MS), (100, SWING_MS + 300), (140, SWING_MS + 100)])
def test_begun_earlier_than_its_extension_it_lasts_no_longer_than_the_longest_of_the_last(
    lead_ms: int, swing_ms: int
) -> None:
    walk = early()
    longest = max(len(on(step(walk, swing_ms=ms))) for ms in (SWING_MS, SWING_MS + 50, SWING_MS))
    assert len(on(step(walk, lead_ms, swing_ms=swing_ms))) <= longest


@pytest.mark.requirement("SR-26")
@pytest.mark.parametrize("rise_s", [0.1, 0.2])
def test_without_a_heel_rise_it_is_off_at_once(rise_s: float) -> None:
    walk = early(rise_s=rise_s)
    step(walk)
    walk.current(walk.t_ms + REST_MS)
    assert begin(walk)
    began_ms, found = walk.t_ms, dict[int, float]()
    for ms in range(began_ms, began_ms + 1000):
        found[ms - began_ms] = walk.current(ms)
    assert on(found) == list(range(FALSE_MS))


def test_a_heel_that_rises_after_a_false_start_has_a_burst_of_its_own() -> None:
    walk = early()
    step(walk)
    walk.current(walk.t_ms + REST_MS)
    assert begin(walk)
    walk.current(walk.t_ms + FALSE_MS + 10)
    walk.enter(PRE_SWING)
    found = {ms: walk.current(ms) for ms in range(walk.t_ms, walk.t_ms + 200)}
    first = on(found)[0]
    assert first - min(found) == 90  # the channel rests for 100 ms first
    assert found[first] == 0.5


@pytest.mark.requirement("SR-26")
@pytest.mark.parametrize(
    "what", ["other foot", "detected", "no stride yet", "on", "resting", "intensity 0", "antagonist", "lost"]
)
def test_nothing_begins_that_may_not(what: str) -> None:
    channel = make_channel(onset="detected" if what == "detected" else "predicted", never_with=[1])
    walk = Walk(channel, make_channel(1, start_phase="stance", stop_phase="pre_swing"))
    if what != "antagonist":
        walk = Walk(make_channel(onset=channel.onset))
    if what != "no stride yet":
        step(walk)
    if what in ("on", "resting"):
        walk.enter(PRE_SWING)
        walk.current(walk.t_ms + 50)
        if what == "resting":
            walk.enter(STANCE)
            walk.current(walk.t_ms + 50)
    else:
        walk.current(walk.t_ms + REST_MS)
    if what == "lost":
        walk.lose()
    walk.intensity = 0.0 if what == "intensity 0" else 1.0
    before = walk.current(walk.t_ms)
    assert not begin(walk, "right_foot" if what == "other foot" else "left_foot")
    assert walk.current(walk.t_ms) == before


@pytest.mark.parametrize("what", ["cancel", "lost", "not permitted"])
def test_what_ends_any_burst_ends_one_that_began_early(what: str) -> None:
    walk = early()
    step(walk)
    walk.current(walk.t_ms + REST_MS)
    assert begin(walk)
    assert walk.current(walk.t_ms + 40) > 0.0
    if what == "cancel":
        walk.plan.cancel()
    elif what == "lost":
        walk.lose()
    else:
        walk.enter(PRE_SWING, permitted=False)
    assert walk.plan.due(walk.t_ms * MS, 1.0)
    assert walk.current(walk.t_ms) == 0.0
    assert walk.current(walk.t_ms + 300) == 0.0


def test_its_longest_duration_counts_from_its_beginning() -> None:
    walk = early(limits={"max_on_s": 0.5})
    step(walk)
    found = step(walk, 60, pre_ms=400, swing_ms=600)
    assert on(found)[0] == -60
    assert 435 < on(found)[-1] < 440  # the last of the ramp is less than a step of the device


def test_a_lower_intensity_acts_at_once_and_stays() -> None:
    walk = early()
    step(walk)
    walk.current(walk.t_ms + REST_MS)
    assert begin(walk)
    walk.current(walk.t_ms + 40)
    walk.intensity = 0.5
    walk.enter(PRE_SWING)
    assert max(walk.current(ms) for ms in range(walk.t_ms, walk.t_ms + 200)) == 10.0


STRIDES = st.lists(
    st.tuples(
        st.integers(0, FALSE_MS + 100),  # how long before T1 a burst is to begin; 0: not
        st.integers(20, 600),  # pre-swing
        st.integers(50, 1200),  # swing
        st.sampled_from(["stance", "lost", "put back", "again"]),
    ),
    min_size=1,
    max_size=8,
)


@pytest.mark.requirement("SR-26")
@settings(max_examples=60, deadline=None)
@given(STRIDES, st.sampled_from([0.04, 0.06, 0.3]), st.sampled_from([0.2, 0.7, 2.0]))
@example([*[(0, 200, 400, "stance")] * 5, (50, 260, 460, "stance")], 0.06, 2.0)
def test_whatever_the_foot_does_a_burst_that_began_early_is_bounded(
    strides: list[tuple[int, int, int, str]], extension_s: float, max_on_s: float
) -> None:
    walk = early(extension_s=extension_s, limits={"max_on_s": max_on_s})
    extension_ms, fall_ms, longest_ms = round(1000 * extension_s), 100, 0
    on_ms: list[int] = []

    def go(until_ms: int) -> None:
        while walk.t_ms < until_ms:
            if walk.current(walk.t_ms) > 0.0:
                on_ms.append(walk.t_ms)
            walk.current(walk.t_ms + 1)

    for lead_ms, pre_ms, swing_ms, how in strides:
        go(walk.t_ms + REST_MS)
        on_ms.clear()
        asked_ms, begun = walk.t_ms, lead_ms > 0 and begin(walk)
        go(asked_ms + lead_ms)
        if lead_ms > FALSE_MS:
            assert all(ms < asked_ms + FALSE_MS for ms in on_ms)
        rise_ms = walk.t_ms
        walk.enter(PRE_SWING)
        go(walk.t_ms + pre_ms)
        if how == "put back":
            walk.enter(STANCE)
            assert walk.current(walk.t_ms) == 0.0
            continue
        walk.enter(SWING)
        go(walk.t_ms + swing_ms)
        if how == "lost":
            walk.lose()
            longest_ms = 0
            assert walk.current(walk.t_ms) == 0.0
            continue
        contact_ms = walk.t_ms
        walk.enter(LOADING)
        go(contact_ms + 500)
        walk.enter(STANCE)
        own_ms = contact_ms - rise_ms + extension_ms
        if begun and lead_ms < FALSE_MS and on_ms:
            assert on_ms[0] == asked_ms
            assert on_ms[-1] < contact_ms + extension_ms + fall_ms
            assert len(on_ms) <= min(max(own_ms, longest_ms) + fall_ms, round(1000 * max_on_s))
        elif not lead_ms and on_ms:
            assert on_ms[0] >= rise_ms
        longest_ms = max(longest_ms, own_ms)


def test_a_plan_without_such_channels_begins_nothing_early() -> None:
    walk = Walk(make_channel())
    step(walk)
    walk.current(walk.t_ms + REST_MS)
    assert not begin(walk)
    assert walk.requests() == (StimRequest(0, False),)


@pytest.mark.parametrize(
    ("what", "said"),
    [({"extension_s": 0.0}, "0.04 at least"), ({"start_phase": "swing"}, "pre_swing"), ({"start_delay_s": 0.1}, "= 0")],
)
def test_what_a_predicted_onset_cannot_be_is_refused(what: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        early(**what)
