"""The six guards T1–T6 as pure predicates over one sample's features.

Plain functions of plain numbers, each of a few named clauses: ``transitions`` calls them as they are, the estimation
core compiles the very same functions, and ``statemachine/terms.py`` calls them with numbers that remember of what they
are made. So every comparison is made whenever a guard is asked: clauses are joined by ``&`` and ``|``, a flag is
compared with ``YES`` or ``NO``, and there is no early return.

Source: Negård et al. (2005), "Gait Phases Detection": which phase may follow which, and what is looked at. The room's
first page (``statemachine/__init__.py``) says where it is departed from, and why.
"""

from typing import Final, NamedTuple

YES: Final = True
NO: Final = False


class Features(NamedTuple):
    """What the guards may look at, at one sample of one foot. All causal.

    ``toe_down_radps`` is how fast the foot turns about its mediolateral axis, toe-down (plantarflexion) positive; "toe
    up" is the same the other way round. ``toe_down_peak_radps`` is the greatest since pre-swing began,
    ``toe_up_peak_radps`` the greatest toe-up rate since swing began, and ``landing_peak_radps`` the greatest rate
    either way since contact (none is negative). ``turned_rad`` is how far the foot has turned toe-down since it last
    stood still in stance. ``pitch_rad`` is how far it is from this person's own flat pitch, learnt in mid-stance,
    toe-up positive, and ``pitch_sd_rad`` how far off it usually is when the foot has landed and stands still: what
    integration over a swing leaves.
    ``contact_jerk_mps3`` is the change of the vertical acceleration over the last 10 ms, or half that of the whole
    force where that is more, per second. ``in_swing_s`` counts from foot off, ``since_contact_s`` from contact.
    ``resting_s`` is how long the foot has hardly turned, ``settled_s`` how long it has stood still since contact,
    ``calm_s`` how long its force has been gravity's alone. ``travelling``: its dead-reckoned speed says that it moves.
    ``speed_share`` is that speed as a share of its peak in this swing. ``swung_rad`` is how far the foot has turned
    toe-up since foot off, from its lowest pitch; ``fallen_rad`` is how far it has come down from its highest since.
    """

    toe_down_radps: float
    toe_down_peak_radps: float
    toe_up_peak_radps: float
    landing_peak_radps: float
    turned_rad: float
    pitch_rad: float
    pitch_sd_rad: float
    contact_jerk_mps3: float
    in_swing_s: float
    since_contact_s: float
    resting_s: float
    settled_s: float
    calm_s: float
    speed_share: float
    swung_rad: float
    fallen_rad: float
    travelling: bool


