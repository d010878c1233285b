"""What the witness tells of sensors that lie, and of sound ones: real walks, persons apart; exit code 3 without data.

The last 65 s of every foot of the data folder and its ``unseen_walkers`` (``--seconds 1000``: all of them) are analysed
as a user would, as they are and with a lie put in: all feet as they are, of each person the first with each lie. Of the
persons in order of set and name every other one is known, the first included: on these the bounds of
``fes/witness/verdict.py`` were chosen. The others judge. docs/witness.md says what the columns are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from rich.table import Table
from scipy.stats import chi2

from benchmarks.lib.command_line import no_recordings, parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import FOOT_SETS, LYING, Foot, feet_of
from fes.analysis.pipeline import analyse
from fes.analysis.results import Analysis
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Recording, Track
from fes.signals import FloatArray
from fes.witness import Testimony, corrected

Change = Callable[[Track], Track]
NEAR = (1, 2, 5)  # strides
GREAT = 0.05  # of stride length
FEET_OF_A_PERSON = 1
ONE_PERSON = ("pyshoe_vicon", "ruler_walks")  # as far as their authors tell


def lag(ms: float) -> Change:
    def change(track: Track) -> Track:
        at = track.t_sensor_ns - 1e6 * ms
        acc = np.column_stack([np.interp(at, track.t_sensor_ns, axis) for axis in track.acc_mps2.T])
        return replace(track, acc_mps2=acc)

    return change


def gains(acc: float, gyr: float) -> Change:
    return lambda track: replace(track, acc_mps2=acc * track.acc_mps2, gyr_radps=gyr * track.gyr_radps)


def of_an_axis(nth: int, work: Callable[[FloatArray], FloatArray]) -> Change:
    """Of the gyroscope's, counted from the main one."""

    def change(track: Track) -> Track:
        gyr = track.gyr_radps.copy()
        axis = (int(np.argmax(gyr.std(axis=0))) + nth) % 3
        gyr[:, axis] = work(gyr[:, axis])
        return replace(track, gyr_radps=gyr)

    return change


def biased(degps: float) -> Change:
    return of_an_axis(0, lambda rates: rates + np.radians(degps))


def flipped(nth: int) -> Change:
    return of_an_axis(nth, np.negative)


def mirrored(track: Track) -> Track:
    mirror = np.array((1.0, 1.0, -1.0))
    return replace(track, acc_mps2=mirror * track.acc_mps2, gyr_radps=mirror * track.gyr_radps)


def exchanged(track: Track) -> Track:
    return replace(track, gyr_radps=track.gyr_radps[:, [1, 0, 2]])


def from_half(change: Change) -> Change:
    def later(track: Track) -> Track:
        half, other = len(track.gyr_radps) // 2, change(track)
        acc, gyr = (
            np.vstack((one[:half], two[half:]))
            for one, two in ((track.acc_mps2, other.acc_mps2), (track.gyr_radps, other.gyr_radps))
        )
        return replace(track, acc_mps2=acc, gyr_radps=gyr)

    return later


SOUND = "as it is"
LIES: dict[str, tuple[str, Change]] = {
    "accelerometer 20 ms late": ("lag", lag(20.0)),
    "accelerometer 20 ms early": ("lag", lag(-20.0)),
    "accelerometer 40 ms late": ("lag", lag(40.0)),
    "gyroscope × 0.9": ("gyr_gain", gains(1.0, 0.9)),
    "gyroscope × 1.1": ("gyr_gain", gains(1.0, 1.1)),
    "gyroscope × 0.8": ("gyr_gain", gains(1.0, 0.8)),
    "accelerometer × 0.9": ("acc_scale", gains(0.9, 1.0)),
    "main axis' sign": ("axes", flipped(0)),
    "left-handed": ("axes", mirrored),
    "gyroscope's x and y exchanged": ("axes", exchanged),
}
LATER: dict[str, tuple[str, Change]] = {
    f"{name}, from half time": (kind, from_half(change))
    for name, (kind, change) in {
        "accelerometer 30 ms late": ("lag", lag(30.0)),
        "gyroscope × 0.8": ("gyr_gain", gains(1.0, 0.8)),
        "accelerometer × 0.9": ("acc_scale", gains(0.9, 1.0)),
        "main axis + 15 deg/s": ("gyr_bias", biased(15.0)),
        "main axis' sign": ("axes", flipped(0)),
        "next axis' sign": ("axes", flipped(1)),
    }.items()
}
EVERY = LIES | LATER


