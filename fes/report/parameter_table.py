"""The report's words and gait parameters: numbers as people read them, what is usual, and which strides want care.

Published ranges are of comfortable walking over ground and depend on age, sex and height, which a session does not
know: they are there to see how far away a number is, and judge nothing.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS
from fes.analysis.parameters.gait import GaitParameters, Statistic
from fes.evaluation.agreement import CONFIDENCE, Interval, combined, mean_of
from fes.report.figures.strides import SpaceFigure, SpaceFoot
from fes.report.gait import POINTS, spread_of
from fes.report.quality import CLIPPED_ACC, CLIPPED_GYR, LOST, MEANING, SHORT, UNSURE, Flag, describe_flags
from fes.report.summary import SessionSummary
from fes.report.text import DIGITS, capitalised, count_of, mean_sd, number, readable, slug, spread, together
from fes.signals import FloatArray

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.foot import FootTrack
    from fes.analysis.hemiparetic.walk import HemipareticWalk, Windows


@dataclass(frozen=True, slots=True)
class Norm:
    """One published range: ``text`` for a table's cell, ``detail`` says of whom, ``source`` where it is from."""

    text: str
    detail: str
    source: str

    def hover(self) -> str:
        """All of it."""
        return f"{self.text}: {self.detail} [{self.source}]"


NORMS: Final[dict[str, Norm]] = {
    "walking_speed_mps": Norm(
        "0.94 … 1.43 m/s",
        "means of healthy adults at their normal pace over ground, from women of 80 and more to men of 40 to 49; a "
        "meta-analysis of 23,111 people",
        "Bohannon & Andrews 2011, Physiotherapy 97:182",
    ),
    "temporal_symmetry": Norm(
        "0.9 … 1.1",
        "95 % interval of 24 healthy people over ground",
        "Patterson et al. 2008, Arch Phys Med Rehabil 89:304",
    ),
}
# Speeds of stroke survivors and how far they usually get with them: upper bound (m/s) and name.
SPEED_CLASSES: Final = ((0.4, "household walking"), (0.8, "limited community walking"), (99.0, "community walking"))
SPEED_CLASSES_SOURCE: Final = (
    "Up to 0.4 m/s, to 0.8 m/s and above 0.8 m/s after a stroke: household, limited community and community walking "
    "[Perry et al. 1995, as in Schmid et al. 2007]. Made for walking over ground at one's own pace"
)


def speed_class(speed_mps: float) -> str:
    """Perry et al.'s class of a walking speed (m/s); "" where it is not known."""
    return next((name for bound, name in SPEED_CLASSES if speed_mps <= bound), "")


GLOSSARY: dict[str, str] = {
    "stride": "From mid-stance to the next mid-stance of the same foot (m, s). Some papers call it a step.",
    "stride length": "Horizontal distance of the foot sensor between the two mid-stances (m).",
    "clearance": "Greatest height of the sensor during the stride above its height at the start (cm).",
    "toe clearance": "Least height of the toe in mid-swing (cm); the settings, or fes analyse, say where the toe is.",
    "heel clearance": "Greatest height of the heel (cm); the settings, or fes analyse, say where the heel is.",
    "pre-swing": "From heel rise until the toe leaves the ground.",
    "swing": "The foot is off the ground, until first contact.",
    "loading response": "From first contact until the foot lies still.",
    "stance": "The foot lies still, until the heel rises again.",
    "four phases": "Pre-swing, swing, loading response and stance were all entered, in this order.",
    "T5": "The heel was lifted and put back without a swing.",
    "T6": "The swing ended in stance without a loading response being seen.",
    "valid": "The stride's numbers can be used; if not, the reason is given and it is left out of all averages.",
    "walking speed": "Distance over time of the valid strides within 30 % of the median speed (m/s); mean of feet.",
    "cadence": "Two steps per stride: 120 s divided by the mean stride time in s (steps/min).",
    "onset": "First command to stimulate, counted from the entry into pre-swing of the same foot (ms).",
    "burst": "A stretch in which a channel was commanded on without a break.",
    "charge": "Charge of one phase of all pulses (µC): counted by the stimulator, else current · width · number.",
    "outside": "Time a channel was commanded on while its foot was in a phase in which it must be off (s).",
    "latency": "From a sample's arrival to the controller's decision (ms).",
    "p50, p99": "Half, and 99 of 100, of the values are no greater than this.",
    "SD": "Standard deviation; for phase durations in percent of the mean.",
    "gate": "The safety gate: the last check before the wire. It turns a command off when in doubt and says why.",
    "pitch": "Rotation of the foot about the axis across it (°): toe up positive, 0 in the stance at the start.",
}