class Thresholds(NamedTuple):
    """This person's measures, which follow from stride to stride within bounds, and the guards' shares of them.

    The measures come from ``fes.estimation.foot.calibration`` (of a shank ``fes.estimation.shank.calibration``). The
    rate of a foot, of which many limits are shares, is the greater of push-off and half the fall: a weak push-off says
    little. Of origin *data* is what all walkers of ``benchmarks/accuracy/left_out.py`` chose; for seven of them
    (docs/accuracy.md) each walker is also judged with values that were chosen without it.
    """

    push_off_radps: float = 6.0
    """measure: The typical greatest toe-down rate of a push-off. Origin: calibration and the strides."""
    fall_radps: float = 12.0
    """measure: The typical fall of that rate, from there to the greatest toe-up rate of the swing. Origin:
    calibration and the strides."""
    stride_s: float = 1.2
    """measure: The typical time of a stride, from contact to contact. Origin: calibration and the strides."""
    swing_s: float = 0.45
    """measure: The typical time of a swing, from foot off to contact. Origin: 0.4 of the stride, 0.6 s at most, and
    the strides."""
    loading_s: float = 0.15
    """measure: The typical time of a loading response, from contact to foot flat. Origin: this value and the
    strides."""
    contact_jerk_mps3: float = 2000.0
    """measure: The typical jump of the force at contact. Origin: calibration and the strides."""
    rest_share: float = 0.15
    """T2, T3, T4, T5, T6: A foot rests while it turns about its mediolateral axis more slowly than this share of its
    rate, and `resting_s` counts; above it, it turns.
    Origin: data."""
    still_radps: float = 0.25
    """T1, T4: The foot stands still while it turns more slowly than this, 14°/s: `settled_s` counts, `turned_rad`
    begins anew. Origin: as in the orientation filter (`STANDING_RADPS`)."""
    turn_rad: float = 0.04
    """T1, T3: A foot has turned when it has by this angle, 2.3°: toe-down since it last stood still, and its heel is
    about 5 mm up; toe-down from its highest pitch in swing, and it is coming down. Origin: data."""
    heel_rise_share: float = 0.12
    """T1: With its heel up, the foot goes on turning toe-down faster than this share of its rate. Origin: data."""
    lifts_after: float = 0.35
    """T1: No foot lifts before this share of the stride has passed since contact. Origin: data."""
    toe_up_share: float = 0.3
    """T1, T2, T3: A foot that is dragged off without a push-off turns toe-up faster than this share of its rate.
    Origin: data."""
    swung_share: float = 0.45
    """T1: Only a swing, whose beginning was missed, turns the foot toe-up faster than this share of a fall. Origin:
    data."""
    swung_after_s: float = 0.25
    """T1: A contact's rebound, which turns the foot toe-up as fast as a swing, has ended this long after contact,
    whatever the cadence. Origin: data."""
    push_off_share: float = 0.4
    """T2: A push-off has been seen once the toe-down rate has reached this share of its typical peak. Origin:
    data."""
    push_off_drop: float = 0.07
    """T2: The peak is over once the rate has fallen by this share of it; a ripple falls by less. Origin: the paper,
    which asks for any fall; the share by hand."""
    swing_turn_rad: float = 0.15
    """T2, T3: A foot that leaves the ground has turned toe-down by this angle, 9°, and one that has swung has turned
    toe-up by it. Origin: data."""
    swing_at_reversal: bool = False
    """T2: Whether swing waits until the foot turns toe-up. Origin: the paper's text, against its formula."""
    shortest_swing_share: float = 0.6
    """T3: No contact comes before this share of the typical swing has passed; the jolts of foot off end before.
    Origin: data."""
    mid_swing_share: float = 0.65
    """T3: Mid-swing has been seen once toe-down peak and toe-up peak together make this share of a fall. Origin:
    data."""
    slowed_share: float = 0.75
    """T3: Mid-swing is over once the speed of the foot and its toe-up rate are both below this share of their peaks
    in this swing; a scuff comes at full speed. Origin: data."""
    jerk_share: float = 0.3
    """T3: The force jumps at contact by more than this share of its typical jump. Origin: the paper's jump; the
    share data."""
    soft_contact_s: float = 0.04
    """T3: After this long at rest with nothing but gravity upon it, a foot has landed without a jolt. Origin: by
    hand."""
    shortest_loading_s: float = 0.03
    """T4: No foot is flat sooner after contact; the jolt of contact ends before. Origin: by hand."""
    flat_rad: float = 0.025
    """T4: A foot is flat while its pitch is within this angle, 1.4°, of this person's flat one. Origin: data."""
    settled_share: float = 0.45
    """T4: A foot near flat has come down once its turn has died away to this share of its peak since contact.
    Origin: data."""
    near_sds: float = 3.0
    """T4: A pitch is near flat within so many of the standard deviations that it has after a swing. Origin: three
    standard deviations, as is usual."""
    settled_after_s: float = 0.08
    """T4: A foot that has stood still for this long is flat. Origin: by hand."""
    longest_loadings: float = 2.0
    """T4: After so many typical loading responses a foot is taken for flat, whatever is seen. Origin: data."""
    put_back_share: float = 0.8
    """T5, T6: A foot that has been at rest for this share of the typical swing was put back. Origin: by hand."""


def t1(x: Features, p: Thresholds) -> bool:
    """Stance → pre-swing: the heel rises (or the foot is dragged off without that).

    The paper asks for movement of both sensors. A foot rolls on all through stance, so how far it has turned since it
    last stood still decides, and that it goes on turning. A swing whose beginning was missed tells itself by its turn
    toe-up, which no stance has.
    """
    rate = max(p.push_off_radps, 0.5 * p.fall_radps)
    heel_rises = (
        (x.toe_down_radps > p.heel_rise_share * rate)
        & (x.turned_rad > p.turn_rad)
        & (x.since_contact_s > p.lifts_after * p.stride_s)
    )
    dragged_off = (-x.toe_down_radps > p.toe_up_share * rate) & (x.since_contact_s > p.lifts_after * p.stride_s)
    swings = (-x.toe_down_radps > p.swung_share * p.fall_radps) & (x.since_contact_s > p.swung_after_s)
    return heel_rises | dragged_off | swings