@dataclass(frozen=True)
class Row:
    """One foot under one lie; lengths over the sound walk's, NaN where there is none."""

    lie: str
    data_set: str
    known: bool
    foot: str
    refused: bool = False
    kinds: tuple[str, ...] = ()
    silent: bool = False
    strides: int = 0
    as_read: float = float("nan")
    mended: float = float("nan")
    apart: int | None = None  # strides between the begin and the one told; None: not told, or as if always so

    @property
    def outcome(self) -> str:
        if self.refused:
            return "refused"
        if EVERY.get(self.lie, ("",))[0] in self.kinds and (self.lie not in LATER or self.apart is not None):
            return "told"
        return "as another" if self.kinds else "not known" if self.silent else "not told"


@dataclass
class Walker:
    """A foot, its half, and its sound walk."""

    foot: Foot
    known: bool
    track: Track
    lied: bool  # whether lies are put into it
    sound: Analysis | None = None
    begins_ns: FloatArray = field(default_factory=lambda: np.empty(0))


def walkers(seconds: float) -> list[Walker]:
    found, feet = [], list(feet_of(data_folder(), FOOT_SETS))
    persons = [(foot.data_set, "" if foot.data_set in ONE_PERSON else foot.person) for foot in feet]
    known, taken = set(sorted(set(persons))[::2]), dict.fromkeys(persons, 0)
    for foot, person in zip(feet, persons, strict=True):
        if foot.person in LYING:
            continue
        newest = np.maximum.accumulate(foot.track.t_sensor_ns)
        begin = int(np.searchsorted(newest, newest[-1] - round(1e9 * seconds)))
        found.append(
            Walker(foot, person in known, foot.track.part(slice(begin, None)), taken[person] < FEET_OF_A_PERSON)
        )
        taken[person] += 1
    return found


def analysed(track: Track) -> Analysis | None:
    try:
        return analyse(Recording("walk", None, {track.sensor: track}))
    except CalibrationError:
        return None


def length_m(result: Analysis | None) -> float:
    lengths = [each.stride_length_m for each in result.strides if each.valid] if result else []
    return float(np.mean(lengths)) if lengths else float("nan")


def judged(walker: Walker, name: str) -> Row:
    """One foot under one lie; as it is, its analysis is kept."""
    foot = walker.foot
    row = Row(name, foot.data_set, walker.known, f"{foot.run} {foot.track.sensor}")
    track = EVERY[name][1](walker.track) if name in EVERY else walker.track
    result = analysed(track)
    if name == SOUND:
        walker.sound = result
        walker.begins_ns = np.array([each.t_start_ns for each in result.strides] if result else [])
    if result is None:
        return replace(row, refused=True)
    told = result.testimonies.get(track.sensor) or Testimony(silent="no strides")
    true_m = length_m(walker.sound)
    mended = length_m(analysed(corrected(track, told.lies))) / true_m if told.lies else float("nan")
    return replace(
        row, kinds=tuple(lie.kind for lie in told.lies), silent=bool(told.silent), strides=len(result.strides),
        as_read=length_m(result) / true_m, mended=mended, apart=_apart(walker, told) if name in LATER else None,
    )  # fmt: skip


