"""The truth beside the bundled recordings: true, complete, in order, and the same after writing and reading."""

from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fes.recording import Recording, read_recording
from fes.signals import G_MPS2, FloatArray
from fes.simulation.sensor import quaternions, rotation
from fes.simulation.truth import Truth, TruthStride, load_truth, write_truth
from sim_inputs.generator.trials import TRIALS
from statemachine.phases import Phase

FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
PARQUET = [trial.name for trial in TRIALS]
WALKS = [name for name in PARQUET if name != "not_walking"]


@cache
def recording(name: str) -> Recording:
    return read_recording(FOLDER / f"{name}.parquet")


@cache
def truth(name: str) -> Truth:
    return load_truth(FOLDER / f"{name}.parquet")


def lasting(strides: list[TruthStride]) -> FloatArray:
    """(N, 3): pre-swing, swing and loading response in s."""
    return np.array(
        [
            (
                s.t_swing_s - s.t_pre_swing_s,
                s.t_loading_response_s - s.t_swing_s,
                s.t_stance_s - s.t_loading_response_s,
            )
            for s in strides
        ]
    )


@pytest.mark.parametrize("name", WALKS)
def test_stride_lengths_add_up_to_the_way_of_the_belt(name: str) -> None:
    speed = recording(name).belt_speed_mps
    assert speed is not None
    for foot in truth(name).feet:
        steady = [stride for stride in truth(name).strides_of(foot) if stride.steady][
            :-1
        ]  # the last one only closes up
        way = sum(stride.stride_length_m for stride in steady)
        assert way == pytest.approx(speed * (steady[-1].t_end_s - steady[0].t_start_s), abs=0.035 * way)


@pytest.mark.parametrize(("name", "count", "kmh"), [("negard_patient1", 40, 1.1), ("negard_patient2", 45, 1.5)])
def test_the_published_trials(name: str, count: int, kmh: float) -> None:
    strides = truth(name).strides
    assert len(strides) == count
    assert all(stride.steady and stride.walking and stride.foot == "right_foot" for stride in strides)
    assert recording(name).belt_speed_mps == pytest.approx(kmh / 3.6)
    assert recording(name).tracks["right_foot"].rate_hz == 500.0
    assert all(stride.foot_strike_deg < 3.0 for stride in strides)
    assert all(-0.003 < stride.toe_clearance_m < 0.015 for stride in strides)


def test_patient_2_has_the_published_phase_durations() -> None:
    """Negård et al. (2005), Table 1: means within 5 %, spreads within a few percent of the mean."""
    strides = truth("negard_patient2").strides
    durations = lasting(strides)
    stance = np.array([b.t_pre_swing_s - a.t_stance_s for a, b in pairwise(strides)])
    for values, mean, spread in (
        (durations[:, 0], 0.40, 0.050),
        (durations[:, 1], 0.69, 0.040),
        (durations[:, 2], 0.19, 0.208),
        (stance, 0.74, 0.086),
    ):
        assert np.mean(values) == pytest.approx(mean, rel=0.05)
        assert np.std(values) / np.mean(values) == pytest.approx(spread, abs=0.025)


@pytest.mark.parametrize("name", [*PARQUET, "example_csv"])
def test_strides_are_in_order_and_within_physiology(name: str) -> None:
    for foot in truth(name).feet:
        strides = truth(name).strides_of(foot)
        assert [stride.number for stride in strides] == list(range(1, len(strides) + 1))
        for stride in strides:
            assert stride.t_start_s < stride.t_pre_swing_s < stride.t_swing_s
            assert stride.t_swing_s < stride.t_loading_response_s <= stride.t_stance_s < stride.t_end_s
            assert 0.0 < stride.clearance_m < 0.25
            assert stride.clearance_m < stride.heel_clearance_m < 0.35
        for before, after in pairwise(strides):
            assert before.t_end_s <= after.t_start_s + 1e-9
            assert before.t_stance_s < after.t_pre_swing_s


