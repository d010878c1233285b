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
        """As a file in ``folder``."""
        np.savez(
            folder / f"{self.name}.case.npz",
            side=self.side,
            rate_hz=self.rate_hz,
            acc=self.acc_mps2,
            gyr=self.gyr_radps,
            borders=self.borders,
            tasks=np.array(self.tasks),
        )

    @staticmethod
    def read(path: Path) -> Case:
        """Back from its file."""
        data = np.load(path)
        return Case(
            path.name.removesuffix(".case.npz"),
            str(data["side"]),
            float(data["rate_hz"]),
            data["acc"],
            data["gyr"],
            data["borders"],
            tuple(str(task) for task in data["tasks"]),
        )


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
