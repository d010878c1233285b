"""Walks of hemiparetic and healthy people, NumPy archives with a ``meta`` of JSON: footswitch_treadmill, stroke_walks.

footswitch_treadmill, ``Hnn_k.npz`` and ``Pnn_k.npz``: one instep (side not told), labels by footswitches at every
sample: 0 heel strike until flat, 1 flat foot, 2 heel off, 3 swing. The stamps are those of arrival: jittered, with
stalls that are followed by bursts, and some real gaps. They stay as they are. Rows that no sensor can have measured
(spikes) are left out. ``bad`` marks spikes and gaps; whatever phase has such a row is not ``judged``.

stroke_walks, ``Snn.npz``: both feet, each by its own clock, which may go back near the end; ranges as its authors say.
"""

import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, npz_file, stamped_track
from fes.recording import Recording, Track
from fes.signals import G_MPS2, FloatArray

PHASES: Final = ("loading_response", "stance", "pre_swing", "swing")  # by the switches' label
MOST_MPS2, MOST_RADPS = 400.0, 40.0  # more than a foot can do: a spike


def read_footswitch_treadmill(path: Path, foot: str | None = None) -> Imported:
    """Read one trial. Raises ImportProblem: it is no such file."""
    data, meta = _archive(path, "foot_t_s", "foot_acc", "foot_gyr", "label", "bad")
    sensor = f"{foot or 'right'}_foot"
    track, spikes = _track(path, sensor, data, "foot")
    t_s, label, bad = data["foot_t_s"] - data["foot_t_s"][0], data["label"].astype(int), data["bad"].astype(bool)
    if label.shape != t_s.shape or bad.shape != t_s.shape or not np.isin(label, range(len(PHASES))).all():
        raise ImportProblem(f"{path}: its labels must be {len(t_s)} of 0 to {len(PHASES) - 1}")
    cuts = np.flatnonzero(np.diff(label)) + 1
    begins, ends = np.append(0, cuts), np.append(cuts, len(label) - 1)
    phases = [
        (sensor, t_s[a], t_s[b], PHASES[label[a]], int(not bad[a : b + 1].any()))
        for a, b in zip(begins.tolist(), ends.tolist(), strict=True)
    ]
    swings = [k for k, (*_, phase, judged) in enumerate(phases) if phase == PHASES[3] and judged]
    events = [(sensor, "FO", phases[k][1]) for k in swings if k > 0]
    events += [(sensor, "IC", phases[k + 1][1]) for k in swings if k + 1 < len(phases)]
    notes = [
        f"which foot is not told: taken for the {sensor.replace('_', ' ')}",
        "stamps are those of arrival, with stalls of seconds and bursts after them: judge nothing there",
        "phases by footswitches, which have delays of their own: .phases.csv (judged 0: a spike or a gap is in it)",
        *([f"{spikes} rows that no sensor can have measured were left out"] if spikes else []),
        *([str(meta["note"])] if meta.get("note") else []),
    ]
    references: dict[str, Any] = {
        ".events.csv": (["foot", "event", "t_s"], sorted(events, key=lambda event: event[2])),
        ".phases.csv": (["foot", "t_start_s", "t_end_s", "phase", "judged"], phases),
    }
    recording = Recording(
        f"footswitch_treadmill_{path.stem}", None, {sensor: track}, subject=str(meta.get("person", path.stem)),
        extra={"group": str(meta.get("group", "")), "surface": "treadmill"},
    )  # fmt: skip
    return Imported(recording, references, tuple(notes))


def read_stroke_walks(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such file."""
    sides = ("left", "right")
    data, meta = _archive(path, *(f"{side}_{kind}" for side in sides for kind in ("t_s", "acc", "gyr")))
    rate_hz = _number(path, meta, "rate_hz")
    ranges = _number(path, meta, "acc_range_g") * G_MPS2, float(np.radians(_number(path, meta, "gyr_range_degps")))
    tracks = {f"{side}_foot": _track(path, f"{side}_foot", data, side, rate_hz, *ranges)[0] for side in sides}
    extra = {"group": str(meta.get("group", "")), "aid": bool(meta.get("aid")), "surface": "floor, with turns"}
    notes = ["each foot has its own clock: set them by the walk with --sync-clocks", "there is no reference"]
    for sensor, track in tracks.items():
        if back := int(np.count_nonzero(np.diff(track.t_sensor_ns) < 0)):
            notes.append(f"{sensor}: the clock goes back {back} times, as recorded")
    recording = Recording(f"stroke_walks_{path.stem}", None, tracks, subject=path.stem, extra=extra)
    return Imported(recording, {}, tuple(notes))


def _archive(path: Path, *needed: str) -> tuple[dict[str, FloatArray], dict[str, Any]]:
    """The arrays and what ``meta`` says."""
    data = npz_file(path, "meta", *needed)
    try:
        meta = json.loads(str(data.pop("meta")))
    except ValueError as error:
        raise ImportProblem(f"{path}: its meta is no JSON: {error}") from error
    if not isinstance(meta, dict):
        raise ImportProblem(f"{path}: its meta is {type(meta).__name__}, must be a table of names")
    return data, meta


def _number(path: Path, meta: dict[str, Any], name: str) -> float:
    value = meta.get(name)
    if not isinstance(value, (int, float)) or not 0.0 < value < 10_000.0:
        raise ImportProblem(f"{path}: its meta says {name} = {value!r}, must be a number above 0")
    return float(value)


def _track(
    path: Path, sensor: str, data: dict[str, FloatArray], prefix: str, rate_hz: float | None = None,
    acc_range_mps2: float | None = None, gyr_range_radps: float | None = None,
) -> tuple[Track, int]:  # fmt: skip
    """One sensor's samples by their own stamps, without spikes, and how many of these there were.

    ``rate_hz`` None: the mean of the stamps.
    """
    t_s, acc, gyr = (np.asarray(data[f"{prefix}_{kind}"], np.float64) for kind in ("t_s", "acc", "gyr"))
    checked(path, acc, gyr)
    if t_s.shape != (len(acc),) or not np.isfinite(t_s).all():
        raise ImportProblem(f"{path}: {prefix}_t_s must be {len(acc)} times in s")
    sound = (np.abs(acc).max(axis=1) < MOST_MPS2) & (np.abs(gyr).max(axis=1) < MOST_RADPS)
    sound[0] = True  # the references count from the first stamp
    t_ns = np.round(1e9 * (t_s[sound] - t_s[0])).astype(np.int64)
    rate_hz = rate_hz or (len(t_ns) - 1) * 1e9 / float(np.ptp(t_ns))
    track = stamped_track(sensor, rate_hz, t_ns, acc[sound], gyr[sound], acc_range_mps2, gyr_range_radps)
    return track, int(np.count_nonzero(~sound))
