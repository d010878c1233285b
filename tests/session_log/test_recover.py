"""Recovering session logs: every whole record comes back, whatever was done to the rest, and the loss is told."""

from __future__ import annotations

import json
import random
import resource
import signal
import struct
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_session_log_faults import small_log

from fes.cli.main import main
from fes.session_log import SessionLogError, SessionWriter, iter_events, read_session
from fes.session_log.framing import MAGIC, LogScan, RecordType, framed
from fes.session_log.repair import ZEROS, Damage, Survey, Whole, recover, stretches, summary_of, survey
from fes.signals import NS_PER_S
from tests.replays import TRIALS, replay


def records_of(path: Path) -> list[bytes]:
    return [framed(kind, bytes(payload)) for kind, payload in LogScan(path)]


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of a replayed bundled trial of five strides."""
    folder = tmp_path_factory.mktemp("real")
    replay(TRIALS / "example_csv.csv", folder)
    return next(folder.glob("*/session.feslog"))


@pytest.fixture(scope="module")
def live(real: Path) -> Path:
    """The same session's first seconds written as a live one is: delivered every 50 ms."""
    path, record = real.with_name("live.feslog"), read_session(real)
    writer = SessionWriter(path, record.header)
    commands = dict(zip([command.t_ns for command in record.commands], record.commands, strict=True))
    frames = dict(zip([frame.t_ns for frame in record.frames], record.frames, strict=True))
    for event in iter_events(real):
        if event.t_ns > 9 * NS_PER_S:
            break
        writer.event(event)
        writer.latency(event.t_ns, 40_000 + event.t_ns % 1000)
        if event.t_ns in commands:
            writer.command(commands[event.t_ns], frames[event.t_ns])
        writer.flush_due(event.t_ns)
    for stride in record.strides[:3]:
        writer.stride(stride)
    for phase in record.phases[:8]:
        writer.phase(phase)
    writer.close(record.summary)
    return path


@pytest.fixture
def small(tmp_path: Path) -> Path:
    small_log(tmp_path / "small.feslog")
    return tmp_path / "small.feslog"


def recovered(data: bytes, folder: Path) -> tuple[Survey, list[bytes]]:
    """Recover these bytes; what was found and the records of the new log without its notes and summary."""
    log, target = folder / "damaged.feslog", folder / "new.feslog"
    log.write_bytes(data)
    target.unlink(missing_ok=True)
    found = survey(log)
    recover(found, target)
    record = read_session(target)
    assert record.complete
    assert record.lost == ""
    assert record.summary == json.loads(json.dumps(summary_of(found)))
    assert len(list(iter_events(target))) == sum(len(each.t_ns) for each in record.samples.values()) + sum(
        map(len, (record.ticks_ns, record.acts, record.statuses, record.alive, record.reopened))
    )
    assert log.read_bytes() == data, "the damaged log itself is never changed"
    kept = records_of(target)[:-1]
    return found, [each for each in kept if not (each[8] == RecordType.NOTE and b'"recover"' in each)]


def test_a_whole_log_is_left_alone(small: Path) -> None:
    result = CliRunner().invoke(main, ["recover", str(small)])
    assert result.exit_code == 0
    assert "is whole" in result.output
    assert [path.name for path in small.parent.iterdir()] == ["small.feslog"]