def t2(x: Features, p: Thresholds) -> bool:
    """Pre-swing → swing: the toe-down rate has passed its peak (toe-off), or the foot already turns toe-up.

    The paper's formula (the derivative turns negative), not its text (the rate changes sign), which comes some 60 ms
    after foot off; ``swing_at_reversal`` asks for the text's. The peak must be a push-off's, of a foot that has turned
    as far as one that leaves, and must be left by ``push_off_drop``. Stimulation may hold the foot back so much that
    neither its push-off nor its turn toe-up is like those without: where the foot travels, its turn alone decides.
    """
    rate = max(p.push_off_radps, 0.5 * p.fall_radps)
    pushed_off = (
        (x.toe_down_peak_radps >= p.push_off_share * p.push_off_radps)
        & (x.toe_down_radps < (1.0 - p.push_off_drop) * x.toe_down_peak_radps)
        & (x.turned_rad > p.swing_turn_rad)
        & ((x.toe_down_radps < 0.0) | (p.swing_at_reversal == NO))
    )
    dragged_off = -x.toe_down_radps > p.toe_up_share * rate
    carried = (x.travelling == YES) & (-x.toe_down_radps > p.rest_share * rate)
    return pushed_off | dragged_off | carried


def t3(x: Features, p: Thresholds) -> bool:
    """Swing → loading response: after mid-swing the force jumps, or the foot turns toe-down, or it has come to rest.

    The paper states no "after mid-swing"; without it the jolt of toe-off counts as contact. A toe that scuffs jolts
    too, at full speed and while the foot still turns toe-up. The paper knows no soft contact.
    """
    rate = max(p.push_off_radps, 0.5 * p.fall_radps)
    long_enough = x.in_swing_s >= p.shortest_swing_share * p.swing_s
    mid_swing_seen = (
        (x.toe_down_peak_radps + x.toe_up_peak_radps >= p.mid_swing_share * p.fall_radps)
        | (x.toe_up_peak_radps >= p.toe_up_share * rate)
        | (x.swung_rad > p.swing_turn_rad)
    )
    slowed = (x.speed_share < p.slowed_share) & (-x.toe_down_radps < p.slowed_share * x.toe_up_peak_radps)
    comes_down = x.fallen_rad > p.turn_rad
    turned_down = x.toe_down_radps > p.rest_share * rate
    jolted = x.contact_jerk_mps3 > p.jerk_share * p.contact_jerk_mps3
    lies = (x.resting_s > p.soft_contact_s) & (x.calm_s > p.soft_contact_s) & (x.travelling == NO)
    return long_enough & mid_swing_seen & (((slowed | comes_down) & (turned_down | jolted)) | lies)


def t4(x: Features, p: Thresholds) -> bool:
    """Loading response → stance: the foot is flat, or its turn has died away, or it stands still, or it is overdue.

    The paper waits for rest of both sensors, which a brisk walker's foot never comes to. A foot that lands on its heel
    comes down to flat, one that lands on its toes from below; both end in a plateau of the pitch. How well the pitch is
    known after a swing differs from sensor to sensor, so it says itself how much it counts.
    """
    rate = max(p.push_off_radps, 0.5 * p.fall_radps)
    jolt_over = x.since_contact_s > p.shortest_loading_s
    flat = abs(x.pitch_rad) < p.flat_rad
    settled = (
        (x.landing_peak_radps > p.rest_share * rate)
        & (abs(x.toe_down_radps) < p.settled_share * x.landing_peak_radps)
        & (abs(x.pitch_rad) < p.near_sds * x.pitch_sd_rad)
    )
    stands = x.settled_s > p.settled_after_s
    overdue = x.since_contact_s > p.longest_loadings * p.loading_s
    return jolt_over & (flat | settled | stands | overdue)


def t5(x: Features, p: Thresholds) -> bool:
    """Pre-swing → stance: the heel was lifted and put back."""
    return (x.resting_s > p.put_back_share * p.swing_s) & (x.travelling == NO)


def t6(x: Features, p: Thresholds) -> bool:
    """Swing → stance: at rest without a contact having been seen.

    The paper asks for no duration; a slow swing comes to a halt above the ground before it lands, so rest must last.
    """
    return (x.resting_s > p.put_back_share * p.swing_s) & (x.travelling == NO)
