"""How long other libraries take on the cases in a folder; runs in the peers' environment, leaves speed.json there.

    .venv-peers/bin/python benchmarks/peers/run_speed.py FOLDER

Processor time, the least of several runs after one that warms up, in µs a sample. Filters that are stepped sample by
sample in Python, as a live program would, get the first part of the case.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import ahrs
import imufusion
import numpy as np
import run_gaitmap
import vqf
from exchange import G_MPS2, Case

STEPPED_SAMPLES = 5_000
REPEATS = 3


def least_us(work: Callable[[], object], samples: int, repeats: int = REPEATS) -> float:
    """µs a sample."""
    work()
    taken = []
    for _ in range(repeats):
        begin_s = time.process_time()
        work()
        taken.append(time.process_time() - begin_s)
    return 1e6 * min(taken) / samples


def stepped(update: Callable[[np.ndarray, np.ndarray], object], case: Case) -> float:
    pairs = list(zip(case.gyr_radps[:STEPPED_SAMPLES], case.acc_mps2[:STEPPED_SAMPLES], strict=True))

    def work() -> None:
        for rate, force in pairs:
            update(rate, force)

    return least_us(work, len(pairs))


def filters(case: Case) -> dict[str, float]:
    """Orientation filters: a call a sample, and where there is one a call for all."""
    whole = vqf.VQF(1.0 / case.rate_hz)
    ekf, ekf_q = ahrs.filters.EKF(frequency=case.rate_hz), np.array([1.0, 0.0, 0.0, 0.0])
    fused = imufusion.Ahrs()

    def by_imufusion(rate: np.ndarray, force: np.ndarray) -> object:
        fused.update_no_magnetometer(np.degrees(rate), force / G_MPS2)
        return fused.get_quaternion()

    def by_ekf(rate: np.ndarray, force: np.ndarray) -> object:
        nonlocal ekf_q
        ekf_q = ekf.update(ekf_q, rate, force)
        return ekf_q

    return {
        "VQF (C++), a call a sample": stepped(vqf.VQF(1.0 / case.rate_hz).update, case),
        "VQF (C++), a call for all": least_us(
            lambda: whole.updateBatch(case.gyr_radps, case.acc_mps2), len(case.acc_mps2)
        ),
        "PyVQF, a call a sample": stepped(vqf.PyVQF(1.0 / case.rate_hz).update, case),
        "imufusion (C), a call a sample": stepped(by_imufusion, case),
        "ahrs EKF, a call a sample": stepped(by_ekf, case),
    }


def pipelines(case: Case) -> dict[str, float]:
    """gaitmap: its whole pipeline with its smoother, and the smoother alone."""
    samples = len(case.acc_mps2)
    methods = {(method.name, method.task): method.run for method in run_gaitmap.METHODS}
    asked = {
        "gaitmap pipeline (Herzer), RtsKalman": ("gaitmap pipeline (Herzer), RtsKalman", "detection"),
        "gaitmap pipeline (Rampp), integration": ("gaitmap pipeline (Rampp), default integration", "detection"),
        "gaitmap RtsKalman": ("gaitmap RtsKalman", "closure"),
    }
    return {name: least_us(lambda key=key: methods[key](case), samples, 2) for name, key in asked.items()}


def main(folder: Path) -> None:
    warnings.simplefilter("ignore")
    found: dict[str, list[float]] = {}
    failed: dict[str, str] = {}
    for path in sorted(folder.glob("*.case.npz")):
        case = Case.read(path)
        case = replace(
            case, acc_mps2=np.ascontiguousarray(case.acc_mps2), gyr_radps=np.ascontiguousarray(case.gyr_radps)
        )
        for part in (filters, pipelines):
            try:
                for name, value in part(case).items():
                    found.setdefault(name, []).append(value)
            except Exception as error:  # a peer may fail in any way
                failed[part.__name__] = f"{type(error).__name__}: {error}"[:300]
    means = {name: float(np.mean(values)) for name, values in found.items()}
    (folder / "speed.json").write_text(json.dumps({"us": means, "failed": failed}), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