def test_cuts_at_random_places(live: Path, tmp_path: Path) -> None:
    whole, records = live.read_bytes(), records_of(live)
    ends = np.cumsum([len(MAGIC), *map(len, records)]).tolist()
    for cut in random.Random(1).sample(range(ends[1], len(whole)), 200):
        log = tmp_path / "cut.feslog"
        log.write_bytes(whole[:cut])
        found = survey(log)
        full = sum(end <= cut for end in ends[1:])
        assert found.lost_bytes == cut - ends[full]
        assert [gap.at for gap in found.gaps] == ([ends[full]] if cut > ends[full] else [])
        assert found.size == cut
    _, kept = recovered(whole[: len(whole) // 2], tmp_path)
    assert kept == records[: len(kept)]


def test_every_bit_of_a_record_in_the_middle(small: Path, tmp_path: Path) -> None:
    whole, records = small.read_bytes(), records_of(small)
    number = next(i for i, each in enumerate(records) if each[8] == RecordType.PHASE)
    begin = len(MAGIC) + sum(map(len, records[:number]))
    told = 0
    for bit in range(8 * len(records[number])):
        spoiled = bytearray(whole)
        spoiled[begin + bit // 8] ^= 1 << bit % 8
        found, kept = recovered(bytes(spoiled), tmp_path)
        assert kept == records[:number] + records[number + 1 :], bit
        (gap,) = found.gaps
        assert (gap.at, gap.size) == (begin, len(records[number]))
        assert found.ended
        told += gap.kind == RecordType.PHASE
    assert told == 8 * (len(records[number]) - 5), "with length and type right, what was lost has a name"


def test_the_time_that_a_gap_covers_is_told(live: Path, tmp_path: Path) -> None:
    whole = bytearray(live.read_bytes())
    runs = [stretch for stretch in stretches(live) if isinstance(stretch, Whole) and stretch.kind == RecordType.SAMPLES]
    before, hit, after = runs[len(runs) // 2 - 1 : len(runs) // 2 + 2]
    whole[hit.at + 20] ^= 4
    found, _ = recovered(bytes(whole), tmp_path)
    (gap,) = found.gaps
    assert gap.kind == RecordType.SAMPLES
    assert (gap.before_ns, gap.after_ns) == (before.end_ns, after.begin_ns)
    assert found.lost_kinds == {"samples": 1}
    assert found.lost_ns == (after.begin_ns or 0) - (before.end_ns or 0)
    assert 0 < found.lost_ns <= 80_000_000
    note = next(note for note in read_session(tmp_path / "new.feslog").notes if note.source == "recover")
    assert note.severity == "warning"
    assert "run of samples" in note.text


def test_zeros_behind_the_end_cost_nothing(small: Path, tmp_path: Path) -> None:
    records = records_of(small)
    found, kept = recovered(small.read_bytes() + bytes(5000), tmp_path)
    assert kept == records
    assert [gap.why for gap in found.gaps] == [ZEROS]
    assert found.lost_bytes == 0
    assert found.ended
    assert summary_of(found)["done"] is True
    assert "ended" not in summary_of(found)


def test_zeros_instead_of_the_end_are_a_loss(small: Path, tmp_path: Path) -> None:
    whole, records = small.read_bytes(), records_of(small)
    keep = len(MAGIC) + sum(map(len, records[:10]))
    found, kept = recovered(whole[:keep] + bytes(len(whole) - keep), tmp_path)
    assert kept == records[:10]
    assert found.lost_bytes == len(whole) - keep


@pytest.mark.parametrize(
    "payload",
    [
        (RecordType.PHASE, b"\0" * 8 + b"\x63\1\0\1"),
        (RecordType.SAMPLES, b"\x09" + bytes(8)),
        (RecordType.SAMPLES, b"\0" + bytes(8) + b"half a sample"),
        (RecordType.STRIDE, b"\xff" * 12),
        (RecordType.NOTE, b"[" * 100_000),
        (RecordType.NOTE, b'{"t_ns":"soon","severity":"info","source":"a","text":"b"}'),
        (RecordType.NOTE, b'{"t_ns":%d,"severity":"info","source":"a","text":"b"}' % 2**70),
        (RecordType.LATENCY, b"\2" + bytes(8)),
        (RecordType.TICK, b"short"),
        (RecordType.SUMMARY, b"no json"),
        (200, b"what is not known"),
    ],
    ids=lambda value: str(value[0]),
)
def test_a_right_checksum_around_wrong_content(payload: tuple[int, bytes], small: Path, tmp_path: Path) -> None:
    kind, content = payload
    body = bytes([kind]) + content
    bad = struct.pack("<II", len(body), zlib.crc32(body, len(body))) + body
    records = records_of(small)
    data = MAGIC + b"".join([*records[:6], bad, *records[6:]])
    found, kept = recovered(data, tmp_path)
    assert kept == records
    assert [gap.size for gap in found.gaps] == [len(bad)]


@st.composite
def spoilings(draw: st.DrawFn) -> list[tuple[str, float, bytes]]:
    kinds = st.sampled_from(["flip", "write", "take", "put", "cut"])
    return draw(st.lists(st.tuples(kinds, st.floats(0, 1), st.binary(min_size=1, max_size=40)), max_size=4))


@given(spoilings())
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], max_examples=150)
def test_whatever_is_done_to_it(tmp_path: Path, spoiling: list[tuple[str, float, bytes]]) -> None:
    (tmp_path / "small.feslog").unlink(missing_ok=True)
    small_log(tmp_path / "small.feslog")
    records = records_of(tmp_path / "small.feslog")
    data = bytearray((tmp_path / "small.feslog").read_bytes())
    begin = len(MAGIC) + len(records[0])
    for what, where, some in spoiling:
        at = begin + int(where * max(len(data) - begin - 1, 0))
        match what:
            case "flip" if at < len(data):
                data[at] ^= some[0] or 1
            case "write":
                data[at : at + len(some)] = some
            case "take":
                del data[at : at + len(some)]
            case "put":
                data[at:at] = some
            case "cut":
                del data[at:]
    found, kept = recovered(bytes(data), tmp_path)
    left = iter(records)
    assert all(any(one == other for other in left) for one in kept), "nothing new, and in the old order"
    still = [record for record in records if record in bytes(data)]
    assert len(kept) >= len(set(still)) - len(spoiling), "what is still there in one stretch is found"
    if not any(what in ("put", "write") for what, _, _ in spoiling):
        assert set(kept) == set(still)
    ends = [(stretch.at, stretch.at + stretch.size) for stretch in stretches(tmp_path / "damaged.feslog")]
    assert all(one[1] == other[0] for one, other in pairwise(ends)), "every byte is accounted for"
    assert not ends or ends[-1][1] == len(data)
    assert sum(gap.size for gap in found.gaps) == sum(
        stretch.size for stretch in stretches(tmp_path / "damaged.feslog") if isinstance(stretch, Damage)
    )


def test_a_damaged_header_needs_another(small: Path, tmp_path: Path) -> None:
    data = bytearray(small.read_bytes())
    data[len(MAGIC) + 12] ^= 1
    log = tmp_path / "headless.feslog"
    log.write_bytes(data)
    result = CliRunner().invoke(main, ["recover", str(log)])
    assert result.exit_code == 2
    assert "--header-from" in result.output
    assert not (tmp_path / "headless.recovered.feslog").exists()
    result = CliRunner().invoke(main, ["recover", str(log), "--header-from", str(small)])
    assert result.exit_code == 1
    again = read_session(tmp_path / "headless.recovered.feslog")
    assert again.header == {"format": 1, "header_from_another_log": True}
    assert again.strides == read_session(small).strides


def test_a_damaged_mark_at_the_start(small: Path, tmp_path: Path) -> None:
    data = bytearray(small.read_bytes())
    data[2] ^= 1
    found, kept = recovered(bytes(data), tmp_path)
    assert kept == records_of(small)
    assert found.lost_bytes == 0


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "only 0 bytes"),
        (MAGIC[:5], "only 5 bytes"),
        (MAGIC[:-1] + b"\x07" + bytes(50), "format 7"),
        (b"t_ns,acc_x_mps2\n1,2\n" * 9, "not a session log"),
        (MAGIC, "its header, with the settings, is damaged"),
        (MAGIC + bytes(4000), "its header, with the settings, is damaged"),
    ],
)
def test_what_cannot_be_recovered(data: bytes, says: str, tmp_path: Path) -> None:
    log = tmp_path / "bad.feslog"
    log.write_bytes(data)
    result = CliRunner().invoke(main, ["recover", str(log)])
    assert result.exit_code == 2
    assert says in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["bad.feslog"]


