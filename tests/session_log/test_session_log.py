"""The session log: every value comes back as it was, in order, small and fast."""

from __future__ import annotations

import gc
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fes.session_log import (
    Note,
    Received,
    SessionLogError,
    SessionWriter,
    framing,
    iter_events,
    iter_inputs,
    read_session,
    reader,
)
from fes.signals import (
    SENSORS,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimStatus,
    StrideResult,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange, Transition

HEADER = {"format": 1, "kind": "replay", "session": {"name": "ü"}, "rates_hz": [100.0, 204.8]}

times = st.integers(-(2**62), 2**62)
near_times = st.integers(0, 10**11)
text = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
real = st.one_of(st.floats(allow_nan=False), st.floats(width=32, allow_nan=False), st.sampled_from([0.0, -0.0, 0.5]))
vector = st.tuples(real, real, real)
samples = st.one_of(
    st.builds(ImuSample, near_times, st.sampled_from(SENSORS), near_times, vector, vector),
    st.builds(ImuSample, times, st.sampled_from(SENSORS), times, vector, vector),
)
small = st.integers(0, 15)
statuses = st.builds(
    StimStatus, times, small, small, st.booleans(), real, real, real, st.integers(0, 2**40), real, text
)
alive = st.builds(StimAlive, times, st.integers(0, 2**32), st.integers(0, 2**32), text)
acts = st.builds(OperatorAct, times, st.sampled_from(list(OperatorAction)), real, text)
events = st.one_of(samples, st.builds(Tick, times), acts, statuses, alive)
commands = st.builds(StimCommand, times, small, st.booleans(), real, real, real, st.integers(0, 10**6), text)
frames = st.builds(WireFrame, times, st.integers(0, 2**29 - 1), st.binary(max_size=64))
phases = st.builds(
    PhaseChange,
    times,
    st.sampled_from(SENSORS),
    st.sampled_from(Transition),
    st.sampled_from(Phase),
    st.sampled_from(Phase),
)
maybe = st.none() | times
single = st.floats(width=32, allow_nan=False)


@st.composite
def strides(draw: st.DrawFn) -> StrideResult:
    rows = draw(st.lists(st.tuples(single, single, single, single, single), max_size=5))
    array = np.array(rows, dtype=np.float64).reshape(-1, 5)
    return StrideResult(
        draw(st.sampled_from(SENSORS)),
        draw(st.integers(0, 10**6)),
        *draw(st.tuples(times, times, real, real, real, real, real, maybe, maybe, maybe, maybe, real, real)),
        valid=draw(st.booleans()),
        reason=draw(text),
        trajectory_m=array[:, :3],
        pitch_rad=array[:, 3],
        roll_rad=array[: draw(st.sampled_from((0, len(array)))), 4],
    )


notes = st.builds(Note, times, st.sampled_from(["info", "warning", "fault"]), text, text)
latencies = st.one_of(st.tuples(near_times, st.integers(0, 10**10)), st.tuples(times, times))
outputs = st.one_of(
    st.tuples(st.just("command"), commands, frames),
    st.tuples(st.just("frame"), frames),
    st.tuples(st.just("phase"), phases),
    st.tuples(st.just("stride"), strides()),
    st.tuples(st.just("note"), notes),
    st.tuples(st.just("received"), st.builds(Received, times, st.binary(max_size=40))),
    st.tuples(st.just("latency"), latencies),
    st.tuples(st.just("flush_due"), near_times),
)
entries = st.lists(st.one_of(st.tuples(st.just("event"), events), outputs), max_size=60)


def write(path: Path, what: list[tuple[Any, ...]], summary: dict[str, Any] | None = None) -> None:
    writer = SessionWriter(path, HEADER)
    for method, *arguments in what:
        if method == "latency":
            writer.latency(*arguments[0])
        else:
            getattr(writer, method)(*arguments)
    writer.close(summary or {})


def of(what: list[tuple[Any, ...]], method: str, kind: type = object, place: int = 1) -> list[Any]:
    return [entry[place] for entry in what if entry[0] == method and isinstance(entry[place], kind)]


@given(entries, st.sampled_from([framing.BLOCK_BYTES, 100, 16]), st.sampled_from([reader.TOGETHER, 3, 1]))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=None)
def test_everything_comes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: list[tuple[Any, ...]], block_bytes: int, together: int
) -> None:
    """However much of the file is read at a time, and however many records are decoded."""
    monkeypatch.setattr(framing, "BLOCK_BYTES", block_bytes)
    monkeypatch.setattr(reader, "TOGETHER", together)
    path = tmp_path / "session.feslog"
    path.unlink(missing_ok=True)
    write(path, what, {"strides": 3})
    log = read_session(path)
    assert (log.complete, log.lost, log.header, log.summary) == (True, "", HEADER, {"strides": 3})
    assert log.received == of(what, "received")
    kept = [entry[1] for entry in what if entry[0] in ("event", "received")]
    assert [each for each in iter_inputs(path) if not isinstance(each, WireFrame)] == kept, "in their order"
    happened = of(what, "event")
    replayed = list(iter_events(path))
    assert replayed == happened
    assert repr(replayed) == repr(happened), "signs of zero and types too"
    assert log.ticks_ns.tolist() == [tick.t_ns for tick in of(what, "event", Tick)]
    assert log.acts == of(what, "event", OperatorAct)
    assert log.statuses == of(what, "event", StimStatus)
    assert log.alive == of(what, "event", StimAlive)
    assert log.phases == of(what, "phase")
    assert log.commands == of(what, "command")
    assert log.notes == of(what, "note")
    assert log.frames == [entry[-1] for entry in what if entry[0] in ("command", "frame")]
    pairs = of(what, "latency")
    assert list(zip(log.latency_t_ns.tolist(), log.latency_ns.tolist(), strict=True)) == pairs
    written = of(what, "stride")
    assert log.strides == written
    for read, stride in zip(log.strides, written, strict=True):
        np.testing.assert_array_equal(read.trajectory_m, stride.trajectory_m)
        np.testing.assert_array_equal(read.pitch_rad, stride.pitch_rad)
        np.testing.assert_array_equal(read.roll_rad, stride.roll_rad)
        assert read.trajectory_m.shape == stride.trajectory_m.shape
    for sensor in SENSORS:
        mine = [sample for sample in happened if isinstance(sample, ImuSample) and sample.sensor == sensor]
        assert (sensor in log.samples) == bool(mine)
        if mine:
            arrays = log.samples[sensor]
            assert arrays.t_ns.tolist() == [sample.t_ns for sample in mine]
            assert arrays.t_sensor_ns.tolist() == [sample.t_sensor_ns for sample in mine]
            assert [tuple(row) for row in arrays.acc_mps2.tolist()] == [sample.acc_mps2 for sample in mine]
            assert [tuple(row) for row in arrays.gyr_radps.tolist()] == [sample.gyr_radps for sample in mine]


