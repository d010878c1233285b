"""What is identified of a foot: threshold and slopes within their stated uncertainty, noise, and the pulse's delay."""

from __future__ import annotations

import math
from random import Random

import numpy as np
import pytest

from fes.config import Band
from fes.stimulation.tuning.delay import FORCE_S, STEP_S, USUAL_S, USUAL_SD_S, DelayEstimate
from fes.stimulation.tuning.demand import GREATEST_AIM, LEAST_AIM, LEAST_AIM_AT_CONTACT, demands_of, leading, room
from fes.stimulation.tuning.response import AT_CONTACT, BARE, BARE_SD, IN_SWING, JUMP_SD, SLOPE, SLOPE_SD, ResponseModel
from fes.stimulation.tuning.targets import PITCH, ROLL, Measure, Reading

TOE = "toe clearance"
NOISE = {TOE: 0.18, PITCH: 0.045}
UNIT = Band(low=0.0, high=1.0)


def reading(levels: dict[str, float]) -> Reading:
    """As if the bands went from 0 to 1."""
    measures = [Measure(name, level, UNIT, 1.0, "") for name, level in levels.items()]
    return Reading(tuple(sorted(measures, key=lambda measure: measure.level)))


class Ramp:
    """A foot whose measures rise from one threshold on, each by its own slope, and scatter."""

    def __init__(
        self, seed: int, threshold: float, slopes: dict[str, float], bare: float = -0.6, noise: float = 1.0
    ) -> None:
        self.random, self.threshold, self.slopes, self.bare = Random(seed), threshold, slopes, bare
        self.noise, self.model = noise, ResponseModel()

    def level(self, name: str, drive: float) -> float:
        return self.bare + self.slopes[name] * max(drive - self.threshold, 0.0)

    def walk(self, *drives: float) -> Ramp:
        for drive in drives:
            seen = {name: self.random.gauss(self.level(name, drive), self.noise * NOISE[name]) for name in self.slopes}
            self.model.add(reading(seen), dict.fromkeys(self.slopes, drive))
        return self


def climb(first: float, last: float, strides: int) -> list[float]:
    return [float(drive) for drive in np.linspace(first, last, strides)]


SEARCH = [*climb(0.2, 0.9, 20), *climb(0.9, 0.6, 10), *[0.6] * 10]  # as a search from far below and its end


def feet(count: int) -> list[Ramp]:
    found = []
    for seed in range(count):
        draw = Random(1000 + seed)
        slopes = {TOE: draw.uniform(1.5, 4.0), PITCH: draw.uniform(1.0, 3.0)}
        found.append(Ramp(seed, draw.uniform(0.3, 0.6), slopes).walk(*SEARCH))
    return found


def test_threshold_and_slopes_are_found_within_what_is_stated() -> None:
    done = feet(60)
    threshold = [abs(foot.model.threshold.value - foot.threshold) / foot.model.threshold.sd for foot in done]
    assert sum(off <= 2.0 for off in threshold) >= 0.9 * len(done)
    for name in NOISE:
        slopes = [foot.model.slope(name) for foot in done]
        off = [abs(known.value - foot.slopes[name]) / known.sd for known, foot in zip(slopes, done, strict=True)]
        assert sum(each <= 2.0 for each in off) >= 0.9 * len(done)
    assert max(foot.model.threshold.sd for foot in done) < 0.1  # stated, and not by saying that nothing is known
    assert max(foot.model.slope(PITCH).sd for foot in done) < 1.0
    middle = np.median([abs(foot.model.slope(PITCH).value / foot.slopes[PITCH] - 1.0) for foot in done])
    assert middle < 0.2


def test_a_level_is_expected_where_it_then_lies() -> None:
    off = []
    for foot in feet(40):
        for drive in (0.3, 0.6, 0.8):
            known = foot.model.expected(PITCH, drive)
            off.append(abs(known.value - foot.level(PITCH, drive)) / known.sd)
    assert sum(each <= 2.0 for each in off) >= 0.9 * len(off)