_MORE = {
    "CV": "Coefficient of variation: standard deviation over the size of the mean (%).",
    "interval": "The mean of endless walking just like this lies there 95 times in 100; strides are taken to be like "
    "their neighbours. It knows nothing of errors that all strides share.",
    "n": "How many steady strides the mean is of: within 30 % of the median stride's length, turning by 20° at most.",
    "usual": "What a published source found; of healthy people over ground, not of this person. "
    + "; ".join(norm.hover() for norm in NORMS.values()),
}


@dataclass(frozen=True, slots=True)
class Term:
    """``name`` is what is explained, ``text`` the explanation with unit, formula in words and source."""

    name: str
    text: str


@cache
def terms() -> dict[str, Term]:
    """By anchor: words of the report, then gait parameters."""
    found = {slug(name): Term(name, text) for name, text in (*GLOSSARY.items(), *_MORE.items())}
    for kind, name in SHORT.items():
        found[slug(f"flag {name}")] = Term(name, f"{capitalised(MEANING[kind])}.")
    for key, known in DEFINITIONS.items():
        symbol = f" ({known.symbol})" if known.symbol else ""
        unit = f" Unit: {known.shown}." if known.shown else ""
        source = f" [{known.source}]" if known.source else ""
        found[slug(key)] = Term(f"{known.name}{symbol}", f"{capitalised(known.text)}.{unit}{source}")
    found[slug("temporal_symmetry")] = Term(
        "temporal symmetry",
        "Swing over stance time of the paretic side over that of the other; left over right where no side was named. "
        f"1 is symmetric. Usual: {NORMS['temporal_symmetry'].hover()}.",
    )
    found[slug("speed_class")] = Term("speed class after stroke", f"{SPEED_CLASSES_SOURCE}.")
    return found


def parameter_slugs() -> list[str]:
    """Anchors of the gait parameters, in the table's order."""
    return [slug(key) for key in DEFINITIONS] + [slug("temporal_symmetry"), slug("speed_class")]


_TIMES: Final = (
    *("stride_time_s", "swing_s", "stance_s", "swing_share", "stance_share", "step_time_s"),
    *("double_support_s", "double_support_share"),
)
_ANGLES: Final = ("heel_rotation_rad", "angle_contact_rad", "angle_off_rad", "orientation_variation_rad", "turn_rad")
_MIXED: Final = ("speed_mps", "step_length_m", "angle_contact_rad", "angle_off_rad")  # need a contact, too


@dataclass(frozen=True, slots=True)
class SideCell:
    """One side's numbers as text; ``flagged`` of the ``n`` strides carry a flag that touches this parameter."""

    foot: str
    mean: str
    sd: str
    cv: str
    n: int
    flagged: int
    why: str


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One parameter: of a stride on both sides, or of the whole walk (then ``sides`` is one cell)."""

    key: str
    name: str
    unit: str
    sides: tuple[SideCell, ...]
    ratio: str
    index: str


@dataclass(frozen=True, slots=True)
class WalkRow:
    """One number of the whole walk; ``norm`` is what is usual and ``norm_detail`` says of whom, "" without a source."""

    key: str
    name: str
    value: str
    norm: str = ""
    norm_detail: str = ""


def flags_touching(key: str) -> frozenset[str]:
    """The kinds of flags that a stride parameter may be wrong by."""
    if key in _TIMES:
        return frozenset((LOST, UNSURE))
    kinds = {LOST, CLIPPED_GYR}
    kinds |= {UNSURE} if key in _MIXED else set()
    kinds |= set() if key in _ANGLES else {CLIPPED_ACC}
    return frozenset(kinds)


def scales_in_words(gait: GaitParameters) -> str:
    """By how much each foot's stride lengths were scaled so that both feet go equally far; "" where none was."""
    scaled = {foot: 100.0 * (scale - 1.0) for foot, scale in gait.common_scales.items() if scale != 1.0}
    return ", ".join(f"{readable(foot)} by {percent:+.2f} %" for foot, percent in scaled.items())


def parameter_rows(gait: GaitParameters, flags: Mapping[tuple[str, int], Sequence[Flag]]) -> list[ParameterRow]:
    """A row for every parameter of which anything is known."""
    rows = []
    for key in STRIDE_KEYS:
        if not any(found[key].n for found in gait.feet.values()):
            continue
        known, both = DEFINITIONS[key], gait.sides.get(key)
        cells = tuple(_cell(gait, foot, key, flags) for foot in gait.feet)
        ratio, index = (math.nan, math.nan) if both is None else (both.ratio, both.index_percent)
        rows.append(ParameterRow(key, known.name, known.shown, cells, number(ratio, 2), number(index, 1)))
    return rows


