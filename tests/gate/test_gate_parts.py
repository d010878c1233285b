"""The gate's parts one by one, at the nanosecond and the digit: dose, stamps, freshness, plausibility, words."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from gate_bench import ASKED, LOOSE, MS, Bench, make_channel, make_limits, unchecked_channel
from judges import Force, all_codes

from fes.config import Exercise, ImuDevice, Session, Stimulation
from fes.gate import SafetyGate, gate_of
from fes.gate.bounds import MOST_SAMPLES, sentence
from fes.gate.channel import ROUNDING_MA, Dose
from fes.gate.electrical import NUMBER_BOUND, is_number, no_number, shown
from fes.gate.freshness import Freshness, Stamps
from fes.gate.plausibility import BOUNDS, Plausibility, place_of
from fes.signals import (
    G_MPS2,
    NS_PER_S,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimRequest,
    Vector3,
)

S = NS_PER_S
UP: Vector3 = (0.0, 0.0, 9.8)


def sample(t_ns: int, sent_ns: int, acc: Vector3 = UP, gyr: Vector3 | None = None) -> ImuSample:
    """One sample of the left foot; without ``gyr`` it differs from every other."""
    return ImuSample(t_ns, "left_foot", sent_ns, acc, gyr or (0.0, 0.0, 1e-9 * (t_ns % 1_000_003)))


# --- dose ---------------------------------------------------------------------------------------------------


def test_dose_is_the_rate_times_the_time_until_the_next_command_or_the_end_of_validity() -> None:
    dose = Dose()
    assert dose.used_uc(5 * S) == 0.0
    dose.command(10 * S, 0.5, S // 2)
    assert dose.used_uc(10 * S) == 0.0
    assert dose.used_uc(10 * S + S // 4) == 0.125
    assert dose.used_uc(20 * S) == 0.25, "no more than its validity"
    dose.command(20 * S, 8.0, S)
    dose.command(20 * S + S // 2, 0.0, 0)
    assert dose.used_uc(21 * S) == 4.25


def test_dose_forgets_whole_seconds_after_a_minute() -> None:
    dose = Dose()
    dose.command(0, 8.0, S // 2)
    assert dose.used_uc(S // 2) == 4.0
    assert dose.used_uc(61 * S - 1) == 4.0, "errs on the side of more"
    assert dose.used_uc(61 * S) == 0.0


def test_dose_never_goes_down_by_looking_back() -> None:
    dose = Dose()
    dose.command(10 * S, 8.0, S)
    assert dose.used_uc(9 * S) == 0.0
    assert dose.used_uc(10 * S + S // 2) == 4.0


def test_minute_whose_charge_is_exactly_the_limit_is_over() -> None:
    """16 mA, 250 µs and 32 Hz are 128 µC/s: 4 µC in 31.25 ms, numbers that binary fractions hold exactly."""
    for limit_mc, passes in ((0.004, False), (math.nextafter(0.004, 1.0), True)):
        bench = Bench(make_channel(limits={"max_charge_per_minute_mc": limit_mc}))
        for _ in range(2):
            bench.wait(31.25)
            command = bench.ask(current_ma=16.0, pulse_width_us=250.0, frequency_hz=32.0)
        assert command.on is passes
        assert command.refused == ("" if passes else "channel 0: 0.004 mC within a minute, limit 0.004 mC")


# --- rise ---------------------------------------------------------------------------------------------------


def test_rounding_of_sums_is_forgiven_and_no_more() -> None:
    assert Bench().ask(current_ma=0.5 + ROUNDING_MA).on
    assert not Bench().ask(current_ma=math.nextafter(0.5 + ROUNDING_MA, 1.0)).on


def test_ramp_stands_still_within_one_instant() -> None:
    """At 2000 mA/s a single nanosecond would be worth twice the rounding."""
    assert not Bench(unchecked_channel(**LOOSE)).ask(current_ma=0.5 + 2.5 * ROUNDING_MA).on


# --- stamps -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("waited_ns", "step_ns", "slips"),
    [
        (2 * MS, 1, False),
        (2 * MS, 0, True),
        (2 * MS, -1, True),
        (2 * MS, 37 * MS, False),
        (2 * MS, 37 * MS + 1, True),
        (300 * MS, 450 * MS, False),
        (300 * MS, 450 * MS + 1, True),
    ],
)
def test_what_counts_as_a_slip(waited_ns: int, step_ns: int, slips: bool) -> None:
    stamps = Stamps()
    said = [stamps.fault(sample(5 * S + k * waited_ns, 7 * S + k * step_ns)) for k in range(4)]
    assert said == ["", "", "", "left_foot's time stamps are out of order: 3 of 3 within a second" * slips]


def window(samples: int, slipping: tuple[int, ...]) -> str:
    """Samples 10 ms apart, those named doubled in their stamps; what the last one says."""
    stamps, sent_ns, said = Stamps(), 0, ""
    for k in range(samples + 1):
        sent_ns = sent_ns if k in slipping else k * 10 * MS
        said = stamps.fault(sample(k * 10 * MS, sent_ns))
    return said


@pytest.mark.requirement("SR-11")
def test_a_twentieth_is_allowed_and_three_slips_are_needed() -> None:
    assert window(60, (20, 40, 60)) == "", "3 of 60 are 5 %"
    assert window(59, (20, 40, 59)) == "left_foot's time stamps are out of order: 3 of 59 within a second"
    assert window(8, (4, 8)) == ""


def test_a_slip_is_forgotten_after_a_second_and_not_before() -> None:
    def third_after(ns: int) -> str:
        stamps = Stamps()
        return [stamps.fault(sample(t_ns, 0)) for t_ns in (0, 10 * MS, 20 * MS, 10 * MS + ns)][-1]

    assert third_after(S) == "left_foot's time stamps are out of order: 3 of 3 within a second"
    assert third_after(S + 1) == ""


# --- freshness ----------------------------------------------------------------------------------------------

MAX_AGE = 40 * MS
STILL: Vector3 = (0.1, 0.2, 0.3)


def heard(*pairs: tuple[int, int]) -> Freshness:
    freshness = Freshness(MAX_AGE)
    for t_ns, sent_ns in pairs:
        assert freshness.note(sample(t_ns, sent_ns)) == ""
    return freshness


def test_first_sample_counts_for_being_frozen() -> None:
    freshness = Freshness(MAX_AGE)
    assert freshness.note(sample(0, 0, gyr=STILL)) == ""
    says = "left_foot is frozen: the same values for 60 ms, limit 60 ms"
    assert freshness.note(sample(60 * MS, 60 * MS, gyr=STILL)) == says
    assert freshness.reason_not_ready("left_foot", 60 * MS) == says


def test_long_times_are_told_in_full_milliseconds() -> None:
    freshness = heard((0, 0))
    assert freshness.silence(sample(250 * MS, 250 * MS)) == ""
    assert freshness.silence(sample(2000 * S, 2000 * S)).startswith("left_foot was silent for 2000000 ms: ")
    freshness = heard((0, 0), (2000 * S, 0))
    drift_ms = 400  # 200 ppm of the time waited
    old = f"{2_000_000 - drift_ms} ms old by the sensor's own clock"
    assert old in freshness.reason_not_ready("left_foot", 2000 * S)
    assert heard((S, S)).reason_not_ready("left_foot", S - 1_375_000) == "left_foot data are dated 1.38 ms ahead"
    freshness.note(sample(3000 * S, 0, gyr=STILL))
    assert "for 1000000 ms" in freshness.note(sample(4000 * S, 0, gyr=STILL))


@pytest.mark.parametrize("values", [(1e308, 1e308, 1e308), (-1e308, -1e308, 0.0)])
def test_huge_numbers_are_numbers_though_their_sum_is_none(values: Vector3) -> None:
    freshness = Freshness(MAX_AGE)
    assert freshness.note(sample(0, 0, values, values)) == ""
    assert freshness.reason_not_ready("left_foot", 0) == ""


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_each_of_the_six_values_must_be_a_number(axis: int, bad: float) -> None:
    values = [math.inf if math.isinf(bad) and k == 5 else 0.1 for k in range(6)]
    values[axis] = bad
    acc, gyr = (values[0], values[1], values[2]), (values[3], values[4], values[5])
    assert Freshness(MAX_AGE).note(sample(0, 0, acc, gyr)) == "non-finite sample from left_foot"


def test_in_the_first_second_an_earlier_stamp_is_learnt_and_later_is_a_slip() -> None:
    """The first sample came 300 ms late, those after it at once."""
    freshness = heard((5 * S, 5 * S - 300 * MS), *((5 * S + k * MS, 5 * S + k * MS) for k in range(1, 5)))
    assert freshness.reason_not_ready("left_foot", 5 * S + 5 * MS) == ""


def test_learning_ends_after_exactly_one_second() -> None:
    heard((S, S - 300 * MS), *[(2 * S, 2 * S)] * 4)
    late = heard((S, S - 300 * MS), *[(2 * S + 1, 2 * S + 1)] * 2)
    assert late.note(sample(2 * S + 1, 2 * S + 1)) == "left_foot's clock went ahead by 300 ms"


def test_three_stamps_exactly_as_far_back_as_data_may_be_old_are_no_restart() -> None:
    heard((S, S), *[(S + k * MS, S - MAX_AGE) for k in range(1, 4)])
    back = heard((S, S), *[(S + k * MS, S - MAX_AGE - 1) for k in range(1, 3)])
    assert back.note(sample(S + 3 * MS, S - MAX_AGE - 1)) == "left_foot's clock went back by 40 ms"


def test_three_stamps_exactly_as_far_ahead_as_data_may_be_old_are_learnt() -> None:
    heard((S, S), (3 * S, 3 * S), *[(3 * S + k * MS, 3 * S + k * MS + MAX_AGE) for k in range(1, 4)])
    ahead = heard((S, S), (3 * S, 3 * S), *[(3 * S + k * MS, 3 * S + k * MS + MAX_AGE + 1) for k in range(1, 3)])
    assert ahead.note(sample(3 * S + 3 * MS, 3 * S + 3 * MS + MAX_AGE + 1)) == "left_foot's clock went ahead by 40 ms"


@pytest.mark.parametrize(("set_s", "says"), [(-1000, "back by 1000000 ms"), (1000, "ahead by 1000000 ms")])
def test_clock_that_was_set_is_trusted_anew_at_once(set_s: int, says: str) -> None:
    t_ns = 2000 * S
    freshness = heard((t_ns - 2 * S, t_ns - 2 * S), (t_ns, t_ns), *[(t_ns, t_ns + set_s * S)] * 2)
    assert freshness.note(sample(t_ns, t_ns + set_s * S, gyr=STILL)) == f"left_foot's clock went {says}"
    assert freshness.reason_not_ready("left_foot", t_ns + MAX_AGE) == "", "its mapping begins with this sample"
    assert "41 ms old" in freshness.reason_not_ready("left_foot", t_ns + MAX_AGE + 1)
    later_ns = t_ns + 60 * MS
    assert "frozen" in freshness.note(sample(later_ns, later_ns + set_s * S, gyr=STILL))


def test_data_that_came_just_in_time_are_too_old_by_the_sensors_own_clock() -> None:
    freshness = heard((0, 0), (100 * MS, 90 * MS))
    assert "50 ms old by the sensor's own clock" in freshness.reason_not_ready("left_foot", 100 * MS + MAX_AGE)


# --- plausibility -------------------------------------------------------------------------------------------

NARROW = ImuDevice(sensor="left_foot", device="xbus", port="tty", rate_hz=100, acc_range_g=4, gyr_range_dps=500)
ACC_END, GYR_END = 0.995 * 4 * G_MPS2, 0.995 * math.radians(500)


def lasting(acc: Vector3, gyr: Vector3, device: ImuDevice | None = NARROW, up: Vector3 | None = None) -> Plausibility:
    """After 200 ms of the same; ``said`` by the last sample is returned through ``fault``."""
    judge = Plausibility("left_foot", device, up)
    for k in range(20):
        judge.fault(sample(k * 10 * MS, 0, acc, gyr))
    return judge


def fault(acc: Vector3, gyr: Vector3 = (0.0, 0.0, 0.0), device: ImuDevice | None = NARROW) -> str:
    return lasting(acc, gyr, device).fault(sample(200 * MS, 0, acc, gyr))


def along(axis: int, size: float, rest: float = 0.0) -> Vector3:
    values = [rest, rest, rest]
    values[axis] = size
    return (values[0], values[1], values[2])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_each_axis_saturates_at_its_end_and_not_before(axis: int, sign: int) -> None:
    says = "left_foot is saturated: at the end of its range for 80 ms"
    assert fault(along(axis, sign * ACC_END)) == says
    assert fault(along(axis, sign * math.nextafter(ACC_END, 0))) == ""
    assert fault(UP, along(axis, sign * GYR_END)) == says
    assert fault(UP, along(axis, sign * math.nextafter(GYR_END, 0))) == ""
    assert fault(along(axis, sign * ACC_END), device=None) == ""


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_force_counts_all_three_axes(axis: int) -> None:
    assert fault(along(axis, 2.5)) == ""
    assert fault(along(axis, 2.499)) == (
        "left_foot shows 2.5 m/s² and less than gravity for 80 ms: is its unit g?"  # rounded to two digits
    )
    assert fault(along(axis, 80.0), device=None) == ""
    assert fault(along(axis, 80.01), device=None) == (
        "left_foot shows 80 m/s² and more than a foot can take for 80 ms: wrong unit?"
    )
    assert fault(along(axis, 1.5, 1.5)) == "", "2.6 m/s² together"


MEAN_TILT = math.radians(65)
LEVEL, UPRIGHT = (G_MPS2, 0.0, 0.0), (0.0, 0.0, G_MPS2)
TURNED = "left_foot shows turned by more than 65° from its calibration: remounted?"


def not_ready(forces: list[Vector3], up: Vector3 = (0.0, 0.0, 1.0), step_ms: float = 10.0) -> list[str]:
    """What is said after each sample of these forces, of a sensor that never rests."""
    judge, said = Plausibility("left_foot", None, up), list[str]()
    for k, acc in enumerate(forces):
        judge.fault(sample(round(k * step_ms * MS), 0, acc, (0.0, 1.0, 1e-3 * k)))
        said.append(judge.not_ready)
    return said


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1, -1])
def test_mean_force_forgets_in_300_ms(axis: int, sign: int) -> None:
    """From upright to level: the angle's tangent is what has come over what is left of gravity; told 80 ms later."""
    left = math.log(1 / (1 + math.tan(MEAN_TILT))) / math.log(1 - 10 / 300)
    assert not_ready([along(axis, sign * G_MPS2)] * (math.ceil(left) + 9))[-2:] == ["", TURNED]


