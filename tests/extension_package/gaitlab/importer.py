"""The laboratory's own files: one foot, semicolons, g and degrees per second, the rate in the first line."""

from pathlib import Path

import numpy as np

import fes
from fes.datasets import DataSet, Imported, ImportProblem


def read(path: Path, foot: str | None) -> Imported:
    """Read one file. Raises ImportProblem: it is none of the laboratory's."""
    first, *lines = path.read_text(encoding="utf-8").splitlines()
    if not first.startswith("gaitlab;"):
        raise ImportProblem(f"{path}: does not begin with gaitlab;RATE")
    try:
        rate_hz = float(first.split(";")[1])
        values = np.array([[float(cell) for cell in line.split(";")] for line in lines])
        acc, gyr = values[:, :3], values[:, 3:6]
        name = f"{foot or 'right'}_foot"
        recording = fes.recording(acc, gyr, rate_hz, name, acc_unit="g", gyr_unit="deg/s", name=path.stem)
    except (ValueError, IndexError) as error:
        raise ImportProblem(f"{path}: {error}") from error
    return Imported(recording, notes=("heel and toe are not known",))


DATA_SET = DataSet("gaitlab", "one foot, as our logger writes it", "our laboratory", "ours", ("*.lab",), read=read)
