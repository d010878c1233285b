"""The bundled recordings: made again they are the same, their physics holds, their truth is the truth."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fes.recording import Recording, Track, read_recording
from fes.signals import G_MPS2, FloatArray
from fes.simulation.sensor import PERFECT, ImuModel, mounting
from fes.simulation.truth import Truth, load_truth
from sim_inputs.generator.foot import stack
from sim_inputs.generator.measured import delivered, distort, ideal_signals, low_pass, measure, resample
from sim_inputs.generator.session import Session
from sim_inputs.generator.trials import CSV_EXAMPLE, TRIALS, main
from statemachine.phases import Phase

FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
BY_NAME = {trial.name: trial for trial in (*TRIALS, CSV_EXAMPLE)}
PARQUET = [trial.name for trial in TRIALS]
WALKS = [name for name in PARQUET if name != "not_walking"]


@cache
def recording(name: str) -> Recording:
    return read_recording(FOLDER / f"{name}{'.csv' if name == CSV_EXAMPLE.name else '.parquet'}")


@cache
def truth(name: str) -> Truth:
    return load_truth(FOLDER / f"{name}.parquet")


@cache
def session(name: str) -> Session:
    return BY_NAME[name].session()


# --- made again ------------------------------------------------------------------------------------------


def test_made_twice_every_byte_is_the_same(tmp_path: Path) -> None:
    for folder in (tmp_path / "a", tmp_path / "b"):
        assert main([str(folder), "--only", "example_csv"]) == 0
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == 5
    for name in files:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


@pytest.mark.parametrize("name", ["negard_patient2", "both_feet_100hz", "example_csv"])
def test_made_again_it_is_the_bundled_one(name: str) -> None:
    made, made_truth = BY_NAME[name].make()
    bundled = recording(name)
    assert list(made.tracks) == list(bundled.tracks)
    for sensor, track in made.tracks.items():
        stored = bundled.tracks[sensor]
        assert np.array_equal(track.t_sensor_ns, stored.t_sensor_ns)
        # another machine's sine may differ in the last bit, hence here and there by one step of the sensor
        for mine, theirs, full in (
            (track.acc_mps2, stored.acc_mps2, track.acc_range_mps2),
            (track.gyr_radps, stored.gyr_radps, track.gyr_range_radps),
        ):
            assert full is not None
            off = np.abs(mine - theirs)
            assert off.max() < 1.1 * full / 2**15
            assert np.mean(off > 1e-5) < 1e-3
    assert len(made_truth.strides) == len(truth(name).strides)
    for mine_stride, bundled_stride in zip(made_truth.strides, truth(name).strides, strict=True):
        assert mine_stride.stride_length_m == pytest.approx(bundled_stride.stride_length_m, abs=2e-4)
        assert mine_stride.t_stance_s == pytest.approx(bundled_stride.t_stance_s, abs=2e-3)


def test_an_unknown_trial_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--only", "nobody"])
    assert "nobody: no such trial; choose one of negard_patient1" in capsys.readouterr().err


# --- physics ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "foot"), [("negard_patient2", "right_foot"), ("misaligned", "left_foot")])
def test_ideal_signals_integrate_back_to_the_pose(name: str, foot: str) -> None:
    """Integrating the ideal signals over a stride gives the pose back: 1 mm, 0.05°."""
    walk = session(name)
    rate_hz = 4000.0
    mount = mounting(*walk.placements[foot].angles_deg)
    for stride in truth(name).strides_of(foot)[10:12]:
        t = np.arange(round(stride.t_start_s * rate_hz), round(stride.t_end_s * rate_hz)) / rate_hz
        force, rate = walk.ideal(foot, t)
        path = walk.path(foot, t)
        position, velocity, _ = stack(path.sensor(walk.rocker, walk.placements[foot].body_m))
        turns = path.sensor_rotation() @ mount
        turn = turns[0]
        guessed = np.empty_like(turns)
        for index in range(len(t)):
            guessed[index] = turn
            step = 0.5 * (rate[index] + rate[min(index + 1, len(t) - 1)]) / rate_hz
            turn = turn @ turned_by(step)
        acceleration = np.einsum("nij,nj->ni", guessed, force) - [0.0, 0.0, G_MPS2]
        speed = velocity[0] + integrate(acceleration, rate_hz)
        where = position[0] + integrate(speed, rate_hz)
        angle = np.arccos(np.clip((np.einsum("nij,nij->n", guessed, turns) - 1.0) / 2.0, -1.0, 1.0))
        assert math.degrees(angle.max()) < 0.05
        assert np.abs(where - position).max() < 1e-3


def turned_by(vector: FloatArray) -> FloatArray:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: FloatArray = np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
    return turn


def integrate(values: FloatArray, rate_hz: float) -> FloatArray:
    steps = 0.5 * (values[1:] + values[:-1]) / rate_hz
    return np.vstack([np.zeros(values.shape[1]), np.cumsum(steps, axis=0)])


@pytest.mark.parametrize("name", PARQUET)
def test_the_sole_never_sinks_into_the_ground(name: str) -> None:
    walk = session(name)
    t = np.arange(0.0, walk.now_s, 0.004)
    sole = walk.rocker.ground.contact(np.radians(np.arange(-20.0, 61.0, 8.0)))
    for foot in walk.feet:
        path = walk.path(foot, t)
        assert path.channels["lift"].value.min() > -1e-9
        for x, z in sole:
            assert path.point(walk.rocker, (float(x), 0.0, float(z)))[2].value.min() > -2e-3


@pytest.mark.parametrize("name", WALKS)
def test_what_touches_the_ground_does_not_slide(name: str) -> None:
    """Heel and ball keep their place on the belt while the foot is flat; the toe does until it is about to leave."""
    walk = session(name)
    for foot in walk.feet:
        t = np.arange(0.0, walk.now_s, 0.004)
        path = walk.path(foot, t)
        marks = [stack(path.point(walk.rocker, body))[0] for body in ((walk.rocker.sole.ball_m, 0.0, 0.0), walk.heel_m)]
        strides = [stride for stride in truth(name).strides_of(foot) if stride.walking]
        for before, after in pairwise(strides):
            flat, off, free = np.searchsorted(t, [before.t_stance_s, after.t_pre_swing_s, after.t_swing_s])
            for mark in marks:
                assert np.ptp(mark[flat:off, :2], axis=0).max() < 4e-3
            # rolling apart, nothing moves the sole from heel off to toe-off
            assert np.ptp(path.channels["along"].value[off:free]) < 4e-3
            assert np.ptp(path.channels["lift"].value[off:free]) < 1e-6


@pytest.mark.parametrize("name", PARQUET)
def test_at_rest_the_sensors_read_gravity(name: str) -> None:
    for track in recording(name).tracks.values():
        first = track.t_ns < 2_500_000_000
        assert np.linalg.norm(track.acc_mps2[first].mean(axis=0)) == pytest.approx(G_MPS2, abs=0.35)
        assert np.linalg.norm(track.gyr_radps[first].mean(axis=0)) < math.radians(1.2)


# --- what each trial is for ------------------------------------------------------------------------------


def jump_of_contact(name: str, foot: str) -> FloatArray:
    """Greatest change of acceleration over 10 ms around each contact, m/s³."""
    track = recording(name).tracks[foot]
    span = round(0.01 * track.rate_hz)
    norm = np.linalg.norm(track.acc_mps2, axis=1)
    jump = np.abs(norm[span:] - norm[:-span]) / (span / track.rate_hz)
    t = track.t_ns[:-span] * 1e-9
    found = []
    for stride in truth(name).strides_of(foot):
        near = (t > stride.t_loading_response_s - 0.03) & (t < stride.t_loading_response_s + 0.08)
        found.append(float(jump[near].max()))
    return np.array(found)


def test_contacts_jolt_except_the_soft_ones() -> None:
    assert np.median(jump_of_contact("negard_patient2", "right_foot")) > 2000.0
    assert np.median(jump_of_contact("both_feet_200hz", "left_foot")) > 2000.0
    assert jump_of_contact("soft_contact", "right_foot").max() < 300.0
    assert not any(stride.loading_detectable for stride in truth("soft_contact").strides)
    assert all(stride.loading_detectable for stride in truth("negard_patient1").strides)


def test_the_faulty_link_loses_and_doubles_samples() -> None:
    for sensor in ("left_foot", "right_foot"):
        faulty = recording("both_feet_200hz").tracks[sensor].quality
        clean = recording("both_feet_100hz").tracks[sensor].quality
        assert faulty.missing > 10
        assert faulty.doubled > 10
        assert clean.missing == clean.doubled == clean.irregular == 0


def test_misaligned_sensors_are_far_off_and_differ() -> None:
    """The mediolateral rate shows on the y axis with opposite signs: calibration must find that."""
    signs = []
    for foot in ("left_foot", "right_foot"):
        track = recording("misaligned").tracks[foot]
        down = [
            track.gyr_radps[np.searchsorted(track.t_ns, round(stride.t_swing_s * 1e9) - 10_000_000)]
            for stride in truth("misaligned").strides_of(foot)
            if stride.steady
        ]
        mean = np.mean(down, axis=0)
        assert np.abs(mean / np.linalg.norm(mean)).max() < 0.97
        signs.append(np.sign(mean[1]))
    assert signs[0] != signs[1]


def test_not_walking_says_what_is_done_when() -> None:
    activities = truth("not_walking").activities
    assert activities[0].start_s == 0.0
    for before, after in pairwise(activities):
        assert after.start_s == pytest.approx(before.end_s)
    assert [item.activity for item in activities if item.walking] == ["walking"]
    assert sum(item.activity == "heel_lift" for item in activities) == 7
    kinds = {item.activity for item in activities}
    assert {"weight_shift", "turning", "sitting_down", "standing_up", "treadmill_start", "treadmill_stop"} <= kinds
    assert 90.0 < activities[-1].end_s < 125.0
    walked = [stride for stride in truth("not_walking").strides if stride.walking]
    assert len(walked) == 20
    for item in (item for item in activities if item.activity == "heel_lift"):
        lifted = []
        for series in truth("not_walking").feet.values():
            t = series.t_ns * 1e-9
            inside = (t > item.start_s) & (t < item.end_s)
            lifted.append(bool(np.any(series.phase[inside] == Phase.PRE_SWING)))
            assert not np.any(series.phase[inside] == Phase.SWING)
        assert lifted.count(True) == 1


# --- The sensor model, one effect at a time ---


FINE = np.arange(0.0, 20.0, 1 / 2000)
WAVE = np.column_stack([np.sin(2 * math.pi * f * FINE) for f in (1.0, 3.0, 7.0)])


def run(
    model: ImuModel, force: FloatArray = WAVE, rate: FloatArray = WAVE, seed: int = 1, rate_hz: float = 200.0
) -> Track:
    return measure(np.random.default_rng(seed), model, "right_foot", rate_hz, FINE, force, rate)


def test_a_perfect_sensor_delivers_the_truth() -> None:
    track = run(PERFECT)
    assert np.abs(track.acc_mps2 - WAVE[::10]).max() < 1e-9
    assert np.array_equal(track.t_ns, np.arange(len(track.t_ns)) * 5_000_000)


def test_same_seed_same_numbers_other_seed_others() -> None:
    assert np.array_equal(run(ImuModel()).acc_mps2, run(ImuModel()).acc_mps2)
    assert not np.array_equal(run(ImuModel()).acc_mps2, run(ImuModel(), seed=2).acc_mps2)


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_noise_density_holds_at_any_rate(rate_hz: float) -> None:
    model = replace(PERFECT, gyr_noise_radps_rthz=1e-3, acc_noise_mps2_rthz=2e-3)
    track = run(model, 0.0 * WAVE, 0.0 * WAVE, rate_hz=rate_hz)
    assert np.std(track.gyr_radps) == pytest.approx(1e-3 * math.sqrt(rate_hz / 2), rel=0.05)
    assert np.std(track.acc_mps2) == pytest.approx(2e-3 * math.sqrt(rate_hz / 2), rel=0.05)


def test_bias_is_constant_and_within_its_limit() -> None:
    track = run(replace(PERFECT, gyr_bias_radps=0.02, acc_bias_mps2=0.3), 0.0 * WAVE, 0.0 * WAVE)
    for values, limit in ((track.gyr_radps, 0.02), (track.acc_mps2, 0.3)):
        assert np.ptp(values, axis=0).max() < 1e-12
        assert 0.0 < np.abs(values[0]).max() <= limit


def test_bias_walks_with_the_root_of_time() -> None:
    rng = np.random.default_rng(4)
    model = replace(PERFECT, gyr_walk_radps_rts=1e-2)
    ends = [distort(rng, np.zeros((400, 3)), 100.0, model, accelerometer=False)[-1] for _ in range(300)]
    assert np.std(ends) == pytest.approx(1e-2 * math.sqrt(4.0), rel=0.1)


def test_scale_and_cross_axis_errors() -> None:
    rng = np.random.default_rng(6)
    unit = np.repeat(np.eye(3), 1, axis=0)
    gains = np.array(
        [distort(rng, unit, 100.0, replace(PERFECT, scale_error=0.01), accelerometer=True) for _ in range(400)]
    )
    assert np.std([np.diag(gain) for gain in gains]) == pytest.approx(0.01, rel=0.1)
    assert np.abs(gains[:, ~np.eye(3, dtype=bool)]).max() == 0.0
    crossed = distort(rng, unit, 100.0, replace(PERFECT, cross_axis=0.01), accelerometer=True)
    assert np.allclose(np.diag(crossed), 1.0)
    assert np.abs(crossed - np.eye(3)).max() > 1e-3


def test_range_clips_and_bits_quantise() -> None:
    track = run(replace(PERFECT, acc_range_mps2=0.5, gyr_range_radps=0.5, bits=8), WAVE, WAVE)
    assert np.abs(track.acc_mps2).max() == pytest.approx(0.5)
    assert track.acc_mps2.max() == pytest.approx(0.5 * 127 / 128)
    steps = track.acc_mps2 / (0.5 / 128)
    assert np.abs(steps - np.round(steps)).max() < 1e-9
    assert track.acc_range_mps2 == 0.5


def test_quantising_without_a_range_is_refused() -> None:
    with pytest.raises(ValueError, match="needs a range"):
        run(replace(PERFECT, bits=16))


def test_a_fine_grid_too_slow_is_refused() -> None:
    with pytest.raises(ValueError, match="fine grid"):
        run(PERFECT, rate_hz=1500.0)


def test_bandwidth_keeps_slow_and_removes_fast() -> None:
    t = np.arange(4000) / 4000
    slow, fast = np.sin(2 * math.pi * 10 * t)[:, None], np.sin(2 * math.pi * 300 * t)[:, None]
    assert np.abs(low_pass(slow, 80 / 4000) - slow)[400:-400].max() < 5e-3
    assert np.abs(low_pass(fast, 80 / 4000))[400:-400].max() < 5e-3


def test_resampling_between_the_grid_is_third_order_exact() -> None:
    grid = np.arange(200) / 200
    inside = np.linspace(0.05, 0.9, 77)
    cubic = np.column_stack([grid**2, 3 * grid, grid * 0 + 2])
    assert (
        np.abs(resample(grid, cubic, inside) - np.column_stack([inside**2, 3 * inside, inside * 0 + 2])).max() < 1e-12
    )


def test_jittered_samples_are_taken_where_the_stamp_says() -> None:
    track = run(replace(PERFECT, jitter_s=0.0008))
    interval = np.diff(track.t_ns)
    assert interval.min() > 0
    assert np.std(interval) == pytest.approx(0.0008 * 1e9 * math.sqrt(2), rel=0.1)
    t = track.t_ns * 1e-9
    assert np.abs(track.acc_mps2[:, 1] - np.sin(2 * math.pi * 3.0 * t))[1:-1].max() < 1e-6


def test_lost_and_doubled_samples() -> None:
    index = delivered(np.random.default_rng(8), 20_000, 0.01, 0.02)
    assert np.all(np.diff(index) >= 0)
    assert 20_000 - len(np.unique(index)) == pytest.approx(200, rel=0.3)
    assert np.count_nonzero(np.diff(index) == 0) == pytest.approx(400, rel=0.3)
    assert index[0] == 0
    assert index[-1] == 19_999
    track = run(replace(PERFECT, lost=0.01, doubled=0.02))
    assert np.count_nonzero(np.diff(track.t_ns) == 0) > 20
    assert np.count_nonzero(np.diff(track.t_ns) > 7_000_000) > 10


def test_a_sensor_at_rest_measures_gravity_along_what_is_up() -> None:
    mount = mounting(0.0, 20.0, 0.0)
    level = np.eye(3)[None]
    force, rate = ideal_signals(np.zeros((1, 3)), level, np.array([[0.0, 1.0, 0.0]]), mount, np.array([0.0, 0.0, 1.0]))
    assert np.linalg.norm(force) == pytest.approx(G_MPS2)
    # a sensor that slopes down forward, as on an instep, sees gravity pull it forward: x reads backward
    assert force[0, 0] == pytest.approx(-G_MPS2 * math.sin(math.radians(20.0)))
    assert rate[0] == pytest.approx([0.0, 1.0, 0.0])