@pytest.mark.parametrize(("step_ms", "samples"), [(40.0, 12), (5000.0, 11)])
def test_one_sample_after_a_silence_stands_for_40_ms(step_ms: float, samples: int) -> None:
    """Three times: 0.87³ of what was is left, and as much as is missing has come: 26 °; the ninth exceeds 65°."""
    assert not_ready([LEVEL] * samples, step_ms=step_ms)[-2:] == ["", TURNED]


@pytest.mark.parametrize(
    ("forces", "up", "step_ms"),
    [
        *(pytest.param([along(k, G_MPS2)] * 100, along(k, 1.0), 10.0, id=f"upright along axis {k}") for k in range(3)),
        pytest.param(([LEVEL] * 38 + [UPRIGHT] * 200) * 5, (0.0, 0.0, 1.0), 10.0, id="a stumble, turned for 60 ms"),
        pytest.param([LEVEL] * 100, (0.0, 0.0, 1.0), -1000.0, id="time runs backward"),
        pytest.param(
            [UPRIGHT] * 51 + [(0.0, 2000.0, G_MPS2)] + [UPRIGHT] * 28, (0.0, 0.0, 1.0), 10.0,
            id="a knock, which counts as twice gravity",
        ),
    ],
)  # fmt: skip
def test_what_does_not_turn_the_mean_force(forces: list[Vector3], up: Vector3, step_ms: float) -> None:
    assert not any(not_ready(forces, up, step_ms))


