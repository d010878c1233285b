"""Channels, their limits and their tuning: what may be stimulated, with what, when; what the foot is to reach by it."""

from collections.abc import Iterator
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from fes import limits
from fes.config.base import Foot, Phase, Settings
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


LEAST_EXTENSION_S = 0.04  # with a predicted onset: by so much a burst begins early, and ends sooner after contact


class ChannelLimits(Settings):
    """What one channel may never exceed. Every entry is required: a missing limit means no stimulation."""

    max_current_ma: float = Field(gt=0, le=limits.MAX_CURRENT_MA)
    max_pulse_width_us: float = Field(gt=0, le=limits.MAX_PULSE_WIDTH_US)
    max_frequency_hz: float = Field(gt=0, le=limits.MAX_FREQUENCY_HZ)
    max_charge_per_phase_uc: float = Field(gt=0, le=limits.MAX_CHARGE_PER_PHASE_UC)
    max_charge_per_minute_mc: float = Field(gt=0, le=limits.MAX_CHARGE_PER_MINUTE_MC)
    max_current_density_ma_per_cm2: float = Field(gt=0, le=limits.MAX_CURRENT_DENSITY_MA_PER_CM2)
    max_rise_ma_per_s: float = Field(gt=0, le=limits.MAX_RISE_MA_PER_S)
    max_on_s: float = Field(gt=0, le=limits.MAX_ON_S)
    min_off_s: float = Field(ge=limits.MIN_OFF_S, le=10.0)


