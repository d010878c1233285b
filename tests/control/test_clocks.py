"""The mapping of a sensor's clock: against simulated drift, delays, restarts."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fes.control.clock_sync import BoundedClock, SensorClock, line_under
from fes.control.runner import CLOSING_S, TICK_NS, armed_after, paced, with_ticks
from fes.signals import NS_PER_S, Event, ImuSample, OperatorAct, OperatorAction, Tick

Delay = Callable[[random.Random, int], float]

MS = 1_000_000


def exponential(rng: random.Random, k: int) -> float:
    return rng.expovariate(1 / 5e6)


def bursts(rng: random.Random, k: int) -> float:
    """Every seventh second arrives 300 ms late."""
    return rng.expovariate(1 / 3e6) + (300e6 if (k // 100) % 7 == 3 else 0.0)


def run(clock: SensorClock, seconds: int, drift_ppm: float, delay: Delay, rate_hz: int = 100) -> list[tuple[int, int]]:
    """(mapped − true, change of the mapped increment in ppb) of every sample after the first 3 s."""
    rng = random.Random(1)
    found: list[tuple[int, int]] = []
    host_ns = 0
    mapped = device = None
    for k in range(seconds * rate_hz):
        true_ns = k * NS_PER_S // rate_hz
        device_ns = round(true_ns * (1 + drift_ppm * 1e-6)) + 77 * NS_PER_S
        host_ns = max(host_ns, true_ns + int(delay(rng, k)))
        mapped_ns = clock.map(host_ns, device_ns)
        if mapped is not None and device is not None and k > 3 * rate_hz:
            step = device_ns - device
            found.append((mapped_ns - true_ns, round((mapped_ns - mapped - step) / step * 1e9)))
        mapped, device = mapped_ns, device_ns
    return found


@pytest.mark.parametrize("drift_ppm", [0.0, 50.0, -100.0, 150.0])
@pytest.mark.parametrize("delay", [exponential, bursts])
def test_mapped_stamps_are_near_the_true_time_and_run_evenly(drift_ppm: float, delay: Delay) -> None:
    clock = SensorClock()
    found = run(clock, 180, drift_ppm, delay)
    errors = sorted(abs(error) for error, _ in found)
    assert errors[int(0.99 * len(errors))] < 2_500_000
    assert max(abs(ppb) for _, ppb in found) <= 200_100  # 1 ns of rounding in 10 ms
    assert clock.resets == 0


def test_an_hour_does_not_diverge() -> None:
    clock = SensorClock()
    found = run(clock, 3600, 120.0, exponential, rate_hz=50)
    assert max(abs(error) for error, _ in found[-10_000:]) < 200_000
    assert clock.resets == 0


@pytest.mark.parametrize("drift_ppm", [-200.0, 200.0])
def test_the_worst_drift_is_followed(drift_ppm: float) -> None:
    found = run(SensorClock(), 300, drift_ppm, exponential)
    assert max(abs(error) for error, _ in found) < 5_000_000


def test_a_first_sample_that_came_late_is_forgotten_within_two_seconds() -> None:
    clock = SensorClock()
    clock.map(500_000_000, 0)
    assert clock.offset_ns == 500_000_000
    for k in range(1, 200):
        mapped_ns = clock.map(max(500_000_000, k * 10_000_000), k * 10_000_000)
    assert mapped_ns == pytest.approx(1_990_000_000, abs=1000)


@pytest.mark.parametrize("jump_s", [-50, 50])
def test_a_clock_that_is_set_begins_a_new_mapping(jump_s: int) -> None:
    clock = SensorClock()
    for k in range(500):
        clock.map(k * 10_000_000, 100 * NS_PER_S + k * 10_000_000)
    for k in range(500, 1000):
        mapped_ns = clock.map(k * 10_000_000, (100 + jump_s) * NS_PER_S + k * 10_000_000)
        assert abs(mapped_ns - k * 10_000_000) < 1000
    assert clock.resets == 1


def test_silence_and_a_queue_drained_late_are_no_restart() -> None:
    clock = SensorClock()
    for k in range(1000):
        clock.map(k * 10_000_000, k * 10_000_000)
    assert clock.map(30 * NS_PER_S, 30 * NS_PER_S) == 30 * NS_PER_S
    assert abs(clock.map(32 * NS_PER_S, 30 * NS_PER_S + 10_000_000) - 30 * NS_PER_S - 10_000_000) < 1000
    assert clock.resets == 0


def test_samples_late_for_good_begin_a_new_mapping() -> None:
    clock = SensorClock()
    for k in range(3000):
        late_ns = 0 if k < 1000 else 700_000_000
        mapped_ns = clock.map(k * 10_000_000 + late_ns, k * 10_000_000)
    assert clock.resets == 1
    assert mapped_ns == pytest.approx(29_990_000_000 + 700_000_000, abs=1000)


def test_the_line_lies_under_all_points() -> None:
    rng = random.Random(3)
    points = [(float(k), 100e3 * k + rng.expovariate(1 / 1e6)) for k in range(40)]
    level, slope = line_under(points)
    assert all(value >= level + slope * time * NS_PER_S - 1e-3 for time, value in points)
    assert slope == pytest.approx(100e-6, abs=10e-6)
    assert line_under(points[:9]) == (min(value for _, value in points[:9]), 0.0)


def test_a_clock_set_ahead_by_half_a_second_is_mapped_anew_at_the_third_sample() -> None:
    clock = SensorClock()
    period_ns = 5 * MS
    for k in range(1000):
        mapped_ns = clock.map(k * period_ns + 2 * MS, k * period_ns)
    ahead_ns = 500 * MS
    for k in range(1000, 1100):
        arrival_ns = k * period_ns + 2 * MS
        before_ns, mapped_ns = mapped_ns, clock.map(arrival_ns, k * period_ns + ahead_ns)
        if k >= 1002:
            assert abs(mapped_ns - arrival_ns) <= 5 * MS
            assert k == 1002 or mapped_ns - before_ns == period_ns
    assert clock.resets == 1


def test_one_or_two_stamps_far_ahead_move_nothing() -> None:
    clock, plain = SensorClock(), SensorClock()
    for k in range(3000):
        arrival_ns, stamp_ns = k * 5 * MS + 2 * MS, k * 5 * MS
        wild = k > 1000 and k % 40 in (0, 1)
        expected_ns = plain.map(arrival_ns, stamp_ns)
        mapped_ns = clock.map(arrival_ns, stamp_ns + (300 * MS if wild else 0))
        if not wild:
            assert mapped_ns == expected_ns
    assert clock.resets == 0


def by_radio(
    clock: BoundedClock, seconds: int, drift_ppm: float, late_ms: float, answered_s: float = 1.0
) -> list[float]:
    """A device that is asked for its time by a way of 0 to 30 ms; mapped − true (ms) of every sample."""
    rng, found, asked_s = random.Random(2), list[float](), 0.0
    for k in range(seconds * 100):
        true_ns = k * NS_PER_S // 100
        device_ns = round(true_ns * (1 + drift_ppm * 1e-6)) + 77 * NS_PER_S
        host_ns = true_ns + round((late_ms + 30.0 * rng.random()) * MS)
        if k / 100 >= asked_s:
            asked_s += 0.1 if k < 200 else answered_s
            way_ns = round(30.0 * rng.random() * MS)
            clock.asked(true_ns, device_ns + round(way_ns * (1 + drift_ppm * 1e-6)))
        mapped_ns = clock.map(host_ns, device_ns)
        if mapped_ns is not None and k > 300:
            found.append((mapped_ns - true_ns) / MS)
    return found


@pytest.mark.requirement("SR-30")
@pytest.mark.parametrize("drift_ppm", [0.0, 80.0, -80.0])
@pytest.mark.parametrize("late_ms", [0.0, 90.0, 2000.0])
def test_a_delay_that_all_samples_have_is_seen_by_the_devices_answers(drift_ppm: float, late_ms: float) -> None:
    clock = BoundedClock()
    off_ms = by_radio(clock, 120, drift_ppm, late_ms)
    assert max(off_ms) <= 0.001  # never measured later than in truth
    assert min(off_ms) >= -20.0
    assert clock.resets == 0


@pytest.mark.requirement("SR-30")
def test_without_an_answer_nothing_is_known_and_old_ones_count_for_less() -> None:
    clock = BoundedClock()
    assert clock.map(NS_PER_S, 5 * NS_PER_S) is None
    off_ms = by_radio(clock, 60, 0.0, 0.0, answered_s=1e9)
    assert off_ms[-1] == pytest.approx(off_ms[0] - 11.4, abs=1.0)  # 0.2 ms a second


@pytest.mark.parametrize("jump_s", [0.05, 3.0, -3.0])
def test_a_clock_that_was_set_begins_anew(jump_s: float) -> None:
    clock = BoundedClock()
    by_radio(clock, 5, 0.0, 0.0)
    stamp_ns = 82 * NS_PER_S + round(jump_s * NS_PER_S)
    assert clock.map(5 * NS_PER_S + 20 * MS, stamp_ns) is None
    assert clock.resets == 1
    assert clock.map(5 * NS_PER_S + 30 * MS, stamp_ns + 10 * MS) is None


# --- Sources of events: silence made audible, the operator of a replay, waiting on a clock ---


CLOSING = int(CLOSING_S * 1e9) // TICK_NS


def sample(t_ns: int) -> ImuSample:
    return ImuSample(t_ns, "left_foot", t_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


def samples(*times_ms: float) -> list[Event]:
    return [sample(int(ms * MS)) for ms in times_ms]


def test_a_steady_stream_has_no_ticks_but_the_closing_ones() -> None:
    stream = samples(*range(0, 100, 10))
    out = list(with_ticks(stream))
    assert out[:10] == stream
    assert out[10:] == [Tick((90 + 10 * k) * MS) for k in range(1, CLOSING + 1)]


@pytest.mark.parametrize(
    ("gap_ms", "ticks_ms"), [(15, []), (16, [10]), (20, [10]), (25, [10]), (26, [10, 20]), (60, [10, 20, 30, 40, 50])]
)
def test_a_silence_is_filled_exactly(gap_ms: int, ticks_ms: list[int]) -> None:
    out = list(with_ticks(samples(0, gap_ms)))
    assert out[: -CLOSING or None] == [sample(0), *(Tick(ms * MS) for ms in ticks_ms), sample(gap_ms * MS)]


@given(st.lists(st.integers(0, 200 * MS), min_size=1, max_size=40))
def test_no_silence_is_left_and_nothing_is_lost(gaps_ns: list[int]) -> None:
    t_ns = 0
    stream: list[Event] = []
    for gap_ns in gaps_ns:
        t_ns += gap_ns
        stream.append(sample(t_ns))
    out = list(with_ticks(stream))
    assert [event for event in out if isinstance(event, ImuSample)] == stream
    steps = [after.t_ns - before.t_ns for before, after in pairwise(out)]
    assert all(0 <= step <= 1.5 * TICK_NS for step in steps)
    assert out[-1].t_ns == stream[-1].t_ns + int(CLOSING_S * 1e9)


def test_nothing_has_no_ticks() -> None:
    assert list(with_ticks([])) == []


def test_the_operator_arms_once_and_then_sets_the_intensity() -> None:
    out = list(armed_after(samples(100, 110, 120, 130), 0.015, 0.7))
    arm = OperatorAct(120 * MS, OperatorAction.ARM)
    assert out == [
        *samples(100, 110, 120),
        arm,
        OperatorAct(120 * MS, OperatorAction.SET_INTENSITY, 0.7),
        sample(130 * MS),
    ]


def test_arming_at_once() -> None:
    out = list(armed_after(samples(5, 10), 0.0, 1.0))
    assert [event.t_ns // MS for event in out if isinstance(event, OperatorAct)] == [5, 5]


@pytest.mark.parametrize(("rearm_after_s", "acts_ms"), [(None, [0]), (0.03, [0, 80]), (0.0, [0, 60])])
def test_arming_again_after_a_fault(rearm_after_s: float | None, acts_ms: list[int]) -> None:
    gate = {"latched": False}
    out: list[Event] = []
    for event in armed_after(samples(*range(0, 200, 10)), 0.0, 1.0, rearm_after_s, lambda: gate["latched"]):
        out.append(event)
        if isinstance(event, ImuSample) and event.t_ns == 50 * MS:
            gate["latched"] = True
        if isinstance(event, OperatorAct) and event.action is OperatorAction.ARM:
            gate["latched"] = False
    assert [event.t_ns // MS for event in out if getattr(event, "action", None) is OperatorAction.ARM] == acts_ms


def test_a_fault_that_stays_is_armed_against_again_and_again() -> None:
    out = armed_after(samples(*range(0, 200, 10)), 0.0, 1.0, 0.05, lambda: True)
    arms = [event.t_ns // MS for event in out if getattr(event, "action", None) is OperatorAction.ARM]
    assert arms == [0, 60, 120, 180]


class FakeClock:
    """Only waiting passes time."""

    def __init__(self, now_ns: int) -> None:
        self.t_ns = now_ns
        self.waits: list[int] = []

    def now_ns(self) -> int:
        return self.t_ns

    def wait_until_ns(self, t_ns: int) -> None:
        self.waits.append(t_ns)
        self.t_ns = max(self.t_ns, t_ns)


@pytest.mark.parametrize(("speed", "scale"), [(1.0, 1.0), (2.0, 0.5), (0.1, 10.0)])
def test_paced_waits_for_each_event_as_asked(speed: float, scale: float) -> None:
    clock = FakeClock(7_000)
    stream = samples(1000, 1002, 1010, 1010, 1500)
    assert list(paced(stream, clock, speed)) == stream
    assert clock.waits == [7_000 + int(ms * MS * scale) for ms in (0, 2, 10, 10, 500)]


def test_paced_hands_on_nothing_before_its_time_and_does_not_drift() -> None:
    clock = FakeClock(0)
    seen: list[int] = []

    def slow() -> Iterator[Event]:
        for event in samples(*range(0, 100, 10)):
            yield event
            clock.t_ns += 13 * MS if event.t_ns == 30 * MS else 1 * MS  # handling takes time, once too long

    for event in paced(slow(), clock, 1.0):
        assert clock.t_ns >= event.t_ns
        seen.append(clock.t_ns - event.t_ns)
    assert seen[4] == 3 * MS
    assert seen[-1] == 0