def test_nothing_is_overwritten(small: Path, tmp_path: Path) -> None:
    log = tmp_path / "torn.feslog"
    log.write_bytes(small.read_bytes()[:-3])
    for args, code in ((["--dry-run"], 1), ([], 1), ([], 2), (["--out", str(log)], 2)):
        before = {path: path.read_bytes() for path in tmp_path.iterdir()}
        result = CliRunner().invoke(main, ["recover", str(log), *args])
        assert result.exit_code == code, result.output
        assert all(path.read_bytes() == data for path, data in before.items())
    assert "not overwritten" in result.output


def test_json_says_the_same(small: Path, tmp_path: Path) -> None:
    log = tmp_path / "torn.feslog"
    log.write_bytes(small.read_bytes()[:-3])
    result = CliRunner().invoke(main, ["recover", str(log), "--json"])
    found = json.loads(result.output)
    assert result.exit_code == 1
    assert found["end_missing"] is True
    assert found["lost_records"] == {"summary": 1}
    assert found["gaps"][0]["byte"] + found["lost_bytes"] == log.stat().st_size
    assert found["recovered"] == str(tmp_path / "torn.recovered.feslog")


def test_a_log_cut_between_two_records_lost_only_its_end(small: Path, tmp_path: Path) -> None:
    log = tmp_path / "killed.feslog"
    log.write_bytes(small.read_bytes()[: -len(records_of(small)[-1])])
    result = CliRunner().invoke(main, ["recover", str(log)])
    assert result.exit_code == 0
    assert "end was never written" in result.output
    assert read_session(tmp_path / "killed.recovered.feslog").summary["ended"].startswith("recovered")


def test_a_full_disk_leaves_nothing_half(small: Path, tmp_path: Path) -> None:
    log = tmp_path / "torn.feslog"
    log.write_bytes(small.read_bytes()[:-3])
    found = survey(log)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, hard))
    try:
        with pytest.raises(SessionLogError, match="cannot be written"):
            recover(found, tmp_path / "new.feslog")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert not (tmp_path / "new.feslog").exists()


@pytest.mark.parametrize("share", [0.3, 0.5, 0.75, 0.9])
def test_a_recovered_log_replays_and_reports(share: float, real: Path, tmp_path: Path) -> None:
    """Cut off in a record: what is left is replayed to the same bytes, like any session."""
    whole = real.read_bytes()
    log = tmp_path / "torn.feslog"
    log.write_bytes(whole[: round(len(whole) * share)])
    run = CliRunner()
    assert run.invoke(main, ["recover", str(log)]).exit_code in (0, 1)
    again = run.invoke(main, ["replay", str(tmp_path / "torn.recovered.feslog")])
    assert again.exit_code == 0, again.output
    assert run.invoke(main, ["report", str(tmp_path / "torn.recovered.feslog")]).exit_code == 0


def test_looking_for_the_next_record_is_not_quadratic(small: Path, tmp_path: Path) -> None:
    """Two megabytes of what looks like heads of long records: each would need a megabyte's checksum."""
    tempting = bytes([0xFF, 0xFF, 0x0F, 0x00, 1, 1, 1, 1, 3]) * 230_000
    records = records_of(small)
    data = MAGIC + records[0] + tempting + b"".join(records[1:])
    found, kept = recovered(data, tmp_path)
    assert kept == records
    assert found.gaps[0].size == len(tempting)