def test_a_triad_that_repeats_itself_is_told_by_its_sensors_name() -> None:
    judge, said = Plausibility("left_foot", None, None), ""
    for k in range(20):
        said = said or judge.fault(sample(k * 10 * MS, k * 10 * MS, UP, (0.0, 1.0, 0.1 * k)))
    assert said == "left_foot's accelerometer is frozen: the same values, the other's change"


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_mean_force_does_not_remember_what_is_no_number(bad: float) -> None:
    none = [(0.0, 0.0, -bad), (0.0, 0.0, bad)] * 7
    said = not_ready([UPRIGHT] * 51 + none + [(0.0, 0.0, -G_MPS2)] * 50)
    assert not any(said[:65])
    assert said[-1], "it still judges"


# --- the force's unit ---------------------------------------------------------------------------------------

IN_G, TOO_STRONG = "is its unit g?", "wrong unit?"


def felt(force: Force, one: ImuSample, force_mps2: float) -> str:
    """What it says of a sample of this force."""
    return force.fault(one, force_mps2, max(map(abs, one.acc_mps2)))


def told(
    forces: list[float],
    sensor: str = "left_foot",
    step_ns: int = 10 * MS,
    sent_ns: int | None = None,
    gaps: tuple[tuple[int, int], ...] = (),
    range_g: float = math.inf,
) -> list[str]:
    """What is said of these forces, sample by sample, by its last words; ``gaps``: samples and the time before them."""
    force, own_ns, said = Force(sensor, range_g), S, list[str]()
    for k, size in enumerate(forces):
        own_ns += dict(gaps).get(k, step_ns if sent_ns is None else sent_ns)
        one = ImuSample(S + k * step_ns, sensor, own_ns, (3.0, 2.0, -size), UP)
        said.append(felt(force, one, size)[-14:].strip())
    return said