class Channel(Settings):
    """One pair of electrodes: which muscle, with what, in which part of the stride.

    The envelope rises over ``rise_s`` when the foot enters ``start_phase`` (plus ``start_delay_s``), holds,
    goes on ``extension_s`` past the entry into ``stop_phase``, and falls over ``fall_s``. It is off at once in
    any phase outside start … stop. With ``onset = "predicted"`` a burst may begin before the foot is seen to enter
    pre-swing, while this person's heel rise is foreseen well (``fes.stimulation.onset``).
    """

    name: str = Field(min_length=1, max_length=60)
    number: int = Field(ge=0, le=7)
    foot: Foot
    muscle: str = "tibialis anterior"
    electrode_area_cm2: float = Field(gt=0, le=400)
    current_ma: float = Field(gt=0, le=limits.MAX_CURRENT_MA)
    pulse_width_us: float = Field(gt=0, le=limits.MAX_PULSE_WIDTH_US)
    frequency_hz: float = Field(gt=0, le=limits.MAX_FREQUENCY_HZ)
    start_phase: Phase = "pre_swing"
    onset: Literal["detected", "predicted"] = "detected"
    start_delay_s: float = Field(default=0.0, ge=0, le=1.0)
    stop_phase: Phase = "loading_response"
    rise_s: float = Field(default=0.15, gt=0, le=1.0)
    extension_s: float = Field(default=0.06, ge=0, le=0.5)
    fall_s: float = Field(default=0.10, ge=0, le=1.0)
    never_with: tuple[int, ...] = Field(default=(), strict=False)  # TOML has lists, no tuples
    limits: ChannelLimits
    tuning: Tuning | None = None

    def _over_limits(self, current_ma: float, pulse_width_us: float) -> Iterator[tuple[str, float, str, float, str]]:
        """Which limits such pulses would break: what, its value and unit, the limit and its name."""
        charge_uc = limits.charge_per_phase_uc(current_ma, pulse_width_us)
        density = limits.current_density_ma_per_cm2(
            current_ma, pulse_width_us, self.frequency_hz, self.electrode_area_cm2
        )
        reached = (
            ("current_ma", current_ma, "mA", "max_current_ma"),
            ("pulse_width_us", pulse_width_us, "µs", "max_pulse_width_us"),
            ("frequency_hz", self.frequency_hz, "Hz", "max_frequency_hz"),
            ("current_ma · pulse_width_us", charge_uc, "µC per phase", "max_charge_per_phase_uc"),
            ("current density", density, "mA/cm² r.m.s.", "max_current_density_ma_per_cm2"),
            ("current_ma / rise_s", current_ma / self.rise_s, "mA/s", "max_rise_ma_per_s"),
        )
        for what, value, unit, name in reached:
            if value > (most := getattr(self.limits, name)):
                yield what, value, unit, most, name

    @model_validator(mode="after")
    def _plan_fits_its_limits(self) -> Self:
        for what, value, unit, most, _ in self._over_limits(self.current_ma, self.pulse_width_us):
            raise ValueError(f"{what} is {value:.4g} {unit}, over this channel's limit of {most:.4g} {unit}")
        if self.number in self.never_with:
            raise ValueError(f"never_with names the channel itself ({self.number})")
        if self.start_phase == self.stop_phase:
            raise ValueError(f"start_phase and stop_phase are both {self.start_phase!r}")
        return self

    @model_validator(mode="after")
    def _a_predicted_onset_is_a_heel_rise(self) -> Self:
        if self.onset == "predicted":
            if self.start_phase != "pre_swing" or self.start_delay_s > 0.0:
                raise ValueError('onset = "predicted" needs start_phase = "pre_swing" and start_delay_s = 0')
            if self.extension_s < LEAST_EXTENSION_S:
                raise ValueError(
                    f'onset = "predicted" needs extension_s = {LEAST_EXTENSION_S:g} at least: a burst that begins '
                    "early ends so much sooner after contact, and must not end before it"
                )
            if self.tuning is not None and self.tuning.mode != "off":
                raise ValueError('onset = "predicted" cannot be tuned: tuning learns when a burst is to begin itself')
        return self

    @model_validator(mode="after")
    def _tuning_stays_within_the_limits(self) -> Self:
        """Refuse a tuning that could leave the channel's limits, or that starts outside its own bounds."""
        tuning = self.tuning
        if tuning is None or tuning.mode == "off" or tuning.bounds is None:
            return self
        if self.start_phase not in ("pre_swing", "swing"):
            raise ValueError(f'tuning is for channels that start in "pre_swing" or "swing", not {self.start_phase!r}')
        if self.stop_phase == "swing":  # a calf's: more of it pulls the toe down
            raise ValueError('tuning is for channels that lift the foot through the swing, not to stop_phase = "swing"')
        bounds = tuning.bounds
        for name in type(bounds).model_fields:
            allowed, value = getattr(bounds, name), getattr(self, name)
            if not allowed.low <= value <= allowed.high:
                raise ValueError(
                    f"tuning.bounds.{name} = {allowed.low:g} … {allowed.high:g} must contain the channel's {value:g}"
                )
        if bounds.start_delay_s.high > 1.0 or bounds.extension_s.high > 0.5:
            raise ValueError("tuning.bounds: start_delay_s goes to 1.0 at most, extension_s to 0.5")
        contact_seen = tuning.pitch_at_contact_deg is not None and self.stop_phase == "loading_response"
        if bounds.extension_s.low < 0.0 and not contact_seen:
            raise ValueError(
                "tuning.bounds.extension_s below 0 (an end before contact) needs pitch_at_contact_deg, which shows "
                'whether the heel still comes first, and stop_phase = "loading_response"'
            )
        learns = tuning.method == "learning"
        current_ma = self.current_ma if learns else bounds.current_ma.high
        width_us = bounds.pulse_width_us.high if learns else self.pulse_width_us
        for _, value, unit, most, name in self._over_limits(current_ma, width_us):
            raise ValueError(
                f"tuning could reach {value:.4g} {unit}, over this channel's {name} = {most:.4g}; lower its bounds"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_not_asked_for(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """So that a session without tuning or prediction reads, and identifies its replays, as before there was any."""
        data: dict[str, Any] = handler(self)
        if data.get("tuning") is None:
            data.pop("tuning", None)
        if data.get("onset") == "detected":
            data.pop("onset")
        return data


class Stimulation(Settings):
    """How often commands go out, for how long they hold, and when walking counts as walking."""

    command_rate_hz: float = Field(default=50.0, ge=20, le=100)
    validity_ms: int = Field(default=limits.MAX_VALIDITY_MS, ge=20, le=limits.MAX_VALIDITY_MS)
    max_data_age_ms: int = Field(default=limits.MAX_DATA_AGE_MS, ge=10, le=limits.RADIO.max_data_age_ms)
    intensity: float = Field(default=1.0, ge=0, le=1)
    strides_before_start: int = Field(default=1, ge=0, le=20)
    min_stride_length_m: float = Field(default=0.15, ge=0, le=1.0)
    max_turn_deg: float = Field(default=35.0, gt=0, le=180)

    @model_validator(mode="after")
    def _validity_outlasts_the_period(self) -> Self:
        if self.validity_ms < 2.0 * 1000.0 / self.command_rate_hz:
            raise ValueError(
                f"validity_ms = {self.validity_ms} must be at least two command periods "
                f"({2000.0 / self.command_rate_hz:.0f} ms at command_rate_hz = {self.command_rate_hz:g})"
            )
        return self
