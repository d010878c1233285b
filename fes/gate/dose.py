"""How much charge a channel has been told to deliver within the last minute."""

from __future__ import annotations

from typing import Final

from fes.signals import NS_PER_S

MINUTE_S: Final = 60


class Dose:
    """Charge of one phase of all pulses commanded, in whole seconds of a ring of one minute and the one under way.

    It counts what a command allows the device to deliver until the next one or the end of its validity, so it errs
    on the side of more. ``used_uc`` may cover up to 61 s.
    """

    def __init__(self) -> None:
        self._by_second: dict[int, float] = {}
        self._rate_uc_per_s = 0.0
        self._since_ns = 0
        self._until_ns = 0

    def command(self, t_ns: int, rate_uc_per_s: float, validity_ns: int) -> None:
        """From now on this much per second, until the next command or the end of the validity; 0 when off."""
        self._settle(t_ns)
        self._rate_uc_per_s, self._since_ns, self._until_ns = rate_uc_per_s, t_ns, t_ns + validity_ns

    def used_uc(self, t_ns: int) -> float:
        """Charge within the minute that ends at ``t_ns``."""
        self._settle(t_ns)
        return sum(self._by_second.values())

    def _settle(self, t_ns: int) -> None:
        """Book what has been delivered so far, and forget what is older than a minute."""
        second = t_ns // NS_PER_S
        end_ns = min(t_ns, self._until_ns)
        if self._rate_uc_per_s > 0.0 and end_ns > self._since_ns:
            charge_uc = self._rate_uc_per_s * (end_ns - self._since_ns) / NS_PER_S
            self._by_second[second] = self._by_second.get(second, 0.0) + charge_uc
            self._since_ns = end_ns
        # booked in order: behind the first that still counts there is nothing to forget
        while self._by_second and next(iter(self._by_second)) < second - MINUTE_S:
            del self._by_second[next(iter(self._by_second))]