def first(said: list[str]) -> int | None:
    return next((k for k, each in enumerate(said) if each), None)


@pytest.mark.parametrize("sensor", ["left_foot", "right_shank"])
def test_bounds_of_the_force_are_no_fault_themselves(sensor: str) -> None:
    bounds = place_of(sensor, None, None)
    assert first(told([bounds.weak_mps2] * 20, sensor)) is None
    assert first(told([math.nextafter(bounds.weak_mps2, 0)] * 20, sensor)) == 8
    assert first(told([bounds.strong_mps2] * 20, sensor)) is None
    assert first(told([math.nextafter(bounds.strong_mps2, 99)] * 20, sensor)) == 8
    down, up = 4.5 * bounds.low_mps2, bounds.high_mps2 / 4.5
    assert first(told([down] * 5 + [bounds.low_mps2] * 20, sensor)) is None
    assert first(told([down] * 5 + [math.nextafter(bounds.low_mps2, 0)] * 20, sensor)) == 13
    assert first(told([up] * 5 + [bounds.high_mps2] * 20, sensor)) is None
    assert first(told([up] * 5 + [math.nextafter(bounds.high_mps2, 99)] * 20, sensor)) == 13


def with_one(size: float, at: int) -> list[float]:
    """A step down to what lies low, with one sample among them that does not."""
    forces = [40.0] * 5 + [5.0] * 9
    forces[at] = size
    return forces


