"""How long a stride took, of all the time that its foot walked."""

from __future__ import annotations

from dataclasses import replace

from fes.signals import NS_PER_S, StrideResult

UNSEEN_NS = -(2**63)  # of what did not happen, for compiled code


def time_of(start_ns: int, end_ns: int, before_ns: int) -> int:
    """As :func:`stride_time_ns`, with ``UNSEEN_NS`` for a stride before that there is not; ready for ``jit``."""
    lasted_ns = end_ns - start_ns
    if before_ns == UNSEEN_NS or not 0 <= start_ns - before_ns <= lasted_ns:
        return lasted_ns
    return end_ns - before_ns


def stride_time_ns(start_ns: int, end_ns: int, before_ns: int | None) -> int:
    """From one stance to the next: the stride from quietest to quietest instant, and the rest before it.

    A long stance, as in slow walking, has two quiet instants: near its beginning one stride ends, before its end the
    next begins. The time between them belongs to walking, or speed and cadence would come out too high. A foot that
    stood for longer than the stride itself did not walk meanwhile.

    Args:
        start_ns: the stride's beginning.
        end_ns: its end.
        before_ns: the end of the stride before, None when there is none.
    """
    return time_of(start_ns, end_ns, UNSEEN_NS if before_ns is None else before_ns)


def at_walking_speed(stride: StrideResult, before_ns: int | None) -> StrideResult:
    """The stride with its speed over all of its time; one that is not valid as it is. ``before_ns`` as above."""
    if not stride.valid:
        return stride
    time_ns = stride_time_ns(stride.t_start_ns, stride.t_end_ns, before_ns)
    return replace(stride, speed_mps=stride.stride_length_m * NS_PER_S / time_ns)
