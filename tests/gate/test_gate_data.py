"""The safety gate on the sensors' data: age, stamps, frozen values, what cannot be."""

from __future__ import annotations

import math
import re

import pytest
from gate_bench import (
    MS,
    Bench,
    assert_latched,
    make_channel,
    noise,
)

from fes.config import ImuDevice
from fes.gate import Flagged
from fes.signals import G_MPS2, NS_PER_S, ImuSample, OperatorAction, Tick, Vector3


@pytest.fixture
def bench() -> Bench:
    return Bench()


# --- data ----------------------------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("vector", ["acc_mps2", "gyr_radps"])
def test_non_finite_sample_latches(bench: Bench, bad: float, vector: str) -> None:
    bench.wait(20, sampling=False)
    bench.sample(**{vector: (0.0, bad, 0.0)})
    assert_latched(bench, bench.ask(), "non-finite sample from left_foot")


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize("recorded_only", ["left_shank", "right_foot"])
def test_a_sensor_that_drives_no_channel_is_flagged_and_counted_and_stops_nobody(
    bench: Bench, recorded_only: str
) -> None:
    for count in (1, 2):
        bench.wait(20)
        bench.sample(sensor=recorded_only, gyr_radps=(0.0, math.nan, 0.0))
        text = f"non-finite sample from {recorded_only}"
        assert bench.gate.flagged == {recorded_only: Flagged(count, text, bench.t_ns)}
        assert (bench.gate.latched, bench.gate.armed) == ("", True)
        assert bench.ask(current_ma=5.0).on
    bench.sample(gyr_radps=(0.0, math.nan, 0.0))
    assert_latched(bench, bench.ask(current_ma=5.0), "non-finite sample from left_foot")
    assert bench.gate.flagged.keys() == {recorded_only}


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(("silent_ms", "told"), [(80, True), (81, False), (223, False)])
def test_what_was_before_a_silence_says_nothing_of_the_unit_after_it(bench: Bench, silent_ms: int, told: bool) -> None:
    """The loop was away; what queued up then comes at once, and two weak samples are no weak 80 ms."""
    bench.sample(acc_mps2=(0.0, 0.1, 1.0))
    bench.wait(silent_ms, sampling=False)
    bench.sample(acc_mps2=(0.0, 0.1, 1.1))
    bench.wait(10, sampling=False)
    bench.sample(acc_mps2=(0.0, 0.1, 1.2))
    assert ("is its unit g?" in bench.gate.latched) is told
    for _ in range(7):
        bench.wait(9, sampling=False)
        bench.sample(acc_mps2=(0.0, 0.1, 1.1))
        assert ("is its unit g?" in bench.gate.latched) is told
    bench.wait(9, sampling=False)
    bench.sample(acc_mps2=(0.0, 0.1, 1.1))
    assert "is its unit g?" in bench.gate.latched  # by its own 80 ms


@pytest.mark.requirement("SR-10")
def test_the_shank_that_drives_a_foot_latches_and_that_foots_own_sensor_is_then_only_recorded() -> None:
    bench = Bench(arm=False, shank_phase_sensors={"left_foot": "left_shank"})
    bench.sample()
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "no data from left_shank"
    bench.sample(sensor="left_shank", gyr_radps=(0.0, 0.0, 1.0))
    bench.rearm()
    bench.off()
    bench.wait(20, sampling=False)
    bench.sample(acc_mps2=(math.nan, 0.0, 0.0))
    bench.sample(sensor="left_shank")
    assert bench.ask(current_ma=5.0).on
    assert list(bench.gate.flagged) == ["left_foot"]
    bench.wait(100)
    assert_latched(bench, bench.ask(current_ma=1.0), "left_shank data 100 ms old")
    bench.sample(sensor="left_shank")
    bench.rearm()
    bench.sample(sensor="left_shank", acc_mps2=(math.nan, 0.0, 0.0))
    assert bench.gate.latched == "non-finite sample from left_shank"


