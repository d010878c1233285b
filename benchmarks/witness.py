"""What the witness tells of sensors that lie, and of sound ones: real walks, persons apart.

    python benchmarks/witness.py [--lies NAME …] [--seconds S] [--json FILE]

The last 65 s of every foot of the data folder ($FES_DATA, "known") and its ``unseen_walkers`` ("unseen") are taken as
they are and with a lie put in, and analysed as a user would. The bounds of ``fes/witness/verdict.py`` were chosen
looking at all of these sets: a figure
of a set that was looked at describes, it does not prove.

By set: feet; refused by calibration; told as what it is; told as something else; not told; and the stride length over
that of the sound walk as read, and where it was told, corrected. A refused foot is not told, but gives no number.
Exit code 3 without data.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from command_line import console_of, parser_of, save
from every_walker import Foot, gaitmap, measured_walks, pyshoe_vicon, ruler_walks, stroke_treadmill, stroke_walks
from rich.table import Table
from stroke_treadmill import data_folder

from fes.analysis.pipeline import analyse
from fes.analysis.results import Analysis
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Recording, Track
from fes.witness import corrected

Change = Callable[[Track], Track]


def lag(ms: float) -> Change:
    def change(track: Track) -> Track:
        at = track.t_sensor_ns - 1e6 * ms
        acc = np.column_stack([np.interp(at, track.t_sensor_ns, axis) for axis in track.acc_mps2.T])
        return replace(track, acc_mps2=acc)

    return change


def gain(factor: float) -> Change:
    return lambda track: replace(track, gyr_radps=factor * track.gyr_radps)


def bias_step(track: Track) -> Track:
    gyr = track.gyr_radps.copy()
    gyr[len(gyr) // 2 :, int(np.argmax(gyr.std(axis=0)))] += np.radians(15.0)
    return replace(track, gyr_radps=gyr)


def flipped(track: Track) -> Track:
    gyr = track.gyr_radps.copy()
    gyr[len(gyr) // 2 :, int(np.argmax(gyr.std(axis=0)))] *= -1.0
    return replace(track, gyr_radps=gyr)


def mirrored(track: Track) -> Track:
    mirror = np.array((1.0, 1.0, -1.0))
    return replace(track, acc_mps2=mirror * track.acc_mps2, gyr_radps=mirror * track.gyr_radps)


LIES: dict[str, tuple[str, Change]] = {
    "sound": ("", lambda track: track),
    "acc 20 ms late": ("lag", lag(20.0)),
    "acc 20 ms early": ("lag", lag(-20.0)),
    "acc 40 ms late": ("lag", lag(40.0)),
    "gyr × 0.9": ("gyr_gain", gain(0.9)),
    "gyr × 1.1": ("gyr_gain", gain(1.1)),
    "gyr × 0.8": ("gyr_gain", gain(0.8)),
    "bias 15 deg/s at half time": ("gyr_bias", bias_step),
    "sign of the main axis at half time": ("axes", flipped),
    "left-handed": ("axes", mirrored),
}


@dataclass
class Row:
    """One foot under one lie; lengths over the sound walk's, NaN where there is none."""

    lie: str
    data_set: str
    foot: str
    refused: bool = False
    kinds: tuple[str, ...] = ()
    strides: int = 0
    as_read: float = float("nan")
    mended: float = float("nan")


def feet() -> Iterator[Foot]:
    base = data_folder()
    for part, folder in (("known", base), ("unseen", base / "unseen_walkers")):
        yield from stroke_treadmill(folder, part)
        yield from measured_walks(pyshoe_vicon(folder), part, lambda name: name[:10])
        yield from measured_walks(ruler_walks(folder), part, lambda name: name)
        yield from gaitmap(folder, part)
        yield from stroke_walks(folder, part)


def last(track: Track, seconds: float) -> Track:
    newest = np.maximum.accumulate(track.t_sensor_ns)
    return track.part(slice(int(np.searchsorted(newest, newest[-1] - round(1e9 * seconds))), None))


def analysed(track: Track) -> Analysis | None:
    try:
        return analyse(Recording("walk", None, {track.sensor: track}))
    except CalibrationError:
        return None


def length_m(result: Analysis | None) -> float:
    lengths = [each.stride_length_m for each in result.strides if each.valid] if result else []
    return float(np.mean(lengths)) if lengths else float("nan")


def judged(foot: Foot, name: str, seconds: float, true_m: float) -> Row:
    track = LIES[name][1](last(foot.track, seconds))
    row = Row(name, f"{foot.data_set}, {foot.part.partition(',')[0]}", f"{foot.run} {foot.track.sensor}")
    result = analysed(track)
    if result is None:
        row.refused = True
        return row
    told = result.testimonies.get(track.sensor)
    row.kinds = tuple(lie.kind for lie in told.lies) if told else ()
    row.strides, row.as_read = len(result.strides), length_m(result) / true_m
    if told and told.lies:
        row.mended = length_m(analysed(corrected(track, told.lies))) / true_m
    return row


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--lies", nargs="*", choices=list(LIES), default=list(LIES))
    parser.add_argument("--seconds", type=float, default=65.0)
    options = parser.parse_args()
    every = list(feet())
    if not every:
        print("No recordings; set FES_DATA.", file=sys.stderr)
        return 3
    rows: list[Row] = []
    for foot in every:
        true_m = length_m(analysed(last(foot.track, options.seconds)))
        rows += [judged(foot, name, options.seconds, true_m) for name in options.lies]
    table = Table("lie", "set", "feet", "refused", "told", "as another", "not told", "length as read", "corrected")
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row.lie, row.data_set].append(row)
    for (name, data_set), own in sorted(groups.items(), key=lambda item: list(LIES).index(item[0][0])):
        kind, used = LIES[name][0], [row for row in own if not row.refused]
        right = [row for row in used if kind in row.kinds]
        other = [row for row in used if row.kinds and kind not in row.kinds]
        spread = [
            "–" if not len(values) else f"{np.median(values):.3f} [{np.min(values):.3f}, {np.max(values):.3f}]"
            for values in (
                np.array([v for v in (row.as_read for row in used) if v == v]),
                np.array([v for v in (row.mended for row in right) if v == v]),
            )
        ]
        counts = len(own), len(own) - len(used), len(right), len(other), len(used) - len(right) - len(other)
        table.add_row(name, data_set, *map(str, counts), *spread)
    console_of(150).print(table)
    save([asdict(row) for row in rows], options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
