"""What to do about a fault or a refusal, for whoever stands beside the session. No clock, no I/O."""

import re
from typing import Final

_COMPUTER: Final = "Close other programs; `fes doctor` says what this computer does not grant."
_LINE: Final = "Check plug, battery and range; its line is opened again by itself. Then arm again."
_READ: Final = "Look at the sensor's link and at `fes doctor`, which reads every sensor for two seconds."
_UNIT: Final = "Check the sensor's unit and ranges in its own settings and in the session file."
_MOUNT: Final = "Put the sensor back as it was at calibration, or calibrate again."
_FELT: Final = "See that the sensor sits firmly; if it does, switch it off and on, or take another one. Then arm again."
_SIDES: Final = "End the session, put each sensor on its own foot, and begin anew."
_RESTART: Final = "Switch the sensor off and on, then arm again."
_LEADS: Final = "Check electrodes, leads and plugs, then arm again."
_DEVICE: Final = "Switch the stimulator off and on, check its supply, then arm again."
_REQUEST: Final = "The plan asked for more than a limit allows; check the channel's settings, and keep the log."

REMEDIES: Final[tuple[tuple[str, str], ...]] = (  # the first whose words are found
    (r"controller stalled|command was .* late|lease expired|too late", _COMPUTER),
    (r"start a new session|did not switch off", "End the session and begin anew; keep the log."),
    (r"are their sensors exchanged", _SIDES),
    (r"sensor lost|no data from", _LINE),
    (r"clock of .* jumped|clock went|time stamps are out of order|dated .* ahead", _RESTART),
    (r"data \d+ ms old|too few samples|samples in the last second|silent for", _READ),
    (r"is frozen|non-finite", _RESTART),
    (r"unit|saturated|is it scaled", _UNIT),
    (r"does not feel it|do not fit|does it dangle", _FELT),
    (r"remounted|tilted", _MOUNT),
    (r"stimulator lost", "Check the stimulator's plug and supply; it is opened again by itself. Then arm again."),
    (r"electrode|lead", _LEADS),
    (r"pulses that nobody asked for|delivers", "Switch the stimulator off at its own switch before anything else."),
    (r"stimulator (fault|restarted|does not answer)", _DEVICE),
    (r"time ran backward", "Do not set this computer's clock during a session; arm again."),
    (r"moves \(", "Stand still for a second."),
    (
        r"the foot rests|without a swing|swings of the foot|nobody asked|a person asked for",
        "The plan asked for current where the foot's movement, or a person, asks for none; keep the log.",
    ),
    (r"mA|µC|µs|mC| Hz|on for|off for|never together|has no channel|must be true or false", _REQUEST),
)


def remedy(fault: str) -> str:
    """What to do about it; "" where nothing is known but to arm again."""
    return next((what for words, what in REMEDIES if re.search(words, fault)), "")


def with_remedy(text: str) -> str:
    """The words of a fault, which may be a question, as a sentence, and what to do about it."""
    return f"{text}{'' if text.endswith(('?', '.')) else '.'} {remedy(text)}".rstrip()
