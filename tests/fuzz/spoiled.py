"""Bytes that were good once: a seeded mutator for fuzzing, and a clock that ends a hang."""

from __future__ import annotations

import random
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

TELLING = (0x00, 0xFF, 0x7F, 0x80, 0x0A, 0x2C, 0xF0, 0x0F, 0x81, 0xFA, 0xDB)


def spoiled(seeds: Sequence[bytes], count: int, seed: int, most: int = 4096) -> Iterator[bytes]:
    """``count`` inputs of at most ``most`` bytes: seeds with one to eight changes each, and one in eight pure noise."""
    chance = random.Random(seed)
    for _ in range(count):
        if chance.random() < 0.125:
            yield chance.randbytes(chance.randrange(64))
            continue
        data = bytearray(chance.choice(seeds))
        for _ in range(chance.choice((1, 1, 2, 3, 8))):
            _change(data, chance, seeds)
        yield bytes(data[:most])


def _change(data: bytearray, chance: random.Random, seeds: Sequence[bytes]) -> None:
    at = chance.randrange(len(data) + 1)
    end = min(len(data), at + chance.choice((1, 1, 2, 4, 16, 64)))
    match chance.randrange(7):
        case 0 if at < len(data):
            data[at] ^= 1 << chance.randrange(8)
        case 1 if at < len(data):
            data[at] = chance.choice(TELLING)
        case 2:
            data[at:end] = chance.randbytes(end - at)
        case 3:
            del data[at:end]
        case 4:
            data[at:at] = chance.randbytes(chance.randrange(1, 9))
        case 5:
            data[at:at] = data[at:end]
        case _:
            data[at:end] = chance.choice(seeds)[: chance.randrange(1, 65)]


@contextmanager
def no_longer_than(seconds: float) -> Iterator[None]:
    """End what hangs with an error."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"more than {seconds:g} s: a hang")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