@pytest.mark.requirement("SR-10")
def test_in_exercise_no_data_are_asked_for_and_all_else_holds() -> None:
    bench = Bench(arm=False, by_sensors=False, exercise_s=1.0)
    bench.act(OperatorAction.ARM)
    bench.off()
    bench.act(OperatorAction.EXERCISE, 0.0)
    for _ in range(10):
        bench.wait(20, sampling=False)
        assert bench.ask(current_ma=5.0).on
    bench.sample(gyr_radps=(0.0, math.nan, 0.0))
    assert list(bench.gate.flagged) == ["left_foot"]  # a sensor that is worn all the same stops nobody
    refused = bench.ask(current_ma=1000.0).refused
    assert "1000 mA" in refused
    assert bench.gate.latched == refused


@pytest.mark.requirement("SR-09")
def test_data_at_the_age_limit_pass_and_beyond_it_latch(bench: Bench) -> None:
    bench.wait(40, sampling=False)
    assert bench.ask(current_ma=1.0).on
    bench.t_ns += 1
    assert_latched(bench, bench.ask(current_ma=1.0), "left_foot data 41 ms old, limit 40 ms")


@pytest.mark.requirement("SR-09")
def test_sessions_tighter_age_counts_and_a_looser_one_does_not() -> None:
    for asked_ms, limit_ms in ((15, 15), (500, 40)):
        bench = Bench(max_data_age_ms=asked_ms)
        bench.wait(limit_ms, sampling=False)
        assert bench.ask(current_ma=1.0).on
        bench.wait(1, sampling=False)
        assert_latched(bench, bench.ask(current_ma=1.0), f"limit {limit_ms} ms")


def test_stale_data_do_not_latch_while_nothing_is_asked(bench: Bench) -> None:
    bench.wait(500, sampling=False)
    assert bench.off().refused == ""
    assert bench.gate.armed


def test_other_foots_data_do_not_count() -> None:
    bench = Bench(make_channel(0), make_channel(1, "right_foot"))
    bench.wait(41, sampling=False)
    bench.observe(ImuSample(bench.t_ns, "right_foot", bench.t_ns - 3 * MS, (0.0, 0.0, 9.8), (0.0, 0.0, 1.0)))
    assert bench.ask(1, 1.0).on
    assert_latched(bench, bench.ask(0, 1.0), "left_foot data 41 ms old")


@pytest.mark.requirement("SR-09")
def test_queue_drained_late_shows_on_the_sensors_own_clock(bench: Bench) -> None:
    sent_ns = bench.t_ns
    bench.rests = True
    bench.wait(200, sampling=False)
    for i in range(1, 80):  # all arrive now; the newest was sent 42 ms ago
        bench.sample(t_sensor_ns=sent_ns - 3 * MS + i * 2 * MS)
    assert_latched(bench, bench.ask(current_ma=1.0), "left_foot data 42 ms old by the sensor's own clock, limit 40 ms")
    bench.sample(t_sensor_ns=bench.t_ns - 3 * MS)
    bench.rearm()


def test_first_samples_delay_is_learnt_away() -> None:
    """The first sample came 300 ms late; the mapping is that of the least delayed one."""
    bench = Bench(arm=False)
    bench.sample(t_sensor_ns=bench.t_ns - 300 * MS)
    bench.wait(2)
    bench.rearm()
    bench.off()
    bench.wait(43, sampling=False)
    bench.sample(t_sensor_ns=bench.t_ns - 3 * MS - 41 * MS)
    assert_latched(bench, bench.ask(current_ma=1.0), "own clock")