DOWN = [40.0] * 5 + [5.0] * 20
UNITS: dict[str, list[tuple[list[float], int | None, dict[str, Any]]]] = {
    "a step is more than four times": [
        ([24.0] * 5 + [6.0] * 20, None, {}),
        ([24.1] * 5 + [6.0] * 20, 13, {}),
        ([17.0] * 5 + [68.0] * 20, None, {}),
        ([17.0] * 5 + [68.1] * 20, 13, {}),
    ],
    "the first sample has none before": [([6.0] * 20, None, {}), ([68.0] * 20, None, {})],
    "too much for a shank is not for a foot": [([70.0] * 9, None, {}), ([70.0] * 9, 8, {"sensor": "right_shank"})],
    "weak samples count as low ones, strong ones as high ones": [
        ([40.0] * 5 + [1.0, 6.0, 6.0, 1.0, 6.0, 6.0, 1.0, 6.0, 1.0], 13, {}),
        ([16.0] * 5 + [90.0, 70.0, 70.0, 90.0, 70.0, 70.0, 90.0, 70.0, 70.0], 13, {}),
    ],
    "a step up makes nothing of low ones": [
        ([1.1] * 3 + [5.0] * 20, None, {}), ([300.0] * 3 + [70.0] * 20, None, {})
    ],
    "a step between samples far apart is none": [
        *((DOWN, 13, {"sent_ns": sent_ns}) for sent_ns in (12_500_000, 1)),
        *((DOWN, None, {"sent_ns": sent_ns}) for sent_ns in (12_500_001, 0, -1)),
    ],
    "nor a force that has been so since a slow sensor began": [([70.0] * 30, None, {"step_ns": 20 * MS})],
    "a step with samples missing after it is not judged": [
        (DOWN[:14], tells, {"gaps": ((at, gap_ns),)})
        for at in (6, 9, 13) for gap_ns, tells in ((25 * MS, 13), (25 * MS + 1, None))
    ],
    "a gap before the span does not matter": [(DOWN[:14], 13, {"gaps": ((0, 30 * MS), (3, 30 * MS))})],
    "samples missing after a step down make no step up of it": [
        ([300.0] * 5 + [70.0] * 9, None, {"gaps": ((9, 30 * MS),)})
    ],
    "a heel that lands between low forces: 61 m/s² would be 61 g": [
        (with_one(60.0, 12), 13, {}), (with_one(61.0, 12), None, {}), (with_one(81.0, 12), None, {})
    ],
    "an axis of ±16 g ends at 16 in g, but for a twentieth": [
        case
        for at in (6, 12, 13)
        for case in (
            (with_one(16.8, at), 13, {"range_g": 16.0}),
            (with_one(16.81, at), None, {"range_g": 16.0}),
            (with_one(16.81, at), 13, {}),
        )
    ],
    "more than the range does not excuse what is far too weak": [([1.0] * 7 + [28.0, 1.0], 8, {"range_g": 16.0})],
    "what speaks against g is forgotten with its span": [
        ([40.0] * 5 + [5.0, 5.0, 30.0, 30.0] + [5.0] * 20, 17, {"range_g": 16.0})
    ],
    "a step out of a shake is a contact with the ground": [
        (DOWN, 13, {}),
        ([40.0] * 4 + [32.0] + [5.0] * 20, 13, {}),  # 8 m/s² before it is no shake yet
        ([40.0] * 4 + [31.9] + [5.0] * 20, None, {}),
        ([8.0] * 4 + [16.0] + [70.0] * 20, 13, {}),
        ([7.9] * 4 + [16.0] + [70.0] * 20, None, {}),
    ],
    "with one sample before it nothing is known of a shake": [([40.0, 5.0] + [5.0] * 20, 9, {})],
}  # fmt: skip


