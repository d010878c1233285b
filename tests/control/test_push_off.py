"""The example session with a channel on the gastrocnemius, on a virtual patient: pulses as the stimulator gave them."""

from __future__ import annotations

from itertools import pairwise
from statistics import median
from typing import Any

import pytest
from replays import TRIALS

from benchmarks.loop.closed_loop_walk import Walk, calibration_of, walk
from fes.config import Channel, load_session
from fes.estimation.foot.calibration import FootCalibration
from fes.simulation.forward import settings_for

PATIENT = settings_for("severe", seed=3, sensors=("right_foot",), calf_channel=1)
SESSION = load_session(TRIALS / "session_push_off.toml")
CALF, TIBIALIS = SESSION.channels
SETTLED = 6  # strides that are not compared
LATE_NS = 60_000_000  # a phase is known some samples after the foot's true event
APART_NS = 1_000_000_000 // 50  # less than the time between two pulses of a channel


@pytest.fixture(scope="module")
def calibration() -> FootCalibration:
    return calibration_of(PATIENT)


@pytest.fixture(scope="module")
def both(calibration: FootCalibration) -> Walk:
    return walked(calibration, CALF, TIBIALIS)


@pytest.fixture(scope="module")
def alone(calibration: FootCalibration) -> Walk:
    return walked(calibration, TIBIALIS)


def walked(calibration: FootCalibration, *channels: Channel) -> Walk:
    return walk(PATIENT, SESSION.model_copy(update={"channels": channels}), calibration, 40.0, 25)


def changed(channel: Channel, **settings: Any) -> Channel:
    return Channel.model_validate({**channel.model_dump(), **settings})


def lasting(extension_s: float) -> Channel:
    """The calf's channel without the limit that ends its burst early."""
    return changed(CALF, extension_s=extension_s, limits={**CALF.limits.model_dump(), "max_on_s": 1.0})


def times_ns(done: Walk, channel: Channel) -> list[int]:
    return [pulse.t_ns for pulse in done.pulses if pulse.channel == channel.number]


def test_the_calf_is_stimulated_between_heel_rise_and_foot_off_alone(both: Walk) -> None:
    assert not both.latched
    strides = both.strides[2:-1]
    calf_ns = [t for t in times_ns(both, CALF) if strides[0].t_heel_off_ns < t < strides[-1].t_contact_ns]
    in_pre_swing = [sum(one.t_heel_off_ns < t < one.t_foot_off_ns for t in calf_ns) for one in strides]
    assert all(3 <= count <= 5 for count in in_pre_swing)  # 0.1 s at 40 Hz
    assert sum(in_pre_swing) == len(calf_ns)


def test_antagonists_never_have_pulses_at_the_same_time(both: Walk) -> None:
    bursts: list[tuple[int, int, int]] = []  # begin, end, channel
    for channel in (CALF, TIBIALIS):
        for t in times_ns(both, channel):
            if bursts and bursts[-1][2] == channel.number and t - bursts[-1][1] < 3 * APART_NS:
                bursts[-1] = (bursts[-1][0], t, channel.number)
            else:
                bursts.append((t, t, channel.number))
    bursts.sort()
    assert {channel for _, _, channel in bursts} == {CALF.number, TIBIALIS.number}
    assert all(end < begin for (_, end, _), (begin, _, _) in pairwise(bursts))
    off_ns = [one.t_foot_off_ns for one in both.strides]
    tibialis = [begin for begin, _, channel in bursts if channel == TIBIALIS.number]
    assert all(min(abs(begin - t) for t in off_ns) < LATE_NS for begin in tibialis[1:-1])


def test_it_pushes_off_more_and_the_toe_passes_no_lower(both: Walk, alone: Walk) -> None:
    more, usual = both.strides[SETTLED:], alone.strides[SETTLED:]
    assert median(s.push_off_j for s in more) > 1.05 * median(s.push_off_j for s in usual)
    assert median(s.toe_clearance_m for s in more) > median(s.toe_clearance_m for s in usual) - 0.002
    assert sum(s.dragged or s.stumbled for s in more) == 0


def test_a_burst_up_to_foot_off_does_harm_that_is_counted(
    calibration: FootCalibration, both: Walk, alone: Walk
) -> None:
    longer = walked(calibration, lasting(0.0), TIBIALIS)
    assert not longer.latched
    assert longer.harm.drags > both.harm.drags + len(longer.strides) / 4
    assert longer.harm.co_contraction_nms > both.harm.co_contraction_nms + 0.5
    assert both.harm.drags <= alone.harm.drags


def test_a_burst_through_swing_harms_at_once_and_most_strides(calibration: FootCalibration) -> None:
    """Nothing is wrong with the sensor, and the phases come in order: what tells such a setting is the harm counted."""
    through = walked(calibration, lasting(0.3), TIBIALIS)
    first_ns, *_, last_ns = times_ns(through, CALF)
    during = [one for one in through.strides if first_ns < one.t_contact_ns < last_ns + 10**9]
    harmed = [one.dragged or one.stumbled for one in during]
    assert harmed[0]
    assert sum(harmed) > 0.5 * len(harmed)


def test_exclusion_holds_whatever_the_phases_say(calibration: FootCalibration) -> None:
    done = walked(calibration, CALF, changed(TIBIALIS, start_phase="pre_swing"))
    calf_ns, tibialis_ns = times_ns(done, CALF), times_ns(done, TIBIALIS)
    assert calf_ns
    for one in done.strides[2:]:
        own = [t for t in calf_ns if one.t_heel_off_ns < t < one.t_contact_ns]
        assert own
        assert not any(min(own) <= t <= max(own) for t in tibialis_ns)


def test_no_other_session_stimulates_the_calf() -> None:
    assert [c.muscle for c in load_session(TRIALS / "session.toml").channels] == ["tibialis anterior"]