def _apart(walker: Walker, told: Testimony) -> int | None:
    begins = [lie.from_ns for lie in told.lies if lie.from_ns is not None]
    if not begins:
        return None
    half_ns = int(walker.track.t_sensor_ns[len(walker.track.t_sensor_ns) // 2])
    low, high = sorted((half_ns, begins[0]))
    return int(np.count_nonzero((walker.begins_ns > low) & (walker.begins_ns < high)))


# --- tables ----------------------------------------------------------------------------------------------------


def of_sound(rows: Sequence[Row]) -> Table:
    cells = []
    for half, known in (("known", True), ("unseen", False)):
        own = [row for row in rows if row.known == known and not row.refused]
        accused, strides = sum(bool(row.kinds) for row in own), sum(row.strides for row in own)
        low = 0.5 * chi2.ppf(0.025, 2 * accused) if accused else 0.0
        high = 0.5 * chi2.ppf(0.975, 2 * accused + 2)
        rate = " ".join(f"{1e3 * value / strides:.2f}" for value in (accused, low, high)).split()
        doubt = sum(row.silent for row in own)
        cells.append((half, str(len(own)), str(strides), str(doubt), str(accused), f"{rate[0]} [{rate[1]}, {rate[2]}]"))
    columns = ("persons", "feet", "strides", "not known", "accused", "false findings per 1,000 strides [95 %]")
    return table_of("Sound sensors", columns, cells)


OUTCOMES = ("refused", "told", "as another", "not known", "not told")


def of_lies(rows: Sequence[Row], names: Sequence[str]) -> Iterator[Table]:
    for half, known in (("unseen", False), ("known", True)):
        cells = []
        for name in names:
            own = [row for row in rows if row.lie == name and row.known == known]
            counts = [sum(row.outcome == outcome for row in own) for outcome in OUTCOMES]
            grave = [row for row in own if row.refused or abs(row.as_read - 1.0) > GREAT]
            right = sum(row.outcome == "told" for row in grave)
            green = sum(row.outcome == "not told" for row in grave)
            mended = [row.mended for row in own if row.outcome == "told"]
            moved = f"{len(grave)}: {right}, {len(grave) - right - green}, {green}"
            read, right_m = (spread(each, ".3f") for each in ([row.as_read for row in own], mended))
            cells.append((name, str(len(own)), *map(str, counts), read, right_m, moved))
        columns = (
            "lie", "feet", *OUTCOMES, "length as read", "length corrected",
            "moved by > 5 %: told, refused or marked, neither",
        )  # fmt: skip
        yield table_of(f"Lies, {half} persons", columns, cells)


def by_set(rows: Sequence[Row], names: Sequence[str]) -> Table:
    sets = sorted({row.data_set for row in rows})
    cells = []
    for name in names:
        found = []
        for data_set in sets:
            own = [row for row in rows if row.lie == name and row.data_set == data_set and not row.refused]
            counts = [sum(row.outcome == outcome for row in own) for outcome in ("told", "as another")]
            found.append(f"{counts[0]}, {counts[1]} of {len(own)}" if own else "–")
        cells.append((name, *found))
    return table_of("Told as itself, as another, of feet not refused, by set", ("lie", *sets), cells)


def of_begins(rows: Sequence[Row], names: Sequence[str]) -> Table:
    cells = []
    for name in names:
        for half, known in (("unseen", False), ("known", True)):
            own = [row for row in rows if row.lie == name and row.known == known and not row.refused]
            apart = [row.apart for row in own if row.outcome == "told" and row.apart is not None]
            near = [str(sum(each <= limit for each in apart)) for limit in NEAR]
            cells.append(
                (name, half, str(len(own)), *near, str(len(apart) - int(near[-1])), str(len(own) - len(apart)))
            )
    columns = ("lie", "persons", "feet", *(f"within {limit}" for limit in NEAR), "farther", "never")
    return table_of("Strides between the begin of a lie and the one told", columns, cells)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--lies", nargs="*", choices=list(EVERY), default=list(EVERY))
    parser.add_argument("--seconds", type=float, default=65.0)
    options = parser.parse_args()
    feet = walkers(options.seconds)
    if not feet:
        return no_recordings(data_folder())
    sound = [judged(walker, SOUND) for walker in feet]
    rows = [judged(walker, name) for name in options.lies for walker in feet if walker.lied and walker.sound]
    accused = [f"{row.foot}: {', '.join(row.kinds)}" for row in sound if row.kinds]
    later = [name for name in options.lies if name in LATER]
    tables = [of_sound(sound)]
    tables += [*of_lies(rows, options.lies), by_set(rows, options.lies)] if rows else []
    tables += [of_begins(rows, later)] if later else []
    notes = [f"Accused as they are: {'; '.join(accused) or 'none'}."]
    notes.append(f"{sum(row.refused for row in sound)} feet are refused as they are and judged no further.")
    publish(tables, options, notes, data_folder())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
