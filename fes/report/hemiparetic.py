"""What the report says of a walk that was looked at as a hemiparetic one: side, ground, windows and their strides."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from fes.analysis.hemiparetic.walk import MIN_AGREEING, MIN_SCORE
from fes.report.figures.strides import SpaceFigure, SpaceFoot
from fes.report.gait import POINTS, spread_of
from fes.report.text import capitalised, mean_sd, readable, spread
from fes.walk_record import Finding

if TYPE_CHECKING:
    from fes.analysis.hemiparetic.foot import FootTrack
    from fes.analysis.hemiparetic.walk import HemipareticWalk, Windows

SIGNS: Final = {
    "power": "less power along the walk (the paper's sign)",
    "swing": "longer swing",
    "push_off": "heel lifted less",
    "landing": "flatter landing",
}
LEAST_STRIDES = 2
MOST_MISCOUNTED = 0.1  # of the strides


@dataclass(frozen=True)
class HemipareticSection:
    """Everything of the section as text, ``space`` None where there are no windows.

    ``sure``: the walk itself tells the side. ``votes``: of each sign what it looks at, which side it takes for paretic,
    and how strongly. ``terrain``: by foot, "46 level, 2 up". ``windows``: each foot's strides between the windows of
    Wang et al., mean and SD. ``miscounts``: where the windows find another number of strides.
    """

    heading: str
    sign: str
    sure: bool
    sentence: str
    votes: tuple[dict[str, str], ...]
    terrain: dict[str, str]
    terrain_of: dict[tuple[str, int], str]
    windows: tuple[dict[str, str | int], ...]
    no_windows: str
    miscounts: str
    space: SpaceFigure | None

    @property
    def finding(self) -> Finding:
        """For the first page."""
        return Finding("info", f"{self.heading}. See under Hemiparetic walk how the signs agree; it is no diagnosis.")


def hemiparetic_section(walk: HemipareticWalk) -> HemipareticSection:
    """Put the walk into words."""
    side = walk.side
    votes = [vote for vote in side.votes.values() if math.isfinite(vote)]
    voted = "left" if sum(votes) >= 0.0 else "right"
    sure = side.score >= MIN_SCORE and side.agreeing >= MIN_AGREEING and voted == side.side
    heading = "Paretic side: not sure"
    if side.side is not None:
        why = f"by the signs of the walk (score {side.score:.2f})" if sure else "as given; the signs alone do not tell"
        heading = f"Paretic side: {side.side}, {why}"
    kinds = {readable(foot): Counter(map(str, found.values())) for foot, found in walk.terrain.items()}
    return HemipareticSection(
        heading=heading,
        sign={"left": "L", "right": "R"}.get(side.side or "", "?"),
        sure=sure,
        sentence=capitalised(side.describe()),
        votes=tuple(_vote(sign, vote) for sign, vote in side.votes.items()),
        terrain={f: ", ".join(f"{n} {kind}" for kind, n in own.items()) or "no strides" for f, own in kinds.items()},
        terrain_of={(foot, n): str(kind) for foot, found in walk.terrain.items() for n, kind in found.items()},
        windows=() if walk.windows is None else tuple(_window_row(walk.windows, track) for track in _tracks(walk)),
        no_windows=walk.no_windows,
        miscounts=_miscounts(walk),
        space=_space_figure(walk),
    )


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
