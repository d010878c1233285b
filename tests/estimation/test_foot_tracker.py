"""One foot's tracker: blocks cut anywhere, hostile samples, silences, any rate, no look ahead; what guards see."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fes.calibration.recording import calibrate_track
from fes.estimation.closures import SOUND, closures
from fes.estimation.foot import features as kernel
from fes.estimation.foot import tracker as one_foot
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.orientation import OrientationSettings
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.records import new_core
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.estimation.tracking.phase_features import (
    CALM_MPS2,
    FIRST_PITCH_SD_RAD,
    FLAT_S,
    FOLLOW,
    LANDED_S,
    LEAST,
    LEAST_PITCH_SD_RAD,
    LONG_REST_S,
    MEASURES,
    MOST,
    TURNED_S,
    USUAL,
    enter_phase,
)
from fes.estimation.tracking.tracker import HISTORY_S, LARGEST_VALUE, RESTART_GAP_S, Outcome
from fes.recording import read_recording
from fes.signals import G_MPS2, FloatArray, IntArray, StrideResult
from fes.simulation.sensor import FINE_HZ, PERFECT
from sim_inputs.generator.measured import measure
from sim_inputs.generator.session import new_session
from sim_inputs.generator.trials import HEALTHY, INSTEP, PATIENT_2
from sim_inputs.generator.walk import Style
from statemachine.guards import Features, Thresholds
from statemachine.machine import GuardDisagreement
from statemachine.phases import Phase, PhaseChange, Transition

FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
FEET = ["left_foot", "right_foot"]
CYCLE = [Transition.T1, Transition.T2, Transition.T3, Transition.T4]


@dataclass(frozen=True)
class Samples:
    t_ns: IntArray
    acc: FloatArray
    gyr: FloatArray

    def __getitem__(self, part: slice | IntArray) -> Samples:
        return Samples(self.t_ns[part], self.acc[part], self.gyr[part])

    def __len__(self) -> int:
        return len(self.t_ns)

    def at_s(self, seconds: float) -> int:
        return int(np.searchsorted(self.t_ns, round(seconds * 1e9)))


@cache
def walk(foot: str) -> tuple[Samples, FootCalibration]:
    """65 s of both_feet_100hz: three times longer than the history kept."""
    track = read_recording(FOLDER / "both_feet_100hz.parquet").tracks[foot]
    assert 1e-9 * track.t_sensor_ns[-1] > 3.0 * HISTORY_S
    return Samples(track.t_sensor_ns, track.acc_mps2, track.gyr_radps), calibrate_track(track)


def tracker_of(calibration: FootCalibration) -> FootTracker:
    stride = StrideSettings(calibration.forward(), np.array(calibration.up))
    return FootTracker(calibration, StrideMaker(calibration.sensor, stride))


def fed(tracker: FootTracker, samples: Samples, cuts: list[int] | None = None) -> list[Outcome]:
    """All outcomes of the samples, given in blocks cut at ``cuts``."""
    edges = [0, *sorted(cuts or []), len(samples)]
    outcomes: list[Outcome] = []
    for begin, end in pairwise(edges):
        part = samples[begin:end]
        outcomes += tracker.advance(part.t_ns, part.acc, part.gyr)
    return outcomes


def facts(outcomes: list[Outcome]) -> list[object]:
    """Everything in the outcomes, to the last bit (NaN equal to itself)."""
    found: list[object] = []
    for outcome in outcomes:
        if isinstance(outcome, StrideResult):
            plain = {name: getattr(outcome, name) for name in outcome.__slots__ if name != "left_over"}  # live alone
            arrays = [plain.pop(name).tobytes() for name in ("trajectory_m", "pitch_rad", "roll_rad")]
            found += [repr(plain), *arrays]
        else:
            found.append(outcome)
    return found


@cache
def whole(foot: str) -> tuple[list[object], bytes]:
    samples, calibration = walk(foot)
    tracker = tracker_of(calibration)
    return facts(fed(tracker, samples)), tracker._state.tobytes()


def changes(outcomes: list[Outcome]) -> list[PhaseChange]:
    return [outcome for outcome in outcomes if isinstance(outcome, PhaseChange)]


def strides(outcomes: list[Outcome]) -> list[StrideResult]:
    return [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]


# --- cut anywhere ----------------------------------------------------------------------------------------


def test_the_walk_is_worth_cutting() -> None:
    for foot in FEET:
        samples, calibration = walk(foot)
        outcomes = fed(tracker_of(calibration), samples)
        assert [c.transition for c in changes(outcomes)] == CYCLE * 46
        assert len([s for s in strides(outcomes) if s.valid]) == 46


@given(foot=st.sampled_from(FEET), cuts=st.lists(st.integers(0, 6400), min_size=1, max_size=60))
@example(foot="left_foot", cuts=[1, 2, 3, 1999, 2000, 2001, 2999, 3000, 3001, 4000])  # around the history's ends
@settings(max_examples=25, deadline=None)
def test_blocks_may_be_cut_anywhere(foot: str, cuts: list[int]) -> None:
    samples, calibration = walk(foot)
    tracker = tracker_of(calibration)
    assert facts(fed(tracker, samples, cuts)) == whole(foot)[0]
    assert tracker._state.tobytes() == whole(foot)[1]


@pytest.mark.parametrize("foot", FEET)
def test_one_sample_at_a_time_as_live_is_the_whole_block(foot: str) -> None:
    samples, calibration = walk(foot)
    tracker = tracker_of(calibration)
    assert facts(stepped(tracker, samples)) == whole(foot)[0]
    assert tracker._state.tobytes() == whole(foot)[1]


def stepped(tracker: FootTracker, samples: Samples) -> list[Outcome]:
    """All outcomes of the samples, one at a time as live."""
    outcomes: list[Outcome] = []
    for t_ns, (ax, ay, az), (gx, gy, gz) in zip(
        samples.t_ns.tolist(), samples.acc.tolist(), samples.gyr.tolist(), strict=True
    ):
        outcomes += tracker.step(t_ns, (ax, ay, az), (gx, gy, gz))
    return outcomes


@pytest.mark.parametrize("foot", FEET)
def test_a_stride_leaves_over_what_its_closure_does(foot: str) -> None:
    samples, calibration = walk(foot)
    found = strides(stepped(tracker_of(calibration), samples))
    rows = [
        np.searchsorted(samples.t_ns, [getattr(each, name) for each in found]) for name in ("t_start_ns", "t_end_ns")
    ]
    t_s = 1e-9 * (samples.t_ns - samples.t_ns[0])
    wanted = closures((t_s, samples.acc, samples.gyr), *rows, np.array([SOUND]))[0]
    assert np.array([each.left_over for each in found]) == pytest.approx(wanted, abs=2e-3)


def test_samples_live_and_in_blocks_may_take_turns() -> None:
    samples, calibration = walk("left_foot")
    tracker, outcomes = tracker_of(calibration), list[Outcome]()
    edges = [0, 700, 1990, 2010, 3300, 4000, 5100, len(samples)]
    for number, (begin, end) in enumerate(pairwise(edges)):
        part = samples[begin:end]
        outcomes += stepped(tracker, part) if number % 2 else fed(tracker, part)
    assert facts(outcomes) == whole("left_foot")[0]
    assert tracker._state.tobytes() == whole("left_foot")[1]


def test_the_history_is_free_of_bias_with_the_orientation_beside_it() -> None:
    samples, calibration = walk("left_foot")
    samples = samples[: samples.at_s(30.0)]
    tracker = tracker_of(calibration)
    fed(tracker, samples)
    t_ns, acc, gyr, quaternions = tracker.history()
    assert 1000 <= len(t_ns) <= 2000
    newest = samples[len(samples) - len(t_ns) : len(samples)]
    assert np.array_equal(t_ns, newest.t_ns)
    assert np.array_equal(acc, newest.acc - np.array(calibration.acc_bias_mps2))
    assert np.array_equal(gyr, newest.gyr - tracker.gyr_bias_radps)
    assert np.linalg.norm(quaternions, axis=1) == pytest.approx(1.0)
    t_ns[:] = 0
    assert tracker.history().t_ns[0] != 0  # it was a copy


@pytest.mark.parametrize("foot", FEET)
def test_forgetting_changes_nothing(foot: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fes.estimation.tracking.tracker.HISTORY_S", 200.0)
    samples, calibration = walk(foot)
    tracker = tracker_of(calibration)
    assert len(tracker._history.arrays.t_ns) == 20_000
    assert facts(fed(tracker, samples)) == whole(foot)[0]


def test_arrays_of_any_kind_give_the_same() -> None:
    """Every other kind would be compiled for once more, in the middle of a session."""
    samples, calibration = walk("left_foot")
    samples = samples[: samples.at_s(12.0)]
    expected = facts(fed(tracker_of(calibration), samples))
    frozen = Samples(samples.t_ns.copy(), samples.acc.copy(), samples.gyr.copy())
    for column in (frozen.t_ns, frozen.acc, frozen.gyr):
        column.flags.writeable = False
    spread = Samples(np.repeat(samples.t_ns, 2)[::2], np.asfortranarray(samples.acc), np.repeat(samples.gyr, 2, 0)[::2])
    compiled: Any = one_foot._block
    kinds = len(compiled.signatures)
    for other in (frozen, spread):
        assert facts(fed(tracker_of(calibration), other)) == expected
    assert len(compiled.signatures) == kinds


def test_numbers_of_any_kind_give_the_same_live() -> None:
    """As whole numbers, or as numpy's: whatever a driver or a caller has."""
    samples, calibration = walk("left_foot")
    samples = samples[: samples.at_s(8.0)]
    rounded = Samples(samples.t_ns, np.round(samples.acc), samples.gyr.astype(np.float32).astype(np.float64))
    expected = facts(stepped(tracker_of(calibration), rounded))
    compiled: Any = one_foot._step
    kinds = len(compiled.signatures)
    tracker, outcomes = tracker_of(calibration), list[Outcome]()
    single = rounded.gyr.astype(np.float32)
    for t_ns, acc, gyr in zip(rounded.t_ns, rounded.acc.astype(np.int64).tolist(), single, strict=True):
        outcomes += tracker.step(t_ns, acc, gyr)
    assert facts(outcomes) == expected
    assert len(compiled.signatures) == kinds


