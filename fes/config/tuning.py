"""Settings of the tuning of one channel: what the foot is to reach, and within which bounds the channel may follow."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from fes import limits
from fes.config.base import Settings


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


class Tuning(Settings):
    """How one channel may tune itself from its foot's strides; off unless the session says otherwise.

    ``mode`` "suggest" only says what it would do, "act" does it. ``method`` "run_to_run" moves the current, and where
    the bounds let it fall the pulse width from mid-swing to contact, "learning" the pulse width over the time within
    the burst. ``timing`` lets start and end follow the walking speed. The targets
    are the least toe height in mid-swing, the sensor's greatest height (used where the toe's is not known), and the
    foot's pitch at initial contact (toe-up positive). The ``max_change_*`` hold for one stride.
    """

    mode: Literal["off", "suggest", "act"] = "off"
    method: Literal["run_to_run", "learning"] = "run_to_run"
    timing: bool = False
    toe_clearance_m: Band | None = None
    sensor_clearance_m: Band | None = None
    pitch_at_contact_deg: Band | None = None
    bounds: TuningBounds | None = None
    gain: float = Field(default=0.6, gt=0, le=1)
    max_change_ma: Step = Field(default=2.0, le=5.0)
    max_change_us: Step = Field(default=20.0, le=50.0)
    max_change_s: Step = Field(default=0.02, le=0.1)
    max_turn_deg: float = Field(default=20.0, gt=0, le=90)
    max_height_gained_m: float = Field(default=0.05, gt=0, le=1)

    @model_validator(mode="after")
    def _knows_where_to_and_how_far(self) -> Self:
        if self.mode == "off":
            return self
        if self.bounds is None:
            raise ValueError(
                f'mode = "{self.mode}" needs bounds (current_ma, pulse_width_us, start_delay_s, extension_s)'
            )
        if self.toe_clearance_m is None and self.sensor_clearance_m is None and self.pitch_at_contact_deg is None:
            raise ValueError(
                f'mode = "{self.mode}" needs a target: toe_clearance_m, sensor_clearance_m or pitch_at_contact_deg'
            )
        return self


def refuse_tuning(
    tuning: Tuning,
    start_phase: str,
    stop_phase: str,
    values: dict[str, float],
    caps: dict[str, float],
    frequency_hz: float,
    electrode_area_cm2: float,
    rise_s: float,
) -> None:
    """Refuse a tuning that could leave its channel's limits, or that starts outside its own bounds.

    Args:
        tuning: as set.
        start_phase: of the channel, as the next.
        stop_phase: where it ends.
        values: the channel's own current_ma, pulse_width_us, start_delay_s and extension_s.
        caps: the channel's limits by name (``ChannelLimits``).
        frequency_hz: of the channel, as the next two.
        electrode_area_cm2: for the density.
        rise_s: for the rise.

    Raises:
        ValueError: says which bound and what would be right.
    """
    if tuning.mode == "off" or tuning.bounds is None:
        return
    if start_phase not in ("pre_swing", "swing"):
        raise ValueError(f'tuning is for channels that start in "pre_swing" or "swing", not {start_phase!r}')
    bounds = tuning.bounds
    for name, value in values.items():
        allowed: Bounds = getattr(bounds, name)
        if not allowed.low <= value <= allowed.high:
            raise ValueError(
                f"tuning.bounds.{name} = {allowed.low:g} … {allowed.high:g} must contain the channel's {value:g}"
            )
    if bounds.start_delay_s.high > 1.0 or bounds.extension_s.high > 0.5:
        raise ValueError("tuning.bounds: start_delay_s goes to 1.0 at most, extension_s to 0.5")
    if bounds.extension_s.low < 0.0 and (tuning.pitch_at_contact_deg is None or stop_phase != "loading_response"):
        raise ValueError(
            "tuning.bounds.extension_s below 0 (an end before contact) needs pitch_at_contact_deg, which shows whether "
            'the heel still comes first, and stop_phase = "loading_response"'
        )
    learns = tuning.method == "learning"
    current_ma = values["current_ma"] if learns else bounds.current_ma.high
    width_us = bounds.pulse_width_us.high if learns else values["pulse_width_us"]
    density = limits.current_density_ma_per_cm2(current_ma, width_us, frequency_hz, electrode_area_cm2)
    checks = (
        (current_ma, "max_current_ma", "mA"),
        (width_us, "max_pulse_width_us", "µs"),
        (limits.charge_per_phase_uc(current_ma, width_us), "max_charge_per_phase_uc", "µC"),
        (density, "max_current_density_ma_per_cm2", "mA/cm² r.m.s."),
        (current_ma / rise_s, "max_rise_ma_per_s", "mA/s"),
    )
    for value, cap, unit in checks:
        if value > caps[cap]:
            raise ValueError(
                f"tuning could reach {value:.4g} {unit}, over this channel's {cap} = {caps[cap]:.4g}; lower its bounds"
            )
