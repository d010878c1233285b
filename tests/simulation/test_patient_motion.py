"""The building blocks of motion, and the foot that rolls: derivatives are exact, the sole neither sinks nor slides."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.simulation.sensor import rotation
from sim_inputs.generator.foot import FootMotion, Rocker, Sole, stack
from sim_inputs.generator.motion import Block, Jet, Pulse, Ring, Step, evaluate, step_time, step_value, wander

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
