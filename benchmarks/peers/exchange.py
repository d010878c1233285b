"""What passes between the benchmark and the peers' processes: one file per case, one per result. Needs numpy alone.

Every peer gets the same: specific force (m/s²) and rates (rad/s) in x forward, y left, z up, as gaitmap asks for and
the others do not mind, free of the gyroscope bias that our calibration found in a standing second. A method that raises
is reported with its reason and does not stop the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

G_MPS2 = 9.80665
Arrays = dict[str, Any]
PLAIN = ("name", "side", "rate_hz", "tasks")  # of a case; the rest are arrays


@dataclass(frozen=True)
class Case:
    """One foot of one recording; ``borders`` (M, 2) are samples, ``tasks`` what is asked of it."""

    name: str
    side: str
    rate_hz: float
    acc_mps2: Any
    gyr_radps: Any
    borders: Any
    tasks: tuple[str, ...]

    def write(self, folder: Path) -> None:
        np.savez(folder / f"{self.name}.case.npz", **vars(self))

    @staticmethod
    def read(path: Path) -> Case:
        with np.load(path) as data:
            given = {name: value.tolist() if name in PLAIN else value for name, value in data.items()}
        return Case(**given | {"tasks": tuple(given["tasks"])})


@dataclass(frozen=True)
class Method:
    """A peer's way of doing a task; ``run`` returns arrays by name."""

    name: str
    task: str
    known: str
    run: Callable[[Case], Arrays]


def run_all(folder: Path, methods: list[Method]) -> None:
    """Every method on every case that asks for its task; results beside the cases."""
    for path in sorted(folder.glob("*.case.npz")):
        case = Case.read(path)
        for method in methods:
            if method.task not in case.tasks:
                continue
            try:
                found = method.run(case)
            except Exception as error:  # a peer may fail in any way, and the table says how
                found = {"error": np.array(f"{type(error).__name__}: {error}".splitlines()[0][:200])}
            stem = f"{case.name}.{method.task}.{method.name}".replace(" ", "_").replace("/", "-")
            np.savez(
                folder / f"{stem}.result.npz", case=case.name, task=method.task, method=method.name,
                known=method.known, **found,
            )  # fmt: skip
