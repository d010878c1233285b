"""A foot that suddenly answers less: named by what fell, never by chance, and never answered by less stimulation."""

from __future__ import annotations

from random import Random

import pytest
from tuning_plant import stride

from fes.config import Band
from fes.stimulation.tuning.faults import ELECTRODE, MOUNTING, PERSON, FaultWatch
from fes.stimulation.tuning.targets import PITCH, Measure, Reading

TOE = "toe clearance"
MOST = 1.5


def reading(toe: float, pitch: float) -> Reading:
    """Levels, as if the bands went from 0 to 1."""
    band = Band(low=0.0, high=1.0)
    return Reading((Measure(TOE, toe, band, 1.0, ""), Measure(PITCH, pitch, band, 1.0, "")))


class Watched:
    """A walk whose levels are drawn about a middle, as real strides are: the toe's scatter more."""

    def __init__(self, seed: int = 1) -> None:
        self.watch, self.random, self.number = FaultWatch(MOST), Random(seed), 0

    def walk(
        self, strides: int, toe: float = 0.4, pitch: float = 0.3, drive: float = 1.0, **changes: float
    ) -> list[str]:
        found = []
        for _ in range(strides):
            self.number += 1
            seen = reading(self.random.gauss(toe, 0.13), self.random.gauss(pitch, 0.03))
            one = stride(self.number, 0.02, **changes)
            found.append(self.watch.stride(one, seen, {TOE: drive, PITCH: drive}))
        return found


@pytest.mark.parametrize(
    ("toe", "pitch", "name"), [(-0.1, 0.08, ELECTRODE), (0.45, -0.2, MOUNTING), (-1.2, 0.32, PERSON)]
)
def test_what_fell_says_what_it_is(toe: float, pitch: float, name: str) -> None:
    walked = Watched()
    assert not any(walked.walk(20))
    assert [one for one in walked.walk(5, toe, pitch) if one] == [name]


def test_an_even_walk_has_no_faults() -> None:
    named = sum(bool(one) for seed in range(20) for one in Watched(seed).walk(200))
    assert named <= 4  # of 4,000 strides


def test_one_stumble_is_no_fault() -> None:
    walked = Watched()
    walked.walk(20)
    assert not any(walked.walk(1, 0.0, 0.2) + walked.walk(10))


def test_what_was_taken_away_is_no_fault() -> None:
    walked = Watched()
    walked.walk(20)
    assert not any(walked.walk(5, 0.2, 0.22, drive=0.75))


def test_a_fall_that_comes_with_a_raise_is_not_the_electrodes() -> None:
    walked = Watched()
    walked.walk(20)
    assert walked.walk(2, -0.1, 0.08, drive=1.2)[-1] == ""


def test_another_speed_begins_anew() -> None:
    walked = Watched()
    walked.walk(20)
    assert not any(walked.walk(5, -0.1, 0.08, stride_length_m=0.5, speed_mps=0.35))
