"""x-io's Gait-Tracking walks: a CSV of an NGIMU on a foot, nominally 400 Hz, g and deg/s.

Stamps are irregular and partly doubled, with the same sample in both rows: doubled rows are left out, the stamps kept.
The walk ends where it starts; there is no other truth.
"""

import re
from pathlib import Path
from typing import Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, plain_csv, stamped_track
from fes.recording import Recording
from fes.signals import G_MPS2

NOMINAL_HZ: Final = 400.0
_UNITS: Final = (("time", "s", 1), ("gyroscope", "deg/s", 3), ("accelerometer", "g", 3))


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such table."""
    names, values = plain_csv(path)
    wanted = [(kind, unit) for kind, unit, axes in _UNITS for _ in range(axes)]
    for name, (kind, unit) in zip(names + [""] * 7, wanted, strict=False):
        if not re.match(rf"{kind}\b.*\({re.escape(unit)}\)$", name.lower()):
            raise ImportProblem(f"{path}: has a column {name!r} where {kind} in {unit} should be; is it x-io's table?")
    t_s = values[:, 0]
    if not np.isfinite(t_s).all():
        raise ImportProblem(f"{path}: row {int(np.flatnonzero(~np.isfinite(t_s))[0]) + 2} has no time")
    kept = np.concatenate([[True], np.diff(t_s) > 0.0])
    acc, gyr = values[kept, 4:7] * G_MPS2, np.radians(values[kept, 1:4])
    checked(path, acc, gyr)
    sensor = f"{foot or 'right'}_foot"
    t_ns = np.round((t_s[kept] - t_s[0]) * 1e9).astype(np.int64)
    notes = (
        f"{int((~kept).sum())} of {len(t_s)} rows carried the stamp of the row before and were left out",
        f"which foot is not documented: taken for the {sensor.replace('_', ' ')}",
        "the walk ends where it starts: the only reference (.end.csv)",
    )
    rate_hz = 1e9 / float(np.median(np.diff(t_ns)))
    track = stamped_track(sensor, rate_hz, t_ns, acc, gyr)
    references = {".end.csv": (["foot", "end_distance_m", "end_height_m"], [(sensor, 0.0, 0.0)])}
    extra = {"closed_loop": True, "nominal_rate_hz": NOMINAL_HZ}
    return Imported(Recording(f"xio_{path.stem}", None, {sensor: track}, extra=extra), references, notes)
