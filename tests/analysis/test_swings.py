"""Swings from the raw signals: as many as a known movement has, whatever the axes, the rate and what lies between."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fes.analysis.pipeline import analyse
from fes.analysis.swings import find_swings, turning_points
from fes.recording import Recording, read_recording
from fes.report.findings import findings
from fes.report.summary import summarise
from fes.signals import G_MPS2
from fes.simulation import bundled_file

STRIDE_S = 1.2


def walk(strides: int, rate_hz: float, turn: Rotation, slap_rad: float = 0.2) -> tuple[np.ndarray, ...]:
    """A foot that stands for 0.6 of each cycle, then turns by −50° and back past flat, slaps down, and travels."""
    t = np.arange(0.0, strides * STRIDE_S + 2.0, 1.0 / rate_hz)
    phase = np.clip((t - 1.0) / STRIDE_S, 0.0, strides - 1e-9) % 1.0
    knots = [0.0, 0.5, 0.64, 0.88, 0.95, 1.0]
    pitch = np.interp(phase, knots, [0.0, 0.0, -0.9, slap_rad, 0.0, 0.0])
    speed = np.where((phase > 0.6) & (phase < 0.92), np.sin((phase - 0.6) / 0.32 * np.pi) * 3.0, 0.0)
    smooth = np.hanning(round(0.06 * rate_hz) | 1)
    pitch, speed = (np.convolve(np.pad(v, 50, "edge"), smooth / smooth.sum(), "same")[50:-50] for v in (pitch, speed))
    ahead = np.gradient(speed, t)
    acc = np.column_stack(
        [np.cos(pitch) * ahead + np.sin(pitch) * G_MPS2, 0 * t, np.cos(pitch) * G_MPS2 - np.sin(pitch) * ahead]
    )
    gyr = np.column_stack([0 * t, -np.gradient(pitch, t), 0 * t])  # x ahead, y left, z up: toe-up is −y
    return np.rint(t * 1e9).astype(np.int64), turn.apply(acc), turn.apply(gyr)


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 1000.0])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (180.0, 0.0, 0.0), (20.0, -40.0, 130.0)])
def test_every_swing_is_counted_once(rate_hz, turn):
    t_ns, acc, gyr = walk(12, rate_hz, Rotation.from_euler("xyz", turn, degrees=True))
    swings = find_swings(t_ns, acc, gyr)
    true_ns = 1e9 * (1.0 + STRIDE_S * (np.arange(12) + 0.76))
    assert len(swings.sure) == len(swings.possible) == 12
    assert np.abs(swings.sure - true_ns).max() < 0.08e9, "in mid-swing, not at the slap or at push-off"
    spans = [(int(t - 6e8), int(t + 6e8)) for t in true_ns[:6]]
    assert swings.outside(spans).tolist() == swings.sure[6:].tolist()
    assert swings.outside([(0, spans[5][1])]).tolist() == swings.sure[1:].tolist(), "one swing a stride"


def test_one_that_the_end_cuts_may_be_one():
    t_ns, acc, gyr = walk(12, 100.0, Rotation.identity())
    seen = t_ns < 1e9 * (1.0 + STRIDE_S * 11.84)  # the foot still turns toe-up
    swings = find_swings(t_ns[seen], acc[seen], gyr[seen])
    assert (len(swings.sure), len(swings.possible)) == (11, 12)


def test_standing_has_none():
    rng = np.random.default_rng(2)
    t_ns = np.arange(3000) * 10_000_000
    acc = rng.normal([0.0, 0.0, G_MPS2], 0.05, (3000, 3))
    assert not len(find_swings(t_ns, acc, rng.normal(0.0, 0.01, (3000, 3))).possible)
    assert not len(find_swings(t_ns[:0], acc[:0], acc[:0]).sure)
    assert not len(find_swings(t_ns, acc, np.full((3000, 3), np.nan)).sure), "nothing was measured"


def test_turning_points_come_by_turns():
    assert turning_points(np.array([0.0, 1.0, 0.9, 2.0, -1.0, -0.9, 3.0, 0.0]), 0.5) == [0, 3, 4, 6]


def test_strides_that_are_missing_are_told():
    recording = read_recording(bundled_file("negard_patient1.parquet"))
    foot = next(iter(recording.tracks))
    whole = analyse(Recording("walk", None, {foot: recording.tracks[foot]})).walk_record()
    told = summarise(whole).feet[foot]
    assert (told.unexplained, told.swings >= 10) == (0, True)
    cut = replace(whole, strides=[stride for stride in whole.strides if stride.number not in (4, 5, 6)])
    summary = summarise(cut)
    assert summary.feet[foot].unexplained == 3
    texts = [finding.text for finding in findings(summary)]
    assert any(f"{told.swings} swings" in text and "3 unexplained between" in text for text in texts)
    assert any("of" in text and "swings passed all four phases" in text for text in texts)
    assert summary.to_json()["feet"][foot]["unexplained"] == 3
