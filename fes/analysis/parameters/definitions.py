"""What each gait parameter is: name, symbol, unit, definition and source, for tables, hover texts and documentation."""

from dataclasses import dataclass
from typing import Final

WANG = "Wang et al. 2013"
PERRY = "Perry & Burnfield 2010"
WINTER = "Winter 1992"
MARIANI = "Mariani et al. 2013"


@dataclass(frozen=True, slots=True)
class Definition:
    """One gait parameter: its ``key`` in tables, its ``name`` for people, the definition and who gives it so."""

    key: str
    name: str
    symbol: str  # as in the literature; "" where there is none
    unit: str  # of the values in tables
    shown: str  # the unit that people read, and …
    factor: float  # … what to multiply by for it
    text: str
    source: str
    scope: str = "stride"  # a value per stride and side; "walk", one for the whole walk; "sides", the two compared

    def hover(self) -> str:
        """Name, symbol, unit, definition and source in one line."""
        symbol = f" ({self.symbol})" if self.symbol else ""
        unit = f", {self.shown}" if self.shown else ""
        return f"{self.name}{symbol}{unit}: {self.text} [{self.source}]"


_CM, _DEG, _PERCENT = ("cm", 100.0), ("°", 57.29577951308232), ("%", 100.0)
_S, _M, _MPS = ("s", 1.0), ("m", 1.0), ("m/s", 1.0)


def _of(
    key: str, name: str, symbol: str, unit: str, shown: tuple[str, float], text: str, source: str, scope: str = "stride"
) -> Definition:
    return Definition(key, name, symbol, unit, shown[0], shown[1], text, source, scope)


_ALL = (
    _of("stride_length_common_m", "stride length", "SL", "m", _M,
        "horizontal distance of the foot between two of its mid-stances, scaled so that both feet go equally far",
        f"{WANG}, 4.1"),
    _of("speed_mps", "stride speed", "", "m/s", _MPS, "stride length over stride time", PERRY),
    _of("stride_time_s", "stride time", "", "s", _S, "from initial contact to the next of the same foot", PERRY),
    _of("swing_s", "swing time", "SwingT", "s", _S, "from foot off to initial contact", PERRY),
    _of("stance_s", "stance time", "StanceT", "s", _S, "from initial contact to foot off of the same foot", PERRY),
    _of("loading_response_s", "loading response", "", "s", _S,
        "from initial contact to foot flat, after the stride's swing", MARIANI),
    _of("foot_flat_s", "foot flat", "", "s", _S, "from foot flat to heel rise, in the stance before its swing",
        MARIANI),
    _of("pre_swing_s", "pre-swing", "", "s", _S, "from heel rise to foot off, before its swing", MARIANI),
    _of("swing_share", "swing share", "", "1", _PERCENT, "swing time over stride time", PERRY),
    _of("stance_share", "stance share", "", "1", _PERCENT, "stance time over stride time", PERRY),
    _of("step_time_s", "step time", "", "s", _S,
        "from the other foot's initial contact to this foot's; a step is named after the foot that ends it", PERRY),
    _of("double_support_s", "double support", "", "s", _S,
        "time in the stride in which both feet are on the ground, both parts summed", PERRY),
    _of("double_support_share", "double-support share", "", "1", _PERCENT, "double support over stride time", PERRY),
    _of("step_length_m", "step length", "", "m", _M,
        "how far ahead of the other foot this one stands after its step; only where both feet stood side by side "
        "before and after the walk, for nothing else tells how far apart two sensors are", PERRY),
    _of("deviation_m", "greatest deviation", "MDD", "m", _CM,
        "greatest sideways distance of the sensor from the straight line of its stride", f"{WANG}, 4.2"),
    _of("circumduction_m", "circumduction", "", "m", _CM,
        "greatest outward distance of the sensor from the straight line of its stride", "Kerrigan et al. 2000"),
    _of("lift_m", "lift of the sensor", "MLH", "m", _CM,
        "greatest height of the sensor above the stance before", f"{WANG}, 4.2"),
    _of("toe_clearance_m", "minimum toe clearance", "MTC", "m", _CM,
        "least height of the toe in mid-swing above the stance before; where the toe does not dip, its height at its "
        "greatest speed", WINTER),
    _of("heel_clearance_m", "heel clearance", "", "m", _CM, "greatest height of the heel", "Mariani et al. 2012"),
    _of("heel_rotation_rad", "heel lifting rotation", "MLR", "rad", _DEG,
        "greatest toe-down rotation of the foot about the axis across it, from the stance before (the paper prints the "
        "vertical axis)", f"{WANG}, 4.2"),
    _of("angle_contact_rad", "foot angle at initial contact", "", "rad", _DEG,
        "rotation about the axis across the foot at initial contact, from the stance before; toe up positive", PERRY),
    _of("angle_off_rad", "foot angle at foot off", "", "rad", _DEG,
        "the same at foot off; toe down is negative", PERRY),
    _of("position_variation_m", "position variation", "PV", "m", _CM,
        "root mean square distance of this stride's path from the one before, both warped onto each other",
        f"{WANG}, 4.2"),
    _of("orientation_variation_rad", "orientation variation", "OV", "rad", _DEG,
        "the same of the orientation, as a rotation vector", f"{WANG}, 4.2"),
    _of("height_gained_m", "height gained", "", "m", _CM, "height of the next stance above the stance before", WANG),
    _of("turn_rad", "turn", "", "rad", _DEG, "change of the foot's heading over the stride, to the left positive", ""),
    _of("walking_speed_mps", "walking speed", "WS", "m/s", _MPS,
        "distance over time of the steady strides, mean of both feet", f"{WANG}, 4.1", "walk"),
    _of("cadence_per_min", "cadence", "", "1/min", ("steps/min", 1.0), "120 s over the mean stride time in s", PERRY,
        "walk"),
    _of("walk_ratio_m_min", "walk ratio", "WR", "m·min", ("mm/(steps/min)", 1000.0),
        "mean step length (half the stride length) over cadence", "Sekiya & Nagasaki 1998", "walk"),
    _of("belt_ratio", "speed over belt", "", "1", ("", 1.0), "walking speed over the treadmill belt's", "", "walk"),
    _of("ratio", "symmetry ratio", "SR", "1", ("", 1.0),
        "paretic over other side; left over right where no side was named", "Patterson et al. 2010", "sides"),
    _of("index_percent", "symmetry index", "SI", "%", ("%", 1.0),
        "difference of the sides over their mean, in percent; 0 is symmetric", "Robinson et al. 1987", "sides"),
)  # fmt: skip

DEFINITIONS: Final[dict[str, Definition]] = {item.key: item for item in _ALL}
STRIDE_KEYS: Final = tuple(item.key for item in _ALL if item.scope == "stride")


def markdown() -> str:
    """The table of ``docs/parameters.md``."""
    rows = ["| key | name | unit | definition | source |", "|---|---|---|---|---|"]
    for item in _ALL:
        name = f"{item.name}, {item.symbol}" if item.symbol else item.name
        rows.append(f"| `{item.key}` | {name} | {item.unit} | {item.text} | {item.source} |")
    return "\n".join(rows)