@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(st.sampled_from(["nan", "inf", "huge", "back", "twice", "lost", "silence"]), min_size=1, max_size=8),
    cuts=st.lists(st.integers(0, 1500), max_size=12),
)
@settings(max_examples=25, deadline=None)
def test_blocks_of_hostile_samples_may_be_cut_anywhere(seed: int, kinds: list[str], cuts: list[int]) -> None:
    samples, calibration = walk("left_foot")
    spoiled = samples[: samples.at_s(15.0)]
    rng = np.random.default_rng(seed)
    for kind in kinds:
        spoiled = spoil(spoiled, kind, int(rng.integers(1, len(spoiled) - 60)))
    one, other, live = (tracker_of(calibration) for _ in range(3))
    assert facts(fed(one, spoiled)) == facts(fed(other, spoiled, [min(cut, len(spoiled)) for cut in cuts]))
    assert one._state.tobytes() == other._state.tobytes()
    assert one.counts == other.counts
    assert facts(stepped(live, spoiled)) == facts(fed(tracker_of(calibration), spoiled))
    assert (one._state.tobytes(), one.counts) == (live._state.tobytes(), live.counts)


def spoil(s: Samples, kind: str, k: int) -> Samples:
    """Something wrong at sample ``k``."""
    t_ns, acc, gyr = s.t_ns.copy(), s.acc.copy(), s.gyr.copy()
    if kind == "nan":
        acc[k, 1] = math.nan
    elif kind == "inf":
        gyr[k, 0] = -math.inf
    elif kind == "huge":
        acc[k, 2] = 1e200
        t_ns[k] += 35_000_000
    elif kind == "back":
        t_ns[k] -= 25_000_000
    elif kind == "twice":
        order = np.insert(np.arange(len(s)), k, k)
        return s[order]
    elif kind == "lost":
        return s[np.delete(np.arange(len(s)), slice(k, k + 6))]
    elif kind == "silence":
        t_ns[k:] += 400_000_000
    return Samples(t_ns, acc, gyr)


