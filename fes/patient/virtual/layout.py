"""What the compiled integration works on: one record per leg, one for the belt; names instead of index numbers."""

from __future__ import annotations

from typing import Final

import numpy as np

STANCE: Final = 0
PRE_SWING: Final = 1
SWING: Final = 2

NO_EVENT: Final = 0
PLAN_DUE: Final = 1  # a planned instant has come: heel off or foot off
CONTACT: Final = 2  # initial contact
STUMBLE: Final = 3
FLAT: Final = 4  # the foot lies flat

HARMONICS: Final = 7
SERIES: Final = 1 + 2 * HARMONICS

# --- fixed while the patient lives ----------------------------------------------------------------------
_BODY = (
    "thigh_m", "shank_m", "sole_m",  # segment lengths; ankle's height over the sole
    "heel_x", "ball_x", "toe_m",  # heel and ball ahead of the ankle, toe ahead of the ball
    "foot_kg", "com_x", "inertia", "moved_kg",  # the foot; its inertia about the ankle; what moves with the ankle
    "weight_n", "leg_k", "leg_d",  # load on one leg; how firmly the leg keeps to its path
    "short_rad", "stiff", "damp",  # passive ankle: how short and stiff the calf is beyond the normal
    "spastic", "own", "own_rad",  # reflex gain; share of voluntary dorsiflexion
    "threshold_uc", "saturation_uc", "torque_max", "tau_ca", "tau_up", "tau_down", "tau_fat", "tau_rec", "fit_floor",
    "slip", "trip_ns",  # friction coefficient; drag impulse at which the foot is caught, N·s
)  # fmt: skip
# --- set anew at each event of the stride ---------------------------------------------------------------
_PLAN = (
    "due_s",  # the next planned instant
    "phase0", "phase_t", "phase_rate",  # place in the gait cycle
    "stand_x",  # where the ankle stands, belt frame
    "load_t", "load_s", "unload_t", "unload_s", "load_share",  # weight goes on, and off
    "rise_t", "rise_s", "rise_rad",  # the heel's rise to foot off
    "swing_t", "swing_s", "lift_m", "hike_m", "fall_m", "early_m", "reach_m", "circle_m", "swerve_rad", "turn_rad",
    "shift_m",
    "across_m", "yaw_rad",  # where the swing starts from
    "offset_t", "offset_s", "roll_goal",
)  # fmt: skip
# --- what evolves ---------------------------------------------------------------------------------------
_STATE = (
    "x", "vx", "ax", "z", "vz", "az", "pitch", "vpitch", "apitch", "roll", "vroll", "aroll", "toe_bend",
    "y", "vy", "ay", "yaw", "vyaw", "ayaw", "shank", "vshank", "ashank",
    "xp", "vxp", "axp", "zp", "vzp", "azp", "nominal", "vnominal", "bend",
    "heel_at", "ball_at", "toe_at", "heel_n", "ball_n", "toe_n", "drag_n",  # bristle anchors (NaN: off the ground)
    "hold", "flat_t", "own_act", "stretch1", "stretch2",
    "calcium", "recruited", "active", "fit", "torque",
    "drag_s", "drag_ns", "tripped", "toe_z", "heel_z",
)  # fmt: skip

LEG: Final = np.dtype(
    [("mode", np.int64), ("flat", np.int64)]
    + [(name, np.float64) for name in (*_BODY, *_PLAN, *_STATE)]
    + [(name, np.float64, (6,)) for name in ("offset_x", "offset_z", "offset_shank")]
    + [(name, np.float64, (SERIES,)) for name in ("thigh", "knee", "ankle")]
)
BELT: Final = np.dtype([(name, np.float64) for name in ("x", "v", "a", "goal")] + [("pulse", np.int64)])

TRACE: Final = (
    "x_m", "y_m", "z_m", "pitch_rad", "roll_rad", "yaw_rad", "shank_rad", "toe_m", "heel_m", "activation", "torque_nm",
    "fitness", "load_n", "mode",
)  # fmt: skip
