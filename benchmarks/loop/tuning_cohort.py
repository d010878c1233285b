"""The cohort of ``benchmarks/loop/tuning.py``: who takes part, and what a competent user sets for them that day.

Taking part needs a drop foot: without stimulation at least half the strides clear the ground by less than the band's
low end. Who does not have one is passed over, as in a trial, and the seed's next draw is looked at. Who cannot be
calibrated stays in: that is a failure of the program, and the tables count it as one.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from typing import Any

from benchmarks.loop.closed_loop_walk import calibration_of, walk
from fes.config import Channel, FootGeometry, ImuDevice, Session
from fes.estimation.foot.calibration import FootCalibration
from fes.signals import NS_PER_S
from fes.simulation.forward import PatientSettings, VirtualPatient, VirtualStride, draw_patient

BAND_MM = (10.0, 40.0)  # of the true least toe clearance in mid-swing
PITCH_DEG = (4.0, 25.0)  # at contact: the heel comes first
SCREENED_S = 30.0
TITRATED_MA = tuple(float(ma) for ma in range(12, 52, 2))
TITRATION_STRIDES, JUDGED_STRIDES = 12, 6
RESERVE = 1.2  # what a therapist adds for tiring
CHRONAXIE_US = 459.0  # of motor axons on average (Mogyoros et al., Brain 119, 1996); no patient has just this
MOST_MA, WIDTH_US = 50.0, 300.0  # so that who needs 35 mA has something left when an electrode slips


def drawn(seed: int, attempt: int) -> PatientSettings:
    """The cohort's person: by seed, so that of fifteen in a row five walk in Wang's slow patterns, each in one."""
    return draw_patient(attempt, seed, sensors=("right_foot",))


def has_a_drop_foot(settings: PatientSettings, made: Callable[[Any], Any] = VirtualPatient) -> bool:
    """Whether at least half the strides without stimulation clear the ground by less than the band's low end."""
    alone = made(settings)
    alone.advance(round(SCREENED_S * NS_PER_S))
    strides = [one for one in alone.strides if one.foot == settings.affected_foot and one.walking][3:]
    return median(one.toe_clearance_m for one in strides) < 1e-3 * BAND_MM[0]


def chosen(
    seed: int, who: Callable[[PatientSettings], PatientSettings] = lambda settings: settings
) -> tuple[PatientSettings, int]:
    """The cohort's patient of this seed, made over by ``who``, and how many without a drop foot were passed over."""
    for attempt in range(100):
        settings = who(drawn(seed, attempt))
        if has_a_drop_foot(settings):
            return settings, attempt
    raise ValueError(f"seed {seed}: no drop foot in 100 draws")


def patient(
    seed: int, who: Callable[[PatientSettings], PatientSettings] = lambda settings: settings
) -> tuple[PatientSettings, FootCalibration, int]:
    """As :func:`chosen`, with the calibration in between.

    Raises:
        CalibrationError: the patient is refused; nobody is drawn instead.
    """
    settings, passed_over = chosen(seed, who)
    return settings, calibration_of(settings), passed_over


def channel_of(
    current_ma: float, width_us: float = WIDTH_US, *, extension_s: float = 0.06, tuning: dict[str, Any] | None = None
) -> Channel:
    """The one channel, 40 Hz, with limits that a session of this kind has."""
    settings: dict[str, Any] = {
        "name": "Tibialis anterior, right", "number": 0, "foot": "right_foot", "electrode_area_cm2": 25.0,
        "current_ma": current_ma, "pulse_width_us": width_us, "frequency_hz": 40.0, "extension_s": extension_s,
        "limits": {
            "max_current_ma": MOST_MA, "max_pulse_width_us": 400.0, "max_frequency_hz": 50.0,
            "max_charge_per_phase_uc": 15.0, "max_charge_per_minute_mc": 40.0, "max_current_density_ma_per_cm2": 0.5,
            "max_rise_ma_per_s": 400.0, "max_on_s": 3.0, "min_off_s": 0.1,
        },
    }  # fmt: skip
    if tuning is not None:
        settings["tuning"] = tuning
    return Channel(**settings)


def session_with(geometry: FootGeometry, *channels: Channel) -> Session:
    """A session of the right foot, and its sensor's ranges."""
    sensor = ImuDevice(sensor="right_foot", device="xsens_can", rate_hz=100.0, acc_range_g=16.0, gyr_range_dps=2000.0)
    return Session(name="virtual", channels=channels, sensors=(sensor,), geometry={"right_foot": geometry})


def walks_well(strides: list[VirtualStride]) -> bool:
    """What a therapist can see: the toe passes clear of the ground and the heel comes first, but for one stride."""
    good = [
        1e3 * one.toe_clearance_m >= BAND_MM[0] and one.pitch_at_contact_rad * 57.3 >= PITCH_DEG[0] for one in strides
    ]
    return sum(good) >= len(good) - 1


def clinic_ma(settings: PatientSettings, geometry: FootGeometry, calibration: FootCalibration) -> float:
    """What a competent user sets that day with pulses of WIDTH_US: see :func:`titrated_ma`."""
    return titrated_ma(settings, geometry, calibration, lambda ma: channel_of(ma, extension_s=0.0))


def titrated_ma(
    settings: PatientSettings, geometry: FootGeometry, calibration: FootCalibration,
    channel: Callable[[float], Channel], made: Callable[[Any], Any] = VirtualPatient,
) -> float:  # fmt: skip
    """What a competent user sets that day: the current in steps of 2 mA with which this patient walks well with the
    electrodes as they are and 2 mA less does not, found by halving, and a reserve; the greatest where none does.

    ``channel`` makes the pulses that recruit as this current does with pulses of WIDTH_US.
    """
    low, high = -1, len(TITRATED_MA)  # too little, enough
    while high - low > 1:
        middle = (low + high) // 2
        session = session_with(geometry, channel(TITRATED_MA[middle]))
        done = walk(settings, session, calibration, 60.0, TITRATION_STRIDES, made=made)
        if walks_well(done.strides[-JUDGED_STRIDES:]):
            high = middle
        else:
            low = middle
    return min(round(2.0 * RESERVE * TITRATED_MA[high]) / 2.0, MOST_MA) if high < len(TITRATED_MA) else MOST_MA


def short_channel(ma: float, **others: Any) -> Channel:
    """The channel at its greatest current, with a pulse that recruits as ``ma`` does with WIDTH_US, by Weiss's law."""
    wanted_uc = ma * WIDTH_US
    width_us = wanted_uc * CHRONAXIE_US / (MOST_MA * (WIDTH_US + CHRONAXIE_US) - wanted_uc)
    return channel_of(MOST_MA, min(float(round(width_us)), WIDTH_US), **others)
