"""A heel rise foreseen: when a burst would begin, of whom it may be used, and what makes it begin anew."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from test_plan import ENDS

from fes.stimulation.onset import (
    EACH_ONSET,
    FALSE_NS,
    GAP_NS,
    KNOWN_FROM,
    LEAD_NS,
    MS,
    NEAR_NS,
    ONSET,
    PROVEN_FROM,
    OnsetPredictor,
)
from statemachine.phases import PhaseChange, Transition

STEP_MS, LOADING_MS, SWING_MS, STANCE_MS, RISING_MS = 5, 100, 500, 700, 100


class Foot:
    """One that stands and swings as told; its turn and rate climb to T1's limits over the last 100 ms of stance."""

    def __init__(self, *, obeyed: bool = True) -> None:
        self.onset, self.t_ms, self.obeyed = OnsetPredictor(), 0, obeyed
        self.began_ms: list[int] = []
        self.said: list[tuple[str, str, str]] = []

    def change(self, transition: Transition, *, permitted: bool = True) -> None:
        self.onset.on_phase(PhaseChange(self.t_ms * MS, "left_foot", transition, *ENDS[transition]), permitted)
        self._listen()

    def land(self) -> None:
        self.change(Transition.T3)
        self.t_ms += LOADING_MS
        self.change(Transition.T4)

    def stand(self, for_ms: int, rises_in_ms: int | None) -> None:
        """Samples of stance; the heel is to rise so long after their beginning, None: not at all."""
        for at_ms in range(0, for_ms, STEP_MS):
            share = 0.0 if rises_in_ms is None else max(0.0, 1.0 - (rises_in_ms - at_ms) / RISING_MS)
            if self.onset.starts(self.t_ms * MS, share, share):
                self.began_ms.append(self.t_ms)
                self.onset.used = self.obeyed and self.onset.in_use
            self._listen()
            self.t_ms += STEP_MS

    def step(self, stance_ms: int = STANCE_MS, *, permitted: bool = True) -> None:
        """From contact to the next one's beginning; ``stance_ms`` from contact to heel rise."""
        self.land()
        self.stand(stance_ms - LOADING_MS, stance_ms - LOADING_MS)
        self.change(Transition.T1, permitted=permitted)
        self.t_ms += SWING_MS // 2
        self.change(Transition.T2)
        self.t_ms += SWING_MS // 2

    def _listen(self) -> None:
        self.said += self.onset.said
        self.onset.said.clear()


def walked(stances_ms: Sequence[int]) -> Foot:
    foot = Foot()
    for stance_ms in stances_ms:
        foot.step(stance_ms)
    return foot


STEADY = [STANCE_MS] * (KNOWN_FROM + PROVEN_FROM)


def test_a_burst_would_begin_a_lead_before_the_heel_rises() -> None:
    foot = Foot()
    for stance_ms in STEADY:
        contact_ms = foot.t_ms
        foot.step(stance_ms)
        if foot.began_ms:
            assert foot.began_ms[-1] == contact_ms + STANCE_MS - LEAD_NS // MS
            assert foot.onset.expected_ns == foot.onset.came_ns
    assert len(foot.began_ms) == PROVEN_FROM


@pytest.mark.requirement("SR-26")
@pytest.mark.parametrize(
    ("stances_ms", "in_use", "why"),
    [
        ([], False, "0 of 10 heel rises have shown"),
        (STEADY[:-1], False, "9 of 10 heel rises have shown"),
        (STEADY, True, "10 of the last 10 heel rises came within 60 ms"),
        ([*STEADY, *[STANCE_MS - 50, STANCE_MS] * 5], True, "20 of the last 20"),
        ([*STEADY, STANCE_MS - 200], True, "10 of the last 11"),
        ([*STEADY, STANCE_MS - 200, STANCE_MS, STANCE_MS - 200], False, "11 of the last 13"),
        ([*STEADY, STANCE_MS - 200, STANCE_MS - 200, *STEADY, *STEADY], True, "20 of the last 20"),
        ([500, 900, 700, 1100, 400] * 8, False, "came within"),
    ],
)
def test_it_is_used_of_those_alone_whose_heel_rises_are_foreseen(stances_ms: list[int], in_use: bool, why: str) -> None:
    foot = walked(stances_ms)
    assert foot.onset.in_use is in_use
    assert why in foot.onset.describe()
    assert foot.onset.describe().startswith("onset is predicted" if in_use else "onset is detected")


