"""What a comparison says in numbers: each parameter of each side, the phases, and the symmetry of the sides.

How much a parameter must change before day-to-day error cannot explain it stands beside it where that was found in
print, with its people and its setting.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS, Definition
from fes.evaluation.agreement import Interval, Mean, combined, difference, mean_of, symmetry_index
from fes.report.comparison.session import PHASES, ComparedSession, Side
from fes.report.glossary import GLOSSARY
from fes.report.text import DIGITS, readable
from fes.signals import FloatArray

KESAR: Final = (
    "Kesar et al. 2011, Gait & Posture 33:314–317: 19 people with chronic stroke on a treadmill, two sessions three "
    "weeks apart; 3.2–4.2 % of the gait cycle for temporal variables (the larger is taken), 6.7 cm for paretic step "
    "length"
)
HOSOI: Final = (
    "Hosoi et al. 2023, Frontiers in Neurology 14:1219505: 84 people after stroke, comfortable speed over 10 m; "
    "0.05 m/s below 0.4 m/s, 0.11 m/s up to 0.8 m/s, 0.21 m/s above"
)
_LEAST: Final = {"swing_share": 0.042, "stance_share": 0.042, "double_support_share": 0.042, "step_length_m": 0.067}
KEY: Final = (
    *("speed_mps", "stride_length_common_m", "stride_time_s", "step_length_m", "toe_clearance_m", "angle_contact_rad"),
    *("circumduction_m", "swing_share", "double_support_share"),
)
SYMMETRIC: Final = ("step_length_m", "step_time_s", "swing_s", "stance_s", "toe_clearance_m", "lift_m")
# spatiotemporal parameters and joint kinematics change with speed: Fukuchi et al. 2019, Systematic Reviews 8:153;
# so does minimum toe clearance: De Asha & Buckley 2015 (PMC4361493)
WITH_SPEED: Final = (
    *("stride_length_common_m", "speed_mps", "stride_time_s", "swing_s", "stance_s", "swing_share", "stance_share"),
    *("step_time_s", "double_support_s", "double_support_share", "step_length_m", "lift_m", "toe_clearance_m"),
    *("heel_clearance_m", "heel_rotation_rad", "angle_contact_rad", "angle_off_rad"),
    *("phase_pre_swing", "phase_swing", "phase_loading_response", "phase_stance"),
)
Pick: TypeAlias = Callable[[Side, Definition], FloatArray | None]


@dataclass(frozen=True, slots=True)
class DetectableChange:
    """The least change (SI) beyond day-to-day error, and who found it in whom."""

    value: float
    source: str


def detectable_change(key: str, first_speed_mps: float, *, belt: bool) -> DetectableChange | None:
    """For one parameter, None where no source is known.

    Args:
        key: of :data:`fes.analysis.parameters.definitions.DEFINITIONS`.
        first_speed_mps: the walking speed of the session that the others are held against.
        belt: any of the sessions was on a treadmill, whose speed is not the patient's choice.
    """
    if key in _LEAST:
        return DetectableChange(_LEAST[key], KESAR)
    if key == "speed_mps" and not belt and first_speed_mps > 0.0:
        least = 0.05 if first_speed_mps < 0.4 else 0.11 if first_speed_mps <= 0.8 else 0.21
        return DetectableChange(least, HOSOI)
    return None


@dataclass(frozen=True)
class ParameterRow:
    """One parameter of one side in all sessions; ``changes`` are of the later ones against the first, SI."""

    about: Definition
    side: str
    means: tuple[Mean, ...]
    changes: tuple[Interval, ...]
    detectable: DetectableChange | None

    @property
    def digits(self) -> int:
        """How many decimals are shown."""
        return DIGITS.get(self.about.shown, 2)

    @property
    def with_speed(self) -> bool:
        """Whether it is known to change with walking speed."""
        return self.about.key in WITH_SPEED

    def clear(self, k: int) -> bool:
        """Whether the interval of change ``k`` leaves zero out."""
        change = self.changes[k]
        return change.low > 0.0 or change.high < 0.0  # NaN limits are not clear

    def beyond(self, k: int) -> bool:
        """Whether change ``k`` is clear, and greater than the least detectable one."""
        return self.detectable is not None and self.clear(k) and abs(self.changes[k].value) > self.detectable.value


@dataclass(frozen=True)
class SymmetryRow:
    """The symmetry index (percent, 0 is symmetric) of one parameter in all sessions, and its changes."""

    about: Definition
    first: str
    second: str
    indices: tuple[Interval, ...]
    changes: tuple[Interval, ...]

    def nearer(self, k: int) -> bool | None:
        """Whether session ``k + 1`` is nearer to symmetry than the first; None where that is not clear."""
        change = self.changes[k]
        if not (change.low > 0.0 or change.high < 0.0):
            return None
        return abs(self.indices[k + 1].value) < abs(self.indices[0].value)


def parameter_rows(sessions: Sequence[ComparedSession]) -> list[ParameterRow]:
    """Of every stride parameter that at least two sessions know, both sides, in the order of the definitions."""
    return _rows(sessions, [DEFINITIONS[key] for key in STRIDE_KEYS], lambda side, about: side.values.get(about.key))


def phase_rows(sessions: Sequence[ComparedSession]) -> list[ParameterRow]:
    """Of the four phases, both sides."""
    names = {phase: readable(phase) for phase in PHASES}
    unit, source = ("", "s", "s", 1.0), "Negård et al. 2005"
    abouts = [Definition(f"phase_{p}", f"{name} (phase)", *unit, GLOSSARY[name], source) for p, name in names.items()]
    return _rows(sessions, abouts, lambda side, about: side.phases.get(about.key.removeprefix("phase_")))


def _rows(sessions: Sequence[ComparedSession], abouts: Sequence[Definition], pick: Pick) -> list[ParameterRow]:
    belt = any(session.summary.belt_speed_mps > 0.0 for session in sessions)
    speed = sessions[0].summary.walking_speed_mps
    rows = []
    for about in abouts:
        for side in ("left", "right"):
            known = [pick(one.sides[side], about) if side in one.sides else None for one in sessions]
            means = tuple(mean_of(() if values is None else values) for values in known)
            if sum(mean.n > 0 for mean in means) < 2:
                continue
            changes = tuple(difference(means[0], mean) for mean in means[1:])
            rows.append(ParameterRow(about, side, means, changes, detectable_change(about.key, speed, belt=belt)))
    return rows


def symmetry_rows(sessions: Sequence[ComparedSession], paretic: str | None = None) -> list[SymmetryRow]:
    """Of the parameters in which sides differ: ``paretic`` against the other side, left against right without it."""
    first = paretic or "left"
    second = "right" if first == "left" else "left"
    rows = []
    for key in SYMMETRIC if all({"left", "right"} <= set(session.sides) for session in sessions) else ():
        values = [[mean_of(one.sides[side].values.get(key, ())) for side in (first, second)] for one in sessions]
        found = [symmetry_index(*each) for each in values]
        if not all(math.isfinite(value) for value, _ in found):
            continue
        before, parts_before = found[0]
        changes = tuple(combined(value - before, parts + parts_before) for value, parts in found[1:])
        indices = tuple(combined(value, parts) for value, parts in found)
        rows.append(SymmetryRow(DEFINITIONS[key], first, second, indices, changes))
    return rows