def walk_rows(gait: GaitParameters) -> list[WalkRow]:
    """Speed, cadence, walk ratio, speed over belt and temporal symmetry, those that are known."""
    walk, rows = gait.walk, []
    if math.isfinite(walk.walking_speed_mps):
        norm, kind = NORMS["walking_speed_mps"], speed_class(walk.walking_speed_mps)
        shown = f"{number(walk.walking_speed_mps, 2)} m/s"
        rows.append(WalkRow("walking_speed_mps", "walking speed", shown, norm.text, norm.hover()))
        rows.append(WalkRow("speed_class", "speed class after stroke", kind, "Perry et al. 1995", SPEED_CLASSES_SOURCE))
    for key, digits in (("cadence_per_min", 1), ("walk_ratio_m_min", 1), ("belt_ratio", 3)):
        known, value = DEFINITIONS[key], getattr(walk, key)
        if math.isfinite(value):
            rows.append(WalkRow(key, known.name, f"{number(known.factor * value, digits)} {known.shown}".strip()))
    ratio = temporal_symmetry(gait)
    if math.isfinite(ratio):
        norm = NORMS["temporal_symmetry"]
        rows.append(WalkRow("temporal_symmetry", "temporal symmetry", number(ratio, 2), norm.text, norm.hover()))
    return rows


def temporal_symmetry(gait: GaitParameters) -> float:
    """Patterson et al. (2008): swing over stance time of one side over that of the other; NaN without two feet.

    Paretic over other side, left over right where no side was named.
    """
    if set(gait.feet) != {"left_foot", "right_foot"}:
        return math.nan
    first = "right_foot" if gait.paretic == "right" else "left_foot"
    second = "left_foot" if first == "right_foot" else "right_foot"
    parts = [gait.feet[foot]["swing_s"].mean / gait.feet[foot]["stance_s"].mean for foot in (first, second)]
    return parts[0] / parts[1] if parts[1] > 0 else math.nan


def _cell(gait: GaitParameters, foot: str, key: str, flags: Mapping[tuple[str, int], Sequence[Flag]]) -> SideCell:
    value: Statistic = gait.feet[foot][key]
    known, kinds, rows = DEFINITIONS[key], flags_touching(key), gait.strides[foot]
    digits = DIGITS[known.shown]
    own = [
        [flag for flag in flags.get((foot, number), ()) if flag.kind in kinds]
        for number in rows["number"][rows["steady"] & np.isfinite(rows[key])].tolist()
    ]
    flagged = sum(bool(each) for each in own)
    why = f"{flagged} of these {value.n} strides of the {readable(foot)} may be off: {describe_flags(own)}"
    mean, sd = (number(known.factor * each, digits) for each in (value.mean, value.sd))
    return SideCell(foot, mean, sd, number(100.0 * value.cv, 1), value.n, flagged, why if flagged else "")


# --- The six numbers of the first page, each with how far it can be relied on -------------------------------


MOST: Final = 6
_OF_FEET: Final = ("stride_length_common_m", "stance_share", "toe_clearance_m", "lift_m")


@dataclass(frozen=True, slots=True)
class KeyNumber:
    """``term``: its word in the glossary. ``values``: (foot, text), the foot "" for what is of all."""

    term: str
    name: str
    values: tuple[tuple[str, str], ...]
    below: str


def key_numbers(summary: SessionSummary, gait: GaitParameters) -> list[KeyNumber]:
    """The first six that are known, in the order in which they matter to whoever treats the person."""
    return list(_known(summary, gait))[:MOST]