def test_what_was_expected_and_what_came_is_told_of_each_stride_in_use_and_of_no_other() -> None:
    foot = walked([*STEADY, STANCE_MS + 20, STANCE_MS - 20])
    each = [text for _, source, text in foot.said if source == EACH_ONSET]
    assert len(each) == 2  # the strides before have only shown how well
    assert "40 ms after the burst was asked for" not in each[0]
    assert "T1 came 20 ms sooner than expected, 20 ms after the burst was asked for" in each[1]
    assert next(text for _, source, text in foot.said if source == ONSET).startswith("onset is predicted")


@pytest.mark.parametrize("late_ms", [0, 100, 400])
def test_a_foot_that_has_not_begun_to_turn_starts_nothing_however_long_it_stands(late_ms: int) -> None:
    foot = walked(STEADY)
    before = len(foot.began_ms)
    foot.land()
    foot.stand(STANCE_MS + late_ms, None)
    assert len(foot.began_ms) == before
    foot.stand(RISING_MS, RISING_MS)  # and then it does
    assert len(foot.began_ms) == before + 1


def false_start(foot: Foot) -> None:
    """The foot turns as before a heel rise, and then stays as it is."""
    foot.land()
    foot.stand(STANCE_MS - LOADING_MS, STANCE_MS - LOADING_MS)
    foot.stand(FALSE_NS // MS + 50, None)


@pytest.mark.requirement("SR-26")
@pytest.mark.parametrize("obeyed", [True, False])
def test_after_one_false_start_it_must_prove_itself_anew(obeyed: bool) -> None:
    foot = Foot(obeyed=obeyed)
    for stance_ms in STEADY:
        foot.step(stance_ms)
    false_start(foot)
    warned = [text for severity, _, text in foot.said if severity == "warning"]
    assert warned == (["a burst was asked for early, but no heel rose within 150 ms: stopped"] if obeyed else [])
    assert not foot.onset.in_use
    assert "0 of 10 heel rises" in foot.onset.describe()
    foot.change(Transition.T1)  # at last, which says nothing of the prediction
    for _ in range(PROVEN_FROM - 1):
        foot.step()
        assert not foot.onset.in_use
    foot.step()
    assert foot.onset.in_use


def test_it_starts_once_a_stance() -> None:
    foot = walked(STEADY)
    before = len(foot.began_ms)
    false_start(foot)
    foot.stand(1000, 1000)
    assert len(foot.began_ms) == before + 1


@pytest.mark.parametrize(
    ("transition", "in_use"), [(Transition.NONE, False), (Transition.T5, True)], ids=["data lost", "heel put back"]
)
def test_nothing_starts_in_a_stance_that_no_contact_began(transition: Transition, in_use: bool) -> None:
    foot = walked(STEADY)
    before = len(foot.began_ms)
    foot.change(transition)
    foot.stand(STANCE_MS, STANCE_MS)
    assert len(foot.began_ms) == before
    assert foot.onset.in_use is in_use


def test_nothing_starts_in_a_stance_with_a_gap() -> None:
    foot = walked(STEADY)
    before = len(foot.began_ms)
    foot.land()
    foot.stand(300, None)
    foot.t_ms += GAP_NS // MS + 10
    foot.stand(300, 300)
    assert len(foot.began_ms) == before


def test_samples_from_the_past_change_nothing() -> None:
    foot = walked(STEADY)
    foot.land()
    assert not foot.onset.starts(foot.t_ms * MS, 9.0, 9.0)
    assert not foot.onset.starts((foot.t_ms - 50) * MS, 9.0, 9.0)
    assert foot.onset.expected_ns is None


def test_heel_rises_that_may_start_no_burst_teach_nothing() -> None:
    foot = Foot()
    for _ in range(3 * PROVEN_FROM):
        foot.step(permitted=False)
    assert foot.began_ms == []
    assert not foot.onset.in_use


def test_the_bounds_fit_together() -> None:
    assert LEAD_NS + NEAR_NS < FALSE_NS  # a heel rise that came as late as is still near is no false start