def test_honest_drift_of_the_sensors_clock_is_no_delay(bench: Bench) -> None:
    for fifth in range(1, 5000):  # 100 ms in 1000 s
        bench.wait(200, sampling=False)
        bench.sample(t_sensor_ns=bench.t_ns - 3 * MS - fifth * MS // 50)
    assert bench.ask(current_ma=1.0).on


@pytest.mark.requirement("SR-09")
def test_data_that_come_after_a_long_silence_may_be_late_whatever_their_stamps_say(bench: Bench) -> None:
    """As data do whose stamps are shifted by as much as they are late."""
    bench.wait(250, sampling=False)
    bench.sample()
    assert bench.gate.latched == "", "a quarter of a second is what is not told"
    bench.wait(600, sampling=False)
    bench.sample()
    assert bench.gate.latched == "left_foot was silent for 600 ms: what comes now may be late"
    bench.rearm()
    bench.act(OperatorAction.DISARM)
    bench.wait(600, sampling=False)
    bench.sample()
    assert bench.gate.latched == "", "nobody is armed: nothing is timed by it"


def test_slight_disorder_of_stamps_is_tolerated(bench: Bench) -> None:
    bench.wait(20)
    bench.sample(t_sensor_ns=bench.t_ns - 43 * MS)  # 40 ms before the newest
    assert bench.ask().on


def test_sensor_that_restarts_latches_and_can_be_armed_again(bench: Bench) -> None:
    for _ in range(3):
        bench.wait(8, sampling=False)
        bench.sample(t_sensor_ns=bench.t_ns - 900 * MS)
    assert_latched(bench, bench.ask(), "left_foot's clock went back by 873 ms")
    bench.sample(t_sensor_ns=bench.t_ns - 900 * MS)
    bench.rearm()


@pytest.mark.requirement("SR-11")
@pytest.mark.parametrize("wild_ms", [10_000, 45, -45, -10_000])
def test_one_wild_stamp_has_no_effect(bench: Bench, wild_ms: int) -> None:
    for _ in range(60):
        bench.wait(20)
    bench.wait(20, sampling=False)
    bench.sample(t_sensor_ns=bench.t_ns - 3 * MS + wild_ms * MS)
    for _ in range(20):
        assert bench.ask(current_ma=1.0).on
        bench.wait(20)
    assert bench.gate.latched == ""


@pytest.mark.requirement("SR-11")
@pytest.mark.parametrize(("every", "latches"), [(2, True), (8, True), (30, False), (60, False)])
@pytest.mark.parametrize("kind", ["doubled", "swapped", "ahead"])
def test_more_than_one_in_twenty_stamps_out_of_order_latches_within_a_second(
    bench: Bench, every: int, latches: bool, kind: str
) -> None:
    """An outlier is two slips, one there and one back, except a doubled stamp; so one in forty is the bound there."""
    every = every * 2 if kind != "doubled" and not latches else every
    slip_ns = {"doubled": 0, "swapped": -6 * MS, "ahead": 200 * MS}[kind]
    for _ in range(130):
        bench.wait(10)
    begun_ns, last_ns = bench.t_ns, bench.t_ns - 3 * MS
    for k in range(1, 400):
        bench.wait(10, sampling=False)
        stamp_ns = last_ns + slip_ns if k % every == 0 else bench.t_ns - 3 * MS
        bench.sample(t_sensor_ns=stamp_ns)
        last_ns = bench.t_ns - 3 * MS
        if bench.gate.latched:
            break
    assert bool(bench.gate.latched) is latches
    if latches:
        assert "time stamps are out of order" in bench.gate.latched
        assert bench.t_ns - begun_ns <= 1_100 * MS


@pytest.mark.requirement("SR-11")
def test_time_running_backward_between_events_latches(bench: Bench) -> None:
    bench.observe(Tick(bench.t_ns))
    assert bench.gate.armed, "the same time again is no step back"
    bench.observe(Tick(bench.t_ns - 1_375_000))
    assert (bench.gate.latched, bench.gate.latched_ns) == ("time ran backward by 1.38 ms", bench.t_ns - 1_375_000)


def test_arming_from_the_past_does_not_stand(bench: Bench) -> None:
    bench.observe(Tick(bench.t_ns + 2 * MS))
    bench.act(OperatorAction.ARM)
    assert not bench.gate.armed
    assert bench.gate.latched == "time ran backward by 2 ms"


@pytest.mark.parametrize("before", ["event", "judgement"])
def test_judging_in_the_past_latches(bench: Bench, before: str) -> None:
    bench.t_ns += 5 * MS
    if before == "event":
        bench.observe(Tick(bench.t_ns))
    else:
        bench.off()
    bench.t_ns -= MS
    assert_latched(bench, bench.ask(current_ma=0.5), "time ran backward by 1 ms")


def test_data_dated_ahead_do_not_arm(bench: Bench) -> None:
    bench.wait(100)
    bench.t_ns -= 50 * MS
    bench.observe(Tick(bench.t_ns))
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == "left_foot data are dated 50 ms ahead"


# --- a sensor that repeats itself ----------------------------------------------------------------------------------


def frozen_for(bench: Bench, ms: int, step_ms: int = 4) -> None:
    """Fresh stamps, old values."""
    still = {"acc_mps2": (0.1, 0.2, 9.7), "gyr_radps": (0.01, 0.02, 0.03)}
    bench.sample(**still)
    for _ in range(ms // step_ms):
        bench.wait(step_ms, sampling=False)
        bench.sample(**still)


@pytest.mark.requirement("SR-10")
def test_frozen_sensor_is_no_ground_for_stimulating() -> None:
    bench = Bench()
    frozen_for(bench, 56)
    assert bench.gate.latched == ""
    bench.wait(4, sampling=False)
    bench.sample(acc_mps2=(0.1, 0.2, 9.7), gyr_radps=(0.01, 0.02, 0.03))
    assert bench.gate.latched == "left_foot is frozen: the same values for 60 ms, limit 60 ms"
    assert not bench.gate.armed


def test_nobody_can_arm_on_a_frozen_sensor_and_one_that_lives_again_may() -> None:
    bench = Bench(arm=False)
    frozen_for(bench, 100)
    bench.act(OperatorAction.ARM)
    assert "frozen" in bench.gate.arming_refused
    bench.wait(4)
    bench.act(OperatorAction.ARM)
    assert bench.gate.arming_refused == ""
    assert bench.gate.armed


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_value_of_each_triad_that_moves_is_life(axis: int) -> None:
    bench = Bench()
    for k in range(100):
        bench.wait(4, sampling=False)
        moved = [0.0, 0.0, 0.0]
        moved[axis] = 1e-3 * k
        bench.sample(acc_mps2=(moved[0], moved[1], 9.8 + moved[2]), gyr_radps=(moved[0], moved[1], moved[2]))
    assert bench.gate.latched == ""


# --- numbers that cannot be ----------------------------------------------------------------------------------------


DEVICE = ImuDevice(sensor="left_foot", device="xbus", port="tty", rate_hz=100, acc_range_g=16, gyr_range_dps=2000)
WITHIN = 80  # ms that something must last to count


def send(bench: Bench, ms: int, acc: Vector3, gyr: Vector3) -> str:
    """The same numbers, with a living sensor's noise, every 4 ms; what latched."""
    for _ in range(ms // 4):
        bench.wait(4, sampling=False)
        alive = noise(bench.t_ns)
        bench.sample(acc_mps2=(acc[0], acc[1], acc[2] + alive), gyr_radps=(gyr[0] + alive, gyr[1], gyr[2]))
    return bench.gate.latched


NARROW = DEVICE.model_copy(update={"acc_range_g": 4})
IMPOSSIBLE = [
    pytest.param((0.0, 0.0, -39.2), (0.0, 0.0, 0.0), "saturated", id="acc at its range"),
    pytest.param((0.0, 9.8, 0.0), (0.0, -34.9, 0.0), "saturated", id="gyr at its range"),
]
WRONG_UNITS = [
    pytest.param(1 / G_MPS2, "is its unit g", id="g for m/s2"),
    pytest.param(G_MPS2, "wrong unit", id="m/s2 scaled by g again"),
    pytest.param(1000 / G_MPS2, "wrong unit", id="mg for m/s2"),
]


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(("acc", "gyr", "says"), IMPOSSIBLE)
def test_what_cannot_be_latches_within_100_ms_and_no_sooner_than_80(acc: Vector3, gyr: Vector3, says: str) -> None:
    assert send(Bench(devices=(NARROW,)), WITHIN, acc, gyr) == ""
    assert re.search(says, send(Bench(devices=(NARROW,)), WITHIN + 4, acc, gyr))


@pytest.mark.parametrize(("acc", "gyr", "says"), IMPOSSIBLE)
def test_what_is_interrupted_is_no_fault(acc: Vector3, gyr: Vector3, says: str) -> None:
    bench = Bench(devices=(NARROW,))
    for _ in range(10):
        send(bench, WITHIN, acc, gyr)
        bench.wait(4)
    assert bench.gate.latched == ""


def swing(t_ns: int) -> Vector3:
    """A brisk one: 14 to 46 m/s², nearly five times gravity."""
    angle = 6 * math.pi * t_ns / NS_PER_S
    return (30.0 + 16.0 * math.sin(angle), 0.0, 2.0 + 4.0 * math.cos(angle))


def turn(t_ns: int) -> Vector3:
    """What a gyroscope tells of it."""
    return (0.0, 4.0 * math.cos(6 * math.pi * t_ns / NS_PER_S), 0.0)


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(("scale", "says"), WRONG_UNITS)
@pytest.mark.parametrize("at_ms", range(0, 340, 20))
def test_wrong_unit_of_force_latches_within_100_ms_of_a_brisk_swing(scale: float, says: str, at_ms: int) -> None:
    bench = Bench()
    begun_ns = bench.t_ns + 340 * MS + at_ms * MS
    while not bench.gate.latched and bench.t_ns < begun_ns + 100 * MS:
        bench.wait(10, sampling=False)
        size = scale if bench.t_ns >= begun_ns else 1.0
        x, y, z = swing(bench.t_ns)
        bench.sample(acc_mps2=(size * x, size * y, size * z), gyr_radps=turn(bench.t_ns))
    assert says in bench.gate.latched
    assert begun_ns <= bench.t_ns <= begun_ns + 90 * MS


@pytest.mark.parametrize("rate_hz", [100, 200, 400, 1000])
@pytest.mark.parametrize("loss", [0, 5])
def test_brisk_swings_are_no_fault_at_any_rate(rate_hz: int, loss: int) -> None:
    bench = Bench()
    for k in range(rate_hz):
        bench.t_ns += NS_PER_S // rate_hz
        if not loss or k % loss:
            bench.sample(acc_mps2=swing(bench.t_ns), gyr_radps=turn(bench.t_ns))
    assert bench.gate.latched == ""


@pytest.mark.requirement("SR-10")
def test_spikes_between_do_not_hide_a_wrong_unit() -> None:
    """In g even a swing's peaks exceed what is weak now and then, for a sample or two."""
    bench = Bench(devices=(DEVICE,))
    begun_ns = bench.t_ns
    while bench.gate.latched == "" and bench.t_ns - begun_ns < 1_000 * MS:
        send(bench, 12, (0.3, 0.2, 0.96), (0.0, 0.0, 0.0))
        send(bench, 4, (0.0, 0.0, 4.0), (0.0, 0.0, 0.0))
    assert "is its unit g" in bench.gate.latched
    assert bench.t_ns - begun_ns <= 100 * MS


def test_a_foot_that_falls_now_and_then_is_no_fault(bench: Bench) -> None:
    for _ in range(20):
        send(bench, 48, (0.3, 0.2, 0.96), (0.0, 0.5, 0.0))
        send(bench, 100, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
    assert bench.gate.latched == ""


@pytest.mark.requirement("SR-10")
def test_degrees_of_a_slow_turn_latch_within_100_ms(bench: Bench) -> None:
    assert send(bench, WITHIN, (0.0, 0.0, 9.8), (0.0, -15.1, 0.0)) == ""
    assert "15 rad/s for 80 ms: is its unit °/s" in send(bench, 4, (0.0, 0.0, 9.8), (0.0, -15.1, 0.0))


def test_no_foot_turns_at_40_radians_a_second(bench: Bench) -> None:
    assert send(bench, 4, (0.0, 0.0, 9.8), (0.0, 40.0, 0.0)) == ""
    assert "is its unit °/s" in send(bench, 4, (0.0, 0.0, 9.8), (0.0, -40.1, 0.0))


@pytest.mark.requirement("SR-10")
@pytest.mark.parametrize(("tilt_deg", "passes"), [(0, True), (30, True), (60, True), (70, False), (180, False)])
def test_sensor_that_rests_turned_over_cannot_time_a_burst(tilt_deg: float, passes: bool) -> None:
    bench = Bench(up={"left_foot": (0.0, 0.0, 1.0)})
    tilt = math.radians(tilt_deg)
    send(bench, 100, (9.8 * math.sin(tilt), 0.0, 9.8 * math.cos(tilt)), (0.0, 0.0, 0.0))
    assert bench.gate.latched == "", "a foot may rest so"
    command = bench.ask(current_ma=1.0)
    assert command.on is passes
    assert ("remounted" in bench.gate.latched) is not passes
    if not passes:
        bench.act(OperatorAction.ARM)
        assert "remounted" in bench.gate.arming_refused


@pytest.mark.parametrize(
    ("acc", "gyr"), [((0.0, 0.0, -12.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, -9.8), (0.0, 0.6, 0.0))], ids=["force", "rate"]
)
def test_a_moving_foot_may_be_turned_over_for_a_moment(acc: Vector3, gyr: Vector3) -> None:
    bench = Bench(up={"left_foot": (0.0, 0.0, 1.0)})
    send(bench, 100, acc, gyr)
    assert bench.ask(current_ma=1.0).on


@pytest.mark.requirement("SR-10")
def test_sensor_turned_in_swing_is_told_before_the_next_burst_though_it_never_rests() -> None:
    """Up is now forward: walking on, half a second later, nobody stimulates by it."""
    bench = Bench(up={"left_foot": (0.0, 0.0, 1.0)})
    for _ in range(100):
        bench.wait(5, sampling=False)
        x, y, z = swing(bench.t_ns)
        bench.sample(acc_mps2=(0.25 * (x - 30.0), y, 9.0 + 0.25 * z), gyr_radps=turn(bench.t_ns))
    assert bench.ask(current_ma=1.0).on
    bench.off()
    for _ in range(100):
        bench.wait(5, sampling=False)
        x, y, z = swing(bench.t_ns)
        bench.sample(
            acc_mps2=(9.0 + 0.25 * z, y, 0.25 * (30.0 - x)), gyr_radps=(0.0, 2.0 + 0.3 * turn(bench.t_ns)[1], 0.0)
        )
    assert_latched(bench, bench.ask(current_ma=1.0), "left_foot shows turned by more than 65° from its calibration")


@pytest.mark.requirement("SR-10")
def test_axes_exchanged_in_a_burst_latch_within_100_ms(bench: Bench) -> None:
    """As a sensor does that starts anew with other axes; two samples later."""
    assert bench.ask(current_ma=0.5).on
    for k in range(13):
        assert bench.gate.latched == ""
        bench.wait(10, sampling=False)
        x, y, z = 6.0 + 0.1 * k, -7.0, 12.0
        p, q, r = 3.0, 5.0 - 0.1 * k, -2.0
        turned = k >= 10
        bench.sample(acc_mps2=(y, z, x) if turned else (x, y, z), gyr_radps=(q, r, p) if turned else (p, q, r))
    assert_latched(bench, bench.ask(current_ma=0.5), "the axes of left_foot changed from one sample to the next")
