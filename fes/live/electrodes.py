"""What is known of the electrodes: some stimulators tell of an open lead only with a pulse of some size."""

from __future__ import annotations

from collections.abc import Iterable

from fes.signals import Event, StimOpened, StimStatus


class Electrodes:
    """Which channels have had a pulse that tells.

    Args:
        channels: those of the session.
        told_from_ma: the least current whose answer tells of an open lead, 0 for any pulse; None: the stimulator tells
            of it by itself, so that nothing is ever unknown.
    """

    def __init__(self, channels: Iterable[int], told_from_ma: float | None) -> None:
        self._channels = tuple(sorted(channels)) if told_from_ma is not None else ()
        self._told_from_ma = told_from_ma or 0.0
        self._unknown = set(self._channels)

    def note(self, event: Event) -> None:
        """An answer without a fault at such a current makes known; a stimulator that was away may have been rewired."""
        if isinstance(event, StimStatus):
            if event.on and not event.fault and event.current_ma >= max(self._told_from_ma, 1e-9):
                self._unknown.discard(event.channel)
        elif isinstance(event, StimOpened):
            self._unknown = set(self._channels)

    def unknown(self) -> str:
        """What to say of those that are not known yet; "" when all are."""
        if not self._unknown:
            return ""
        at = f" at {self._told_from_ma:g} mA" if self._told_from_ma else ""
        which = ", ".join(map(str, sorted(self._unknown)))
        return f"electrode not known until the first pulse{at} (channel {which})"