# --- hostile samples -------------------------------------------------------------------------------------


def test_samples_that_are_no_use_are_counted_and_change_nothing() -> None:
    samples, calibration = walk("right_foot")
    samples = samples[: samples.at_s(12.0)]
    order = np.insert(np.arange(len(samples)), [300, 301, 700, 900, 1000, 1100], [299, 250, 699, 900, 1000, 1100])
    hostile = samples[order]
    for at, value in ((903, math.nan), (1004, math.inf), (1105, -1.01 * LARGEST_VALUE)):
        assert hostile.t_ns[at] == hostile.t_ns[at + 1]  # a spoiled one and after it the good one of the same time
        hostile.acc[at, 0] = value
    clean, spoiled = tracker_of(calibration), tracker_of(calibration)
    assert facts(fed(spoiled, hostile)) == facts(fed(clean, samples))
    assert spoiled.counts.to_dict() == {
        "used": len(samples), "doubled_or_backward": 3, "not_finite": 3, "restarts": 0,
    }  # fmt: skip
    assert spoiled._state["t_ns"] == samples.t_ns[-1]


def test_nothing_but_rubbish() -> None:
    calibration = walk("left_foot")[1]
    tracker = tracker_of(calibration)
    t_ns = np.arange(50) * 10_000_000
    assert tracker.advance(t_ns, np.full((50, 3), math.nan), np.zeros((50, 3))) == []
    assert tracker.counts.not_finite == 50
    assert tracker.counts.used == 0
    assert tracker.advance(t_ns[:0], np.zeros((0, 3)), np.zeros((0, 3))) == []
    assert tracker._state["t_ns"] == 0


def test_a_sensor_that_begins_with_zeros() -> None:
    """Switched on a moment ago, it sends nothing but zeros; the calibrated bias aside, no direction is up."""
    samples, calibration = walk("left_foot")
    calibration = replace(calibration, acc_bias_mps2=(0.0, 0.0, 0.0), gyr_bias_radps=(0.0, 0.0, 0.0))
    tracker = tracker_of(calibration)
    t_ns = np.arange(100) * 10_000_000
    tracker.advance(t_ns, np.zeros((100, 3)), np.zeros((100, 3)))
    assert np.isfinite(tracker._state["quaternion"]).all()
    later = Samples(samples.t_ns + 1_000_000_000, samples.acc, samples.gyr)
    outcomes = fed(tracker, later[: later.at_s(30.0)])
    assert len([s for s in strides(outcomes) if s.valid]) > 10


# --- silences --------------------------------------------------------------------------------------------


def without(samples: Samples, begin_s: float, gap_s: float) -> Samples:
    """Samples of ``gap_s`` lost: the next stamp is that much later than the one before."""
    first = samples.at_s(begin_s)
    return samples[np.delete(np.arange(len(samples)), slice(first, first + round(100.0 * gap_s) - 1))]


def in_swing_s(foot: str) -> float:
    """An instant in the middle of a swing somewhere in the walk."""
    samples, calibration = walk(foot)
    stride = [s for s in strides(fed(tracker_of(calibration), samples)) if s.valid][20]
    assert stride.t_swing_ns is not None
    return round(1e-9 * stride.t_swing_ns + 0.12, 2)


