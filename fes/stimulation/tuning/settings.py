"""Every number that the tuning's rule and its watch go by, each with its unit, its meaning and where it is from.

*TUNER* is the plain rule of an independent comparison on 85 virtual patients; *dev* are walks of people that no
published figure uses (seeds 140000–140019 and 130070–130094, of the second model 1–54); *chosen* is a judgement. Levels
are places in a target band: 0 is its low end, 1 its high one. A drive is a share of its upper bound. The channel's
``gain`` (0.8, TUNER) is in the session.
"""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class RuleSettings:
    """Of one channel; strides where no unit is named."""

    toe_aim: float = 0.45  # level: a little under the middle (TUNER)
    pitch_aim: float = 0.15  # level: the heel first, and little more (dev: in 81 of 100; in 75 at 0.12, TUNER)
    roll_aim: float = 0.5  # level: the middle, for the sides of this band are alike (chosen)
    near: float = 0.1  # level below its aim at which a measure asks for more at once (TUNER)
    far: float = 0.4  # level above its aim at which the newest and the median of `lately` suffice for less (dev)
    much: float = 0.06  # level above its aim from which less will do (TUNER)
    drive_per_band: float = 0.5  # drive that lifts by one band (TUNER)
    eased: float = 0.03  # drive: the most taken away with one stride (TUNER)
    pitch_leads: float = 0.55  # toe's level up to which the front may also rise for the pitch (TUNER: its aim + 0.1)
    carried: float = 0.7  # share of the swing to which the front lasts; the tail holds the foot from there on (dev)
    answer_s: float = 0.12  # s from a pulse to what it does to the foot (TUNER)
    outlives_s: float = 0.13  # s by which force outlives the pulses (TUNER)
    up_at: float = 0.15  # share of the swing by which the foot is to be up (dev: at 0.25 more toes drag)
    lately: int = 3  # strides whose median must say far too much (TUNER)
    surely: int = 5  # of which each must say too much (dev: with 3 something is lowered in most five strides)
    answers: int = 40  # newest ones by which the rule knows how the foot answers, the watch by the first (dev)
    remembered: int = 6  # whose phases are usual (TUNER)
    there: float = 0.02  # drive: nearer is the same (chosen)
    twice: int = 2  # jerked strides in a row (chosen: once may be chance)
    spared: int = 5  # after a fault is named, in which nothing is lowered (chosen: time to look at the electrodes)
    spent: float = 0.99  # drive: from there on there is nothing left to give (TUNER)
    vain: int = 6  # at the bound with more wanted: a hint, or without an answer the end (TUNER)
    answered: float = 0.25  # level above its strides without stimulation from which a foot answers (chosen) …
    no_answer: float = -0.3  # … or where there are none of these (TUNER)
    untaught: int = 10  # stimulated ones in a row that taught nothing: a hint (chosen)

    # the watch (dev: whole, slipped, drifting and spastic walks)
    flattest: float = 0.7  # bands by which all of the drive lifts a foot, at the least
    believed: float = 0.01  # drive²: spread from which a foot's own answer weighs more than drive_per_band
    newest: int = 7  # strides that are held against …
    earlier: int = 8  # … earlier ones, of which
    enough: int = 5  # at least so many must be at the same speed,
    same_speed: float = 0.12  # share of it
    drift_lag: int = 18  # between these, for what goes slowly
    slipped: float = 0.75  # share of the drive that still arrives, below which something has happened
    stays: float = 0.33  # share of such a loss which all but one of the strides must show
    least_sd: float = 0.03  # level: strides that agree by chance do not make a measure exact


OWN: Final = RuleSettings()
