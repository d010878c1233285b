"""What flows through the controller: frozen values in SI units, no logic.

Times are integer nanoseconds of one monotonic clock (the host's when live, the recording's in replay).
Vectors are in the sensor's own frame unless the name says otherwise.
"""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
Vector3: TypeAlias = tuple[float, float, float]

FOOT_SENSORS = ("left_foot", "right_foot")
SHANK_SENSORS = ("left_shank", "right_shank")
SENSORS = FOOT_SENSORS + SHANK_SENSORS

G_MPS2 = 9.80665
NS_PER_S = 1_000_000_000
MID_SWING_BEGIN, MID_SWING_END = 0.25, 0.80  # of the swing: the toe has left the ground, and passes low once more


class ImuSample(NamedTuple):
    """One sample of one sensor; a named tuple, for it is made 0.4 µs faster than a frozen dataclass, and so often.

    ``t_ns`` is when it reached the host, ``t_sensor_ns`` what the sensor's own clock said (mapped to the same
    origin); ``acc_mps2`` is specific force (+9.81 along the upward axis at rest).
    """

    t_ns: int
    sensor: str
    t_sensor_ns: int
    acc_mps2: Vector3
    gyr_radps: Vector3


@dataclass(frozen=True, slots=True)
class Tick:
    """Time has passed and nothing came: silence is an event too."""

    t_ns: int


class OperatorAction(StrEnum):
    """What a person can ask for."""

    ARM = "arm"
    DISARM = "disarm"
    EMERGENCY_STOP = "emergency_stop"
    SET_INTENSITY = "set_intensity"
    TEST_BURST = "test_burst"
    TRIGGER = "trigger"
    EXERCISE = "exercise"
    SET_BELT_SPEED = "set_belt_speed"
    SET_INCLINE = "set_incline"
    FREE_GROUND = "free_ground"
    FREEZE_TUNING = "freeze_tuning"
    RESUME_TUNING = "resume_tuning"
    ACCEPT_SUGGESTION = "accept_suggestion"
    ROLL_BACK = "roll_back"


GROUND_ACTS = frozenset((OperatorAction.SET_INCLINE, OperatorAction.FREE_GROUND))  # what is walked on, and no more


@dataclass(frozen=True, slots=True)
class RawSample:
    """One sample as the device gave it, in SI units.

    ``t_host_ns``: when it was read. ``t_device_ns``: the device's own clock, unwrapped; it may jump.
    """

    sensor: str
    t_host_ns: int
    t_device_ns: int
    acc_mps2: Vector3
    gyr_radps: Vector3


@dataclass(frozen=True, slots=True)
class OperatorAct:
    """A person acted.

    ``value`` is the intensity (0–1) for SET_INTENSITY, the channel's number for TEST_BURST (a short burst at rest),
    TRIGGER (a burst now, as at the start of a step), EXERCISE (one of a set that a person has armed),
    ACCEPT_SUGGESTION (what its tuning last suggested) and ROLL_BACK (to the session's own settings), the belt's speed
    in m/s for SET_BELT_SPEED, what the ground rises per horizontal distance for SET_INCLINE; unused otherwise, also for
    FREE_GROUND (stairs, ramps: nobody knows), which is an action of its own so that no value is NaN. ``why`` is what
    made the session freeze its tuning by itself, when a person armed it; "" for what a person asked for.
    """

    t_ns: int
    action: OperatorAction
    value: float = 0.0
    why: str = ""


@dataclass(frozen=True, slots=True)
class StimStatus:
    """The stimulator's answer to one command: what it delivers now.

    ``counter`` echoes the command's counter (0–15). ``pulses`` and ``charge_uc`` count what the channel has
    delivered since the device's previous status of that channel. ``fault`` is "" when all is well.
    """

    t_ns: int
    channel: int
    counter: int
    on: bool
    current_ma: float
    pulse_width_us: float
    frequency_hz: float
    pulses: int = 0
    charge_uc: float = 0.0
    fault: str = ""


@dataclass(frozen=True, slots=True)
class StimAlive:
    """The stimulator's own heartbeat: ``boot_id`` changes when it restarts, ``fault`` is "" when all is well."""

    t_ns: int
    boot_id: int
    rejected: int
    fault: str = ""


