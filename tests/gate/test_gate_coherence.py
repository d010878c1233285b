"""Accelerometer and gyroscope against each other: sound strides are no fault; what lies is told within a stride."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable

import pytest
from coherence_streams import LIES, SAID, verdicts
from gate_bench import MS, Bench
from judges import Coherence, MeanForce, Six, Stillness

from fes.gate.plausibility import BOUNDS
from fes.signals import G_MPS2, NS_PER_S, ImuSample, OperatorAction, Vector3

S = NS_PER_S
STRIDE_S, STANCE_S = 1.2, 0.6
Change = Callable[[Six, float], Six]


def stride(t_s: float) -> Six:
    """Force and rate of a foot that stands flat, rises its heel, swings, and strikes the ground; both fit together."""
    phase_s = t_s % STRIDE_S - STANCE_S
    alive = 1e-3 * math.sin(1e4 * t_s)
    if phase_s < 0.0:
        return (alive, -alive, G_MPS2 + alive, alive, -alive, alive)
    omega = 2 * math.pi / (STRIDE_S - STANCE_S)
    pitch, rate = 0.5 * (1 - math.cos(omega * phase_s)), 0.5 * omega * math.sin(omega * phase_s)
    roll = 0.15 * math.sin(omega * phase_s)
    roll_rate = 0.15 * omega * math.cos(omega * phase_s)
    forward = 9.0 * math.sin(omega * phase_s) + (25.0 if phase_s > STRIDE_S - STANCE_S - 0.03 else 0.0)
    x = forward * math.cos(pitch) - G_MPS2 * math.sin(pitch) + alive
    z = forward * math.sin(pitch) + G_MPS2 * math.cos(pitch)
    y, z = z * math.sin(roll) + 2.0 * math.sin(3 * omega * phase_s), z * math.cos(roll)
    return (x, y, z, roll_rate, rate + alive, 0.3 * math.sin(2 * omega * phase_s))


def same(values: Six, t_s: float) -> Six:
    return values


def walk(
    change: Change = same,
    seconds: float = 12.0,
    rate_hz: float = 100.0,
    sensor: str = "left_foot",
    from_s: float = 0.0,
) -> tuple[str, float]:
    """What was said first of strides that ``change`` alters from ``from_s`` on, and how long after that (s)."""
    judge, step_ns = Coherence(sensor), round(S / rate_hz)
    for k in range(round(seconds * rate_hz)):
        t_ns = S + k * step_ns
        t_s = 1e-9 * k * step_ns
        values = change(stride(t_s), t_s) if t_s >= from_s else stride(t_s)
        if said := judge.fault(ImuSample(t_ns, sensor, t_ns, values[:3], values[3:])):
            return said, t_s - from_s
    return "", math.inf


@pytest.mark.parametrize("rate_hz", [60.0, 100.0, 200.0, 500.0, 1000.0])
@pytest.mark.parametrize("sensor", ["left_foot", "right_shank"])
def test_sound_strides_are_no_fault(rate_hz: float, sensor: str) -> None:
    assert walk(rate_hz=rate_hz, sensor=sensor)[0] == ""


def stuck(axes: tuple[int, ...], noise: float, at_s: float) -> Change:
    held = stride(at_s)

    def change(values: Six, t_s: float) -> Six:
        a = list(values)
        for axis in axes:
            a[axis] = held[axis] + noise * math.sin(1e5 * t_s + axis)
        return (a[0], a[1], a[2], a[3], a[4], a[5])

    return change


ACC, GYR = (0, 1, 2), (3, 4, 5)
SWING_S, STANCE_AT_S = 4 * STRIDE_S + STANCE_S + 0.12, 4 * STRIDE_S + 0.2
LATER_S = 14 * STRIDE_S + 0.2  # in stance, when every axis is known


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(
    ("axes", "noise", "from_s", "says", "within_s"),
    [
        pytest.param(ACC, 0.0, SWING_S, "accelerometer is frozen", 0.08, id="force frozen in swing"),
        pytest.param(ACC, 0.0, STANCE_AT_S, "accelerometer is frozen", 0.08, id="force frozen in stance"),
        pytest.param(GYR, 0.0, SWING_S, "gyroscope is frozen", 0.08, id="rate frozen in swing"),
        pytest.param(GYR, 0.0, STANCE_AT_S, "gyroscope is frozen", 0.08, id="rate frozen in stance"),
        pytest.param(ACC, 0.1, SWING_S, "accelerometer does not feel", 0.5, id="force dead in swing"),
        pytest.param(ACC, 0.1, STANCE_AT_S, "accelerometer does not feel", 0.8, id="force dead in stance"),
        pytest.param((0,), 0.1, LATER_S, "x axis does not feel", STRIDE_S, id="an axis of force stuck"),
        pytest.param(GYR, 0.05, SWING_S, "accelerometer does not feel|do not fit", STRIDE_S, id="rate stuck in swing"),
        pytest.param(GYR, 0.05, STANCE_AT_S, "gyroscope does not feel", 2 * STRIDE_S, id="rate dead in stance"),
        pytest.param((3,), 0.05, LATER_S, "x axis does not feel", STRIDE_S, id="an axis of rate stuck"),
        pytest.param((4,), 0.05, SWING_S, "fit|does not feel", 1.6, id="main axis of rate stuck"),
        *(
            pytest.param((axis,), 0.0, SWING_S, f"{'xyz'[axis % 3]} axis is frozen", 0.15, id=f"axis {axis} frozen")
            for axis in range(6)
        ),
        pytest.param((4,), 0.0, STANCE_AT_S, "y axis is frozen", STANCE_S + 0.15, id="main axis frozen in stance"),
    ],
)
def test_what_is_stuck_is_told(axes: tuple[int, ...], noise: float, from_s: float, says: str, within_s: float) -> None:
    said, after_s = walk(stuck(axes, noise, from_s), seconds=24.0, from_s=from_s)
    assert any(word in said for word in says.split("|")), said
    assert after_s <= within_s


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_force_that_is_scaled_is_told_within_two_strides(factor: float) -> None:
    def change(v: Six, t_s: float) -> Six:
        return (factor * v[0], factor * v[1], factor * v[2], v[3], v[4], v[5])

    said, after_s = walk(change, from_s=STANCE_AT_S)
    assert "do not fit" in said or "is it scaled?" in said
    assert after_s <= 2 * STRIDE_S
    said, after_s = walk(change, from_s=SWING_S)
    assert after_s <= 2 * STRIDE_S


def test_a_triad_that_lives_again_is_ready_again() -> None:
    judge, freeze = Coherence("left_foot"), stuck(ACC, 0.0, 1.0)
    ready = []
    for k in range(300):
        t_s = 0.01 * k
        judge.over([freeze(stride(t_s), t_s) if 1.0 <= t_s < 1.2 else stride(t_s)], S + k * 10 * MS)
        ready.append(judge.not_ready == "")
    assert all(ready[:106])
    assert not ready[115]
    assert all(ready[121:])


def test_single_repeats_of_now_one_triad_now_the_other_are_no_frozen_axis() -> None:
    """A converter of few bits repeats a value now and then; what repeated once and went on is not counted again."""
    walked = [list(stride(0.0))]
    for k in range(400):
        now = list(stride(0.01 * k))
        for axis in (3, 5) if k % 2 else (1,) if k == 200 else ():
            now[axis] = walked[-1][axis]
        walked.append(now)
    assert not any(Coherence("left_foot").over((x, y, z, p, q, r) for x, y, z, p, q, r in walked[1:]))


def pendulum(t_s: float, swings: float) -> Six:
    tilt, turn = 0.7 * math.sin(swings * t_s), 0.7 * swings * math.cos(swings * t_s)
    noise = 0.02 * math.sin(9e4 * t_s)
    return (noise, -noise, G_MPS2 * math.cos(tilt) + 0.3 * turn**2, 0.01 * math.sin(t_s), turn, noise)


@pytest.mark.parametrize("swings", [5.0, 7.0])
def test_a_sensor_that_dangles_is_told(swings: float) -> None:
    said, after_s = walk(lambda _, t_s: pendulum(t_s, swings), from_s=STANCE_AT_S)
    assert "dangle" in said or "axis does not feel it" in said or "accelerometer does not feel it" in said
    assert after_s < 3.0


@pytest.mark.requirement("SR-10")
def test_what_repeats_itself_at_full_scale_or_from_the_start_is_not_frozen() -> None:
    def clipped(v: Six, t_s: float) -> Six:
        return (v[0], v[1], v[2], v[3], max(min(v[4], 2.0), -2.0), v[5])

    def planar(v: Six, t_s: float) -> Six:
        return (v[0], v[1], v[2], 0.0, v[4], v[5])

    assert "frozen" not in walk(clipped)[0]
    assert "frozen" not in walk(planar, sensor="left_shank")[0]


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(("turns", "says"), [(0.6, ""), (0.02, "z axis does not feel")])
def test_an_axis_may_move_less_but_not_by_nothing(turns: float, says: str) -> None:
    """As feet do that no longer turn about an axis; a fiftieth of the usual, or 0.1 rad/s, is a move."""

    def change(v: Six, t_s: float) -> Six:
        return (v[0], v[1], v[2], v[3], v[4], turns * v[5])

    said, _ = walk(change, seconds=24.0, from_s=LATER_S, sensor="right_shank")
    assert says in said
    assert bool(said) == bool(says)


def test_whoever_stands_moves_no_axis_and_none_is_dead() -> None:
    def living(k: int) -> Six:
        x, y, z, p, q, r = (each + 1e-3 * math.sin(1e4 * k) for each in stride(0.01 * k if k < 800 else 0.1))
        return (x, y, z, p, q, r)

    assert not any(Coherence("left_shank").over(map(living, range(1400))))


def test_after_a_long_silence_what_is_usual_is_learnt_anew() -> None:
    judge, said = Coherence("left_shank"), list[str]()
    for begin_s, share in ((0.0, 1.0), (20.0, 0.02)):  # put on anew, it turns otherwise
        walked = (stride(begin_s + 0.01 * k) for k in range(600))
        said += judge.over(((*five, share * last) for *five, last in walked), S + round(S * begin_s))
    assert not any(said)


@pytest.mark.parametrize("name", LIES)
def test_of_every_stream_it_says_what_it_said(name: str) -> None:
    """To the sample. Who changes a rule writes the file anew (``coherence_streams.py``) and looks at the difference."""
    before = json.loads(SAID.read_text(encoding="utf-8"))
    assert before.keys() == LIES.keys()
    assert verdicts(name) == before[name]
    if name == "none":
        assert before[name] == ["0 in all, not ready in 0"]


# --- to the digit -----------------------------------------------------------------------------------------------------


def feed(judge: Coherence, values: Iterable[Six], t_ns: int = S, step_ns: int = 15 * MS) -> list[str]:
    """What is said of each; a step is a block of its own."""
    assert step_ns >= BOUNDS.block_ns
    return judge.over(values, t_ns, step_ns)


def alive(k: int, z: float = G_MPS2, rate: float = 0.0) -> Six:
    return (1e-6 * k, 0.0, z, 0.0, rate, 1e-6 * k)


@pytest.mark.parametrize("step_ns", [15 * MS, BOUNDS.block_ns, BOUNDS.most_step_ns])
def test_force_that_moves_without_a_turn_is_counted(step_ns: int) -> None:
    moving = [alive(k, G_MPS2 + 1.5 * (k % 2)) for k in range(BOUNDS.most_unturned + 4)]
    said = feed(Coherence("left_foot"), moving, step_ns=step_ns)
    assert next(k for k, each in enumerate(said) if each) == BOUNDS.most_unturned + 2
    turning = [alive(k, G_MPS2 + 1.5 * (k % 2), 0.3 * (k // 20 % 2)) for k in range(60)]
    assert not any(feed(Coherence("left_foot"), turning))


@pytest.mark.parametrize("size_mps2", [G_MPS2, 2.4])
@pytest.mark.parametrize("unseen", [0, 1, 2])
def test_an_axis_that_feels_nothing_of_gravity_turning_into_it_is_counted(unseen: int, size_mps2: float) -> None:
    """Gravity is along one axis, the turn about another; force along that one moves, as somebody's would."""
    gravity, about = (unseen + 1) % 3, (unseen + 2) % 3
    values, way_mps2, after = list[Six](), 0.0, 0
    for k in range(90):
        rate = 2.0 + 0.3 * (k // 10 % 2)
        force, turn = [1e-6 * k] * 3, [1e-6 * k] * 3
        force[gravity], force[about], turn[about] = size_mps2, 0.75 * (-1) ** k, rate
        values.append((force[0], force[1], force[2], turn[0], turn[1], turn[2]))
        if k > 1 and way_mps2 <= BOUNDS.most_unseen_axis_mps2:  # the first begins, the second is the first mean
            way_mps2 += G_MPS2 * 0.015 * rate * size_mps2 / math.hypot(size_mps2, 0.75)
            after = k
    said = feed(Coherence("left_foot"), values)
    assert next(k for k, each in enumerate(said) if each) == after
    assert f"accelerometer's {'xyz'[unseen]} axis does not feel it" in said[after]


def test_turning_counts_as_smooth_through_what_is_no_jolt_and_anew_after_one() -> None:
    rate, jolt_at = 4.0, 12
    count = math.ceil(BOUNDS.most_smooth_rad / (rate * 0.015))

    def turning(change_mps2: float, every: int) -> list[str]:
        """It turns about its own upright; force across it changes now and then, and once by a jolt."""
        return feed(
            Coherence("right_shank"),
            [
                (1e-6 * k, change_mps2 * (k // every % 2) + 2.5 * (k == jolt_at), G_MPS2, 0.3 * (k % 2), 1e-6 * k, rate)
                for k in range(jolt_at + count + 3)
            ],
        )

    shaken, calm = turning(1.5, 10), turning(0.0, 10)
    for said in (shaken, calm):
        assert [k for k, each in enumerate(said) if "dangle" in each] == [jolt_at + 1 + count]


@pytest.mark.parametrize(
    ("off_mps2", "rate_radps", "tells"),
    [
        (BOUNDS.gravity_off_mps2 - 0.01, 0.0, False),
        (BOUNDS.gravity_off_mps2 + 0.01, 0.0, True),
        (-BOUNDS.gravity_off_mps2 - 0.01, 0.0, True),
        (-G_MPS2, 0.0, True),
        (-2.8, 0.2, True),
        (-2.8, 0.4, False),  # a slow swing comes down as evenly
    ],
)
def test_gravity_at_a_long_rest(off_mps2: float, rate_radps: float, tells: bool) -> None:
    said = feed(Coherence("left_foot"), [alive(k, G_MPS2 + off_mps2, rate_radps) for k in range(40)])
    assert any("is it scaled?" in each for each in said) is tells
    assert not any(said[:14]), "not before 0.2 s"


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_force_that_is_scaled_and_never_rests_is_told(factor: float) -> None:
    def change(v: Six, t_s: float) -> Six:
        x, y, z, *_ = v
        more = factor if t_s >= 20.0 else 1.0
        return (more * x, more * y, more * z, v[3], v[4], v[5] + 0.8 * (-1) ** round(50.0 * t_s))

    said, after_s = walk(change, seconds=24.0)
    assert "do not fit" in said
    assert 20.0 < after_s < 21.5


def felt(judge: MeanForce, extra_mps2: float, rate_radps: float, seconds: float) -> list[bool]:
    """Whether it says that something is wrong, of a turn about the force's own direction with more or less of it."""
    force, rate = (0.0, 0.0, G_MPS2 + extra_mps2), (0.0, 0.0, rate_radps)
    return [judge.wrong(force, rate, rate_radps, 15 * MS) > 0.0 for _ in range(round(seconds / 0.015))]


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(
    ("usual_mps2", "then_mps2", "tells"),
    [
        pytest.param(0.0, BOUNDS.more_mps2 - 0.02, False, id="more"),
        pytest.param(0.0, BOUNDS.more_mps2 + 0.02, True, id="too much"),
        pytest.param(0.0, -BOUNDS.less_mps2 + 0.02, False, id="less"),
        pytest.param(0.0, -BOUNDS.less_mps2 - 0.02, True, id="too little"),
        pytest.param(-0.6, BOUNDS.more_mps2 - 0.5, True, id="than usual here"),
        pytest.param(-0.6, -BOUNDS.less_mps2 - 0.5, False, id="usual here"),
    ],
)
def test_the_mean_force_is_what_it_usually_is(usual_mps2: float, then_mps2: float, tells: bool) -> None:
    """Learnt while the foot walks; it then turns slowly, so that nothing is learnt any more."""
    judge = MeanForce()
    assert not any(felt(judge, usual_mps2, BOUNDS.walks_radps + 0.01, 80.0))
    assert any(felt(judge, then_mps2, BOUNDS.walks_radps - 0.01, 6.0)) is tells


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(
    ("extra_mps2", "tells"),
    [
        (BOUNDS.more_at_first_mps2 - 0.02, False),
        (BOUNDS.more_at_first_mps2 + 0.02, True),
        (-BOUNDS.less_at_first_mps2 + 0.02, False),
        (-BOUNDS.less_at_first_mps2 - 0.02, True),
        (-G_MPS2, True),
    ],
)
def test_the_mean_force_is_about_gravity_at_first(extra_mps2: float, tells: bool) -> None:
    said = felt(MeanForce(), extra_mps2, BOUNDS.walks_radps - 0.01, 10.0)
    assert any(said) is tells
    assert not any(said[:199]), "not before three seconds"


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(("factor", "tells"), [(1.0, False), (2.5, True), (-1.0, True)])
def test_a_rate_that_turns_the_force_elsewhere_is_told_within_a_stride(factor: float, tells: bool) -> None:
    judge, said = MeanForce(), list[bool]()
    for k in range(800):
        t_s, now = 0.015 * k, factor if k >= 700 else 1.0
        pitch, rate = 0.9 * math.sin(6.0 * t_s), 5.4 * math.cos(6.0 * t_s)
        force = (-G_MPS2 * math.sin(pitch), 0.0, G_MPS2 * math.cos(pitch))
        said.append(judge.wrong(force, (0.0, now * rate, 0.0), abs(rate), 15 * MS) > 0.0)
    assert not any(said[:700])
    assert any(said[700:]) is tells


def moving(seconds: float, still: int = -1, others: float = 1.0) -> list[Six]:
    """Six axes that move as those of somebody who walks, but for one that lies still from the middle on."""
    found: list[Six] = []
    count = round(seconds / 0.015)
    for k in range(count):
        swing = [others * math.sin(0.1 * k + axis) for axis in range(6)]
        if still >= 0 and k > count // 2:
            swing[still] = 0.02 * (-1) ** k
        x, y, z, p, q, r = swing
        found.append((3.0 * x + 2.5 * (-1) ** (k // 3), 3.0 * y, G_MPS2 + 3.0 * z, p, q, r))
    return found


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize("axis", range(1, 6))
def test_an_axis_that_lies_still_while_the_others_move(axis: int) -> None:
    said = stuck_ones(moving(24.0))
    assert said == {-1: 0}
    said = stuck_ones(moving(24.0, axis))
    assert set(said) == {-1, axis}


def stuck_ones(values: list[Six]) -> dict[int, int]:
    """By the axis that was called stuck, -1 for none, since which of these."""
    stillness, said = Stillness(), dict[int, int]()
    for k, each in enumerate(values):
        said.setdefault(stillness.stuck(each, 15 * MS), k)
    return said


def test_a_gap_begins_anew() -> None:
    judge = Coherence("left_foot")
    moving = [alive(k, G_MPS2 + 1.5 * (k % 2)) for k in range(BOUNDS.most_unturned)]
    assert not any(feed(judge, moving))
    assert not any(feed(judge, moving, S + len(moving) * 15 * MS + BOUNDS.most_step_ns)), (
        "what was counted is forgotten"
    )


@pytest.mark.parametrize(
    ("back_ns", "counts"),
    [(0, True), (BOUNDS.most_step_ns - 1, True), (BOUNDS.most_step_ns, False), (BOUNDS.most_step_ns + 1, False)],
)
def test_a_stamp_that_goes_back_by_a_step_is_passed_over_and_by_more_begins_anew(back_ns: int, counts: bool) -> None:
    judge = Coherence("left_foot")
    moving = [alive(k, G_MPS2 + 1.5 * (k % 2)) for k in range(BOUNDS.most_unturned)]
    feed(judge, moving)
    last_ns = S + (len(moving) - 1) * 15 * MS
    feed(judge, [alive(99)], last_ns - back_ns)
    more = feed(judge, moving, (last_ns if counts else last_ns - back_ns) + 15 * MS)
    assert any(more[:4]) is counts


@pytest.mark.parametrize("odd", [math.nan, math.inf, 1e200])
@pytest.mark.parametrize("where", ["force", "rate", "both"])
def test_numbers_that_are_none_leave_nothing_behind(odd: float, where: str) -> None:
    judge = Coherence("left_foot")
    feed(judge, [alive(k) for k in range(10)])
    force, rate = odd if where != "rate" else 0.0, odd if where != "force" else 0.0
    assert not any(feed(judge, [(force, 0.0, force, 0.0, 0.0, rate), alive(1)], S + 10 * 15 * MS))
    assert not any(feed(judge, [alive(k) for k in range(300)], S + 12 * 15 * MS))
    moving = [alive(k, G_MPS2 + 1.5 * (k % 2)) for k in range(BOUNDS.most_unturned + 6)]
    assert any(feed(judge, moving, S + 312 * 15 * MS))


def test_no_force_at_all_is_no_direction() -> None:
    judge = Coherence("left_foot")
    said = feed(judge, [(0.0, 0.0, 0.0, 0.0, 0.0, 1e-6 * k) for k in range(7)])
    assert said[-1].startswith("left_foot's accelerometer is frozen")
    judge = Coherence("left_foot")
    assert any("is it scaled?" in e for e in feed(judge, [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for _ in range(60)]))


@pytest.mark.requirement("SR-10")
def test_the_gate_latches_a_frozen_triad_and_names_it() -> None:
    for changing, frozen in (("gyr_radps", "accelerometer"), ("acc_mps2", "gyroscope")):
        bench = Bench()
        values: dict[str, Vector3] = {"acc_mps2": (0.0, 0.0, G_MPS2), "gyr_radps": (0.01, 0.0, 0.0)}
        begun_ns = bench.t_ns
        for k in range(30):
            bench.wait(10, sampling=False)
            x, y, z = values[changing]
            bench.sample(**(values | {changing: (x + 1e-3 * k, y, z)}))
            if bench.gate.latched:
                break
        assert bench.gate.latched.startswith(f"left_foot's {frozen} is frozen")
        assert bench.t_ns - begun_ns <= 80 * MS
        bench.act(OperatorAction.ARM)
        assert f"{frozen} is frozen" in bench.gate.arming_refused, "nor can it be armed as long as that lasts"
        bench.wait(10)
        bench.rearm()


def dead_band(v: Six, t_s: float) -> Six:
    """The rate is exactly 0 while it is small."""
    return (*v[:3], 0.0, 0.0, 0.0) if max(map(abs, v[3:])) < 0.05 else v


@pytest.mark.requirement("SR-10")
def test_a_gyroscope_with_a_dead_band_is_not_frozen_standing_or_walking() -> None:
    assert walk(dead_band, seconds=20 * STRIDE_S) == ("", math.inf)
    judge = Coherence("left_foot")
    for k in range(6000):  # a minute of standing
        standing = (1e-3 * (k % 7), 0.3 * math.sin(0.01 * k), G_MPS2, 0.0, 0.0, 0.0)
        assert judge.over([standing], S + k * 10 * MS) == [""]
        assert judge.not_ready == ""


@pytest.mark.requirement("SR-10")
def test_a_gyroscope_that_died_in_its_dead_band_is_told_with_the_first_movement() -> None:
    dead = 4 * STRIDE_S + 0.2  # in stance, where nobody can know yet

    def change(v: Six, t_s: float) -> Six:
        return (*v[:3], 0.0, 0.0, 0.0)

    said, after_s = walk(change, from_s=dead)
    assert "gyroscope is frozen" in said
    moved_s = next(t for t in (0.01 * k for k in range(60)) if abs(stride(dead + t)[0] - stride(dead)[0]) > 1.0)
    assert after_s - moved_s <= 0.07


@pytest.mark.requirement("SR-10")
def test_both_triads_the_same_are_off_in_65_ms_though_the_rate_is_0() -> None:
    bench = Bench()
    begun_ns = bench.t_ns
    for _ in range(60):
        bench.wait(2, sampling=False)
        bench.sample(acc_mps2=(0.0, 0.1, G_MPS2), gyr_radps=(0.0, 0.0, 0.0))
        if bench.gate.latched:
            break
    assert "is frozen" in bench.gate.latched
    assert bench.t_ns - begun_ns <= 65 * MS


# --- what repeats itself, to the sample -------------------------------------------------------------------------------


def living(k: int, force: Vector3, rate: Vector3) -> list[float]:
    """These, and a little that changes with every sample; once more than that, so that they are not at full scale."""
    change = 1.0 if k == 3 else 1e-12 * (-1) ** k * (1 + k)
    return [each + change for each in (*force, *rate)]


def said_of(values: Iterable[list[float]], step_ns: int = 10 * MS) -> list[str]:
    return Coherence("left_foot").over(((x, y, z, p, q, r) for x, y, z, p, q, r in values), step_ns=step_ns)


def frozen_at(
    axes: tuple[int, ...],
    force: Vector3 = (0.0, 0.0, 20.0),
    rate: Vector3 = (0.0, 0.0, 0.0),
    lives: int = 60,
    step_ns: int = 10 * MS,
    count: int = 30,
) -> list[int]:
    """How many repeats of these axes had been seen each time that it called something frozen."""
    values, held = [living(k, force, rate) for k in range(lives + count)], living(lives - 1, force, rate)
    for now in values[lives:]:
        for axis in axes:
            now[axis] = held[axis]
    return [k - lives + 1 for k, said in enumerate(said_of(values, step_ns)) if "frozen" in said]


def test_a_triad_is_frozen_after_60_ms_of_the_same_and_both_are_another_matter() -> None:
    assert frozen_at(ACC)[0] == 6
    assert frozen_at(GYR)[0] == 6
    assert frozen_at((*ACC, *GYR), (0.0, 0.0, G_MPS2)) == []


@pytest.mark.parametrize(
    ("force", "rate", "moves"),
    [
        ((0.0, 0.0, G_MPS2 + 0.95), (0.0, 0.0, 0.0), False),
        ((0.0, 0.0, G_MPS2 + 0.96), (0.0, 0.0, 0.0), True),
        ((0.0, 0.0, G_MPS2 - 1.05), (0.0, 0.0, 0.0), False),
        ((0.0, 0.0, G_MPS2 - 1.06), (0.0, 0.0, 0.0), True),
        ((G_MPS2, 0.0, 0.0), (0.0, 0.0, 0.0), False),
        ((0.0, G_MPS2, 0.0), (0.0, 0.0, 0.0), False),
        ((7.0, 6.0, 3.0), (0.0, 0.0, 0.0), False),
        ((0.0, 0.0, G_MPS2), (0.0, 0.599, 0.0), False),
        ((0.0, 0.0, G_MPS2), (0.0, 0.61, 0.0), True),
        ((0.0, 0.0, G_MPS2), (0.0, 0.0, 0.61), True),
        ((0.0, 0.0, G_MPS2), (0.4, 0.4, 0.4), True),
        ((0.0, 0.0, G_MPS2), (0.3, 0.3, 0.3), False),
    ],
)
def test_an_axis_is_frozen_only_while_the_sensor_moves(force: Vector3, rate: Vector3, moves: bool) -> None:
    """It is then told after every 100 ms."""
    assert frozen_at((3,), force, rate) == ([10, 20, 30] if moves else [])


def test_an_axis_that_hardly_ever_lived_is_not_frozen() -> None:
    """The first sample has nothing to differ from. What is frozen is told anew after as long."""
    assert frozen_at((0,), lives=51) == []
    assert frozen_at((0,), lives=52) == [10, 20, 30]
    assert frozen_at((0,), step_ns=33_333_333, count=12) == [4, 8, 12]


def test_an_axis_lives_while_another_one_repeats_itself() -> None:
    values = [living(k, (0.0, 0.0, 20.0), (0.0, 0.0, 0.0)) for k in range(80)]
    for k, now in enumerate(values):
        if k >= 60:
            now[:2] = 0.5, 0.0
        elif k % 4:
            now[1] = 0.0
    assert "x axis is frozen" in said_of(values)[70]


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("lives", "tells"), [(51, False), (52, True)])
def test_an_axis_lives_by_itself_though_another_one_never_does(axis: int, lives: int, tells: bool) -> None:
    values = [living(min(k, lives - 1), (0.0, 0.0, 20.0), (0.0, 0.0, 0.0)) for k in range(lives + 12)]
    for k, now in enumerate(values):
        now[(axis + 1) % 3], now[5] = 5.0, 1e-6 * k
        now[(axis + 2) % 3] += 1e-6 * k
    assert any(f"{'xyz'[axis]} axis is frozen" in said for said in said_of(values)) is tells


@pytest.mark.parametrize("share", [1.0, 0.005])
@pytest.mark.parametrize("spike", [0, 1, 2])
@pytest.mark.parametrize(("at_mps2", "tells"), [(97.9, True), (98.0, False), (-97.9, True), (-98.0, False)])
def test_near_full_scale_nothing_is_frozen(at_mps2: float, tells: bool, spike: int, share: float) -> None:
    """Full scale is the greatest value along any axis."""
    values = [living(k, (1.0, 0.0, 9.0), (0.0, 0.0, 0.0)) for k in range(90)]
    for now in values[60:]:
        now[0] = at_mps2
    values[30][spike] = 100.0
    said = said_of([share * each for each in now[:3]] + now[3:] for now in values)
    assert any("x axis is frozen" in each for each in said) is tells
