"""What the watch names: electrodes that slip or drift; not chance, not what stimulation does, not a calf in spasm."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

import pytest
from tuning_plant import BOUNDS, Tuned, channel, stride, tuning

from fes.signals import OperatorAct, OperatorAction

WIDE = BOUNDS | {"pulse_width_us": {"low": 60.0, "high": 300.0}}
PITCH = {"low": 4.0, "high": 25.0}
FAULT = 22


def walk(
    quality: Callable[[int], float],
    seed: int,
    strides: int = 60,
    held: Callable[[int], float] = lambda n: 0.0,
    armed_at: int | None = None,
) -> Tuned:
    """A foot lifted from little on; ``quality`` is the share that arrives, ``held`` presses the foot down (°).

    ``armed_at``: the stride before which somebody arms again after a stop.
    """
    random = Random(seed)
    settings = tuning(method="learning", pitch_at_contact_deg=PITCH, bounds=WIDE, max_change_us=30.0)
    tuned = Tuned(channel(settings, pulse_width_us=60.0))
    for number in range(strides):
        front, tail = (quality(number) * tuned.parameters.widths_us[at] / 300.0 for at in (0, -1))
        toe_m = 0.012 + 0.023 * (2.2 * front - 0.6 + random.gauss(0.0, 0.18)) - 0.001 * held(number)
        pitch_deg = 4.0 + 21.0 * (1.3 * tail - 0.35 + random.gauss(0.0, 0.03)) - held(number)
        walked = stride(number, max(toe_m, -0.01), pitch_deg)
        if number == armed_at:
            tuned.tuners.on_act(OperatorAct(walked.t_start_ns - 1, OperatorAction.ARM))
        tuned.walk(walked)
    return tuned


def named(tuned: Tuned) -> list[str]:
    return [report.text for report in tuned.said if report.kind == "fault"]


def test_a_slip_to_two_thirds_is_named_in_nine_of_ten() -> None:
    found = [named(walk(lambda n: 1.0 if n < FAULT else 0.65, seed)) for seed in range(20)]
    assert sum(bool(texts) for texts in found) >= 18
    first = next(texts[0] for texts in found if texts)
    assert "something has changed that stimulation did not: most likely the electrodes" in first
    assert first.endswith("; look at it")


def test_a_drift_to_sixty_per_cent_in_twenty_strides_is_named_in_nine_of_ten() -> None:
    drift = [named(walk(lambda n: 1.0 - 0.02 * min(max(n - FAULT, 0), 20), seed)) for seed in range(20)]
    assert sum(any("electrodes" in text for text in texts) for texts in drift) >= 18


@pytest.mark.parametrize("loss", [0.0, 0.004])
def test_nothing_is_named_in_a_thousand_strides_of_a_whole_foot_fresh_or_tiring(loss: float) -> None:
    false = [named(walk(lambda n: 1.0 - loss * min(n, 40), seed)) for seed in range(18)]
    assert sum(len(texts) for texts in false) == 0, false


def test_a_calf_that_holds_the_foot_for_four_strides_is_no_electrode() -> None:
    spasms = [
        named(walk(lambda n: 1.0, seed, held=lambda n: 4.0 if FAULT <= n < FAULT + 4 else 0.0)) for seed in range(20)
    ]
    assert sum(bool(texts) for texts in spasms) <= 1, spasms


def test_what_is_named_changes_nothing_by_itself() -> None:
    tuned = walk(lambda n: 1.0 if n < FAULT else 0.7, 3)
    faults = [report for report in tuned.said if report.kind == "fault"]
    assert faults
    assert all(report.before == report.after for report in faults)


def test_what_was_before_a_stop_is_another_walk() -> None:
    lost: Callable[[int], float] = lambda n: 1.0 if n < FAULT else 0.65  # noqa: E731
    through = [named(walk(lost, seed)) for seed in range(6)]
    stopped = [named(walk(lost, seed, armed_at=FAULT)) for seed in range(6)]
    assert sum(map(bool, through)) >= 5
    assert not any(stopped), "a foot that is lifted less after a stop is not held against what it was before"