def test_of_a_foot_never_seen_the_usual_is_believed() -> None:
    model = ResponseModel()
    known = model.expected(TOE, 0.5)
    assert (known.value, known.sd) == (BARE, BARE_SD)
    assert not model.knows(TOE)
    model.add(reading({TOE: 0.1}), {TOE: 0.5})
    assert model.knows(TOE)
    assert model.slope(TOE).value == pytest.approx(SLOPE, abs=1.0)


@pytest.mark.parametrize("share", [0.4, 2.0])
def test_the_noise_follows_the_strides_and_begins_with_what_is_usual(share: float) -> None:
    foot = Ramp(3, 0.4, {TOE: 2.5, PITCH: 2.0}, noise=share).walk(0.6)
    assert foot.model.noise(TOE) == IN_SWING.noise
    assert foot.model.noise(PITCH) == AT_CONTACT.noise
    foot.walk(*[0.6] * 40)
    own = share * NOISE[PITCH]
    found = foot.model.noise(PITCH)
    assert abs(found - own) < 0.5 * abs(AT_CONTACT.noise - own)


def test_one_stumble_moves_what_is_expected_by_little() -> None:
    foot = Ramp(4, 0.4, {PITCH: 2.0}).walk(*SEARCH)
    before, sd = foot.model.expected(PITCH, 0.6).value, foot.model.noise(PITCH)
    foot.model.add(reading({PITCH: before - 3.0}), {PITCH: 0.6})
    assert 0.0 < before - foot.model.expected(PITCH, 0.6).value < 3.0 * sd


def test_after_a_shake_less_is_known_and_what_is_new_is_learnt_soon() -> None:
    foot = Ramp(5, 0.4, {TOE: 3.0, PITCH: 2.0}).walk(*SEARCH)
    threshold, slope, level = foot.model.threshold.sd, foot.model.slope(PITCH).sd, foot.model.expected(PITCH, 0.6).sd
    foot.model.shake()
    assert foot.model.threshold.sd > 2.0 * threshold
    assert foot.model.slope(PITCH).sd > max(0.95 * SLOPE_SD, 1.5 * slope)
    assert foot.model.expected(PITCH, 0.0).sd > 0.95 * JUMP_SD
    assert foot.model.expected(PITCH, 0.6).sd > 5.0 * level
    foot.bare -= 0.5
    foot.walk(0.6, 0.6)
    assert foot.model.expected(PITCH, 0.6).value == pytest.approx(foot.level(PITCH, 0.6), abs=0.1)


def test_where_nothing_moves_it_is_forgotten_how_the_foot_answers() -> None:
    foot = Ramp(6, 0.4, {PITCH: 2.0}).walk(*SEARCH)
    sd = foot.model.slope(PITCH).sd
    foot.walk(*[0.6] * 150)
    assert foot.model.slope(PITCH).sd > 1.2 * sd


def test_what_a_drive_lifts_and_the_least_that_reaches_a_level() -> None:
    foot = Ramp(7, 0.4, {PITCH: 2.0}).walk(*SEARCH, *SEARCH)
    gained = foot.model.gained(PITCH, 0.8)
    assert abs(gained.value - 0.8) < 2.0 * gained.sd
    least = foot.model.least_drive(PITCH, 0.0)
    assert least == pytest.approx(0.4 + 0.6 / 2.0, abs=0.05)
    assert foot.model.least_drive(PITCH, 5.0) == 1.0


# --- what follows from it ------------------------------------------------------------------------------------


def test_the_aim_lies_as_far_above_the_low_end_as_strides_scatter() -> None:
    aims = []
    for share in (0.3, 3.5):
        foot = Ramp(8, 0.4, {TOE: 3.0, PITCH: 2.0}, noise=share).walk(*SEARCH)
        found = demands_of(foot.model, reading({TOE: 0.2, PITCH: 0.2}), {TOE: 0.6, PITCH: 0.6})
        aims.append({demand.measure.name: demand.aim for demand in found})
    assert aims[0] == {TOE: LEAST_AIM, PITCH: pytest.approx(LEAST_AIM_AT_CONTACT, abs=0.03)}
    assert aims[1][TOE] == GREATEST_AIM
    assert aims[1][PITCH] > 3.0 * aims[0][PITCH]


