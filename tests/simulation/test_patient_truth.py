"""The truth beside the bundled recordings: true, complete, in order, and the same after writing and reading."""

import math
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.recording import Recording, read_recording
from fes.signals import G_MPS2, FloatArray
from fes.simulation.sensor import quaternions, rotation
from fes.simulation.truth import Truth, TruthStride, load_truth, write_truth
from sim_inputs.generator.foot import FootMotion, Rocker, Sole, stack
from sim_inputs.generator.motion import Block, Jet, Pulse, Ring, Step, evaluate, step_time, step_value, wander
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


# --- The building blocks of motion, and the foot that rolls: derivatives are exact ---


FINE = np.arange(0.0, 2.0, 1e-4)
ROCKER = Rocker(Sole())


def check_derivatives(jet: Jet, step: float, tolerance: float = 2e-4) -> None:
    """Central differences of the value give the rate, of the rate the acceleration."""
    for below, above in ((jet.value, jet.rate), (jet.rate, jet.acceleration)):
        difference = (below[2:] - below[:-2]) / (2.0 * step)
        scale = np.abs(above).max() + 1e-9
        assert np.abs(difference - above[1:-1]).max() / scale < tolerance


@pytest.mark.parametrize(
    "block",
    [
        Step(0.2, 0.9, 1.5),
        Step(0.3, 1.4, -0.7, m=4, n=2),
        Pulse(0.1, 0.5, 0.9, 1.3, 0.8),
        Ring(0.4, 20.0, 30.0, 0.016, rise_s=0.01),
        wander(np.random.default_rng(3), 0.2, 1.8, 0.1, 0.3),
    ],
)
def test_blocks_carry_their_own_derivatives(block: Block) -> None:
    jet = evaluate([block], FINE)
    check_derivatives(jet, 1e-4, 5e-3)
    assert jet.value[0] == jet.rate[0] == jet.acceleration[0] == 0.0
    assert abs(jet.rate[-1]) < 1e-9


@given(st.integers(2, 6), st.integers(2, 6), st.floats(0.02, 0.98))
def test_step_time_inverts_step_value(m: int, n: int, fraction: float) -> None:
    assert step_value(np.array([step_time(fraction, m, n)]), m, n)[0] == pytest.approx(fraction, abs=1e-9)


def test_pulse_goes_as_far_as_it_says() -> None:
    pulse = Pulse(0.1, 0.5, 0.9, 1.3, 0.8)
    assert evaluate([pulse], FINE).value[-1] == pytest.approx(pulse.total, abs=1e-12)
    assert pulse.total == pytest.approx(0.8 * 0.8)


def test_blocks_do_the_same_on_any_grid() -> None:
    blocks: list[Block] = [Step(0.2, 0.9, 1.5), Pulse(0.1, 0.5, 0.9, 1.3, 0.8), Ring(0.4, 20.0, 30.0, 0.016)]
    whole = evaluate(blocks, FINE)
    assert np.array_equal(evaluate(blocks, FINE[7::13]).value, whole.value[7::13])


@settings(max_examples=40)
@given(st.floats(-40.0, 75.0))
def test_contact_point_is_the_lowest_and_the_ground_is_never_crossed(pitch_deg: float) -> None:
    """The support function of a convex sole: no point of the sole lies below the one that touches."""
    pitch = np.array([math.radians(pitch_deg)])
    still = Jet(pitch, np.zeros(1), np.zeros(1))
    _, height = ROCKER.roll(still, Jet(np.zeros(1), np.zeros(1), np.zeros(1)))
    sole = ROCKER.ground.contact(np.radians(np.linspace(-45.0, 80.0, 400)))
    above = height.value[0] - math.sin(pitch[0]) * sole[:, 0] + math.cos(pitch[0]) * sole[:, 1]
    assert above.min() > -1e-6
    assert above.min() < 2e-4


def test_rolling_does_not_slip() -> None:
    """The foot's point that touches stands still in that instant, at any pitch and pitch rate."""
    motion = FootMotion()
    motion.add("pitch", Step(0.1, 0.9, math.radians(-20.0)), Step(0.8, 1.8, math.radians(80.0)))
    path = motion.at(FINE)
    touch = ROCKER.ground.contact(path.channels["pitch"].value)
    for index in range(2000, 18000, 1500):
        x, z = touch[index]
        position, velocity, _ = stack(path.point(ROCKER, (float(x), 0.0, float(z))))
        assert abs(position[index, 2]) < 1e-9
        assert np.abs(velocity[index]).max() < 1e-6


def test_in_the_air_the_true_sole_stays_above_the_lift_asked_for() -> None:
    pitch = np.radians(np.linspace(-40.0, 75.0, 300))
    zero = np.zeros_like(pitch)
    on_ground = ROCKER.roll(Jet(pitch, zero, zero), Jet(zero, zero, zero))[1]
    free = ROCKER.roll(Jet(pitch, zero, zero), Jet(zero + 1.0, zero, zero))[1]
    above = free.value - on_ground.value
    assert above.min() > -1e-6
    assert above.max() < 0.025


def test_pose_angular_rate_and_velocity_belong_to_the_pose() -> None:
    """The rate is that of the rotation matrix, the acceleration that of the position; all channels in use."""
    rng = np.random.default_rng(5)
    motion = FootMotion()
    for channel, size in (("pitch", 0.4), ("roll", 0.2), ("yaw", 0.3), ("along", 0.5), ("lift", 0.05), ("air", 0.3)):
        motion.add(channel, wander(rng, 0.0, 2.0, 0.2, size))
    path = motion.at(FINE)
    for part in path.sensor(ROCKER, (0.07, 0.01, 0.07)):
        check_derivatives(part, 1e-4, 2e-3)
    turns = path.sensor_rotation()
    relative = np.einsum("nji,njk->nik", turns[:-2], turns[2:])
    measured = np.column_stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ]
    ) / (4e-4)
    assert np.abs(measured - path.sensor_rate()[1:-1]).max() < 1e-4


def test_positive_pitch_is_toe_down_and_positive_yaw_to_the_left() -> None:
    toe_down = rotation(np.array([0.3]), np.zeros(1), np.zeros(1))[0] @ [1.0, 0.0, 0.0]
    left = rotation(np.zeros(1), np.zeros(1), np.array([0.3]))[0] @ [1.0, 0.0, 0.0]
    assert toe_down[2] < -0.2
    assert left[1] > 0.2