def _known(s: SessionSummary, gait: GaitParameters) -> Iterator[KeyNumber]:
    if s.channels:
        bursts, on_s = sum(channel.bursts for channel in s.channels), sum(channel.on_time_s for channel in s.channels)
        charge_mc = sum(channel.charge_uc for channel in s.channels) / 1e3
        counted = all(channel.charge_counted_by_device for channel in s.channels if channel.bursts)
        how = f"{count_of(bursts, 'burst')}, {on_s:.1f} s on; {'counted by the stimulator' if counted else 'estimated'}"
        how += f"; {len(s.channels)} channels together" if len(s.channels) > 1 else ""
        yield KeyNumber("charge", "Stimulation", (("", f"{charge_mc:.2f} mC"),), how)
    feet = together(list(s.feet))
    if s.exercise is None:
        below = f"usual {NORMS['walking_speed_mps'].text}"
        if s.belt_speed_mps > 0:
            below = f"belt {s.belt_speed_mps:.2f}, ratio {number(s.speed_over_belt, 3)}"
        shown = _shown(_over_feet(gait, "speed_mps", s.walking_speed_mps), 2, "m/s")
        yield KeyNumber("walking speed", "Walking speed", (("", shown),), below)
    for key in _OF_FEET[:2]:
        yield from _of_each_foot(gait, key)
    if np.isfinite(gait.walk.cadence_per_min):
        time = _over_feet(gait, "stride_time_s", 120.0 / gait.walk.cadence_per_min)
        ends = sorted((120.0 / time.low, 120.0 / time.high))
        shown = _shown(Interval(gait.walk.cadence_per_min, *ends), 1, "/min")
        yield KeyNumber("cadence", "Cadence", (("", shown),), "steps")
    lifted = [each for key in _OF_FEET[2:] for each in _of_each_foot(gait, key)]
    yield from lifted[:1]  # the toe's where it is known
    of = len(s.strides) + sum(foot.unexplained for foot in s.feet.values())
    if of:
        four = sum(row.four_phases for row in s.strides)
        low, high = share_between(four, of)
        shown = f"{100 * four / of:.0f} % ({100 * low:.0f} … {100 * high:.0f})"
        yield KeyNumber(
            "four phases", "All four phases", (("", shown),), ", ".join(filter(None, (f"{four} of {of}", feet)))
        )
    valid = sum(row.valid for row in s.strides)
    yield KeyNumber(
        "stride", "Strides", (("", f"{len(s.strides)}"),), ", ".join(filter(None, (f"{valid} valid", feet)))
    )


def share_between(count: int, of: int) -> tuple[float, float]:
    """Confidence interval of a share (Wilson, J Am Stat Assoc 22, 1927)."""
    z, share = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE), count / of
    middle, reach = share + z**2 / (2 * of), z * math.sqrt(share * (1.0 - share) / of + (z / (2 * of)) ** 2)
    low, high = (middle - reach) / (1.0 + z**2 / of), (middle + reach) / (1.0 + z**2 / of)
    return max(low, 0.0), min(high, 1.0)


def _shown(value: Interval, digits: int, unit: str) -> str:
    """``0.41 ± 0.01 m/s``; without an interval ``± –``."""
    return f"{number(value.value, digits)} ± {number(0.5 * (value.high - value.low), digits)} {unit}".rstrip()


def _values(gait: GaitParameters, foot: str, key: str) -> FloatArray:
    rows = gait.strides[foot]
    return np.asarray(rows[key][rows["steady"]], np.float64)


def _over_feet(gait: GaitParameters, key: str, value: float) -> Interval:
    """A number of the walk, with the interval of the mean of the feet's means."""
    feet = [mean_of(_values(gait, foot, key)) for foot in gait.strides]
    feet = [each for each in feet if each.n]
    return combined(value, [(1.0 / len(feet), each.error, each.freedom) for each in feet]) if feet else Interval(value)


def _of_each_foot(gait: GaitParameters, key: str) -> Iterator[KeyNumber]:
    known, means = DEFINITIONS[key], {foot: mean_of(_values(gait, foot, key)) for foot in gait.strides}
    digits = DIGITS[known.shown]
    values = []
    for foot, mean in means.items():
        if mean.n:
            own = combined(known.factor * mean.mean, [(known.factor, mean.error, mean.freedom)])
            values.append((foot, _shown(own, digits, known.shown)))
    if values:
        below = f"of {' and '.join(str(each.n) for each in means.values() if each.n)} strides"
        yield KeyNumber(key, capitalised(known.name), tuple(values), below)


# --- A walk that was looked at as a hemiparetic one: side, ground, windows and their strides -----------------


SIGNS: Final = {
    "power": "less power along the walk (the paper's sign)",
    "swing": "longer swing",
    "push_off": "heel lifted less",
    "landing": "flatter landing",
}
LEAST_STRIDES = 2
MOST_MISCOUNTED = 0.1  # of the strides


