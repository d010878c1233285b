"""One channel as the gate knows it: its charge of a minute, its last command, and what time allows next."""

from dataclasses import dataclass, field
from typing import Final

from fes import limits
from fes.config import Channel
from fes.gate.electrical import Caps, caps_of
from fes.signals import NS_PER_S

MINUTE_S: Final = 60
RISE_STEP_MA: Final = 0.5  # most devices' step: a ramp rounded to it may run this far ahead
COARSEST_STEP_MA: Final = 2.0  # a device of still coarser steps is none for a ramp
ROUNDING_MA: Final = 1e-6  # of sums of floating-point numbers
ANSWERED_NS: Final = NS_PER_S // 4  # later than this after its last command no answer reports pulses that it asked for


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


@dataclass(slots=True)
class ChannelState:
    """A channel's settings, the sensor that its timing rests on, its antagonists' numbers, and its state.

    ``ramp_ma`` climbs no faster than the rise limit and never lies above the current let out; a request may exceed it
    by ``step_ma``. So no sequence of commands, however dense, beats the limit by more than a step. It begins at the
    burst's first command: however long the channel was off, that one is a step at most.
    The limits from ``caps`` on are, each, the absolute one, that of its sensor's class (``most``) or the channel's own,
    whichever is tightest.
    ``held_back``: the burst now asked for was refused though nothing is broken; see :mod:`fes.gate.gate`.
    """

    channel: Channel
    sensor: str
    partners: tuple[int, ...]
    validity_ns: int
    step_ma: float
    most: limits.SensorClass = limits.CABLE
    on: bool = False
    on_since_ns: int = 0
    off_since_ns: int | None = None
    commanded_ns: int | None = None
    ramp_ma: float = 0.0
    held_back: bool = False
    dose: Dose = field(default_factory=Dose)
    caps: Caps = field(init=False)
    most_on_ns: int = field(init=False)
    least_off_ns: int = field(init=False)
    most_mc: float = field(init=False)
    most_rise_ma_per_s: float = field(init=False)

    def __post_init__(self) -> None:
        own = self.channel.limits
        self.caps = caps_of(own, self.most)
        self.most_on_ns = round(min(limits.MAX_ON_S, self.most.max_on_s, own.max_on_s) * NS_PER_S)
        self.least_off_ns = round(max(limits.MIN_OFF_S, own.min_off_s) * NS_PER_S)
        most_mc = min(limits.MAX_CHARGE_PER_MINUTE_MC, self.most.max_charge_per_minute_mc)
        self.most_mc = min(most_mc, own.max_charge_per_minute_mc)
        self.most_rise_ma_per_s = min(limits.MAX_RISE_MA_PER_S, own.max_rise_ma_per_s)

    def command_on(self, t_ns: int, current_ma: float, charge_uc_per_s: float) -> None:
        """The device is commanded to deliver this current, and charge at this rate."""
        self.dose.command(t_ns, charge_uc_per_s, self.validity_ns)
        self.ramp_ma = min(self._ramp_ma_at(t_ns), current_ma)
        if not self.on:
            self.on, self.on_since_ns = True, t_ns
        self.commanded_ns = t_ns

    def command_off(self, t_ns: int) -> None:
        """The device is commanded to be off."""
        if self.on:
            self.on, self.off_since_ns = False, t_ns
        self.dose.command(t_ns, 0.0, 0)
        self.ramp_ma, self.commanded_ns = 0.0, t_ns

    def let_lapse(self, t_ns: int) -> None:
        """A command outlived is an off that the device gave itself; what comes next is no part of that burst."""
        if self.on and self.commanded_ns is not None and t_ns - self.commanded_ns > self.validity_ns:
            self.command_off(self.commanded_ns + self.validity_ns)
            self.held_back = True

    def unasked(self, t_ns: int) -> bool:
        """Whether pulses that the device reports now were asked for by no command."""
        return not self.on and (self.off_since_ns is None or t_ns - self.off_since_ns > ANSWERED_NS)

    def on_too_long(self, t_ns: int) -> str:
        """Says so when the burst has lasted longer than a burst may."""
        on_ns = t_ns - self.on_since_ns if self.on else 0
        if on_ns <= self.most_on_ns:
            return ""
        return f"on for {on_ns / NS_PER_S:.3g} s, limit {self.most_on_ns / NS_PER_S:.3g} s"

    def too_much_charge(self, t_ns: int) -> str:
        """Says so when the last minute's charge is at its limit."""
        most_mc = self.most_mc
        used_mc = 1e-3 * self.dose.used_uc(t_ns)
        return f"{used_mc:.4g} mC within a minute, limit {most_mc:.4g} mC" if used_mc >= most_mc else ""

    def off_too_short(self, t_ns: int) -> str:
        """Says so when the last burst is too recent for another."""
        if self.on or self.off_since_ns is None or t_ns - self.off_since_ns >= self.least_off_ns:
            return ""
        return f"off for {(t_ns - self.off_since_ns) / NS_PER_S:.3g} s, at least {self.least_off_ns / NS_PER_S:.3g} s"

    def rises_too_fast(self, t_ns: int, current_ma: float) -> str:
        """Says so when this current is more than the ramp can have reached."""
        most_ma = self._ramp_ma_at(t_ns) + self.step_ma
        if current_ma <= most_ma + ROUNDING_MA:
            return ""
        return f"rise to {current_ma:.4g} mA too fast, at most {most_ma:.4g} mA by now"

    def _ramp_ma_at(self, t_ns: int) -> float:
        """Where the ramp may be; one validity is the longest time since a command that counts."""
        if not self.on or self.commanded_ns is None:
            return self.ramp_ma
        elapsed_ns = min(max(t_ns - self.commanded_ns, 0), self.validity_ns)
        return self.ramp_ma + self.most_rise_ma_per_s * elapsed_ns / NS_PER_S
