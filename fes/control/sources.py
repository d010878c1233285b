"""Sources of events for the one loop: a recording's samples, with silence made audible and an operator who arms.

Each function takes an iterator of events and gives one back; nothing here reads a clock except :func:`paced`, which
waits on the clock it is handed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

from fes.signals import NS_PER_S, Event, OperatorAct, OperatorAction, Tick

TICK_NS = 10_000_000
CLOSING_S = 0.5  # ticks after the last sample, so that what follows from silence is seen too


class Clock(Protocol):
    """Something to wait on."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""

    def wait_until_ns(self, t_ns: int) -> None:
        """Return at ``t_ns`` or, when that has passed, at once."""


def with_ticks(events: Iterable[Event]) -> Iterator[Event]:
    """Fill silences of more than one and a half tick periods with ticks, and close with half a second of them."""
    last_ns: int | None = None
    for event in events:
        while last_ns is not None and event.t_ns - last_ns > 1.5 * TICK_NS:
            last_ns += TICK_NS
            yield Tick(last_ns)
        last_ns = event.t_ns
        yield event
    if last_ns is not None:
        for k in range(1, int(CLOSING_S * NS_PER_S) // TICK_NS + 1):
            yield Tick(last_ns + k * TICK_NS)


def armed_after(
    events: Iterable[Event],
    after_s: float,
    intensity: float,
    rearm_after_s: float | None = None,
    latched: Callable[[], bool] = lambda: False,
) -> Iterator[Event]:
    """Act as the operator of a replay: arm once the recording has run for ``after_s``, then set the intensity.

    With ``rearm_after_s`` the operator also arms again that long after a fault has latched.
    """
    start_ns: int | None = None
    arm_ns: int | None = None
    for event in events:
        if start_ns is None:
            start_ns = event.t_ns
            arm_ns = start_ns + int(after_s * NS_PER_S)
        yield event
        if arm_ns is not None and event.t_ns >= arm_ns:
            yield OperatorAct(event.t_ns, OperatorAction.ARM)
            yield OperatorAct(event.t_ns, OperatorAction.SET_INTENSITY, intensity)
            arm_ns = None
        elif arm_ns is None and rearm_after_s is not None and latched():
            arm_ns = event.t_ns + int(rearm_after_s * NS_PER_S)


def paced(events: Iterable[Event], clock: Clock, speed: float) -> Iterator[Event]:
    """Let each event through when its time has come, ``speed`` times as fast as recorded."""
    origin_ns: int | None = None
    start_ns = 0
    for event in events:
        if origin_ns is None:
            origin_ns, start_ns = event.t_ns, clock.now_ns()
        clock.wait_until_ns(start_ns + int((event.t_ns - origin_ns) / speed))
        yield event
