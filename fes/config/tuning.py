"""Settings of the tuning of one channel: what the foot is to reach, and within which bounds the channel may follow."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from fes.config.base import Settings
from fes.extensions import extension_names


class Band(Settings):
    """What a measured value is to lie in, ``low`` < ``high``, in the unit that the setting's name ends with."""

    low: float = Field(ge=-90, le=90)
    high: float = Field(ge=-90, le=90)

    @model_validator(mode="after")
    def _has_width(self) -> Self:
        if self.low >= self.high:
            raise ValueError(f"low = {self.low:g} must be below high = {self.high:g}")
        return self


class Bounds(Settings):
    """From where to where tuning may move one parameter, ``low`` ≤ ``high``."""

    low: float = Field(ge=0)
    high: float = Field(ge=0)

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low = {self.low:g} must not be above high = {self.high:g}")
        return self


class EndBounds(Bounds):
    """Of ``extension_s``: below 0 the burst begins to fall before contact."""

    low: float = Field(ge=-0.1)


class TuningBounds(Settings):
    """How far each parameter may go. All are required: what must not move gets its own value at both ends."""

    current_ma: Bounds
    pulse_width_us: Bounds
    start_delay_s: Bounds
    extension_s: EndBounds


Step = Annotated[float, Field(gt=0)]
HIGHEST_TOE_M, HIGHEST_SENSOR_M = 0.2, 1.0  # in a step on even ground


class Tuning(Settings):
    """How one channel may tune itself from its foot's strides; off unless the session says otherwise.

    ``mode`` "suggest" only says what it would do, "act" does it. ``rule``: whose rule proposes, the name of another
    package's; "" for our own. ``method`` "run_to_run" moves the current, and where the bounds let it fall the pulse
    width from mid-swing to contact, "learning" the pulse widths of the burst's two parts. ``timing`` lets start and end
    follow the walking speed. The targets are the least toe height in mid-swing, the sensor's greatest height (used
    where the toe's is not known), and the foot's pitch at initial contact (toe-up positive), or, of a channel on the
    evertors, its eversion there. The ``max_change_*`` hold for one stride.
    """

    mode: Literal["off", "suggest", "act"] = "off"
    rule: str = ""
    method: Literal["run_to_run", "learning"] = "run_to_run"
    timing: bool = False
    toe_clearance_m: Band | None = None
    sensor_clearance_m: Band | None = None
    pitch_at_contact_deg: Band | None = None
    eversion_at_contact_deg: Band | None = None
    bounds: TuningBounds | None = None
    gain: float = Field(default=0.8, gt=0, le=1)
    max_change_ma: Step = Field(default=2.0, le=5.0)
    max_change_us: Step = Field(default=20.0, le=50.0)
    max_change_s: Step = Field(default=0.02, le=0.1)
    max_turn_deg: float = Field(default=20.0, gt=0, le=90)
    max_height_gained_m: float = Field(default=0.05, gt=0, le=1)

    @model_validator(mode="after")
    def _knows_where_to_and_how_far(self) -> Self:
        if self.mode == "off":
            return self
        if self.rule and self.rule not in (brought := extension_names("tuner")):
            raise ValueError(f"rule = {self.rule!r}: no installed package brings it; there are: {brought}")
        if self.bounds is None:
            needed = "bounds (current_ma, pulse_width_us, start_delay_s, extension_s)"
            raise ValueError(f'mode = "{self.mode}" needs {needed}')
        heights = {"toe_clearance_m": HIGHEST_TOE_M, "sensor_clearance_m": HIGHEST_SENSOR_M}
        for name, most_m in heights.items():
            band: Band | None = getattr(self, name)
            if band is not None and band.high > most_m:
                raise ValueError(f"{name} is in metres, at most {most_m:g}, got {band.low:g} to {band.high:g}")
        targets = (self.toe_clearance_m, self.sensor_clearance_m, self.pitch_at_contact_deg)
        if self.eversion_at_contact_deg is not None and any(targets):
            raise ValueError("eversion_at_contact_deg is the only target of its channel; the toe is another muscle's")
        if self.eversion_at_contact_deg is None and not any(targets):
            needed = "a target: toe_clearance_m, sensor_clearance_m, pitch_at_contact_deg or eversion_at_contact_deg"
            raise ValueError(f'mode = "{self.mode}" needs {needed}')
        return self
