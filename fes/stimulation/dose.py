"""The dose ledger: charge per step, minute and session of each channel's electrodes, and a hint of fatigue.

It books what the stimulator says it delivered, not what was asked for. Charge is that of one phase, summed over the
pulses: with balanced pulses both electrodes of a pair get the same.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Final

from fes.limits import charge_per_phase_uc
from fes.signals import NS_PER_S, StimStatus

KEPT_NS: Final = 30 * NS_PER_S  # of single bookings; a stride is closed within 20 s
MINUTE_NS: Final = 60 * NS_PER_S
LONGEST_HOLD_NS: Final = 2 * NS_PER_S  # an answer stands until the next; longer no device goes on (P24's watchdog)
WINDOW: Final = 10  # stimulated strides whose median counts
SETTLING: Final = 20  # strides in which people still lift the leg as they did without stimulation, less and less
LEAST_M: Final = 0.004  # clearance is measured to some millimetres: less that is missing tells nothing
FALLEN: Final = 0.75  # of the first response per charge: worth a hint …
HINT_STEP: Final = 0.15  # … and another each time it has fallen by this much more
STEADY: Final = 1.25  # most by which the charges of the reference may differ: while it is raised, more gives less


@dataclass(slots=True)
class ElectrodeDose:
    """What one channel's electrodes have been given.

    ``by_minute_uc`` is by whole minutes of the session's clock; ``steps_uc`` by closed stride; ``estimated`` when some
    of it was computed from the delivered current and time, because the device does not count its charge.
    """

    channel: int
    pulses: int = 0
    session_uc: float = 0.0
    by_minute_uc: dict[int, float] = field(default_factory=dict)
    steps_uc: list[float] = field(default_factory=list)
    estimated: bool = False
    _recent: deque[tuple[int, float]] = field(default_factory=deque, repr=False)
    _counts: bool = field(default=False, repr=False)
    _holds: StimStatus | None = field(default=None, repr=False)
    _intensity: float = field(default=1.0, repr=False)
    _settling: int = field(default=SETTLING, repr=False)
    _response: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=WINDOW), repr=False)
    _first: tuple[float, float] | None = field(default=None, repr=False)
    _hinted: float = field(default=1.0, repr=False)

    def book(self, status: StimStatus) -> None:
        """Book one answer of the stimulator."""
        charge_uc, pulses = status.charge_uc, status.pulses
        self._counts = self._counts or pulses > 0  # between two pulses such a device counts none: that is no estimate
        if not self._counts and charge_uc == 0.0:
            charge_uc = self._held_uc(status.t_ns)
            self.estimated = self.estimated or charge_uc > 0.0
        self._holds = status
        if not (math.isfinite(charge_uc) and charge_uc > 0.0):
            return
        self.pulses += pulses
        self.session_uc += charge_uc
        minute = status.t_ns // MINUTE_NS
        self.by_minute_uc[minute] = self.by_minute_uc.get(minute, 0.0) + charge_uc
        self._recent.append((status.t_ns, charge_uc))
        while self._recent[0][0] < status.t_ns - KEPT_NS:
            self._recent.popleft()

    def _held_uc(self, t_ns: int) -> float:
        """What the last answer comes to until now, for it holds until the next, by charge and rate of its pulses."""
        held = self._holds
        if held is None or not held.on:
            return 0.0
        held_s = min(max(t_ns - held.t_ns, 0), LONGEST_HOLD_NS) / NS_PER_S
        return charge_per_phase_uc(held.current_ma, held.pulse_width_us) * held.frequency_hz * held_s

    @property
    def this_minute_uc(self) -> float:
        """Of the minute of the newest answer; 0 in one without stimulation."""
        return 0.0 if self._holds is None else self.by_minute_uc.get(self._holds.t_ns // MINUTE_NS, 0.0)

    def between_uc(self, t_start_ns: int, t_end_ns: int) -> float:
        """Charge delivered from start to end; of the last 30 s only."""
        charges_uc: list[float] = []
        for t_ns, charge_uc in reversed(self._recent):
            if t_ns <= t_start_ns:
                break
            if t_ns <= t_end_ns:
                charges_uc.append(charge_uc)
        return sum(reversed(charges_uc))

    def close_step(self, t_start_ns: int, t_end_ns: int) -> float:
        """Book a stride's charge and return it, µC."""
        charge_uc = self.between_uc(t_start_ns, t_end_ns)
        self.steps_uc.append(charge_uc)
        return charge_uc

    def respond(self, response: float, charge_uc: float, intensity: float = 1.0) -> str:
        """Note what a step's charge achieved; a hint when the response per charge has fallen, else "".

        ``response`` is what the foot did (the tuner's measure), m, greater being more; NaN is passed over, and so is a
        step without charge. ``intensity`` is the operator's setting, 0–1.

        The reference are the first ``WINDOW`` steps in a row with about the same charge once the walk has settled, anew
        with every intensity set by hand: a foot answers less to more charge, be it ever so fresh. Less response to less
        charge is no fatigue either, so a hint needs at least nearly the charge of then.
        """
        if not (charge_uc > 0.0 and math.isfinite(response)):
            return ""
        if intensity != self._intensity:
            self._intensity, self._first, self._hinted, self._settling = intensity, None, 1.0, SETTLING
            self._response.clear()
        if self._settling > 0:
            self._settling -= 1
            return ""
        self._response.append((response, charge_uc))
        if len(self._response) < WINDOW:
            return ""
        charges = [q for _, q in self._response]
        now = (median(r for r, _ in self._response), median(charges))
        if self._first is None:
            if max(charges) > STEADY * min(charges):
                return ""
            self._first = now
        if self._first[0] <= 0.0 or now[1] < 0.95 * self._first[1]:
            return ""
        left = now[0] * self._first[1] / (now[1] * self._first[0])
        if left > FALLEN or left > self._hinted - HINT_STEP or (1.0 - left) * self._first[0] < LEAST_M:
            return ""
        self._hinted = left
        self._response.clear()
        return (
            f"response per charge has fallen to {max(left, 0.0):.0%} of what it was at first "
            f"({now[1]:.0f} µC a step now, {self._first[1]:.0f} µC then): the muscle may be tiring, an electrode "
            "have come loose, or more charge lift the foot no further; consider a pause and look at the electrodes"
        )

    def to_dict(self) -> dict[str, Any]:
        """For summaries and reports: numbers in µC."""
        steps = self.steps_uc
        return {
            "channel": self.channel,
            "pulses": self.pulses,
            "session_uc": self.session_uc,
            "by_minute_uc": {str(minute): charge for minute, charge in sorted(self.by_minute_uc.items())},
            "steps": len(steps),
            "median_step_uc": median(steps) if steps else 0.0,
            "greatest_step_uc": max(steps, default=0.0),
            "estimated": self.estimated,
        }


class DoseLedger:
    """One :class:`ElectrodeDose` per channel; answers of channels that the session has not are booked too."""

    def __init__(self, channels: Iterable[int]) -> None:
        self.electrodes = {number: ElectrodeDose(number) for number in channels}

    def book(self, status: StimStatus) -> None:
        """Book one answer of the stimulator."""
        dose = self.electrodes.get(status.channel)
        if dose is None:
            dose = self.electrodes[status.channel] = ElectrodeDose(status.channel)
        dose.book(status)

    def to_dict(self) -> dict[str, Any]:
        """All channels, by number, for summaries and reports."""
        return {str(number): dose.to_dict() for number, dose in sorted(self.electrodes.items())}
