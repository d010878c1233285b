"""Stroke survivors on a treadmill (Sint Maartenskliniek): a folder of Xsens texts for each run, or packed.

As downloaded, ``data/1019_ppNN/Xsens/exportedKKK`` holds a text a sensor (two feet, two shanks, lumbar). Which run it
is stands in ``data/1019_ppNN/corresponding_files.txt``; which sensor sat where in ``sensorspec.json`` (or
``.json.txt``) in one of a participant's folders. Where that is missing the sensors' numbers tell: two sets were used,
and each sat the same way in all folders that say so. The belt's speed is none of the files: it is the authors' table of
comfortable speeds (``MovingReality_functions.py``), which holds for the runs with feedback; the others are self-paced.
Checked against the repository's files at the first samples of two participants (one of each set), which are those of
the packed archives.

Packed, a run is one NumPy archive, ``MRpp_TRIAL.npz``: arrays ``acc_``/``gyr_`` + left/right + foot/shank (m/s²,
rad/s), ``fs``, ``belt_speed`` (m/s, NaN where self-paced) and ``fsa_mean_deg``. Only the mean is true of the belt: its
speed is quoted to 0.1 m/s, and holds over the last 120 s.

A text is as Xsens' MT Manager exports it: remark lines, a line of column names, tabs, a row a packet. Packets are
numbered by a 16-bit counter that all sensors of a station share; a lost packet is a number that is missing, or a row
without values. Accelerations are in m/s², rates in rad/s.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, even_track, npz_file, stamped_track
from fes.recording import Recording, Track
from fes.signals import SENSORS, FloatArray, IntArray

RATE_HZ: Final = 100.0
PLACES: Final = (
    {"4778E": "left_foot", "47793": "right_foot", "47786": "left_shank", "47795": "right_shank"},
    {"47787": "left_foot", "47796": "right_foot", "47783": "left_shank", "47792": "right_shank"},
)
BELT_MPS: Final = {1: 0.4, 2: 1.6, 3: 0.4, 4: 1.2, 5: 0.9, 6: 1.2, 7: 1.0, 8: 1.2, 9: 0.9, 10: 1.4, 11: 0.8, 12: 1.1}
WITH_FEEDBACK: Final = ("FBIC", "FBPO", "2FB")
_RUN: Final = re.compile(r"\s*1019_MR(\d+)_(\w+?)\.c3d\S*\s*=\s*(exported\d+)\s*(.*)")
_TRIAL: Final = re.compile(r"(1Reg|2Reg|FBIC|FBPO|2FB)(?:0\d)?$")


WRAP: Final = 65536
COLUMNS: Final = ("PacketCounter", *(f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ"))


@dataclass(frozen=True, eq=False)
class XsensText:
    """One sensor: ``rate_hz`` None where the file does not say, ``counter`` (N,) goes on where the 16 bits wrap.

    ``acc_mps2`` and ``gyr_radps`` are (N, 3).
    """

    rate_hz: float | None
    counter: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray


def read_xsens_text(path: Path) -> XsensText:
    """Read one sensor's file. Raises ImportProblem: it is no such file; the message names the line."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ImportProblem(f"{path}: cannot be read: {error}") from error
    first = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("//")), len(lines))
    names = lines[first].split("\t") if first < len(lines) else []
    missing = [name for name in COLUMNS if name not in names]
    if missing:
        what = "is no text export of MT Manager with calibrated data: it lacks the columns"
        raise ImportProblem(f"{path}: {what} {', '.join(missing)}")
    at = [names.index(name) for name in COLUMNS]
    counts, rows = [], []
    for number, line in enumerate(lines[first + 1 :], first + 2):
        cells = line.split("\t")
        if not line.strip() or (len(cells) == len(names) and not any(cells[k].strip() for k in at[1:])):
            continue  # a lost packet
        try:
            values = [float(cells[k]) for k in at]
            counts.append(int(values[0]))
        except (ValueError, IndexError, OverflowError):
            raise ImportProblem(f"{path}:{number}: holds no packet of {len(names)} columns; is the file cut?") from None
        rows.append(values[1:])
    table = np.array(rows, np.float64).reshape(-1, 6)
    counter = np.array(counts, np.int64)
    wrapped = np.concatenate([[0], np.cumsum(np.diff(counter) < -WRAP // 2)]) if len(counter) else counter
    counter = counter + WRAP * wrapped
    back = np.flatnonzero(np.diff(counter) <= 0)
    if len(back):
        raise ImportProblem(f"{path}: its PacketCounter does not increase after packet {int(counter[back[0]]) % WRAP}")
    remarks = "\n".join(lines[:first])
    rate = re.search(r"(?:Update|Output|Sample)\s*[Rr]ate:?\s*([0-9.]+)\s*Hz", remarks)
    return XsensText(float(rate[1]) if rate else None, counter, table[:, :3], table[:, 3:])


def read_tracks(folder: Path) -> tuple[dict[str, Track], list[str]]:
    """The sensors of one run on their common clock, and notes.

    ImportProblem: the folder holds no sensor whose place is known, or a file is damaged.
    """
    places, how = _places(folder)
    texts: dict[str, XsensText] = {}
    for path in sorted(folder.glob("MT_*.txt")):
        place = next((place for end, place in places.items() if path.stem.upper().endswith(end)), None)
        if place in SENSORS:
            texts[place] = read_xsens_text(path)
            checked(path, texts[place].acc_mps2, texts[place].gyr_radps)
    if not texts:
        raise ImportProblem(f"{folder}: holds no sensor on foot or shank. Add a sensorspec.json: leftfoot, rightfoot …")
    begin = int(next(iter(texts.values())).counter[0])
    offsets = {place: (int(t.counter[0]) - begin + WRAP // 2) % WRAP - WRAP // 2 for place, t in texts.items()}
    earliest = min(offsets.values())
    tracks, lost = {}, 0
    for place in (name for name in SENSORS if name in texts):
        text = texts[place]
        packets = text.counter - text.counter[0] + offsets[place] - earliest
        lost += int(packets[-1] - packets[0]) + 1 - len(packets)
        rate_hz = text.rate_hz or RATE_HZ
        t_ns = np.round(packets * 1e9 / rate_hz).astype(np.int64)
        tracks[place] = stamped_track(place, rate_hz, t_ns, text.acc_mps2, text.gyr_radps)
    return tracks, [how, f"{lost} packets were lost"] if lost else [how]


def run_of(folder: Path) -> tuple[str, str, float | None]:
    """A name for the run, its participant, and the belt's speed (m/s), None where it is self-paced or not known."""
    listing = folder.parents[1] / "corresponding_files.txt"
    lines = listing.read_text(encoding="utf-8", errors="replace").splitlines() if listing.is_file() else []
    for line in lines:
        found = _RUN.match(line)
        trial = _TRIAL.search(found[2]) if found else None
        if found is None or trial is None or found[3] != folder.name:
            continue
        number = int(found[1])
        run = "2Reg" if "second trial without feedback" in found[4] else trial[1]  # one file is misnamed, and says so
        return f"MR{number:02d}_{run}", f"MR{number:02d}", BELT_MPS.get(number) if run in WITH_FEEDBACK else None
    return f"{folder.parents[1].name}_{folder.name}", folder.parents[1].name, None


def _places(folder: Path) -> tuple[dict[str, str], str]:
    """End of a sensor's number (upper case) → sensor name; and how that is known."""
    near = [*sorted(folder.glob("sensorspec.json*")), *sorted(folder.parent.glob("exported*/sensorspec.json*"))]
    sensor_of = {sensor.replace("_", ""): sensor for sensor in SENSORS}
    for spec in near:
        try:
            spec_places = json.loads(spec.read_text(encoding="utf-8-sig"))
            found = {
                str(number).upper().removesuffix(".TXT"): sensor_of[place]
                for place, number in spec_places.items()
                if place in sensor_of
            }
        except (OSError, ValueError, AttributeError) as error:
            raise ImportProblem(f"{spec}: is no table of sensors: {error}") from error
        return found, f"which sensor sat where: {spec.parent.name}/{spec.name}"
    both = {end: place for places in PLACES for end, place in places.items()}
    return both, "which sensor sat where: by the sensors' numbers, as in the participants who say so"


STEADY_S: Final = 120.0
NOTES: Final = (
    "foot: x points back and up along the instep, z out of it, +gyr_y is toe-up on both feet",
    "which side is paretic is not documented",
)


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one run: an archive, a folder of texts, or one of its texts. Raises ImportProblem: it is none of these."""
    if path.suffix.lower() == ".npz":
        return _packed(path)
    folder = (path if path.is_dir() else path.parent).resolve()
    tracks, notes = read_tracks(folder)
    name, subject, belt_mps = run_of(folder)
    references, note = _belt(belt_mps, tracks)
    recording = Recording(f"stroke_treadmill_{name}", None, tracks, belt_mps, subject)
    return Imported(recording, references, (*NOTES, note, *notes))


def _packed(path: Path) -> Imported:
    data = npz_file(path, "fs", "belt_speed")
    rate_hz, belt_mps = float(data["fs"]), float(data["belt_speed"])
    if not 10.0 <= rate_hz <= 5000.0:
        raise ImportProblem(f"{path}: its rate fs is {rate_hz:g} Hz, which no such sensor has")
    tracks = {}
    for sensor in SENSORS:
        acc, gyr = (data.get(f"{kind}_{sensor.replace('_', '')}") for kind in ("acc", "gyr"))
        if acc is None or gyr is None:
            continue
        acc, gyr = np.asarray(acc, np.float64), np.asarray(gyr, np.float64)
        checked(path, acc, gyr)
        tracks[sensor] = even_track(sensor, rate_hz, acc, gyr)
    if not tracks:
        raise ImportProblem(f"{path}: holds no sensor such as acc_leftfoot and gyr_leftfoot")
    references, note = _belt(belt_mps if math.isfinite(belt_mps) and belt_mps > 0.0 else None, tracks)
    notes = [*NOTES, note]
    extra: dict[str, Any] = {}
    if "fsa_mean_deg" in data and math.isfinite(float(data["fsa_mean_deg"])):
        extra["foot_strike_mean_deg"] = float(data["fsa_mean_deg"])
        what = "Vicon's mean of the first 50 contacts of each side, both pooled, toe-up positive"
        notes.append(f"foot_strike_mean_deg: {what}")
    belt, subject = belt_mps if references else None, path.stem.split("_")[0]
    recording = Recording(f"stroke_treadmill_{path.stem}", None, tracks, belt, subject, extra=extra)
    return Imported(recording, references, tuple(notes))


def _belt(belt_mps: float | None, tracks: Mapping[str, Track]) -> tuple[dict[str, Any], str]:
    """The belt's speed as a reference, and a note."""
    if belt_mps is None:
        return {}, "self-paced, or the belt's speed is not known: there is no reference"
    end_s = max(track.duration_s for track in tracks.values())
    begin_s = max(end_s - STEADY_S, 0.0)
    rows = [(t, belt_mps) for t in (begin_s, 0.5 * (begin_s + end_s), end_s)]
    note = "the belt's speed is quoted to 0.1 m/s and taken for the last 120 s: right on average only"
    return {".belt.csv": (["t_s", "speed_mps"], rows)}, note
