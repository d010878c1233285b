"""A tuner of one's own: half a milliampere up while the toe lies below its band, and never down."""

from dataclasses import replace

from fes.config import Channel
from fes.stimulation.tuning.report import Proposal, Seen


class SteadyRule:
    """Of one channel; what it proposes is held within the session's bounds, whatever it is."""

    def __init__(self, channel: Channel, incline: float | None) -> None:
        self._channel = channel

    def stride(self, seen: Seen) -> Proposal | None:
        """The newest stride; what is to come of it."""
        if seen.reading is None or seen.reading.level >= 0.0:
            return None
        more = replace(seen.given, current_ma=seen.given.current_ma + 0.5)
        return Proposal(f"{seen.reading.measures[0].text()}, half a milliampere more", more)

    def acted(self, what: str, incline: float | None = None) -> None:
        """Nothing is remembered that a person could change."""
