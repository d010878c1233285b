"""The plain rule of the independent comparison, an arm of ``tuning.py``: the least that a tuner must beat.

Front and tail of the burst follow toe clearance and pitch at contact; no memory of speed or ground, no second channel,
nothing learnt of the foot. It goes through the same wrapper as the tuning's own rule. Drives are shares of the greatest
pulse width.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from statistics import median

from fes.config import Channel
from fes.signals import NS_PER_S, StrideResult
from fes.stimulation.envelope import BIN_S
from fes.stimulation.tuning.report import Proposal, Seen
from fes.stimulation.tuning.targets import PITCH

AIMS, TOE = {"toe": 0.45, "pitch": 0.12}, "toe"
GAIN, DRIVE_PER_BAND, RAISED_FROM, LOWERED_FROM, LOWERED_BY = 0.8, 0.5, 0.10, -0.06, 0.03
ANSWER_S, OUTLIVES_S, CARRIED, UP_AT = 0.12, 0.13, 0.6, 0.25
TOE_LEADS, AT_BOUND, NEVER_ABOVE, VAIN = 0.55, 0.99, -0.3, 6


class PlainRule:
    """Of one channel whose pulse widths are moved."""

    def __init__(self, channel: Channel, incline: float | None = 0.0) -> None:
        tuning = channel.tuning
        assert tuning is not None
        assert tuning.bounds is not None
        self._channel, self._most_us = channel, tuning.bounds.pulse_width_us.high
        self._errors: dict[str, deque[float]] = {name: deque(maxlen=3) for name in AIMS}
        self._phases: deque[tuple[float, ...]] = deque(maxlen=6)
        self._vain = 0

    def acted(self, what: str, incline: float | None = None) -> None:
        """It remembers nothing that a person could change."""

    def stride(self, seen: Seen) -> Proposal | None:
        """The newest stride; what is to come of it."""
        if seen.skipped or seen.reading is None:
            return Proposal(f"stride {seen.stride.number} skipped: {seen.skipped}")
        levels = {"pitch" if m.name == PITCH else TOE: m.level for m in seen.reading.measures}
        for name, level in levels.items():
            self._errors[name].append(AIMS[name] - level)
        given = seen.given
        front, tail = (given.widths_us[at] / self._most_us for at in (0, -1))
        toe, pitch = (self._errors[name][-1] if name in levels else -1.0 for name in AIMS)
        leads = TOE
        if tail >= front - 1e-6 and levels.get(TOE, 0.0) < TOE_LEADS and pitch > toe:
            leads = "pitch"
        self._vain = self._vain + 1 if front >= AT_BOUND and levels.get(TOE, 0.0) < NEVER_ABOVE else 0
        if self._vain >= VAIN:
            return Proposal("all that the bounds allow does not lift the foot", stop=True)
        front += self._change(leads)
        tail = min(tail + self._change("pitch"), front)
        return Proposal(seen.reading.measures[0].text(), self._burst(seen, front, tail))

    def _change(self, name: str) -> float:
        errors = self._errors[name]
        if errors and errors[-1] > RAISED_FROM:
            return GAIN * DRIVE_PER_BAND * errors[-1]
        if errors and median(errors) < LOWERED_FROM and errors[-1] < LOWERED_FROM:
            return max(DRIVE_PER_BAND * median(errors), -LOWERED_BY)
        return 0.0

    def _burst(self, seen: Seen, front: float, tail: float) -> object:
        given, count = seen.given, len(seen.given.widths_us)
        if (phases := _phases_s(seen.stride)) is not None:
            self._phases.append(phases)
        if not self._phases:
            return replace(given, widths_us=(front * self._most_us,) * count)
        pre_s, swing_s, loading_s = (median(each) for each in zip(*self._phases, strict=True))
        delay_s = max(pre_s + UP_AT * swing_s - ANSWER_S - self._channel.rise_s, 0.0)
        carried = round((pre_s + CARRIED * swing_s - ANSWER_S - given.start_delay_s) / BIN_S)
        carried = min(max(carried, 0), count)
        widths = (front * self._most_us,) * carried + (tail * self._most_us,) * (count - carried)
        return replace(given, start_delay_s=delay_s, extension_s=loading_s - OUTLIVES_S, widths_us=widths)


def _phases_s(stride: StrideResult) -> tuple[float, ...] | None:
    pre, swing, loading, stance = (
        stride.t_pre_swing_ns, stride.t_swing_ns, stride.t_loading_response_ns, stride.t_stance_ns,
    )  # fmt: skip
    if pre is None or swing is None or loading is None or stance is None:
        return None
    return tuple((b - a) / NS_PER_S for a, b in ((pre, swing), (swing, loading), (loading, stance)))
