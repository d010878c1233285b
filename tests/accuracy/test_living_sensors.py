"""What the gate calls a broken sensor, no living one looks like: not in the quietest stance, not at a heel strike.

Frozen (the same values for 80 ms), implausible (units, ranges), remounted (turned over at rest), stamps out of order.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fes.calibration.recording import calibrate_shank_track, calibrate_track
from fes.estimation.foot.calibration import calibrate_foot
from fes.gate.freshness import MAX_SAME_MS, Stamps
from fes.gate.plausibility import Plausibility
from fes.recording import Track, read_recording
from fes.signals import G_MPS2, NS_PER_S, FloatArray, ImuSample, Vector3

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
DATA = Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
RUNS = sorted((DATA / "stroke_treadmill").glob("*.npz"))


def longest_repetition_s(t_s: FloatArray, acc: FloatArray, gyr: FloatArray) -> float:
    """Longest time (s) over which no value changes."""
    changed = np.flatnonzero((np.diff(acc, axis=0) != 0).any(axis=1) | (np.diff(gyr, axis=0) != 0).any(axis=1)) + 1
    begins = np.concatenate(([0], changed))
    ends = np.concatenate((changed - 1, [len(t_s) - 1]))
    return float((t_s[ends] - t_s[begins]).max())


def test_it_finds_a_repetition() -> None:
    values = np.array([[0.0], [1.0], [1.0], [1.0], [2.0]]).repeat(3, axis=1)
    assert longest_repetition_s(np.arange(5.0), values, np.zeros((5, 3))) == 2.0


def tracks() -> list[Track]:
    paths = [path for path in sorted(TRIALS.glob("*.parquet")) if "truth" not in path.name]
    return [track for path in paths for track in read_recording(path).tracks.values()]


def test_bundled_sensors_never_look_frozen() -> None:
    longest = [longest_repetition_s(1e-9 * track.t_ns, track.acc_mps2, track.gyr_radps) for track in tracks()]
    assert len(longest) >= 11
    assert max(longest) < 0.5 * MAX_SAME_MS / 1000


def complaints(track: Track, up: Vector3 | None) -> set[str]:
    """All that the gate's judges say of a track."""
    plausible = Plausibility(track.sensor, None, up)
    stamps = Stamps()
    said = set()
    for t_ns, t_sensor_ns, acc, gyr in zip(
        track.t_ns.tolist(),
        track.t_sensor_ns.tolist(),
        track.acc_mps2.tolist(),
        track.gyr_radps.tolist(),
        strict=True,
    ):
        sample = ImuSample(t_ns, track.sensor, t_sensor_ns, tuple(acc), tuple(gyr))
        said |= {plausible.fault(sample), stamps.fault(sample), plausible.not_ready}
    return said - {""}


def test_judges_complain_of_a_wrong_unit_and_of_a_sensor_turned_over() -> None:
    track = tracks()[0]
    assert complaints(replace(track, acc_mps2=track.acc_mps2 / G_MPS2), None)
    assert complaints(replace(track, gyr_radps=np.degrees(track.gyr_radps)), None)
    up = calibrate_track(track).up
    assert complaints(track, (-up[0], -up[1], -up[2]))


def test_bundled_sensors_are_plausible() -> None:
    for track in tracks():
        assert not complaints(track, calibrate_track(track).up)


@pytest.mark.requirement("SR-10")
@pytest.mark.data
@pytest.mark.skipif(not RUNS, reason=f"no recordings in {DATA / 'stroke_treadmill'}; set FES_DATA")
@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_real_sensors_are_plausible(path: Path) -> None:
    data = np.load(path)
    rate_hz, bundled = float(data["fs"]), tracks()[0]
    for segment in ("leftfoot", "rightfoot", "leftshank", "rightshank"):
        acc, gyr = (data[f"{what}_{segment}"].astype(np.float64) for what in ("acc", "gyr"))
        t_ns = np.round(np.arange(len(acc)) * NS_PER_S / rate_hz).astype(np.int64)
        sensor = segment.replace("foot", "_foot").replace("shank", "_shank")
        track = replace(
            bundled, sensor=sensor, rate_hz=rate_hz, t_ns=t_ns, t_sensor_ns=t_ns, acc_mps2=acc, gyr_radps=gyr
        )
        up = (
            calibrate_foot(segment, rate_hz, t_ns, acc, gyr) if "foot" in segment else calibrate_shank_track(track)
        ).up
        assert not complaints(track, up)
        for at in range(2000, len(acc) - 2000, 997):
            if np.abs(gyr[at]).max() > 1.5:
                assert until_in_g_ms(track, at) <= 200.0  # a step right after a shake tells nothing by itself


def until_in_g_ms(track: Track, at: int) -> float:
    """From sample ``at``, since which the force is in g, until the judge says so; infinite after half a second."""
    judge = Plausibility(track.sensor, None, None)
    for k in range(at - 20, at + 50):
        acc = track.acc_mps2[k] / (G_MPS2 if k >= at else 1.0)
        t_ns = int(track.t_ns[k])
        if judge.fault(ImuSample(t_ns, track.sensor, t_ns, tuple(acc.tolist()), tuple(track.gyr_radps[k].tolist()))):
            return 1e-6 * (t_ns - int(track.t_ns[at])) if k >= at else -1.0
    return float("inf")


@pytest.mark.requirement("SR-10")
@pytest.mark.data
@pytest.mark.skipif(not RUNS, reason=f"no recordings in {DATA / 'stroke_treadmill'}; set FES_DATA")
@pytest.mark.parametrize("path", RUNS, ids=lambda path: path.stem)
def test_real_sensors_never_look_frozen(path: Path) -> None:
    data = np.load(path)
    for segment in ("leftfoot", "rightfoot", "leftshank", "rightshank"):
        acc, gyr = data[f"acc_{segment}"], data[f"gyr_{segment}"]
        assert longest_repetition_s(np.arange(len(acc)) / float(data["fs"]), acc, gyr) < 0.5 * MAX_SAME_MS / 1000
