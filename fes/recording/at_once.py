"""Work on several sensors at once: compiled code and numpy hold no lock of Python's meanwhile, so that threads share
the processors."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Made = TypeVar("Made")


def at_once(work: Callable[[str], Made], sensors: Iterable[str]) -> dict[str, Made]:
    """What ``work`` makes of each sensor, by their names and in their order; an error of the first that fails is
    raised."""
    names = list(sensors)
    with ThreadPoolExecutor() as threads:
        return dict(zip(names, threads.map(work, names), strict=True))