@pytest.mark.parametrize("foot", FEET)
def test_a_long_silence_begins_anew(foot: str) -> None:
    samples, calibration = walk(foot)
    at_s = in_swing_s(foot)
    tracker = tracker_of(calibration)
    outcomes = fed(tracker, without(samples, at_s, RESTART_GAP_S + 0.05))
    restarts = [c for c in changes(outcomes) if c.transition is Transition.NONE]
    assert tracker.counts.restarts == len(restarts) == 1
    assert (restarts[0].source, restarts[0].destination) == (Phase.SWING, Phase.STANCE)
    assert restarts[0].t_ns == pytest.approx(1e9 * (at_s + 0.29), abs=2e7)
    found = strides(outcomes)
    assert not [s for s in found if s.t_start_ns < restarts[0].t_ns < s.t_end_ns]
    assert [s.number for s in found] == list(range(1, len(found) + 1))
    assert len([s for s in found if s.valid]) >= 43  # those before and after are not touched


@pytest.mark.parametrize("foot", FEET)
@pytest.mark.parametrize("into_s", [round(0.06 * k, 2) for k in range(19)])
def test_begun_at_any_instant_of_the_gait_the_phases_are_soon_the_walks(foot: str, into_s: float) -> None:
    """As after a silence: swing must not be taken for stance for good."""
    samples, calibration = walk(foot)

    def contacts_s(part: Samples) -> FloatArray:
        seen = changes(fed(tracker_of(calibration), part))
        return 1e-9 * np.array([c.t_ns for c in seen if c.transition is Transition.T3])

    begin_s, end_s = 20.0 + into_s, 32.0
    found = contacts_s(samples[samples.at_s(begin_s) : samples.at_s(end_s)])
    true = contacts_s(samples[: samples.at_s(end_s)])
    true, found = true[true > begin_s + 3.0], found[found > begin_s + 3.0]
    assert len(true) > 5
    assert len(found) == len(true)
    assert np.abs(found - true).max() < 0.08


@pytest.mark.parametrize("foot", FEET)
def test_a_shorter_gap_spoils_its_stride_only(foot: str) -> None:
    samples, calibration = walk(foot)
    at_s = in_swing_s(foot)
    tracker = tracker_of(calibration)
    outcomes = fed(tracker, without(samples, at_s, 0.10))
    assert tracker.counts.restarts == 0
    assert Transition.NONE not in [c.transition for c in changes(outcomes)]
    bad = [s for s in strides(outcomes) if not s.valid]
    assert len(bad) == 1
    assert bad[0].t_start_ns < 1e9 * at_s < bad[0].t_end_ns
    assert bad[0].reason == "samples missing for 100 ms"
    assert len(strides(outcomes)) >= 45


@pytest.mark.parametrize(("gap_s", "restarts"), [(RESTART_GAP_S, 0), (RESTART_GAP_S + 0.01, 1)])
def test_the_longest_silence_that_is_bridged(gap_s: float, restarts: int) -> None:
    samples, calibration = walk("left_foot")
    tracker = tracker_of(calibration)
    fed(tracker, without(samples[: samples.at_s(4.0)], 2.0, gap_s))
    assert tracker.counts.restarts == restarts


def test_stamps_far_from_zero() -> None:
    """A monotonic clock may begin anywhere, below zero too."""
    samples, calibration = walk("left_foot")
    samples = samples[: samples.at_s(12.0)]
    plain = changes(fed(tracker_of(calibration), samples))
    for offset in (-5_000_000_000_000, 10**18):
        moved = fed(tracker_of(calibration), Samples(samples.t_ns + offset, samples.acc, samples.gyr))
        assert [(c.t_ns - offset, c.transition) for c in changes(moved)] == [(c.t_ns, c.transition) for c in plain]


def test_a_machine_that_does_not_agree_stops_everything() -> None:
    samples, calibration = walk("left_foot")
    tracker = tracker_of(calibration)
    fed(tracker, samples[:300])
    enter_phase(tracker._core[0], int(Phase.PRE_SWING))
    tracker._state["toe_down_peak"] = 99.0
    with pytest.raises(GuardDisagreement, match="from STANCE of left_foot"):
        fed(tracker, samples[300:])


# --- causality -------------------------------------------------------------------------------------------