def hemiparetic_section(walk: HemipareticWalk) -> dict[str, Any]:
    """Everything of the section for the template, as text.

    ``sure``: the walk itself tells the side. ``votes``: of each sign what it looks at, which side it takes for paretic,
    and how strongly. ``terrain``: by foot, "46 level, 2 up"; ``terrain_of`` a stride, by foot and number. ``windows``:
    each foot's strides between the windows of Wang et al., mean and SD. ``miscounts``: where the windows find another
    number of strides. ``space``: the :class:`SpaceFigure`, None where there are no windows.
    """
    from fes.analysis.hemiparetic.walk import MIN_AGREEING, MIN_SCORE  # which only such a report needs

    side = walk.side
    votes = [vote for vote in side.votes.values() if math.isfinite(vote)]
    voted = "left" if sum(votes) >= 0.0 else "right"
    sure = side.score >= MIN_SCORE and side.agreeing >= MIN_AGREEING and voted == side.side
    heading = "Paretic side: not sure"
    if side.side is not None:
        why = f"by the signs of the walk (score {side.score:.2f})" if sure else "as given; the signs alone do not tell"
        heading = f"Paretic side: {side.side}, {why}"
    kinds = {readable(foot): Counter(map(str, found.values())) for foot, found in walk.terrain.items()}
    return {
        "heading": heading,
        "sign": {"left": "L", "right": "R"}.get(side.side or "", "?"),
        "sure": sure,
        "sentence": capitalised(side.describe()),
        "votes": [_vote(sign, vote) for sign, vote in side.votes.items()],
        "terrain": {f: ", ".join(f"{n} {kind}" for kind, n in own.items()) or "no strides" for f, own in kinds.items()},
        "terrain_of": {(foot, n): str(kind) for foot, found in walk.terrain.items() for n, kind in found.items()},
        "windows": [] if walk.windows is None else [_window_row(walk.windows, track) for track in _tracks(walk)],
        "no_windows": walk.no_windows,
        "miscounts": _miscounts(walk),
        "space": _space_figure(walk),
    }


def _tracks(walk: HemipareticWalk) -> list[FootTrack]:
    tracks = walk.windows.tracks if walk.windows is not None else {}
    return [tracks[foot] for foot in sorted(tracks)]


def _vote(sign: str, vote: float) -> dict[str, str]:
    side = "left" if vote > 0 else "right" if vote < 0 else "neither"
    known = {"side": "not measured", "size": "–"} if math.isnan(vote) else {"side": side, "size": f"{abs(vote):.2f}"}
    return {"sign": SIGNS.get(sign, sign), **known}


def _window_row(windows: Windows, track: FootTrack) -> dict[str, str | int]:
    return {
        "foot": track.name,
        "role": "taken for healthy" if track.name == windows.healthy else "its windows mapped",
        "threshold": f"{windows.thresholds_m2ps4[track.name]:.3f}",
        "strides": max(len(track.windows) - 1, 0),
        "length": mean_sd(spread(track.stride_lengths_m()), 2),
        "swing": mean_sd(spread(track.swing_s()), 2),
        "stance": mean_sd(spread(track.stance_s()), 2),
    }


def _miscounts(walk: HemipareticWalk) -> str:
    """What tells against the windows: another number of strides than the project's own; "" where they agree."""
    parts = []
    for track in _tracks(walk):
        own, theirs = len(walk.parameters.strides.get(track.name, ())), max(len(track.windows) - 1, 0)
        if abs(own - theirs) > MOST_MISCOUNTED * own:
            parts.append(f"{readable(track.name)} {theirs} strides where this report has {own} valid ones")
    return "; ".join(parts)


def _space_figure(walk: HemipareticWalk) -> SpaceFigure | None:
    """Wang et al.'s own Figure 5: strides between the centres of windows, without the first and the last."""
    feet = {track.name: foot for track in _tracks(walk) if (foot := _space_foot(track)) is not None}
    if not feet:
        return None
    caption = (
        "By the method of Wang et al. (2013) with its zero-velocity windows, in its visualization frame: x right, "
        "y along the walk, z up; strides stretched to the same length in time, the first and the last left out."
    )
    return SpaceFigure("windows", feet, "Strides between zero-velocity windows", caption)


def _space_foot(track: FootTrack) -> SpaceFoot | None:
    centres = track.centres.tolist()[1:-1]
    share = np.linspace(0.0, 1.0, POINTS)
    strides = []
    for first, last in pairwise(centres):
        path = track.position_m[first : last + 1] - track.position_m[first]
        places = np.linspace(0.0, 1.0, len(path))
        strides.append(np.column_stack([np.interp(share, places, column) for column in path.T]))
    if len(strides) < LEAST_STRIDES:
        return None
    every = np.array(strides)
    return SpaceFoot(every.mean(axis=0), spread_of(every), len(every))