def test_what_is_left_out_stays_empty_and_the_rest_comes(tmp_path: Path) -> None:
    path = tmp_path / "session.feslog"
    frame = WireFrame(5, 1, b"x")
    write(path, [("event", Tick(5)), ("frame", frame), ("note", Note(5, "info", "here", "words"))])
    log = read_session(path, frozenset({framing.RecordType.FRAME}))
    assert (log.frames, log.notes, log.ticks_ns.tolist()) == ([], [Note(5, "info", "here", "words")], [5])
    assert read_session(path).frames == [frame]


def test_reading_leaves_the_garbage_collector_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "session.feslog"
    write(path, [("event", Tick(5))])
    assert gc.isenabled()
    read_session(path)
    assert gc.isenabled()
    gc.disable()
    try:
        read_session(path)
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_nan_survives(tmp_path: Path) -> None:
    nan = math.nan
    sample = ImuSample(1, "left_foot", 1, (nan, math.inf, -math.inf), (0.0, 0.1, nan))
    stride = StrideResult("left_foot", 1, 0, 1, 1.0, 0.1, 0.0, 0.0, 1.0, None, None, None, None)
    write(tmp_path / "log", [("event", sample), ("stride", stride)])
    (read,) = iter_events(tmp_path / "log")
    assert repr(read) == repr(sample)
    assert math.isnan(read_session(tmp_path / "log").strides[0].toe_clearance_m)