@pytest.mark.parametrize(
    ("forces", "at", "more"),
    [pytest.param(*case, id=f"{rule}, {k}") for rule, cases in UNITS.items() for k, case in enumerate(cases)],
)
def test_where_a_wrong_unit_is_told(forces: list[float], at: int | None, more: dict[str, Any]) -> None:
    assert first(told(forces, **more)) == at


def test_says_which_way_the_unit_is_wrong() -> None:
    assert told([1.0] * 9)[-1] == IN_G
    assert told([90.0] * 9)[-1].endswith(TOO_STRONG)
    assert told([40.0] * 5 + [5.0] * 9)[-1] == IN_G
    assert told([16.0] * 5 + [70.0] * 9)[-1].endswith(TOO_STRONG)


@pytest.mark.parametrize(("size", "before"), [(1.0, 9.8), (90.0, 30.0), (5.0, 40.0), (70.0, 16.0)])
def test_three_in_four_samples_suffice_and_fewer_do_not(size: float, before: float) -> None:
    """At 20 ms a span has five samples, so four; at 10 ms nine, so seven. Usual ones come last, steps first."""
    usual = 9.8
    lead = [before] * 5
    assert any(told(lead + [size] * 7 + [usual] * 2))
    assert not any(told(lead + [size] * 6 + [usual] * 3))
    steps = (size, before) in [(5.0, 40.0), (70.0, 16.0)]
    assert any(told([before, *[size] * 4, usual], step_ns=20 * MS)) is not steps, "a step takes less than 12.5 ms"


@pytest.mark.parametrize(("size", "before"), [(2.4, 9.0), (90.0, 30.0), (5.0, 40.0), (70.0, 16.0)])
def test_exactly_three_in_four_samples_suffice(size: float, before: float) -> None:
    """At 11.5 ms a span has eight samples."""
    lead, step_ns = [before] * 5, 23 * MS // 2
    assert any(told([*lead, *[size] * 6, 9.8, 9.8], step_ns=step_ns))
    assert not any(told([*lead, *[size] * 5, 9.8, 9.8, 9.8], step_ns=step_ns))


def test_time_that_goes_back_begins_anew() -> None:
    force = Force("left_foot")
    for k in range(8):
        assert felt(force, ImuSample(9 * S + k * 10 * MS, "left_foot", S, UP, UP), 1.0) == ""
    said = [felt(force, ImuSample(S + k * 10 * MS, "left_foot", S, UP, UP), 1.0) for k in range(9)]
    assert first(said) == 8
    assert first([felt(force, ImuSample(S + k * 10 * MS, "left_foot", S, UP, UP), 9.8) for k in range(9, 40)]) in (0, 1)