@given(cut=st.integers(500, 4000), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_the_future_changes_nothing(cut: int, seed: int) -> None:
    """In one block with whatever comes later, outcomes up to now are those of now."""
    samples, calibration = walk("right_foot")
    so_far = facts(fed(tracker_of(calibration), samples[:cut]))
    rng = np.random.default_rng(seed)
    other = Samples(
        samples.t_ns,
        np.concatenate((samples.acc[:cut], rng.normal(0.0, 20.0, (len(samples) - cut, 3)))),
        np.concatenate((samples.gyr[:cut], rng.normal(0.0, 5.0, (len(samples) - cut, 3)))),
    )
    assert facts(fed(tracker_of(calibration), other))[: len(so_far)] == so_far


def test_a_change_bears_the_time_of_the_sample_that_made_it() -> None:
    samples, calibration = walk("left_foot")
    tracker = tracker_of(calibration)
    for k in range(samples.at_s(12.0)):
        for outcome in fed(tracker, samples[k : k + 1]):
            if isinstance(outcome, PhaseChange):
                assert outcome.t_ns == samples.t_ns[k]
                assert tracker.phase is outcome.destination
            else:
                assert outcome.t_end_ns <= samples.t_ns[k]


# --- any sampling rate -----------------------------------------------------------------------------------

RATES_HZ = (100.0, 200.0, 500.0, 1000.0)


@cache
def at_rates(name: str) -> dict[float, tuple[Samples, FootCalibration]]:
    """One seeded walk seen by a faultless sensor at several rates, with one and the same calibration."""
    style: Style = {"healthy": HEALTHY, "drop foot": PATIENT_2}[name]
    session = new_session(name, 71, INSTEP)
    session.stand(4.0)
    session.walk({"right_foot": style}, 7, 1.2 if name == "healthy" else 0.42, ramp_s=1.0, early=False)
    session.stand(2.0)
    session.finish()
    fine = np.arange(int(session.now_s * FINE_HZ) + 1) / FINE_HZ
    force, rate = session.ideal("right_foot", fine)
    rng = np.random.default_rng(0)
    model = replace(PERFECT, bandwidth=0.4)
    tracks = {hz: measure(rng, model, "right_foot", hz, fine, force, rate) for hz in RATES_HZ}
    calibration = calibrate_track(tracks[200.0])
    return {
        hz: (Samples(t.t_sensor_ns, t.acc_mps2, t.gyr_radps), replace(calibration, rate_hz=hz))
        for hz, t in tracks.items()
    }


@pytest.mark.parametrize("name", ["healthy", "drop foot"])
def test_one_setting_holds_at_any_rate(name: str) -> None:
    seen = {hz: fed(tracker_of(calibration), samples) for hz, (samples, calibration) in at_rates(name).items()}
    reference = changes(seen[500.0])
    assert [c.transition for c in reference] == CYCLE * 7
    for hz in RATES_HZ:
        assert [c.transition for c in changes(seen[hz])] == [c.transition for c in reference], hz
        for a, b in zip(changes(seen[hz]), reference, strict=True):
            late_ms = {Transition.T1: 30.0, Transition.T4: 100.0}  # a gentle landing rests early or not at all
            assert 1e-6 * abs(a.t_ns - b.t_ns) < late_ms.get(a.transition, 15.0), (hz, a, b)
        lengths = [
            abs(s.stride_length_m - r.stride_length_m)
            for s, r in zip(strides(seen[hz]), strides(seen[500.0]), strict=True)
        ]
        assert max(lengths) < 0.025, hz


# --- what the guards see ---------------------------------------------------------------------------------


class Core:
    """The compiled core alone, sample by sample at 100 Hz, in a phase that only the test changes."""

    def __init__(self, phase: Phase = Phase.STANCE, stride_s: float = 1.2) -> None:
        self.calibration = replace(
            walk("left_foot")[1], up=(0.0, 0.0, 1.0), toe_down=(0.0, 1.0, 0.0), acc_bias_mps2=(0.0, 0.0, 0.0),
            gyr_bias_radps=(0.0, 0.0, 0.0), push_off_radps=6.0, fall_radps=10.0, stride_s=stride_s,
            contact_jerk_mps3=2000.0,
        )  # fmt: skip
        parameters, thresholds = self.calibration.parameters(), self.calibration.thresholds()
        parts = {"parameters": parameters, "thresholds": thresholds, "settings": OrientationSettings()}
        self.core = new_core(kernel.CORE, **parts)[0]
        self.state = self.core.state
        kernel.start(self.core, 0, 0.0, 0.0, G_MPS2)
        self.feed(0.2)
        enter_phase(self.core, int(phase))

    def feed(
        self, seconds: float, rate: tuple[float, float, float] = (0.0, 0.0, 0.0), extra: FloatArray | None = None
    ) -> list[Features]:
        """Samples of this rate, and of gravity plus ``extra`` in the sensor's axes; what is seen after each."""
        seen = []
        for _ in range(round(seconds * 100.0)):
            t_ns = np.array([int(self.state["t_ns"]) + 10_000_000])
            w, x, y, z = self.state["quaternion"]
            up = np.array([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
            force = G_MPS2 * up + (np.zeros(3) if extra is None else extra)
            kernel.advance(self.core, t_ns, force[None].copy(), np.array([rate]), 0, 1, np.empty((1, 4)))
            seen.append(kernel.features(self.state))
        return seen

    def resting_s(self, *sizes: float) -> list[float]:
        return [round(self.feed(0.01, (0.0, size, 0.0))[0].resting_s, 9) for size in sizes]

    def measures(self) -> Thresholds:
        return Thresholds._make(self.core.thresholds.item())

    def stride(
        self,
        push_off_radps: float,
        fall_radps: float,
        stride_s: float,
        swing_s: float,
        loading_s: float,
        contact_jerk_mps3: float,
    ) -> Thresholds:
        """One stride that shows this, from contact to contact; the measures after it."""
        enter_phase(self.core, int(Phase.SWING))
        self.state["toe_down_peak"], self.state["toe_up_peak"] = push_off_radps, fall_radps - push_off_radps
        self.state["t_ns"] = self.state["contact_ns"] + round(1e9 * stride_s)
        self.state["swing_ns"] = self.state["t_ns"] - round(1e9 * swing_s)
        enter_phase(self.core, int(Phase.LOADING_RESPONSE))
        self.state["greatest_jerk"] = contact_jerk_mps3
        self.state["t_ns"] += round(1e9 * loading_s)
        enter_phase(self.core, int(Phase.STANCE))
        return self.measures()


def test_rest_begins_when_the_foot_turns_no_more() -> None:
    core = Core()
    assert core.feed(0.01)[-1].resting_s > 1.0  # nothing is known of before
    assert core.resting_s(2.0, 0.0, 0.0, 2.0, 0.0) == [0.0, 0.01, 0.02, 0.0, 0.01]


@pytest.mark.parametrize(("push_off_radps", "fall_radps"), [(6.0, 10.0), (3.0, 10.0)])
def test_the_limit_of_rest_is_a_share_of_the_push_off_or_of_half_the_fall(
    push_off_radps: float, fall_radps: float
) -> None:
    core = Core()
    core.core.thresholds.push_off_radps = push_off_radps
    limit = core.measures().rest_share * max(push_off_radps, 0.5 * fall_radps)
    assert core.resting_s(1.0001 * limit, 0.9999 * limit, limit) == [0.0, 0.01, 0.0]


def test_a_foot_that_flies_evenly_travels() -> None:
    """A push, then half a second without force: it is no rest before it has been still for long."""
    push = np.array([8.0, 0.0, 0.0])
    core = Core(Phase.SWING)
    core.feed(0.2, (0.0, 2.0, 0.0), push)
    assert core.state["peak_speed"] > 1.0
    coasting = [x.travelling for x in core.feed(0.5)]
    assert coasting.index(False) == pytest.approx(100.0 * LONG_REST_S, abs=2)
    stopped = Core(Phase.SWING)
    stopped.feed(0.2, (0.0, 2.0, 0.0), push)
    stopped.feed(0.2, (0.0, -2.0, 0.0), -push)
    assert not any(x.travelling for x in stopped.feed(0.2))


@pytest.mark.parametrize("phase", [Phase.STANCE, Phase.LOADING_RESPONSE])
def test_the_reckoned_speed_of_a_foot_on_the_ground_dies_away(phase: Phase) -> None:
    core = Core(Phase.SWING)
    core.feed(0.2, (0.0, 2.0, 0.0), np.array([8.0, 0.0, 0.0]))
    enter_phase(core.core, int(phase))
    core.feed(0.5)
    assert core.state["speed"] < 0.02
    assert core.state["peak_speed"] < 1.6


def test_look_backs_are_times() -> None:
    assert kernel.lags_at(100.0) == (1, 2)
    assert kernel.lags_at(204.8) == (2, 4)
    assert kernel.lags_at(1000.0) == (10, 20)
    assert kernel.lags_at(25.0) == (1, 1)
    assert kernel.lags_at(1e5) == (63, 63)


def test_features_are_rates_per_second() -> None:
    core = Core(Phase.SWING)
    core.state["toe_down_peak"] = 1.0
    x = core.feed(0.01, extra=np.array([0.0, 0.0, 7.0]))[-1]
    assert x.contact_jerk_mps3 == pytest.approx(700.0, rel=1e-6)
    x = core.feed(0.02, (0.0, 0.4, 0.0))[-1]
    assert x.toe_down_radps == pytest.approx(0.4, abs=1e-3)
    assert x.in_swing_s == pytest.approx(0.03)


def test_of_a_jump_sideways_half_counts() -> None:
    core = Core(Phase.SWING)
    assert core.feed(0.01, extra=np.array([8.0, 0.0, 0.0]))[-1].contact_jerk_mps3 == pytest.approx(400.0, rel=1e-6)
    assert core.feed(0.01, extra=np.array([8.0, 0.0, 0.0]))[-1].contact_jerk_mps3 == pytest.approx(0.0, abs=1.0)


DOWN, UP = (0.0, 3.0, 0.0), (0.0, -3.0, 0.0)


def test_how_far_it_has_turned_counts_since_it_last_stood_still() -> None:
    core = Core()
    assert core.feed(0.1, DOWN)[-1].turned_rad == pytest.approx(0.3, abs=1e-3)
    assert core.feed(0.05, UP)[-1].turned_rad == pytest.approx(0.15, abs=1e-3)  # turning back begins nothing anew
    assert core.feed(TURNED_S)[-1].turned_rad == pytest.approx(0.15 / math.e, rel=0.05)
    assert core.feed(5.0 * TURNED_S)[-1].turned_rad < 0.001
    assert core.feed(0.1, DOWN)[-1].turned_rad == pytest.approx(0.3, abs=1e-3)


def test_the_pitch_becomes_the_flat_one_while_the_foot_stands_still() -> None:
    core = Core()
    assert core.feed(0.1, DOWN)[-1].pitch_rad == pytest.approx(-0.3, abs=1e-3)
    assert core.feed(FLAT_S)[-1].pitch_rad == pytest.approx(-0.3 / math.e, rel=0.05)
    assert abs(core.feed(5.0 * FLAT_S)[-1].pitch_rad) < 0.002
    assert core.feed(0.1, UP)[-1].pitch_rad == pytest.approx(0.3, abs=2e-3)


@pytest.mark.parametrize("phase", [Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE])
def test_a_halt_outside_stance_is_neither_flat_nor_the_beginning_of_a_turn(phase: Phase) -> None:
    core = Core(phase)
    core.feed(0.1, DOWN)
    x = core.feed(0.5)[-1]
    assert (x.turned_rad, x.pitch_rad) == pytest.approx((0.3, -0.3), abs=1e-3)


def test_it_stands_still_below_a_rate() -> None:
    core = Core(Phase.LOADING_RESPONSE)
    limit = core.measures().still_radps
    seen = [core.feed(0.01, (0.0, rate, 0.0))[-1].settled_s for rate in (1.001 * limit, 0.999 * limit, 0.0)]
    assert seen == pytest.approx([0.0, 0.01, 0.02])


def test_how_far_it_has_turned_in_swing_counts_from_foot_off() -> None:
    core = Core(Phase.PRE_SWING)
    core.feed(0.1, DOWN)
    enter_phase(core.core, int(Phase.SWING))
    x = core.feed(0.1, DOWN)[-1]
    assert (x.swung_rad, x.fallen_rad) == (0.0, 0.0), "it has not swung up yet"
    core.feed(0.2, tuple(-rate for rate in DOWN))
    x = core.feed(0.1, DOWN)[-1]
    assert (x.swung_rad, x.fallen_rad) == pytest.approx((0.3, 0.3), abs=1e-3)


def test_it_has_settled_since_contact_at_the_earliest() -> None:
    core = Core(Phase.SWING)
    core.feed(0.2)
    enter_phase(core.core, int(Phase.LOADING_RESPONSE))
    assert core.feed(0.03)[-1].settled_s == pytest.approx(0.03)
    enter_phase(core.core, int(Phase.STANCE))
    assert core.feed(0.01)[-1].settled_s == pytest.approx(0.04)
    assert core.feed(0.01, DOWN)[-1].settled_s == 0.0


def test_it_is_calm_while_nothing_but_gravity_is_upon_it() -> None:
    core = Core(Phase.SWING)
    assert core.feed(0.02, extra=np.array([1.1 * CALM_MPS2, 0.0, 0.0]))[-1].calm_s == 0.0
    assert core.feed(0.02, extra=np.array([0.9 * CALM_MPS2, 0.0, 0.0]))[-1].calm_s == pytest.approx(0.02)
    assert core.feed(0.02, extra=np.array([0.0, 0.0, -1.1 * CALM_MPS2]))[-1].calm_s == 0.0


def test_how_far_from_flat_it_stands_still_after_a_landing_is_followed() -> None:
    def after(*landings_rad: float) -> float:
        core = Core()
        for pitch_rad in landings_rad:
            enter_phase(core.core, int(Phase.LOADING_RESPONSE))
            core.state["pitch_rad"] = pitch_rad
            seen = core.feed(2.0 * core.measures().settled_after_s)
            assert len({x.pitch_sd_rad for x in seen}) <= 2, "once a landing"
        return seen[-1].pitch_sd_rad

    first = FIRST_PITCH_SD_RAD + FOLLOW * (0.2 - FIRST_PITCH_SD_RAD)
    assert after(0.2) == after(-0.2) == pytest.approx(first)
    assert after(0.2, 0.1) == pytest.approx(first + FOLLOW * (0.1 - first))
    assert after(*[0.0] * 20) == LEAST_PITCH_SD_RAD


def test_standing_still_long_after_contact_or_in_swing_tells_nothing_of_the_landing() -> None:
    for phase, moved_s in ((Phase.LOADING_RESPONSE, LANDED_S), (Phase.SWING, 0.1)):
        core = Core(Phase.LOADING_RESPONSE)
        enter_phase(core.core, int(phase))
        core.feed(moved_s, DOWN)
        core.state["pitch_rad"] = 0.2
        assert core.feed(0.3)[-1].pitch_sd_rad == FIRST_PITCH_SD_RAD


def test_the_peak_of_landing_is_the_greatest_rate_either_way_between_contact_and_flat() -> None:
    core = Core(Phase.SWING)
    core.feed(0.02, UP)
    enter_phase(core.core, int(Phase.LOADING_RESPONSE))
    seen = [core.feed(0.01, (0.0, rate, 0.0))[-1].landing_peak_radps for rate in (1.0, -2.0, 0.5)]
    assert seen == pytest.approx([1.0, 2.0, 2.0], rel=1e-3)
    enter_phase(core.core, int(Phase.STANCE))
    assert core.feed(0.01, DOWN)[-1].landing_peak_radps == pytest.approx(2.0, rel=1e-3)
    enter_phase(core.core, int(Phase.LOADING_RESPONSE))
    assert core.feed(0.01)[-1].landing_peak_radps == pytest.approx(0.0, abs=1e-3)


def test_rest_before_the_heel_rose_is_no_rest_after() -> None:
    core = Core()
    core.feed(0.5)
    enter_phase(core.core, int(Phase.PRE_SWING))
    assert core.feed(0.01)[-1].resting_s == pytest.approx(0.01)


def test_peaks_are_those_since_pre_swing_and_since_swing() -> None:
    core = Core()
    core.feed(0.05, (0.0, 3.0, 0.0))
    core.feed(0.05, (0.0, -2.0, 0.0))
    enter_phase(core.core, int(Phase.PRE_SWING))
    assert core.feed(0.01, (0.0, 1.0, 0.0))[-1].toe_down_peak_radps == pytest.approx(1.0, rel=1e-3)
    assert core.feed(0.05, (0.0, -1.0, 0.0))[-1].toe_up_peak_radps == pytest.approx(2.0, rel=1e-3)
    enter_phase(core.core, int(Phase.SWING))
    x = core.feed(0.01, (0.0, -0.5, 0.0))[-1]
    assert (x.toe_down_peak_radps, x.toe_up_peak_radps) == pytest.approx((1.0, 0.5), rel=1e-3)


# --- this person's measures follow -----------------------------------------------------------------------

SHOWN = (7.0, 13.0, 1.5, 0.6, 0.2, 2800.0)


def measured(p: Thresholds) -> list[float]:
    return [getattr(p, name) for name, _ in MEASURES]


def calibrated_measures(calibration: FootCalibration) -> Thresholds:
    """What the tracker begins with: the usual swing of a stride so long, for the calibration knows none."""
    own = calibration.thresholds()
    return own._replace(swing_s=min(0.4 * own.stride_s, 0.6))


@pytest.mark.parametrize(("stride_s", "swing_s"), [(1.2, 0.48), (1.4, 0.56), (3.0, 0.6)])
def test_before_a_swing_has_been_seen_its_time_is_the_usual_one(stride_s: float, swing_s: float) -> None:
    assert Core(stride_s=stride_s).measures().swing_s == pytest.approx(swing_s)


def test_each_stride_is_followed_by_an_eighth() -> None:
    core = Core()
    core.stride(*measured(core.measures()))  # from here on a contact is known
    before = measured(core.measures())
    after = measured(core.stride(*SHOWN))
    assert FOLLOW == 1 / 8
    assert after == pytest.approx([old + FOLLOW * (shown - old) for old, shown in zip(before, SHOWN, strict=True)])


@pytest.mark.parametrize(("factor", "bound"), [(3.0, MOST), (0.2, LEAST)])
def test_measures_stay_within_bounds_about_the_calibrated_ones(factor: float, bound: float) -> None:
    assert (LEAST, MOST) == (0.6, 1.6)
    core = Core()
    first = calibrated_measures(core.calibration)
    calibrated = measured(first)
    for _ in range(200):
        stride_s = core.measures().stride_s * (1.4 if factor > 1.0 else 0.7)
        shown = dict(zip((name for name, _ in MEASURES), (factor * was for was in calibrated), strict=True))
        core.stride(**{**shown, "stride_s": stride_s})
        for now_is, was in zip(measured(core.measures()), calibrated, strict=True):
            assert LEAST * was <= now_is <= MOST * was
    assert measured(core.measures()) == pytest.approx([bound * was for was in calibrated])
    assert core.measures()._replace(**{name: getattr(first, name) for name, _ in MEASURES}) == first


@pytest.mark.parametrize("share", [0.99 * USUAL[0], 1.01 * USUAL[1], 10.0, 0.01])
def test_a_pause_or_a_double_contact_is_no_stride_time(share: float) -> None:
    core = Core()
    shown = (6.0, 10.0, 1.3, 0.5, 0.15, 2000.0)
    before = core.stride(*shown).stride_s
    assert core.stride(*shown[:2], share * before, *shown[3:]).stride_s == before


def test_the_trackers_measures_follow_the_walk_and_keep_the_asked_rule() -> None:
    samples, calibration = walk("left_foot")
    maker = StrideMaker("left_foot", StrideSettings(calibration.forward(), np.array(calibration.up)))
    tracker = FootTracker(calibration, maker, swing_at_reversal=True)
    start = calibration.thresholds(swing_at_reversal=True)
    assert tracker.thresholds == start
    assert len(strides(fed(tracker, samples))) > 40
    assert tracker.thresholds.swing_at_reversal is True
    for now, was in zip(measured(tracker.thresholds), measured(start), strict=True):
        assert now != was
        assert LEAST * was <= now <= MOST * was


def test_standing_in_noise_leaves_the_measures_alone() -> None:
    _, calibration = walk("left_foot")
    tracker = tracker_of(calibration)
    rng = np.random.default_rng(4)
    still = Samples(
        np.arange(6000) * 10_000_000,
        G_MPS2 * np.array(calibration.up) + rng.normal(0.0, 0.3, (6000, 3)),
        rng.normal(0.0, 0.1, (6000, 3)),
    )
    assert fed(tracker, still) == []
    assert tracker.thresholds == calibrated_measures(calibration)