@pytest.mark.parametrize("name", PARQUET)
def test_phase_series_tells_the_same_as_the_strides(name: str) -> None:
    for foot, series in truth(name).feet.items():
        t = series.t_ns * 1e-9
        for stride in truth(name).strides_of(foot):
            middle = 0.5 * (stride.t_swing_s + stride.t_loading_response_s)
            assert series.phase[np.searchsorted(t, middle)] == Phase.SWING
            assert series.phase[np.searchsorted(t, stride.t_swing_s) - 3] == Phase.PRE_SWING
            assert series.phase[np.searchsorted(t, stride.t_stance_s) + 2] == Phase.STANCE
        swings = np.count_nonzero(np.diff((series.phase == Phase.SWING).astype(int)) == 1)
        assert swings == len(truth(name).strides_of(foot))


def test_the_reference_marker_in_the_belts_frame_is_the_sensor() -> None:
    """Eq. (21): p + v t, up to where the belt's clock started, is the sensor's path; noise 1.5 mm."""
    for name in ("negard_patient1", "negard_patient2"):
        speed = recording(name).belt_speed_mps
        assert speed is not None
        marker = truth(name).reference
        foot = truth(name).feet["right_foot"]
        steady = (marker[:, 0] > 6.0) & (marker[:, 0] < marker[-1, 0] - 6.0)
        t = marker[steady, 0]
        assert np.diff(t) == pytest.approx(0.04)
        error = marker[steady, 1:].copy()
        error[:, 0] += speed * t
        for axis in range(3):
            error[:, axis] -= np.interp(t, foot.t_ns * 1e-9, foot.sensor_m[:, axis])
        error -= error.mean(axis=0)
        assert np.std(error) == pytest.approx(0.0015, abs=0.0006)


def test_truth_quaternions_turn_gravity_as_the_sensor_feels_it_at_rest() -> None:
    for name in ("misaligned", "both_feet_100hz"):
        for sensor, track in recording(name).tracks.items():
            w, x, y, z = truth(name).feet[sensor].q_world_from_sensor[100]
            up_in_sensor = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])
            felt = track.acc_mps2[track.t_ns < 2_000_000_000].mean(axis=0) / G_MPS2
            assert np.degrees(np.arccos(felt @ up_in_sensor / np.linalg.norm(felt))) < 2.0


def test_quaternions_of_rotations_near_half_turns() -> None:
    angles = np.radians(np.array([0.0, 90.0, 179.9, 180.0, 181.0, 270.0]))
    for kind in range(3):
        parts = [angles if kind == axis else 0.0 * angles for axis in range(3)]
        turns = rotation(*parts)
        w, x, y, z = quaternions(turns).T
        assert np.allclose(w * w + x * x + y * y + z * z, 1.0)
        assert np.allclose(turns[:, 0, 0], 1 - 2 * (y * y + z * z))
        assert np.allclose(turns[:, 1, 0], 2 * (x * y + w * z))
        assert np.allclose(turns[:, 2, 1], 2 * (y * z + w * x))


# --- reading truth ---------------------------------------------------------------------------------------


def test_truth_survives_writing_and_reading(tmp_path: Path) -> None:
    original = truth("negard_patient1")
    write_truth(original, tmp_path)
    again = load_truth(tmp_path / "negard_patient1.truth.parquet")
    assert again.strides == original.strides
    assert again.activities == original.activities
    assert np.array_equal(again.feet["right_foot"].sensor_m, original.feet["right_foot"].sensor_m)
    assert np.array_equal(again.reference, original.reference)


def test_missing_truth_names_the_file_and_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"x\.truth\.parquet: no such truth file; `python -m"):
        load_truth(tmp_path / "x.parquet")


def test_a_spoilt_truth_file_is_named(tmp_path: Path) -> None:
    write_truth(truth("example_csv"), tmp_path)
    file = tmp_path / "example_csv.strides.csv"
    text = file.read_text()
    file.write_text(text.replace("right_foot,1,", "right_foot,one,"))
    with pytest.raises(ValueError, match="number = 'one' is not a number"):
        load_truth(tmp_path / "example_csv.csv")
    file.write_text(text.replace("stride_length_m", "length"))
    with pytest.raises(ValueError, match="column 'stride_length_m' is missing"):
        load_truth(tmp_path / "example_csv.csv")
