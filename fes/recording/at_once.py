"""Work on several sensors at once: compiled code and numpy hold no lock of Python's meanwhile, so that threads share
the processors.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import parent_process
from typing import TypeVar

Made = TypeVar("Made")


def at_once(work: Callable[[str], Made], sensors: Iterable[str]) -> dict[str, Made]:
    """What ``work`` makes of each sensor, by their names and in their order; an error of the first that fails is
    raised."""
    names = list(sensors)
    if len(names) < 2 or parent_process() is not None:  # one of several processes, which share the processors already
        return {name: work(name) for name in names}
    with ThreadPoolExecutor() as threads:
        return dict(zip(names, threads.map(work, names), strict=True))