def test_an_hour_of_two_sensors_at_500_hz_stays_under_200_mb(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    seconds = 10
    values = rng.normal(0.0, 9.0, (1000 * seconds, 6)).astype(np.float32).astype(float).tolist()
    writer = SessionWriter(tmp_path / "log", HEADER)
    for number, (ax, ay, az, gx, gy, gz) in enumerate(values):
        t_ns = 10**15 + number * 1_000_000
        writer.event(ImuSample(t_ns, SENSORS[number % 2], t_ns - 2_000_000, (ax, ay, az), (gx, gy, gz)))
        writer.latency(t_ns, 80_000)
        if number % 20 == 0:
            writer.event(Tick(t_ns))
            for channel in range(2):
                writer.command(StimCommand(t_ns, channel, True, 20.5, 300.0, 40.0, 60), WireFrame(t_ns, 9, bytes(8)))
                writer.event(StimStatus(t_ns, channel, 3, True, 20.5, 300.0, 40.0, 1, 6.15))
        writer.flush_due(t_ns)
    writer.close({})
    per_hour = (tmp_path / "log").stat().st_size * 3600 / seconds
    assert per_hour < 200e6, f"{per_hour / 1e6:.0f} MB an hour"


def test_a_run_ends_where_a_sample_does_not_fit(tmp_path: Path) -> None:
    single, double = (1.0, 2.0, 3.0), (0.1, 0.2, 0.3)
    made = [
        (0, 0, single),
        (4_000_000_000, 4_000_000_000, single),
        (5_000_000_000, 5_000_000_000, single),  # further from the run's first than a run lasts
        (5_001_000_000, 5_001_000_000, double),
        (5_002_000_000, 5_002_000_000, single),
        (5_001_500_000, 5_001_500_000, single),
        (100, 100, single),  # back in time
        (200, 200 + 2**40, single),  # another clock altogether
        (300, 300, single),
    ]
    samples = [ImuSample(t_ns, "left_foot", stamp, values, values) for t_ns, stamp, values in made]
    latencies = [(0, 5), (10, 2**33), (20, 6), (5, -1), (6_000_000_000, 7), (0, 8)]
    writer = SessionWriter(tmp_path / "log", HEADER)
    for sample in samples:
        writer.event(sample)
    for pair in latencies:
        writer.latency(*pair)
    with pytest.raises(SessionLogError, match="cannot be logged"):
        writer.latency(2**70, 1)
    writer.close({})
    assert list(iter_events(tmp_path / "log")) == samples
    log = read_session(tmp_path / "log")
    assert log.samples["left_foot"].t_ns.tolist() == [t_ns for t_ns, _, _ in made]
    assert list(zip(log.latency_t_ns.tolist(), log.latency_ns.tolist(), strict=True)) == latencies


def test_a_tear_costs_a_quarter_of_a_second_of_a_fast_replay(tmp_path: Path) -> None:
    """A replay logs minutes between two deliveries, so that a cut anywhere goes through a run of samples."""
    writer = SessionWriter(tmp_path / "log", HEADER)
    for t_ns in range(0, 60 * 10**9, 2_000_000):
        writer.event(ImuSample(t_ns, "left_foot", t_ns, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
    writer.close({})
    whole = (tmp_path / "log").read_bytes()
    at = len(whole) // 2
    (tmp_path / "torn").write_bytes(whole[:at])
    kept = read_session(tmp_path / "torn").samples["left_foot"].t_ns.size
    assert kept > 30_000 * at / len(whole) - 0.25 * 500 - 5


def test_flush_due_hands_over_every_50_ms_and_not_more_often(tmp_path: Path) -> None:
    path = tmp_path / "log"
    writer = SessionWriter(path, HEADER)
    start = path.stat().st_size
    assert start > 0, "the header is stored at once"
    assert writer.flush_due(1_000_000_000)
    writer.event(ImuSample(5, "left_foot", 5, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
    writer.latency(5, 7)
    assert not writer.flush_due(1_049_999_999)
    assert path.stat().st_size == start
    assert writer.flush_due(1_050_000_000)
    log = read_session(path)
    assert (log.samples["left_foot"].t_ns.tolist(), log.latency_ns.tolist()) == ([5], [7])
    assert (log.complete, log.lost) == (False, "")
    writer.note(Note(1, "info", "x", "y"))
    assert writer.flush_due(900_000_000), "a clock that went back does not hold data up"
    assert len(read_session(path).notes) == 1
    writer.close({})


def test_much_data_goes_out_without_being_asked(tmp_path: Path) -> None:
    path = tmp_path / "log"
    writer = SessionWriter(path, HEADER)
    for number in range(10_000):
        writer.event(ImuSample(number, "left_foot", number, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
    assert len(read_session(path).samples["left_foot"].t_ns) > 7_000
    for number in range(3_000):
        writer.note(Note(number, "info", "x", "a remark that is worth keeping"))
    assert len(read_session(path).notes) > 1_500
    writer.close({})


def test_refuses_to_overwrite(tmp_path: Path) -> None:
    path = tmp_path / "log"
    write(path, [("event", Tick(1))])
    before = path.read_bytes()
    with pytest.raises(SessionLogError, match=r"log: is there already.*choose another name"):
        SessionWriter(path, HEADER)
    assert path.read_bytes() == before
    with pytest.raises(SessionLogError, match="cannot be made"):
        SessionWriter(tmp_path / "nowhere" / "log", HEADER)


def test_a_closed_log_takes_nothing_more(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "log", HEADER)
    writer.close({"a": 1})
    writer.close({"a": 2})
    sample = ImuSample(1, "left_foot", 1, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    for call in (
        lambda: writer.event(sample),
        lambda: writer.event(Tick(1)),
        lambda: writer.latency(1, 1),
        lambda: writer.flush_due(5),
    ):
        with pytest.raises(SessionLogError, match="is closed already"):
            call()
    assert read_session(tmp_path / "log").summary == {"a": 1}


@pytest.mark.parametrize(
    "value",
    [
        ImuSample(1, "nose", 1, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
        ImuSample(2**70, "left_foot", 1, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),
        Tick(2**70),
        StimAlive(1, 2**70, 0),
    ],
)
def test_what_cannot_be_logged_is_named_and_the_rest_stays(tmp_path: Path, value: Any) -> None:
    writer = SessionWriter(tmp_path / "log", HEADER)
    writer.event(Tick(1))
    with pytest.raises(SessionLogError, match="cannot be logged"):
        writer.event(value)
    writer.event(Tick(2))
    writer.close({})
    assert list(iter_events(tmp_path / "log")) == [Tick(1), Tick(2)]
    assert read_session(tmp_path / "log").samples == {}


def test_header_and_summary_must_be_plain_data(tmp_path: Path) -> None:
    with pytest.raises(SessionLogError, match="the header cannot be stored"):
        SessionWriter(tmp_path / "log", {"path": Path("x")})
    assert not (tmp_path / "log").exists()
    writer = SessionWriter(tmp_path / "log", {"rate": np.float64(204.8), "n": np.int64(3), "m": np.eye(2)})
    with pytest.raises(SessionLogError, match="the summary cannot be stored"):
        writer.close({"x": object()})
    log = read_session(tmp_path / "log")
    assert log.header == {"rate": 204.8, "n": 3, "m": [[1.0, 0.0], [0.0, 1.0]]}
    assert not log.complete


def test_a_note_has_a_known_severity() -> None:
    with pytest.raises(ValueError, match="'bad' is none of info, warning, fault"):
        Note(1, "bad", "x", "y")