def test_a_sensor_that_floods_takes_no_more_memory() -> None:
    force = Force("left_foot")
    for _ in range(3 * MOST_SAMPLES):
        assert felt(force, ImuSample(S, "left_foot", S, UP, UP), 1.0) == ""
    assert force.one.unit.filled == MOST_SAMPLES
    assert sum(force.one.unit.counts) == MOST_SAMPLES
    assert felt(force, ImuSample(S + 80 * MS, "left_foot", S, UP, UP), 1.0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rate_that_lasts_is_bounded_about_each_axis(axis: int) -> None:
    assert fault(UP, along(axis, 15.0), None) == ""
    assert fault(UP, along(axis, -15.1), None) == ("left_foot turns at more than 15 rad/s for 80 ms: is its unit °/s?")


@pytest.mark.parametrize(("t_ns", "tells"), [(2**62 - 1, False), (2**62, True), (-(2**62), True), (2**99, True)])
def test_a_stamp_beyond_any_clock_is_told_and_never_raises(t_ns: int, tells: bool) -> None:
    for one in (sample(t_ns, 0, UP, UP), sample(0, t_ns, UP, UP)):
        assert Plausibility("left_foot", None, None).fault(one) == "left_foot's stamps are beyond any clock" * tells


@pytest.mark.parametrize("code", all_codes())
def test_there_are_words_for_every_code(code: int) -> None:
    assert "left_foot" in sentence(code, "left_foot", 1.5)
    assert "{" not in sentence(code, "left_foot", 1.5)
    assert sentence(0, "left_foot", 1.5) == ""


def test_nothing_is_doubted_before_the_first_sample() -> None:
    assert Plausibility("left_foot", None, None).not_ready == ""


def test_the_least_tilt_that_is_doubted() -> None:
    """An ``up`` that is short makes the cosine exact: the force itself lies along it."""
    for short, says in ((0.0, ""), (1e-12, TURNED)):
        up = (BOUNDS.upright - short, 0.0, 0.0)
        assert lasting((9.5, 0.0, 0.0), (0.0, 0.0, 0.0), up=up).not_ready == says


@pytest.mark.parametrize("up", [(0.8, 0.6, 0.0), (0.0, 0.8, 0.6), (0.6, 0.0, 0.8)])
def test_every_axis_counts_for_a_rest(up: Vector3) -> None:
    """Upright lies along two axes, most of it along one; that one's share must not be taken away."""
    x, y, z = (G_MPS2 * u for u in up)
    assert lasting((x, y, z), (0.0, 0.0, 0.0), up=up).not_ready == ""
    assert "shows turned" in lasting((-x, -y, -z), (0.0, 0.0, 0.0), up=up).not_ready


@pytest.mark.parametrize(
    ("force_mps2", "rate_radps", "rests"),
    [
        (9.8, 0.5, True),
        (9.8, 0.501, False),
        (11.3, 0.0, True),
        (11.31, 0.0, False),
        (8.31, 0.0, True),
        (8.3, 0.0, False),
        (G_MPS2 + 1.5, 0.0, True),
    ],
)
def test_what_rests(force_mps2: float, rate_radps: float, rests: bool) -> None:
    judge = lasting((0.0, 0.0, -force_mps2), (0.0, -rate_radps, 0.0), up=(0.0, 0.0, 1.0))
    assert ("shows turned" in judge.not_ready) is rests


# --- words --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("current_ma", -1.5, "current is -1.5, must be a number above 0"),
        ("pulse_width_us", True, "pulse width is True, must be a number above 0"),
        ("frequency_hz", "40", "frequency is '40', must be a number above 0"),
        ("current_ma", 10**4000, "current is a huge number, must be a number above 0"),
        ("current_ma", -(10**4000), "current is a huge number, must be a number above 0"),
        ("frequency_hz", "4" * 99, f"frequency is '{'4' * 39}, must be a number above 0"),
    ],
)
def test_what_is_no_number_is_named_and_shown(field: str, value: Any, says: str) -> None:
    asked: dict[str, Any] = {"current_ma": 20.0, "pulse_width_us": 300.0, "frequency_hz": 40.0}
    assert no_number(StimRequest(0, True, **(asked | {field: value}))) == says


@pytest.mark.parametrize("field", ["current_ma", "pulse_width_us", "frequency_hz"])
def test_0_is_none_of_the_three_numbers_and_all_above_it_is(field: str) -> None:
    asked: dict[str, Any] = {"current_ma": 20.0, "pulse_width_us": 300.0, "frequency_hz": 40.0}
    assert no_number(StimRequest(0, True, **(asked | {field: 1e-9}))) == ""
    assert no_number(StimRequest(0, True, **(asked | {field: 0.0}))).endswith("is 0.0, must be a number above 0")