def test_the_measure_that_needs_the_greatest_drive_leads() -> None:
    foot = Ramp(9, 0.4, {TOE: 6.0, PITCH: 1.2}).walk(*SEARCH)
    seen = reading({TOE: foot.level(TOE, 0.6), PITCH: foot.level(PITCH, 0.6)})
    first, second = demands_of(foot.model, seen, {TOE: 0.6, PITCH: 0.6})
    assert first.measure.name == PITCH
    assert first.error > 0.0 > second.error
    assert first.wanted == pytest.approx(0.4 + (0.6 + first.aim) / 1.2, abs=0.1)
    assert leading((first, second)) is first
    assert second.drive <= room((first, second)) < 1.0  # the toe would leave its band above


# --- the delay -----------------------------------------------------------------------------------------------


def swings(delay_s: float, seed: int, strides: int = 30, noise_deg: float = 1.0) -> DelayEstimate:
    """Swings whose pitch follows the filtered drive so much later; the burst's edges move as the tuner moves them."""
    random, estimate = Random(seed), DelayEstimate()
    at_s = np.arange(0.0, 0.9, STEP_S)
    for _ in range(strides):
        level, start_s = random.uniform(0.1, 0.5), random.uniform(0.0, 0.15)
        late_s = random.uniform(0.4, 0.6)
        drive = np.where(at_s < start_s, 0.0, np.where(at_s < late_s, level, random.uniform(0.1, 0.5)))
        keep, force, filtered = math.exp(-STEP_S / FORCE_S), 0.0, []
        for value in drive:
            force = keep * force + (1.0 - keep) * value
            filtered.append(force)
        pitch = np.interp(at_s - delay_s, at_s, filtered, left=0.0) * math.radians(25.0)
        wander = np.convolve([random.gauss(0.0, 1.0) for _ in range(len(at_s) + 7)], np.ones(8) / math.sqrt(8), "valid")
        pitch = pitch + math.radians(noise_deg) * wander + 0.3 * at_s
        estimate.add(at_s.tolist(), pitch.tolist(), at_s.tolist(), drive)
    return estimate


@pytest.mark.parametrize("delay_s", [0.06, 0.12, 0.20])
def test_the_delay_is_found_within_what_is_stated(delay_s: float) -> None:
    found = [swings(delay_s, seed).delay_s for seed in range(10)]
    assert all(abs(known.value - delay_s) < max(2.0 * known.sd, STEP_S) for known in found)
    assert all(known.sd < 0.5 * USUAL_SD_S for known in found)


def test_without_a_change_of_the_burst_the_delay_is_what_is_usual() -> None:
    estimate, at_s = DelayEstimate(), np.arange(0.0, 0.9, STEP_S)
    random, same = Random(1), np.full(len(at_s), 0.4)
    for _ in range(20):
        pitch = [random.gauss(0.1, 0.05) for _ in at_s]
        estimate.add(at_s.tolist(), pitch, at_s.tolist(), same)
    assert estimate.delay_s.value == pytest.approx(USUAL_S, abs=0.005)
    assert estimate.delay_s.sd == pytest.approx(USUAL_SD_S, abs=0.005)


def test_over_a_skipped_stride_nothing_is_compared() -> None:
    at_s = np.arange(0.0, 0.9, STEP_S)
    for skipped in (True, False):
        estimate = DelayEstimate()
        for level in (0.1, 0.6):
            estimate.add(at_s.tolist(), (level * at_s).tolist(), at_s.tolist(), np.full(len(at_s), level))
            if skipped:
                estimate.forget_last()
        assert (estimate.delay_s.sd == pytest.approx(USUAL_SD_S, abs=0.005)) == skipped


def test_what_another_channel_may_have_done_is_not_taken_for_an_answer() -> None:
    """The dorsiflexors are raised, and turn the foot in, as the evertors are: that says nothing against these."""
    told, alone = ResponseModel(), ResponseModel()
    for number in range(8):
        drive = 0.2 + 0.08 * number
        lower = reading({ROLL: 0.5 - 0.15 * number})
        told.add(lower, {ROLL: drive}, others_changed=0.1)
        alone.add(lower, {ROLL: drive})
    assert alone.slope(ROLL).value + 2.0 * alone.slope(ROLL).sd < 0.0
    assert told.slope(ROLL).value + 2.0 * told.slope(ROLL).sd > 0.0
