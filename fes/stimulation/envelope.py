"""The current of one burst over time: a linear rise, a plateau, a linear fall.

What of a burst may differ from one stride to the next; all else is the session's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from fes.config import Channel
from fes.signals import NS_PER_S

BIN_S = 0.05  # of the pulse-width profile: two or three commands
BINS = 30


@dataclass(frozen=True, slots=True)
class BurstParameters:
    """One channel's burst, as the next one is to be.

    ``widths_us`` (BINS,) is the pulse width over the time since the burst began, in steps of ``BIN_S``; later than the
    last bin, the last one holds.
    """

    current_ma: float
    start_delay_s: float
    extension_s: float
    widths_us: tuple[float, ...]

    @classmethod
    def for_channel(cls, channel: Channel) -> BurstParameters:
        """As the session has them."""
        return cls(channel.current_ma, channel.start_delay_s, channel.extension_s, (channel.pulse_width_us,) * BINS)

    def width_us(self, since_start_s: float) -> float:
        """Pulse width this long after the burst's start."""
        at = int(since_start_s / BIN_S)
        if at < len(self.widths_us):
            return self.widths_us[at] if at > 0 else self.widths_us[0]
        return self.widths_us[-1]

    @property
    def mean_width_us(self) -> float:
        """Over the whole profile."""
        return sum(self.widths_us) / len(self.widths_us)

    @property
    def strength_nc(self) -> float:
        """Charge of the strongest pulse."""
        return self.current_ma * max(self.widths_us)


@dataclass(slots=True)  # frozen it would take six times as long to make, at the sample that starts a burst
class Envelope:
    """One burst with all its parameters, fixed when it starts; only ``intensity`` (0–1) may come down later.

    ``t_start_ns`` is the foot of the rise (the start delay is over). ``t_stop_ns`` is the entry into the stop phase,
    None as long as that has not come; the burst goes on for ``extension_ns`` after it, still rising if it was, and
    then falls from the level reached. At ``t_due_ns`` it falls even if that entry has not come. Whatever happens it is
    over ``max_on_ns`` after its start, and begins to fall early enough to end in a ramp where the settings leave room
    for one. ``t_fall_ns`` is when it falls, for all that is known. A burst is never changed but replaced.
    """

    t_start_ns: int
    parameters: BurstParameters
    frequency_hz: float
    rise_ns: int
    extension_ns: int
    fall_ns: int
    max_on_ns: int
    intensity: float = 1.0
    t_stop_ns: int | None = None
    t_due_ns: int | None = None
    t_fall_ns: int = field(init=False)

    def __post_init__(self) -> None:
        latest_ns = self.t_start_ns + max(self.max_on_ns - self.fall_ns, min(self.rise_ns, self.max_on_ns))
        if self.t_due_ns is not None:
            latest_ns = min(self.t_due_ns, latest_ns)
        self.t_fall_ns = latest_ns if self.t_stop_ns is None else min(self.t_stop_ns + self.extension_ns, latest_ns)

    @classmethod
    def for_channel(
        cls,
        channel: Channel,
        t_start_ns: int,
        intensity: float,
        parameters: BurstParameters,
        t_due_ns: int | None = None,
    ) -> Envelope:
        """The burst that these settings ask for from ``t_start_ns`` on."""
        return cls(
            t_start_ns,
            parameters,
            channel.frequency_hz,
            to_ns(channel.rise_s),
            max(to_ns(parameters.extension_s), 0),
            to_ns(channel.fall_s),
            to_ns(channel.limits.max_on_s),
            intensity,
            t_due_ns=t_due_ns,
        )

    def dimmed(self, intensity: float) -> Envelope:
        """The same burst at this intensity if that is lower; a higher one waits for the next burst."""
        return replace(self, intensity=intensity) if intensity < self.intensity else self

    def stopped(self, t_ns: int) -> Envelope:
        """The same burst with the stop phase entered at ``t_ns``; the first entry counts."""
        return replace(self, t_stop_ns=t_ns) if self.t_stop_ns is None else self

    def unstopped(self) -> Envelope:
        """The same burst with the stop phase still to come."""
        return replace(self, t_stop_ns=None)

    def due(self, t_ns: int | None) -> Envelope:
        """The same burst, to fall at ``t_ns`` though the stop phase has not come; None: not before it."""
        return replace(self, t_due_ns=t_ns)

    def level_ma(self, t_ns: int) -> float:
        """Current at ``t_ns``, in mA, never negative; 0 before the start and after the end."""
        rising_ns, left = t_ns - self.t_start_ns, 1.0
        if not 0 <= rising_ns < self.max_on_ns:
            return 0.0
        if t_ns > self.t_fall_ns:
            rising_ns = max(0, self.t_fall_ns - self.t_start_ns)
            left = max(0.0, 1.0 - (t_ns - self.t_fall_ns) / max(self.fall_ns, 1))
        risen = rising_ns / self.rise_ns if rising_ns < self.rise_ns else 1.0
        return self.parameters.current_ma * self.intensity * (risen * left)

    def width_us(self, t_ns: int) -> float:
        """Pulse width at ``t_ns``."""
        return self.parameters.width_us((t_ns - self.t_start_ns) / NS_PER_S)

    def over(self, t_ns: int) -> bool:
        """Whether nothing comes any more at or after ``t_ns``."""
        return t_ns >= min(self.t_start_ns + self.max_on_ns, self.t_fall_ns + max(self.fall_ns, 1))

    def falls(self, t_ns: int) -> bool:
        """Whether the fall has begun by ``t_ns``; the level cannot rise again from there."""
        return t_ns >= self.t_fall_ns

    def steady_until_ns(self, width_step_us: float) -> int:
        """Until when it stays on once it is: until it falls, if no pulse of it is narrower than a step."""
        return self.t_fall_ns if min(self.parameters.widths_us) >= width_step_us else self.t_start_ns


def to_ns(seconds: float) -> int:
    """Seconds in whole nanoseconds."""
    return round(seconds * NS_PER_S)


def round_down(value: float, step: float) -> float:
    """The greatest multiple of ``step`` that does not exceed ``value`` (both ≥ 0)."""
    steps = math.floor(value / step)
    return steps * step if steps * step <= value else (steps - 1) * step


def difference(before: BurstParameters, after: BurstParameters) -> str:
    """What changes, in words; "" for nothing."""
    changes = []
    if after.current_ma != before.current_ma:
        changes.append(f"current {before.current_ma:.1f} → {after.current_ma:.1f} mA")
    moved = [a - b for b, a in zip(before.widths_us, after.widths_us, strict=True)]
    if any(moved):
        k = max(range(len(moved)), key=lambda k: abs(moved[k]))
        width = f"pulse width {before.widths_us[k]:.0f} → {after.widths_us[k]:.0f} µs"
        even = len(set(before.widths_us)) == len(set(after.widths_us)) == 1
        mean = f"mean {before.mean_width_us:.0f} → {after.mean_width_us:.0f} µs"
        changes.append(width if even else f"{width} {k * BIN_S:.2f} s into the burst, where it changes most ({mean})")
    for name, key in (("start delay", "start_delay_s"), ("extension", "extension_s")):
        was, becomes = getattr(before, key), getattr(after, key)
        if was != becomes:
            changes.append(f"{name} {1e3 * was:.0f} → {1e3 * becomes:.0f} ms")
    return ", ".join(changes)
