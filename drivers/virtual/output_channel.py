"""One output stage of the simulated stimulator: makes pulses while its lease lasts, and counts them."""

from __future__ import annotations

from collections import deque
from typing import Final

from drivers.stimulator.can_codec import CURRENT_STEP_MA, PULSE_WIDTH_STEP_US
from drivers.stimulator.can_messages import Result
from fes.signals import NS_PER_S

MAX_ON_NS: Final = 3 * NS_PER_S  # the node's own limit on continuous stimulation
NS_PER_MS: Final = 1_000_000
NEVER: Final = 2**63 - 1


class OutputChannel:
    """Silent until :meth:`drive`, and again when the lease or the on-time ends. Times are the node's own clock.

    ``pulses`` and ``charge_steps`` (0.5 nC, one phase) run since the last :meth:`reset`. ``blocked`` after the
    on-time limit: only an off command releases it.
    """

    def __init__(self) -> None:
        self.made: deque[tuple[int, float, float]] = deque(maxlen=64)  # newest pulses: time, mA, µs; for who takes them
        self.reset()

    def reset(self) -> None:
        """Off, and all counts at zero."""
        self.on = False
        self.blocked = False
        self.current_ma = 0.0
        self.pulse_width_us = 0.0
        self.frequency_hz = 0.0
        self.counter = 0
        self.accepted_ns = 0
        self.lease_end_ns = NEVER
        self.on_end_ns = NEVER
        self.last_pulse_ns = -NEVER
        self.next_pulse_ns = NEVER
        self.pulses = 0
        self.charge_steps = 0

    @property
    def levels(self) -> tuple[float, float, float]:
        """Current in mA, pulse width in µs, frequency in Hz: what it delivers now."""
        return self.current_ma, self.pulse_width_us, self.frequency_hz

    def drive(self, t_ns: int, levels: tuple[float, float, float], validity_ms: int) -> None:
        """Deliver these levels until ``validity_ms`` from now, unless told again before."""
        if not self.on:
            self.on = True
            self.on_end_ns = t_ns + MAX_ON_NS
        self.current_ma, self.pulse_width_us, self.frequency_hz = levels
        self.accepted_ns = t_ns
        self.lease_end_ns = t_ns + validity_ms * NS_PER_MS
        if self.frequency_hz > 0:
            self.next_pulse_ns = max(t_ns, self.last_pulse_ns + self._period_ns())
        else:
            self.next_pulse_ns = NEVER

    def silence(self) -> None:
        """Off now; the counts stay."""
        self.on = False
        self.current_ma = self.pulse_width_us = self.frequency_hz = 0.0
        self.lease_end_ns = self.on_end_ns = self.next_pulse_ns = NEVER

    def next_deadline_ns(self) -> int:
        """When it next has something to do by itself."""
        return min(self.next_pulse_ns, self.lease_end_ns, self.on_end_ns)

    def advance(self, t_ns: int) -> Result | None:
        """Make the pulses due by now; why it fell silent by itself, None when it did not."""
        end_ns = min(self.lease_end_ns, self.on_end_ns)
        while self.next_pulse_ns <= t_ns and self.next_pulse_ns < end_ns:
            self._pulse()
        if end_ns > t_ns:
            return None
        reason = Result.LEASE_EXPIRED if self.lease_end_ns <= self.on_end_ns else Result.ON_TIME
        self.blocked = reason is Result.ON_TIME
        self.silence()
        return reason

    def _pulse(self) -> None:
        self.pulses += 1
        self.charge_steps += round(self.current_ma / CURRENT_STEP_MA) * round(self.pulse_width_us / PULSE_WIDTH_STEP_US)
        self.last_pulse_ns = self.next_pulse_ns
        self.made.append((self.last_pulse_ns, self.current_ma, self.pulse_width_us))
        self.next_pulse_ns += self._period_ns()

    def _period_ns(self) -> int:
        return int(NS_PER_S / self.frequency_hz)