@dataclass(frozen=True, slots=True)
class StimOpened:
    """The stimulator was opened again after it had been lost: commands go out under a new session identifier."""

    t_ns: int
    session_id: int


@dataclass(frozen=True, slots=True)
class FootSwitchEvent:
    """A switch under the foot closed (``pressed``) or opened; None: it has fallen silent, and nobody knows."""

    t_ns: int
    foot: str
    pressed: bool | None


@dataclass(frozen=True, slots=True)
class SystemFault:
    """The session found in itself what forbids stimulation: a sensor or the stimulator lost, a loop that stalled."""

    t_ns: int
    text: str


Event: TypeAlias = ImuSample | Tick | OperatorAct | StimStatus | StimAlive | StimOpened | FootSwitchEvent | SystemFault


@dataclass(frozen=True, slots=True)
class StimRequest:
    """What the plan asks for one channel; off is its own request, not 0 mA."""

    channel: int
    on: bool
    current_ma: float = 0.0
    pulse_width_us: float = 0.0
    frequency_hz: float = 0.0


@dataclass(frozen=True, slots=True)
class StimCommand:
    """What the gate lets out for one channel.

    ``validity_ms``: how long the device may act on it without a newer one. ``refused`` says in words why an
    asked-for stimulation became off; "" when the request went through as it was.
    """

    t_ns: int
    channel: int
    on: bool
    current_ma: float
    pulse_width_us: float
    frequency_hz: float
    validity_ms: int
    refused: str = ""


@dataclass(frozen=True, slots=True)
class WireFrame:
    """Bytes as they went onto the wire (CAN: identifier and payload)."""

    t_ns: int
    identifier: int
    data: bytes


@dataclass(frozen=True, slots=True)
class StrideResult:
    """One stride of one foot, from quietest instant to quietest instant of the stances around its swing.

    Negård et al. (2005) call this a step; in today's terms it is a stride. Position is in a frame with z up
    against gravity and x along the stride's own direction, origin at the start: ``trajectory_m`` (K, 3),
    ``pitch_rad`` (K,) and ``roll_rad`` (K,) at K equally spaced times from ``t_start_ns`` to ``t_end_ns``. Pitch is the
    angle of the foot's long axis against the horizontal, toe up positive; roll that of its mediolateral axis, inner
    side up (inversion, the sole turning inward) positive on both feet; both are 0 in the starting stance. Roll is empty
    of a shank. ``stride_length_sd_m`` is the length's uncertainty, ``free_rise_m`` the height gained
    by the sensor alone, whatever the ground is said to be, ``clearance_m`` the sensor's greatest height over the line
    from start to end; ``toe_clearance_m`` the least height of the toe in mid-swing and ``heel_clearance_m`` the heel's
    greatest height, NaN unless the session says where the sensor sits. The ``t_*`` phase entries are None where the
    stride did not pass that phase. ``left_over`` (6,) is what a sound sensor at rest would have left over at its end
    (:func:`fes.estimation.closures.closures`); empty of a shank and off-line. ``valid`` is False, with ``reason``,
    where the numbers must not be used.
    """

    foot: str
    number: int
    t_start_ns: int
    t_end_ns: int
    stride_length_m: float = math.nan
    clearance_m: float = math.nan
    height_gained_m: float = math.nan
    turn_rad: float = math.nan
    speed_mps: float = math.nan
    t_pre_swing_ns: int | None = None
    t_swing_ns: int | None = None
    t_loading_response_ns: int | None = None
    t_stance_ns: int | None = None
    toe_clearance_m: float = math.nan
    heel_clearance_m: float = math.nan
    valid: bool = True
    reason: str = ""
    trajectory_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)), compare=False, repr=False)
    pitch_rad: FloatArray = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)
    roll_rad: FloatArray = field(default_factory=lambda: np.zeros(0), compare=False, repr=False)
    stride_length_sd_m: float = field(default=math.nan, compare=False)  # not in session logs
    free_rise_m: float = field(default=math.nan, compare=False)  # nor this
    left_over: tuple[float, ...] = field(default=(), compare=False, repr=False)  # nor these
