"""The wrapper holds whatever a rule proposes: bounds, steps, and a person's last word."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from random import Random
from typing import Any, cast

import pytest
from tuning_plant import BOUNDS, channel, stride, tuning

from fes.config import Channel, ConfigError, Tuning
from fes.extensions import ExtensionError
from fes.stimulation.envelope import BINS, BurstParameters
from fes.stimulation.tuning.held import Tuner, held
from fes.stimulation.tuning.report import Proposal, Rule, Seen, TuningReport
from fes.stimulation.tuning.session import rule_of

EDGES = BOUNDS | {"extension_s": {"low": 0.0, "high": 0.2}}
STEPS = {"max_change_ma": 1.7, "max_change_us": 13.0, "max_change_s": 0.012}
EPSILON = 1e-6
WRONG: list[Any] = [
    math.nan, math.inf, -math.inf, 1e308, -1e308, -1.0, 0.0, "30", None, True, [], 3 + 4j, 10**400, object(),
]  # fmt: skip


class Liar:
    """Proposes anything, or raises."""

    def __init__(self, random: Random) -> None:
        self._random = random

    def _value(self) -> Any:
        r = self._random
        return r.choice(WRONG) if r.random() < 0.15 else r.uniform(-1000.0, 1000.0)

    def stride(self, seen: Seen) -> Any:
        r = self._random
        kind = r.randrange(10)
        if kind == 0:
            raise r.choice([ValueError, ZeroDivisionError, RecursionError, KeyError, MemoryError])("no")
        if kind == 1:
            return r.choice(WRONG)
        if kind == 2:
            return Proposal("x", cast("Any", r.choice(WRONG)), cast("Any", r.choice(WRONG)))
        if kind == 3:
            return Proposal(cast("Any", object()), seen.given, stop=r.random() < 0.5)
        widths = tuple(self._value() for _ in range(r.choice([BINS, BINS, BINS, 1, 0])))
        return Proposal("more", BurstParameters(self._value(), self._value(), self._value(), widths))

    def acted(self, what: str, incline: float | None = None) -> None:
        if self._random.random() < 0.2:
            raise RuntimeError(what)


class Always:
    """Proposes the same whatever comes."""

    def __init__(self, wanted: BurstParameters | None, text: str = "more") -> None:
        self.proposal = None if wanted is None else Proposal(text, wanted)

    def stride(self, seen: Seen) -> Proposal | None:
        return self.proposal

    def acted(self, what: str, incline: float | None = None) -> None:
        """Nothing to it."""


def asking(one: Channel | None = None, **more: float) -> Tuner:
    """A tuner whose rule asks for 40 mA at every stride; the session has 30."""
    tuner = Tuner(one or channel(), Always(None), **more)
    tuner.rule = Always(replace(tuner.start, current_ma=40.0))
    return tuner


def seen_of(number: int, given: BurstParameters, intensity: float = 1.0) -> Seen:
    return Seen(stride(number, 0.02), None, given, 270.0, intensity)


def values_of(burst: BurstParameters) -> dict[str, tuple[float, ...]]:
    return {
        "current_ma": (burst.current_ma,),
        "start_delay_s": (burst.start_delay_s,),
        "extension_s": (burst.extension_s,),
        "pulse_width_us": burst.widths_us,
    }


MOST = {"current_ma": 1.7, "start_delay_s": 0.012, "extension_s": 0.012, "pulse_width_us": 13.0}


def check_step(before: BurstParameters, after: BurstParameters, start: BurstParameters) -> None:
    old = values_of(before)
    for name, values in values_of(after).items():
        for was, now in zip(old[name], values, strict=True):
            assert isinstance(now, float)
            assert EDGES[name]["low"] - EPSILON <= now <= EDGES[name]["high"] + EPSILON
            at_once = name == "start_delay_s" and now == start.start_delay_s
            assert at_once or abs(now - was) <= MOST[name] + EPSILON


def lie(walks: int, strides: int = 20) -> None:
    """Walks under a rule that lies, with a person who acts now and then; everything is checked at every stride."""
    one = channel(tuning(bounds=EDGES, **STEPS))
    suggests = channel(tuning(bounds=EDGES, mode="suggest", **STEPS))
    for walk in range(walks):
        random = Random(walk)
        suggest = walk % 4 == 0
        tuner = Tuner(suggests if suggest else one, cast("Rule", Liar(random)))
        by_hand = False
        for number in range(strides):
            before = tuner.parameters
            tuner.observe(number, seen_of(number, before, random.choice([0.0, 0.3, 1.0])))
            check_step(before, tuner.parameters, tuner.start)
            if by_hand or suggest:
                assert tuner.parameters == before, "a person froze it, or has not accepted"
            before, pending = tuner.parameters, tuner.pending
            act = random.randrange(12)
            if act == 0:
                by_hand = by_hand or not tuner.frozen
                if by_hand:
                    tuner.freeze(number)
            elif act == 1 and tuner.frozen:
                by_hand = False
                tuner.resume(number)
            elif act == 2:
                tuner.accept(number)
                assert tuner.parameters == (pending or before)
                check_step(before, tuner.parameters, tuner.start)
            elif act == 3 and walk % 3 == 0:
                tuner.roll_back(number)
                assert tuner.parameters == tuner.start
                assert tuner.frozen
                by_hand = True
            elif act == 4:
                tuner.acted("ground", 0.05)


def test_nothing_goes_over_a_bound_or_a_step_under_a_rule_that_lies() -> None:
    lie(600)


@pytest.mark.slow
def test_nothing_does_in_ten_thousand_walks() -> None:
    lie(10_000)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, None, [], 3 + 4j, 10**400, object()])
def test_what_is_no_number_stops_the_tuning(wrong: Any) -> None:
    tuner = Tuner(channel(), Always(None))
    tuner.rule = Always(replace(tuner.start, current_ma=wrong))
    report = tuner.observe(1, seen_of(1, tuner.start))
    assert report is not None
    assert report.kind == "roll_back"
    assert "its rule cannot be used (" in tuner.frozen
    assert tuner.parameters == tuner.start


def test_a_rule_that_has_stopped_is_stepped_back_to_less_and_asked_no_more() -> None:
    tuner = asking()
    for number in range(4):
        tuner.observe(number, seen_of(number, tuner.parameters))
    assert tuner.parameters.current_ma == 38.0

    def stride_of(seen: Seen) -> Proposal:
        return Proposal("enough", stop=True)

    cast("Any", tuner.rule).stride = stride_of
    said = [tuner.observe(n, seen_of(n, tuner.parameters)) for n in range(4, 12)]
    texts = [report.text for report in said if report is not None]
    assert texts[0] == "enough; tuning has stopped and goes back: current 38.0 → 36.0 mA"
    assert texts[1:] == [
        "still going back: current 36.0 → 34.0 mA",
        "still going back: current 34.0 → 32.0 mA",
        "still going back: current 32.0 → 30.0 mA",
    ]


def test_below_the_sessions_intensity_nothing_gets_stronger_than_its_own_settings() -> None:
    tuner = asking(usual_intensity=1.0)
    assert tuner.observe(1, seen_of(1, tuner.start, 0.5)) is None
    assert tuner.parameters == tuner.start
    tuner.observe(2, seen_of(2, tuner.start, 1.0))
    assert tuner.parameters.current_ma == 32.0


def test_a_suggestion_waits_for_a_person_and_is_said_once() -> None:
    tuner = asking(channel(tuning(mode="suggest")))
    first = tuner.observe(1, seen_of(1, tuner.start))
    assert first is not None
    assert first.text == "suggested: more: current 30.0 → 32.0 mA"
    assert tuner.observe(2, seen_of(2, tuner.start)) is None
    assert tuner.parameters == tuner.start
    accepted = tuner.accept(3)
    assert accepted is not None
    assert tuner.parameters.current_ma == 32.0
    assert tuner.accept(4) is None


@pytest.mark.parametrize(
    ("act", "then"),
    [
        (Tuner.freeze, "tuning is frozen (on demand)"),
        (Tuner.roll_back, "back to the session's settings, tuning is frozen"),
    ],
)
def test_a_person_has_the_last_word(act: Callable[[Tuner, int], TuningReport], then: str) -> None:
    tuner = asking()
    tuner.observe(1, seen_of(1, tuner.start))
    assert then in act(tuner, 2).text
    frozen = tuner.parameters
    assert tuner.observe(3, seen_of(3, frozen)) is None
    assert tuner.parameters == frozen
    assert tuner.resume(4).text == "tuning goes on"
    tuner.observe(5, seen_of(5, frozen))
    assert tuner.parameters.current_ma == frozen.current_ma + 2.0


def test_steps_are_those_of_the_device_and_end_at_the_bounds() -> None:
    one = channel()
    assert one.tuning is not None
    start = BurstParameters.for_channel(one)
    after = held(start, replace(start, current_ma=30.7, widths_us=(300.4,) * BINS), one.tuning)
    assert after == replace(start, current_ma=30.5)
    off_grid = replace(start, current_ma=39.3)
    assert held(off_grid, replace(start, current_ma=99.0), one.tuning).current_ma == 40.0
    with pytest.raises(ValueError, match="no burst"):
        held(start, replace(start, widths_us=(300.0,)), one.tuning)


def test_a_rule_of_another_package_is_named_in_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises((ConfigError, ValueError), match="no installed package brings it"):
        tuning(rule="gaitlab_steady")
    named = tuning().model_copy(update={"rule": "gaitlab_steady"})
    with pytest.raises(ExtensionError, match="no installed package brings a tuner"):
        rule_of(channel().model_copy(update={"tuning": named}), 0.0)
    monkeypatch.setattr("fes.stimulation.tuning.session.load_extension", lambda kind, name: lambda *_: (kind, name))
    assert rule_of(channel().model_copy(update={"tuning": named}), 0.0) == cast("Any", ("tuner", "gaitlab_steady"))
    assert Tuning().rule == ""
