"""An optical orientation against what the inertial sensor alone tells: inclination, which is all but heading.

Reference and estimate each say where up is in the sensor's axes. The angle between the two is the error that has
nothing to do with heading; it goes into words. Bland–Altman and the like need signed quantities: they are the angles of
the sensor's x and z axes to the vertical.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from fes.evaluation.reference.alignment import Synchrony
from fes.evaluation.reference.compare import Estimate, Pair
from fes.evaluation.reference.evaluation import Evaluation, rows_of
from fes.evaluation.reference.read import kind_of, orientation_columns
from fes.evaluation.reference.table import ReferenceError, read_columns
from fes.recording import Recording, Track
from fes.signals import FloatArray

PAIRS_HZ: Final = 10.0
LEAST: Final = 10


@dataclass(frozen=True, eq=False)
class OrientationReference:
    """Sensor to world, z up: ``t_s`` (N,) increasing, ``quaternion`` (N, 4) w, x, y, z, NaN where it was not seen.

    ``judged`` (N,): where it counts, as while the body moves. ``sensor`` is "" where the file names none.
    """

    source: str
    sensor: str
    t_s: FloatArray
    quaternion: FloatArray
    judged: npt.NDArray[np.bool_]


def only_orientations(paths: Sequence[Path]) -> bool:
    """Whether these references are tables of orientation, all of them."""
    tables = [path for path in paths if path.suffix.lower() in (".csv", ".txt", ".tsv") and path.is_file()]
    return bool(paths) and len(tables) == len(paths) and all(kind_of(read_columns(p)) == "orientation" for p in paths)


def read_orientation(path: Path) -> OrientationReference:
    """Read a table t, q_w, q_x, q_y, q_z, and perhaps sensor (or foot) and moving.

    ReferenceError: it cannot be read, or a quaternion is none.
    """
    table = read_columns(path)
    t_s, quaternion, judged = orientation_columns(table)
    seen = np.isfinite(quaternion).all(axis=1)
    size = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(seen & (np.abs(size - 1.0) > 0.05))
    if len(wrong):
        raise ReferenceError(
            f"{path}:{table.first_line + int(wrong[0])}: a quaternion has the length {size[wrong[0]]:.3f}, not 1"
        )
    names = {text.strip() for text in table.columns.get("sensor", table.columns.get("foot", []))}
    if len(names) > 1:
        raise ReferenceError(f"{path}: is of several sensors ({', '.join(sorted(names))}); a table for each, please")
    return OrientationReference(str(path), next(iter(names), ""), t_s, quaternion, judged & seen)


def evaluate_orientation(recording: Recording, references: Sequence[OrientationReference]) -> Evaluation:
    """Hold each reference against its sensor's orientation, off-line; the causal filter's error stands in the notes.

    ReferenceError: the recording has no such sensor, or both hardly overlap.
    """
    pairs: list[Pair] = []
    notes: list[str] = []
    for reference in references:
        own, said = _hold_against(recording, reference)
        pairs += own
        notes += said
    span = [float(t) for reference in references for t in (reference.t_s[0], reference.t_s[-1])]
    source = str(recording.path or recording.name)
    estimate = Estimate(source, "orientation, off-line", min(span), max(span), (), {}, {})
    notes.append("neighbouring samples are alike: the intervals of the table are far too narrow, SD and limits are not")
    sources, found = tuple(reference.source for reference in references), tuple(pairs)
    return Evaluation(estimate, sources, Synchrony(0.0, "", None), found, (), rows_of(found), tuple(notes), ())


def upward(quaternion: FloatArray) -> FloatArray:
    """The world's z axis in the sensor's axes (N, 3)."""
    w, x, y, z = quaternion.T
    up = np.column_stack((2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)))
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _hold_against(recording: Recording, reference: OrientationReference) -> tuple[list[Pair], list[str]]:
    from fes.estimation.orientation.body import smooth_orientation, track_orientation

    track = _track_of(recording, reference)
    t_s = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
    index = np.searchsorted(t_s, reference.t_s - 0.5 / track.rate_hz)
    index = np.minimum(index, len(t_s) - 1)
    judged = reference.judged & (np.abs(t_s[index] - reference.t_s) <= 1.0 / track.rate_hz)
    if judged.sum() < LEAST:
        raise ReferenceError(
            f"{reference.source}: fewer than {LEAST} of its orientations fall on samples of {track.sensor}; both begin "
            "at 0 s?"
        )
    true = upward(reference.quaternion[judged])
    notes, off_line = [], np.zeros((0, 3))
    for how, run in (("causal", track_orientation), ("off-line", smooth_orientation)):
        samples = track.acc_mps2, track.gyr_radps, track.rate_hz
        path = run(*samples, acc_range_mps2=track.acc_range_mps2, gyr_range_radps=track.gyr_range_radps)
        off_line = upward(path.quaternion)[index[judged]]
        error = np.degrees(np.arctan2(np.linalg.norm(np.cross(off_line, true), axis=1), (off_line * true).sum(axis=1)))
        notes.append(
            f"{track.sensor}, {how}: the vertical is off by {np.sqrt(np.mean(error**2)):.2f}° (RMS of {len(error)} "
            f"samples), 95 % within {np.percentile(error, 95):.2f}°, worst {error.max():.2f}°"
        )
    times = reference.t_s[judged]
    every = max(round(1.0 / (PAIRS_HZ * float(np.median(np.diff(reference.t_s))))), 1)
    pairs = [
        Pair(name, track.sensor, float(times[k]), float(a[k]), float(b[k]))
        for name, axis in (("inclination_x_rad", 0), ("inclination_z_rad", 2))
        for a, b in [(np.arccos(np.clip(side[:, axis], -1.0, 1.0)) for side in (true, off_line))]
        for k in range(0, len(times), every)
    ]
    return pairs, notes


def _track_of(recording: Recording, reference: OrientationReference) -> Track:
    names = [reference.sensor] if reference.sensor else list(recording.tracks)
    if len(names) != 1 or names[0] not in recording.tracks:
        raise ReferenceError(
            f"{reference.source}: of which sensor is it? The recording has {', '.join(recording.tracks)}; add a column "
            "'sensor'"
        )
    return recording.tracks[names[0]]
