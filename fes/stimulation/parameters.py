"""What of a burst may differ from one stride to the next; all else is the session's."""

from __future__ import annotations

from dataclasses import dataclass

from fes.config import Channel

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
