"""Comparing two logs: identical ones are, and each difference is found where it is."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import ttest_ind

from fes.cli.main import main
from fes.evaluation.agreement import combined, difference, mean_of, symmetry_index
from fes.evaluation.log_comparison import QUANTITIES, best_shift, compare_logs
from fes.session_log import SessionRecord, SessionWriter, read_session
from fes.signals import StimCommand, StrideResult, WireFrame
from statemachine.phases import Phase, PhaseChange, Transition
from tests.replays import MS, SETTINGS, TRIALS, replay

S = 1000 * MS
HEADER = {"session": {"channels": [{"number": 0, "foot": "left_foot"}, {"number": 1, "foot": "left_foot"}]}}


def stride(number: int, foot: str = "left_foot", shift_ms: float = 0.0, **changes: Any) -> StrideResult:
    begin = number * S + number * number * 20 * MS + round(shift_ms * MS)
    times = [begin + t * MS for t in (200, 400, 800, 900)]
    made = StrideResult(
        foot, number, begin, begin + S, stride_length_m=1.2, clearance_m=0.05, height_gained_m=0.0, turn_rad=0.0,
        speed_mps=1.2, t_pre_swing_ns=times[0], t_swing_ns=times[1], t_loading_response_ns=times[2],
        t_stance_ns=times[3],
    )  # fmt: skip
    return replace(made, **changes)


def session(strides: list[StrideResult], header: dict[str, Any] | None = None) -> SessionRecord:
    """A record with these strides, their T1s, and channel 0 on from pre-swing to stance."""
    record = SessionRecord(header or {**HEADER, "created": "now"}, strides=strides)
    for each in strides:
        if each.t_pre_swing_ns is None or each.t_stance_ns is None:
            continue
        record.phases.append(PhaseChange(each.t_pre_swing_ns, each.foot, Transition.T1, Phase.STANCE, Phase.PRE_SWING))
        for t_ns, on in ((each.t_pre_swing_ns, True), (each.t_stance_ns, False)):
            record.commands.append(StimCommand(t_ns, 0, on, 20.0 * on, 200.0, 40.0, 60))
            record.frames.append(WireFrame(t_ns, 0x128, bytes([on])))
    return record


WALK = [stride(number) for number in range(1, 11)]


def test_the_same_is_identical_whenever_it_was_made() -> None:
    result = compare_logs(session(WALK), session(WALK, {**HEADER, "created": "later", "created_t_ns": 5}))
    assert result.identical
    assert (result.shift_s, result.matched_by, len(result.pairs)) == (0.0, "time", 10)
    assert all(result.spread(name).greatest == 0.0 for name in QUANTITIES)


@pytest.mark.parametrize(
    ("change", "quantity", "value"),
    [
        ({"stride_length_m": 1.25}, "length_cm", 5.0),
        ({"clearance_m": 0.04}, "clearance_cm", -1.0),
        ({"t_swing_ns": WALK[4].t_swing_ns + 30 * MS}, "T2_ms", 30.0),
        ({"t_pre_swing_ns": WALK[4].t_pre_swing_ns - 20 * MS}, "on_ms", -20.0),
        ({"t_stance_ns": WALK[4].t_stance_ns + 10 * MS}, "off_ms", 10.0),
        ({"valid": False, "reason": "x"}, "length_cm", 0.0),
        ({"toe_clearance_m": 0.01}, "length_cm", 0.0),
    ],
)
def test_one_changed_stride_is_found(change: dict[str, Any], quantity: str, value: float) -> None:
    result = compare_logs(session(WALK), session([*WALK[:4], replace(WALK[4], **change), *WALK[5:]]))
    (different,) = [each for each in result.pairs if not each.same]
    assert (different.number_a, different.number_b) == (5, 5)
    assert different.differences[quantity] == pytest.approx(value)
    assert not result.identical


def test_a_stride_that_only_one_has() -> None:
    result = compare_logs(session(WALK), session(WALK[:3] + WALK[4:]))
    assert [each.number for each in result.only_a] == [4]
    assert result.only_b == []
    assert len(result.pairs) == 9
    assert all(each.same for each in result.pairs)


@pytest.mark.parametrize("shift_ms", [-3456.0, 250.0, 7_000_123.0])
def test_clocks_that_differ_are_brought_together(shift_ms: float) -> None:
    moved = [stride(number, shift_ms=shift_ms) for number in range(3, 14)]
    result = compare_logs(session(WALK), session(moved))
    assert result.shift_s == pytest.approx(1e-3 * shift_ms)
    assert [(each.number_a, each.number_b) for each in result.pairs] == [(n, n) for n in range(3, 11)]
    assert all(each.same for each in result.pairs)
    assert not result.identical
    assert [len(result.only_a), len(result.only_b)] == [2, 3]


def test_walks_that_have_nothing_in_common_are_matched_by_number() -> None:
    other = [stride(number, shift_ms=777.0 * number * number) for number in range(1, 6)]
    result = compare_logs(session(WALK), session(other))
    assert result.matched_by == "number"
    assert len(result.pairs) == 5
    assert all(each.differences["T2_ms"] == 0.0 for each in result.pairs), "from each stride's own start"


def test_best_shift_of_nothing() -> None:
    none = np.zeros(0, np.int64)
    assert best_shift({}, {}) is None
    assert best_shift({"left_foot": none}, {"left_foot": none}) is None
    assert best_shift({"left_foot": np.array([1])}, {"right_foot": np.array([1])}) is None
    result = compare_logs(session([]), session([]))
    assert result.identical
    assert np.isnan(result.spread("T1_ms").mean)


def test_settings_that_differ_are_named() -> None:
    one = {**HEADER, "a": {"b": [{"c": 1}, {"c": 2}], "list": [1, 2]}, "nan": float("nan")}
    other = {**HEADER, "a": {"b": [{"c": 1}, {"c": 3}, {"c": 4}], "list": [1, 3]}, "nan": float("nan")}
    result = compare_logs(session(WALK, one), session(WALK, other))
    assert result.settings == [("a.b.1.c", 2, 3), ("a.list", [1, 2], [1, 3]), ("a.b.2.c", None, 4)]


@pytest.mark.parametrize(
    ("spoil", "where", "says"),
    [
        (
            lambda r: r.commands.__setitem__(3, replace(r.commands[3], current_ma=19.5)),
            "commands",
            "command 4: A channel",
        ),
        (lambda r: r.frames.__setitem__(3, replace(r.frames[3], data=b"\7")), "frames", "frame 4: A 128#00"),
        (
            lambda r: r.phases.__setitem__(2, replace(r.phases[2], foot="right_foot")),
            "phases",
            "phase change 3: A left",
        ),
        (lambda r: r.commands.pop(), "commands", "A has 20 commands, B 19"),
        (lambda r: r.frames.pop(), "frames", "A has 20 frames, B 19"),
        (lambda r: r.phases.pop(), "phases", "A has 10 phase changes, B 9"),
    ],
)
def test_the_first_difference_is_told(spoil: Callable[[SessionRecord], Any], where: str, says: str) -> None:
    other = session(WALK)
    spoil(other)
    result = compare_logs(session(WALK), other)
    assert says in getattr(result, where)
    assert not result.identical


def written(record: SessionRecord, path: Path) -> Path:
    writer = SessionWriter(path, record.header)
    for change in record.phases:
        writer.phase(change)
    for command, frame in zip(record.commands, record.frames, strict=True):
        writer.command(command, frame)
    for each in record.strides:
        writer.stride(each)
    writer.close({})
    return path


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(main, ["compare", *map(str, arguments)])


def test_the_command_tells_and_exits(tmp_path: Path) -> None:
    a = written(session(WALK), tmp_path / "a.feslog")
    b = written(session([*WALK[:-1], stride(10, stride_length_m=1.3)], {**HEADER, "x": 1}), tmp_path / "b.feslog")
    same = run(a, a)
    assert same.exit_code == 0
    assert "Identical." in same.output
    assert "Bytes     the same" in same.output
    different = run(a, b)
    assert different.exit_code == 1
    assert "x: – → 1" in different.output
    assert "10 strides in both, 9 of them the same." in different.output
    assert "10.00" in different.output
    assert max(map(len, different.output.splitlines())) <= 110
    told = json.loads(run(a, b, "--json").output, parse_constant=pytest.fail)
    assert told["identical"] is False
    assert told["differences"]["length_cm"] == {
        "n": 10,
        "mean": pytest.approx(1.0),
        "sd": pytest.approx(10 / np.sqrt(10)),
        "greatest": pytest.approx(10.0),
    }
    assert [each["same"] for each in told["strides"]] == [True] * 9 + [False]


def test_what_cannot_be_compared(tmp_path: Path) -> None:
    a = written(session(WALK), tmp_path / "a.feslog")
    (tmp_path / "text.feslog").write_text("this is no session log")
    for other in (tmp_path / "gone.feslog", tmp_path / "text.feslog"):
        assert run(a, other).exit_code == 2
        assert run(other, a).exit_code == 2


def test_odd_headers_do_not_stop_it(tmp_path: Path) -> None:
    for odd in ({}, {"session": None}, {"session": {"channels": [{}]}}, {"session": [1, {"a": 2}]}):
        assert compare_logs(session(WALK, odd or {"y": 1}), session(WALK)).pairs


def test_two_replays_are_identical_and_changed_settings_show(tmp_path: Path) -> None:
    """Without an extension the stimulation falls sooner, as far as T4 left room for one, and nothing else changes."""
    trial = TRIALS / "example_csv.csv"
    shorter = tmp_path / "shorter.toml"
    shorter.write_text(SETTINGS.read_text().replace("extension_s = 0.06", "extension_s = 0.0"))
    one, again, other = (replay(trial, tmp_path, settings) for settings in (SETTINGS, SETTINGS, shorter))
    assert compare_logs(one, again).identical
    logs = sorted(tmp_path.glob("*/session.feslog"))
    assert run(logs[0], logs[1]).exit_code == 0
    assert read_session(logs[0]).commands == one.commands
    result = compare_logs(one, other)
    assert {name for name, _, _ in result.settings} == {"session.channels.0.extension_s", "stim_session_id"}
    off = result.spread("off_ms")
    assert off.n > 0
    assert -60.0 <= off.mean <= -10.0
    assert all(result.spread(name).greatest == 0.0 for name in ("length_cm", "clearance_cm", "T2_ms", "T3_ms", "on_ms"))


# --- Means of two walks held against each other: the interval covers as often as it says ---


FEW = st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=40)


def autoregressive(rng: np.random.Generator, n: int, r: float) -> np.ndarray:
    x = np.empty(n)
    x[0] = rng.normal()
    noise = math.sqrt(1.0 - r * r) * rng.normal(size=n)
    for k in range(1, n):
        x[k] = r * x[k - 1] + noise[k]
    return x


@pytest.mark.parametrize("r", [0.0, 0.6])
@pytest.mark.parametrize(("n", "m"), [(15, 30), (100, 40)])
def test_it_covers_the_true_difference_as_often_as_it_says(r, n, m):
    rng = np.random.default_rng(7)
    inside, plain, runs = 0, 0, 200
    for _ in range(runs):
        a, b = autoregressive(rng, n, r), 3.0 + autoregressive(rng, m, r)
        found = difference(mean_of(a), mean_of(b))
        inside += found.low <= 3.0 <= found.high
        usual = ttest_ind(b, a, equal_var=False).confidence_interval()
        plain += usual.low <= 3.0 <= usual.high
    assert inside >= 0.92 * runs
    if r == 0.6:
        assert plain < 0.75 * runs  # what taking strides for independent would do


def test_walks_that_drift_for_minutes_are_covered_too_seldom():
    """What docs/evaluation.md says of it: fractional noise of exponent 0.75, whose correlations never die out."""
    rng, runs = np.random.default_rng(11), 200
    lag = np.arange(60)
    covariance = 0.5 * (np.abs(lag + 1) ** 1.5 - 2.0 * np.abs(lag) ** 1.5 + np.abs(lag - 1) ** 1.5)
    root = np.linalg.cholesky(covariance[np.abs(lag[:, None] - lag[None, :])])
    inside = 0
    for _ in range(runs):
        a, b = (root @ rng.normal(size=60) for _ in range(2))
        found = difference(mean_of(a[:40]), mean_of(b))
        inside += found.low <= 0.0 <= found.high
    assert 0.65 * runs < inside < 0.85 * runs


def test_of_independent_values_it_is_hardly_wider_than_welch():
    rng = np.random.default_rng(3)
    wider = []
    for _ in range(50):
        a, b = rng.normal(size=60), rng.normal(1.0, 2.0, size=90)
        found, usual = difference(mean_of(a), mean_of(b)), ttest_ind(b, a, equal_var=False).confidence_interval()
        wider.append((found.high - found.low) / (usual.high - usual.low))
    assert min(wider) > 0.99
    assert np.mean(wider) < 1.25


def test_slow_change_widens_it():
    rng = np.random.default_rng(5)
    steady = rng.normal(size=80)
    drifting = np.linspace(-2.0, 2.0, 80) + 0.3 * rng.normal(size=80)
    assert mean_of(drifting).effective < 10 < mean_of(steady).effective


def test_too_few_and_constant_values():
    few = mean_of([1.0, 2.0, 3.0, 4.0, math.nan])
    assert (few.n, few.mean) == (4, 2.5)
    assert math.isnan(few.error)
    assert math.isnan(difference(few, mean_of(range(10))).low)
    assert mean_of([]).n == 0
    same = difference(mean_of([2.0] * 9), mean_of([5.0] * 6))
    assert (same.low, same.value, same.high) == (3.0, 3.0, 3.0)


@settings(max_examples=60)
@given(FEW, FEW, st.floats(-10.0, 10.0))
@example([0.0] * 6, [0.0] * 5 + [1e-107], 0.0)  # the squares of what differs so little are nothing
@example([0.0] * 6, [0.0] * 5 + [1e-161], 0.0)
def test_it_turns_round_and_moves_with_the_values(a, b, shift):
    one, other = mean_of(a), mean_of(b)
    there, back = difference(one, other), difference(other, one)
    size = 1e-6 * (1.0 + max(map(abs, (*a, *b))))
    assert there.low == pytest.approx(-back.high, abs=size)
    moved = difference(one, mean_of(np.array(b) + shift))
    assert moved.value - there.value == pytest.approx(shift, abs=size)
    assert there.low <= there.value <= there.high


def test_symmetry_index_and_its_interval():
    rng = np.random.default_rng(1)
    a, b = mean_of(0.4 + 0.02 * rng.normal(size=50)), mean_of(0.6 + 0.02 * rng.normal(size=60))
    value, parts = symmetry_index(a, b)
    assert value == pytest.approx(-40.0, abs=1.0)
    found = combined(value, parts)
    drawn = [200 * (x - y) / (x + y) for x, y in rng.normal((a.mean, b.mean), (a.error, b.error), (4000, 2))]
    assert 0.5 * (found.high - found.low) == pytest.approx(2.0 * np.std(drawn), rel=0.08)
    assert math.isnan(symmetry_index(a, mean_of(-np.ones(9)))[0])
