"""The sensor model, one effect at a time."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fes.recording import Track
from fes.signals import G_MPS2, FloatArray
from fes.simulation.sensor import PERFECT, ImuModel, mounting
from sim_inputs.generator.measured import delivered, distort, ideal_signals, low_pass, measure, resample

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