def test_bound_of_what_is_a_number_belongs_to_it() -> None:
    assert is_number(NUMBER_BOUND)
    assert is_number(-NUMBER_BOUND)
    assert not is_number(math.nextafter(NUMBER_BOUND, math.inf))
    assert shown(10**9) == "1000000000"
    assert shown(10**9 + 1) == "a huge number"


# --- the gate's own state -----------------------------------------------------------------------------------


# --- the gate of a session ----------------------------------------------------------------------------------


def session_gate(**more: float) -> SafetyGate:
    """A session with a narrow sensor on the shank, which tells the foot's phases; data may be 15 ms old."""
    shank = NARROW.model_copy(update={"sensor": "left_shank"})
    stimulation = Stimulation(max_data_age_ms=15, validity_ms=50)
    session = Session(name="x", channels=(make_channel(),), sensors=(shank,), stimulation=stimulation)
    return gate_of(session, {"left_shank": (0.0, 0.0, 1.0)}, {"left_foot": "left_shank"}, **more)


def shank_sample(gate: SafetyGate, t_ns: int, acc: Vector3 = UP, turns_radps: float = 1.0) -> None:
    alive = (acc[0] + 1e-9 * (t_ns % 1_000_003), acc[1], acc[2])
    gate.observe(sample(t_ns, t_ns, alive)._replace(sensor="left_shank", gyr_radps=(0.0, 0.0, turns_radps + alive[0])))


def test_gate_of_a_session_takes_all_that_the_session_says() -> None:
    gate = session_gate()
    shank_sample(gate, S)
    gate.observe(OperatorAct(S, OperatorAction.ARM))
    assert gate.armed
    command = gate.judge(S, replace(ASKED, current_ma=0.5))
    assert (command.on, command.validity_ms) == (True, 50)
    late = gate.judge(S + 16 * MS, replace(ASKED, current_ma=0.5))
    assert late.refused == "left_shank data 16 ms old, limit 15 ms"


@pytest.mark.parametrize(("more", "most_ma"), [({}, 0.5), ({"current_step_ma": 1.0}, 1.0)])
def test_gate_of_a_session_knows_the_stimulators_step(more: dict[str, float], most_ma: float) -> None:
    for current_ma in (most_ma, most_ma + 0.1):
        gate = session_gate(**more)
        shank_sample(gate, S)
        gate.observe(OperatorAct(S, OperatorAction.ARM))
        assert gate.judge(S, replace(ASKED, current_ma=current_ma)).on is (current_ma == most_ma)


def test_gate_of_a_session_knows_ranges_and_mounting() -> None:
    gate = session_gate()
    for k in range(20):
        shank_sample(gate, S + k * 10 * MS, (0.0, 0.0, ACC_END))
    assert gate.latched == "left_shank is saturated: at the end of its range for 80 ms"
    gate = session_gate()
    for k in range(20):
        shank_sample(gate, S + k * 10 * MS, (0.0, 0.0, -9.8), 0.0)
    gate.observe(OperatorAct(S + 190 * MS, OperatorAction.ARM))
    assert "remounted" in gate.arming_refused


@pytest.mark.parametrize("by_clock", [True, False])
def test_gate_of_an_exercise_lets_a_burst_last_as_long_as_it_is(by_clock: bool) -> None:
    """No data are asked for then, but a person's word: rise, hold, and the channel's fall, to the nanosecond."""
    channel = make_channel(extension_s=0.0, fall_s=0.2, limits=make_limits(max_on_s=3.0))
    exercise = Exercise(rise_s=0.4, on_s=0.7, off_s=2.0, count=1)
    gate = gate_of(Session(name="x", channels=(channel,), exercise=exercise if by_clock else None), {})
    gate.observe(OperatorAct(S, OperatorAction.ARM))
    assert gate.armed is by_clock, gate.arming_refused
    if not by_clock:
        return
    gate.observe(OperatorAct(S, OperatorAction.EXERCISE, 0.0))
    for k in range(131):
        assert gate.judge(S + k * 10 * MS, replace(ASKED, current_ma=0.5)).on
    assert "longer than a person asked for" in gate.judge(S + 1300 * MS + 1, replace(ASKED, current_ma=0.5)).refused


def test_the_judge_is_ready_before_any_sensor_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiled with a first sample, it kept the supervisor away for longer than the controller waits."""
    judged: list[Any] = []
    monkeypatch.setattr("fes.gate.plausibility.judge", lambda core: judged.append(core) or 0)
    SafetyGate((), max_data_age_ms=40, validity_ms=60)
    assert judged
