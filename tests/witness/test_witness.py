"""The witness: what a sensor says wrongly is told with its size, and undone; a sound sensor is not accused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fes.analysis.pipeline import analyse
from fes.analysis.results import Analysis
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Recording, read_recording
from fes.recording.tracks import Track
from fes.signals import FloatArray
from fes.witness import examine
from fes.witness.frozen import dead_band_radps, frozen_rows, without_frozen

FOOT = "left_foot"
WALK = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
Change = Callable[[Track], Track]


@cache
def walk() -> Recording:
    recording = read_recording(WALK)
    return replace(recording, tracks={FOOT: recording.tracks[FOOT]})


@cache
def sound() -> Analysis:
    return analyse(walk())


def lied(change: Change) -> Recording:
    return replace(walk(), tracks={FOOT: change(walk().tracks[FOOT])})


def late(ms: float) -> Change:
    def change(track: Track) -> Track:
        at = track.t_sensor_ns - 1e6 * ms
        acc = np.column_stack([np.interp(at, track.t_sensor_ns, axis) for axis in track.acc_mps2.T])
        return replace(track, acc_mps2=acc)

    return change


def turned(factors: FloatArray, *, half: bool = False, also_acc: bool = False) -> Change:
    def change(track: Track) -> Track:
        gyr, begin = track.gyr_radps.copy(), len(track.t_ns) // 2 if half else 0
        gyr[begin:] *= factors
        return replace(track, gyr_radps=gyr, acc_mps2=track.acc_mps2 * factors if also_acc else track.acc_mps2)

    return change


def shifted(track: Track) -> Track:
    gyr = track.gyr_radps.copy()
    gyr[len(gyr) // 2 :, 1] += np.radians(25.0)
    return replace(track, gyr_radps=gyr)


def mean_length_m(result: Analysis) -> float:
    return float(np.mean([stride.stride_length_m for stride in result.strides if stride.valid]))


def test_a_sound_sensor_is_not_accused() -> None:
    told = sound().testimonies[FOOT]
    assert told.strides >= 20
    assert not told.lies
    assert not told.silent


LIES: dict[str, tuple[Change, str, float, float]] = {
    "late": (late(30.0), "lag", 0.030, 0.010),
    "early": (late(-25.0), "lag", -0.025, 0.006),
    "low": (turned(np.full(3, 0.85)), "gyr_gain", 0.85, 0.04),
    "high": (turned(np.full(3, 1.2)), "gyr_gain", 1.2, 0.06),
    "bias": (shifted, "gyr_bias", np.radians(25.0), np.radians(4.0)),
    "sign": (turned(np.array((-1.0, 1.0, 1.0))), "axes", 0.0, 0.0),
    "sign from half time": (turned(np.array((1.0, -1.0, 1.0)), half=True), "axes", 0.0, 0.0),
}


@pytest.mark.parametrize("name", LIES)
def test_what_a_sensor_says_wrongly_is_told_and_undone(name: str) -> None:
    change, kind, value, within = LIES[name]
    result = analyse(lied(change), correct=True)
    (lie,) = result.corrections[FOOT]
    assert lie.kind == kind
    assert lie.value == pytest.approx(value, abs=within)
    begins = name == "sign from half time" or kind == "gyr_bias"
    assert (lie.from_ns is not None) == begins
    if lie.from_ns is not None:
        half_ns = int(walk().tracks[FOOT].t_sensor_ns[len(walk().tracks[FOOT].t_ns) // 2])
        assert abs(lie.from_ns - half_ns) < 5e9
    assert mean_length_m(result) == pytest.approx(mean_length_m(sound()), rel=0.03)
    (finding,) = [each for each in result.findings if each.code == kind]
    assert finding.corrected
    assert finding.sensor == FOOT


def test_where_axes_let_a_foot_seem_to_walk_backward_that_is_said() -> None:
    for change in (turned(np.array((1.0, -1.0, 1.0))), turned(np.array((1.0, 1.0, -1.0)), also_acc=True)):
        with pytest.raises(CalibrationError, match="left-handed"):
            analyse(lied(change))


def test_a_lie_that_moves_a_number_is_an_alert_with_its_effect_and_a_remedy() -> None:
    (finding,) = [each for each in analyse(lied(turned(np.full(3, 0.8)))).findings if each.code == "gyr_gain"]
    assert finding.level == "alert"
    assert "stride length" in finding.effect
    assert "--correct" in finding.remedy


def test_too_few_strides_are_said_to_show_nothing() -> None:
    track = walk().tracks[FOOT]
    rows = sound().blocks[FOOT].rows[:6]
    assert "20 are needed" in examine(track, rows["t_start_ns"], rows["t_end_ns"]).silent


def repeated(track: Track, begin: int, count: int) -> Track:
    acc, gyr = track.acc_mps2.copy(), track.gyr_radps.copy()
    acc[begin : begin + count], gyr[begin : begin + count] = acc[begin], gyr[begin]
    return replace(track, acc_mps2=acc, gyr_radps=gyr)


def test_what_a_frozen_sensor_repeats_counts_as_lost_and_no_other_sample() -> None:
    track = walk().tracks[FOOT]
    frozen = frozen_rows(repeated(track, 1000, 60))
    assert np.flatnonzero(frozen).tolist() == list(range(1001, 1060))
    assert not frozen_rows(repeated(track, 1000, 5)).any()
    assert without_frozen(track) is track
    result = analyse(lied(lambda own: repeated(own, 1000, 60)))
    (finding,) = [each for each in result.findings if each.code == "frozen"]
    assert finding.level == "warning"
    beside = {stride.t_start_ns: stride for stride in result.strides if stride.valid}
    same = [stride for stride in sound().strides if stride.valid and stride.t_start_ns in beside]
    assert len(same) >= len(sound().strides) - 5


def test_a_dead_band_is_known_by_its_zeros_and_coarse_numbers_are_none() -> None:
    track = walk().tracks[FOOT]
    band = np.radians(1.0)
    dead = replace(track, gyr_radps=np.where(np.abs(track.gyr_radps) < band, 0.0, track.gyr_radps))
    assert dead_band_radps(dead) == pytest.approx(band, rel=0.1)
    coarse = replace(track, gyr_radps=np.round(track.gyr_radps / band) * band)
    assert dead_band_radps(coarse) == 0.0
    assert dead_band_radps(track) == 0.0


@pytest.mark.parametrize(("factor", "farther"), [(1.2, "left"), (0.8, "right")])
def test_two_feet_of_one_walk_that_go_unequally_far_are_told(factor: float, farther: str) -> None:
    both = analyse(read_recording(WALK))
    assert not [each for each in both.findings if each.code == "feet_apart"]
    longer = [
        replace(each, stride_length_m=factor * each.stride_length_m, speed_mps=factor * each.speed_mps)
        if each.foot == FOOT else each
        for each in both.strides
    ]  # fmt: skip
    (found,) = (each for each in replace(both, measured_strides=longer).findings if each.code == "feet_apart")
    assert found.level == "alert"
    assert f"the {farther} foot went " in found.cause
    few = replace(both, measured_strides=longer[:30])
    assert not [each for each in few.findings if each.code == "feet_apart"], "15 of a foot tell nothing"
