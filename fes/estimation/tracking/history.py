"""The last twenty seconds of one sensor: which samples are used, and where strides find them later."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_ieee
from fes.signals import FloatArray, IntArray

RESTART_GAP_S = 0.25  # after a longer silence nothing is known of the phase
RESTART_GAP_NS = round(1e9 * RESTART_GAP_S)
HISTORY_S = 20.0
LARGEST_VALUE = 1e4  # m/s² and rad/s: beyond any sensor, and one such value would spoil the orientation for good
LONG_AGO_NS = -(2**63)

BOOK = np.dtype(
    [
        ("running", np.bool_),
        ("newest_ns", np.int64),
        ("filled", np.int64),
        ("used", np.int64),
        ("doubled_or_backward", np.int64),
        ("not_finite", np.int64),
    ],
    align=True,
)


@dataclass(slots=True)
class SampleCounts:
    """What became of the samples."""

    used: int = 0
    doubled_or_backward: int = 0
    not_finite: int = 0
    restarts: int = 0

    def to_dict(self) -> dict[str, int]:
        """For the session log."""
        return asdict(self)


KEPT, NOT_FINITE, NOT_NEWER, SILENCE, FULL = range(5)  # what became of a sample


@inlined
def judged(
    running: bool, newest_ns: int, filled: int, room: int, t_ns: int,
    ax: float, ay: float, az: float, gx: float, gy: float, gz: float,
) -> int:  # fmt: skip
    """What becomes of a sample where ``filled`` of ``room`` rows are, the last of ``newest_ns``.

    An unusable sample's stamp counts for nothing, or it would matter where the blocks are cut.
    """
    became = KEPT
    usable = (abs(ax) < LARGEST_VALUE) & (abs(ay) < LARGEST_VALUE) & (abs(az) < LARGEST_VALUE)
    usable &= (abs(gx) < LARGEST_VALUE) & (abs(gy) < LARGEST_VALUE) & (abs(gz) < LARGEST_VALUE)
    if not usable:  # a comparison with what is not a number is False
        became = NOT_FINITE
    elif running and t_ns <= newest_ns:
        became = NOT_NEWER
    elif not running or not 0 < t_ns - newest_ns <= RESTART_GAP_NS:  # stamps so far apart that this overflows
        became = SILENCE
    elif filled == room:
        became = FULL
    return became


@jit_ieee
def take_one(
    b: Any, kept_t_ns: Any, kept_acc: Any, kept_gyr: Any, t_ns: int, ax: float, ay: float, az: float,
    gx: float, gy: float, gz: float,
) -> int:  # fmt: skip
    """Copy one sample into the history of the book ``b``, or say why not: ``SILENCE`` and ``FULL`` wait for Python."""
    n = b.filled
    became = judged(b.running, b.newest_ns, n, kept_t_ns.shape[0], t_ns, ax, ay, az, gx, gy, gz)
    if became == KEPT:
        b.newest_ns = t_ns
        b.filled = n + 1
        b.used += 1
        kept_t_ns[n] = t_ns
        kept_acc[n, 0], kept_acc[n, 1], kept_acc[n, 2] = ax, ay, az
        kept_gyr[n, 0], kept_gyr[n, 1], kept_gyr[n, 2] = gx, gy, gz
    elif became == NOT_FINITE:
        b.not_finite += 1
    elif became == NOT_NEWER:
        b.doubled_or_backward += 1
    return became


@jit_ieee
def take_in(
    book: Any, kept_t_ns: Any, kept_acc: Any, kept_gyr: Any, t_ns: Any, acc: Any, gyr: Any, begin: int
) -> tuple[int, int]:
    """Copy the samples from ``begin`` on, as :func:`take_one` would; see :meth:`History.take_in`.

    Returns the first sample not yet seen to, and why: ``SILENCE`` and ``FULL`` are the caller's to see to, ``KEPT``
    says that there is no more. What evolves is kept out of the book meanwhile, or it would be written at every sample.
    """
    b, n, i, became = book[0], t_ns.shape[0], begin, KEPT
    filled, newest_ns, running, room = b.filled, b.newest_ns, b.running, kept_t_ns.shape[0]
    before = filled
    while i < n:
        now_ns, ax, ay, az, gx, gy, gz = t_ns[i], acc[i, 0], acc[i, 1], acc[i, 2], gyr[i, 0], gyr[i, 1], gyr[i, 2]
        became = judged(running, newest_ns, filled, room, now_ns, ax, ay, az, gx, gy, gz)
        if became == KEPT:
            newest_ns = now_ns
            kept_t_ns[filled] = now_ns
            kept_acc[filled, 0], kept_acc[filled, 1], kept_acc[filled, 2] = ax, ay, az
            kept_gyr[filled, 0], kept_gyr[filled, 1], kept_gyr[filled, 2] = gx, gy, gz
            filled += 1
        elif became == NOT_FINITE:
            b.not_finite += 1
        elif became == NOT_NEWER:
            b.doubled_or_backward += 1
        else:
            break
        i += 1
    b.filled, b.newest_ns = filled, newest_ns
    b.used += filled - before
    return i, became if i < n else KEPT


@jit_ieee
def forget_half(book: Any, kept_t_ns: Any, kept_acc: Any, kept_gyr: Any, trace: Any) -> None:
    """As :meth:`History.forget_half`."""
    n = kept_t_ns.shape[0]
    half = n // 2
    for i in range(half, n):
        k = i - half
        kept_t_ns[k] = kept_t_ns[i]
        for j in range(3):
            kept_acc[k, j] = kept_acc[i, j]
            kept_gyr[k, j] = kept_gyr[i, j]
        for j in range(4):
            trace[k, j] = trace[i, j]
    book[0].filled = n - half


class History:
    """Samples as measured, oldest first, and beside each what the core left there.

    ``t_ns`` (N,), ``acc_mps2`` (N, 3), ``gyr_radps`` (N, 3), ``trace`` (N, 4); how many of the rows are filled is what
    :meth:`take_in` and :meth:`forget_half` last said. ``book`` (1,) of ``BOOK`` is for :func:`take_one`.
    """

    def __init__(self, rate_hz: float) -> None:
        capacity = max(int(HISTORY_S * rate_hz), 64)
        self.t_ns: IntArray = np.zeros(capacity, np.int64)
        self.acc_mps2: FloatArray = np.zeros((capacity, 3))
        self.gyr_radps: FloatArray = np.zeros((capacity, 3))
        self.trace: FloatArray = np.zeros((capacity, 4))
        self.book = np.zeros(1, BOOK)

    @property
    def filled(self) -> int:
        """How many rows are filled."""
        return int(self.book["filled"][0])

    def counts(self, restarts: int) -> SampleCounts:
        """What became of the samples so far."""
        _, _, _, used, doubled_or_backward, not_finite = self.book[0].tolist()
        return SampleCounts(used, doubled_or_backward, not_finite, restarts)

    def take_in(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, begin: int) -> tuple[int, int, bool]:
        """Copy the samples from ``begin`` on, up to a silence or until there is no room.

        Samples not newer than the one before, and samples that are not finite or beyond ``LARGEST_VALUE``, are counted
        and passed over. Returns the first sample not yet seen to, how many rows are filled, and whether that sample
        comes after a silence (as the first of all does): then :meth:`restart` first. Where it does not and there is
        still one, :meth:`forget_half`.
        """
        taken, became = take_in(self.book, self.t_ns, self.acc_mps2, self.gyr_radps, t_ns, acc, gyr, begin)
        return taken, self.filled, became == SILENCE

    def restart(self, t_ns: int) -> bool:
        """Forget everything; the next sample is that of ``t_ns``. Returns whether there was anything before."""
        was_running = bool(self.book["running"][0])
        self.book["running"], self.book["filled"] = True, 0
        self.book["newest_ns"] = max(t_ns - 1, LONG_AGO_NS)
        return was_running

    def forget_half(self) -> int:
        """Make room: the older half goes. Returns how many rows remain."""
        forget_half(self.book, self.t_ns, self.acc_mps2, self.gyr_radps, self.trace)
        return self.filled
