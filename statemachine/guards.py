"""The six guards T1–T6 as pure predicates over one sample's features.

Plain functions of plain numbers: ``transitions`` calls them as they are, and the estimation core compiles the very same
functions. Source: Negård et al. (2005), "Gait Phases Detection". Departures, each said where it is made:
thresholds are physical rates, so that one setting holds from 100 Hz to 1 kHz, and T2 and T3 wait for the part of the
swing in which their feature means what the paper takes it to mean.
"""

from typing import NamedTuple

FORMER_NAMES = {"contact_jump_mps3": "contact_jerk_mps3", "vertical_jump_mps3": "vertical_jerk_mps3"}  # in old files


class Features(NamedTuple):
    """What the guards may look at, at one sample of one foot. All causal.

    ``toe_down_*`` is about the mediolateral axis, toe-down (plantarflexion) positive. ``toe_down_peak_radps`` is the
    greatest toe-down rate since pre-swing began and ``toe_up_peak_radps`` the greatest toe-up rate since swing began
    (both not negative). ``vertical_jerk_mps3`` is the change of vertical acceleration over the last 10 ms, per second.
    ``resting_s`` is how long neither sensor has seen movement.
    """

    a_rest: bool
    g_rest: bool
    toe_down_radps: float
    toe_down_change_radps2: float
    toe_down_peak_radps: float
    toe_up_peak_radps: float
    vertical_jerk_mps3: float
    in_phase_s: float
    resting_s: float


class Thresholds(NamedTuple):
    """Limits of the guards, in physical units.

    ``fes.estimation.foot.calibration`` fits ``rest_gyr_radps``, ``min_toe_down_peak_radps``, ``rest_hold_s`` and
    ``contact_jerk_mps3`` to the person.
    """

    rest_gyr_radps: float = 0.7  # T1, T4–T6: at rest below (as a constant, 0.7 lets 98 % of strides pass)
    min_toe_down_peak_radps: float = 0.8  # T2: no push-off has been seen below this rate
    rest_acc_mps2: float = 1.2  # T1, T4–T6: at rest while |f| is this close to gravity
    turned_acc_mps2: float = 1.0  # T1: moving once f has turned this far from its mean in this stance
    leave_gyr: float = 1.8  # T1: a resting gyroscope counts as moving only above its limit times this
    leave_acc: float = 1.8  # T1: the same of the accelerometer, which every jolt of the floor shakes
    still_speed_mps: float = 0.25  # T4–T6: at rest only below this dead-reckoned speed …
    still_speed_share: float = 0.35  # … or below this share of the swing's greatest …
    long_rest_s: float = 0.3  # … or after being still for this long
    rest_hold_s: float = 0.03  # T4–T6: at rest for this long, so that a zero crossing is no rest
    push_off_drop: float = 0.05  # T2: the rate has fallen by this share of its peak, so that a ripple is no peak
    swing_at_reversal: bool = False  # T2: wait until the foot turns toe-up (the paper's text, not its formula)
    contact_jerk_mps3: float = 600.0  # T3: jump of vertical acceleration
    min_swing_s: float = 0.12  # T3: toe-off jolts end before, no swing is shorter
    mid_swing_share: float = 0.25  # T3: mid-swing's toe-up rate is at least this share of push-off's toe-down rate
    rising_share: float = 0.3  # T3: the toe-up rate has fallen to this share of its peak: mid-swing is over
    late_swing_s: float = 0.45  # T3: from then on, with no mid-swing peak to wait for (a dragged foot)
    soft_contact_rest_s: float = 0.15  # T6: a swinging foot may seem to rest for a tenth of a second before it lands
    still_change_radps2: float = 15.0  # T6: d1 of the paper
    still_rate_radps: float = 0.5  # T6: d2 of the paper


def t1(x: Features, p: Thresholds) -> bool:
    """Stance → pre-swing: both sensors say that the foot moves."""
    return not x.a_rest and not x.g_rest


def t2(x: Features, p: Thresholds) -> bool:
    """Pre-swing → swing: one sensor moves, and the toe-down rate has passed its peak (toe-off).

    The paper's formula (the derivative turns negative), not its text (the rate changes sign), which comes some 60 ms
    after foot off; ``swing_at_reversal`` asks for the text's. The peak must be a push-off's, and must be left by
    ``push_off_drop``.
    """
    return (
        (not x.a_rest or not x.g_rest)
        and x.toe_down_change_radps2 < 0.0
        and x.toe_down_peak_radps >= p.min_toe_down_peak_radps
        and x.toe_down_radps < (1.0 - p.push_off_drop) * x.toe_down_peak_radps
        and (x.toe_down_radps < 0.0 or not p.swing_at_reversal)
    )


def t3(x: Features, p: Thresholds) -> bool:
    """Swing → loading response: vertical acceleration jumps, after mid-swing.

    The paper states no "after mid-swing"; without it the jolt of toe-off counts as contact.
    """
    return (
        abs(x.vertical_jerk_mps3) > p.contact_jerk_mps3
        and x.in_phase_s >= p.min_swing_s
        and (
            (
                x.toe_up_peak_radps >= p.mid_swing_share * x.toe_down_peak_radps
                and -x.toe_down_radps < p.rising_share * x.toe_up_peak_radps
            )
            or x.in_phase_s >= p.late_swing_s
        )
    )


def t4(x: Features, p: Thresholds) -> bool:
    """Loading response → stance: the foot is flat and both sensors rest."""
    return x.a_rest and x.g_rest


def t5(x: Features, p: Thresholds) -> bool:
    """Pre-swing → stance: the heel was lifted and put back."""
    return x.a_rest and x.g_rest


def t6(x: Features, p: Thresholds) -> bool:
    """Swing → stance: at rest without a contact having been seen.

    The paper asks for no duration; a slow swing comes to a halt above the ground before it lands, so rest must last.
    """
    return (
        x.a_rest
        and x.g_rest
        and abs(x.toe_down_change_radps2) < p.still_change_radps2
        and abs(x.toe_down_radps) < p.still_rate_radps
        and x.resting_s >= p.soft_contact_rest_s
    )
