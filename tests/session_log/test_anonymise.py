"""A log without names: nothing of them in its bytes, and the same bytes on the wire."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import report_records as make
from click.testing import CliRunner
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from replays import SETTINGS, rewritten, write_cut

from fes.cli.main import main
from fes.cli.replay.command import Options, repeat, replay_recording
from fes.session_log import Note, SessionLogError, SessionWriter, read_session
from fes.session_log.anonymise import DATE, anonymise
from fes.session_log.codec import decode, decode_json, encode, encode_json
from fes.session_log.framing import RecordType, framed
from fes.signals import NS_PER_S, StimAlive, StimCommand, SystemFault, WireFrame
from fes.walk_record import MARK

NAMES = ("Zoltan Quixley", "Mx Brontë-Vøllum", "kliniek-rechner-7", "/home/quixley/Stünde 3", "03A1F9C2", "Wilhelmsbad")


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay's log with names wherever one may stand."""
    folder = tmp_path_factory.mktemp("named")
    options = Options(session=SETTINGS, out=folder, stimulator="none", report=False, as_json=True)
    log = replay_recording(write_cut(folder), options)
    person, operator, host, path, serial, place = NAMES

    def change(kind: int, payload: bytes) -> bytes:
        if kind == RecordType.HEADER:
            header = decode_json(memoryview(payload))
            header["session"] |= {"name": f"{place}, {person}", "subject": person}
            header["session"]["channels"][0]["name"] = f"{person}'s peroneus"
            header["session"]["bus"] = {"interface": "socketcan", "channel": host, "options": {"app": operator}}
            header["recording"] |= {"name": f"{path}.csv", "operator": operator, "serial": serial}
            return encode_json(header | {"operator": operator, "host": {"name": host}, "serials": [serial]})
        if kind == RecordType.SUMMARY:
            return encode_json(decode_json(memoryview(payload)) | {"log": path, "recovered": {"from": person}})
        return payload

    log = rewritten(log, folder / "named.feslog", change)
    texts = [*NAMES, person.upper(), f"cannot arm: {path} by {operator}", f"{person.split()[1]} turned, 2.5 m/s²"]
    notes = [Note(NS_PER_S, "info", source, text) for text in texts for source in (MARK, "session", "runner", "gate")]
    at = log.read_bytes()
    framed_notes = b"".join(framed(*encode(note)) for note in notes)
    end = at.rindex(b'{"ended"') - 9  # the summary's record
    log.write_bytes(at[:end] + framed_notes + at[end:])
    assert read_session(log).complete
    return log


@pytest.mark.parametrize("keep", [False, True])
def test_no_name_is_left_and_the_replay_is_the_same(named: Path, tmp_path: Path, keep: bool) -> None:
    target = tmp_path / "new.feslog"
    before_bytes = named.read_bytes()
    more = ["--keep-marks"] if keep else []
    result = CliRunner().invoke(main, ["anonymise", str(named), "--out", str(target), "--json", *more])
    assert result.exit_code == 0, result.output
    assert named.read_bytes() == before_bytes
    text = target.read_bytes().decode("utf-8", "replace").casefold()
    words = {word for name in NAMES for word in (name, *name.replace("/", " ").split()) if len(word) > 3}
    assert [word for word in words if word.casefold() in text] == []
    before, after = read_session(named), read_session(target)
    assert before.header["created"] not in text
    assert after.header["created"] == DATE
    shift_ns = after.commands[0].t_ns - before.commands[0].t_ns
    assert min(int(arrays.t_ns[0]) for arrays in after.samples.values()) >= NS_PER_S
    assert [frame.data for frame in after.frames] == [frame.data for frame in before.frames]
    assert [frame.t_ns - shift_ns for frame in after.frames] == [frame.t_ns for frame in before.frames]
    for sensor, arrays in before.samples.items():
        assert (after.samples[sensor].t_ns - shift_ns == arrays.t_ns).all()
        assert (after.samples[sensor].t_sensor_ns - shift_ns == arrays.t_sensor_ns).all()
        assert after.samples[sensor].acc_mps2.tobytes() == arrays.acc_mps2.tobytes()
    again, was = repeat(target), repeat(named)
    assert again.difference == was.difference == ""
    assert [frame.data for frame in again.now.frames] == [frame.data for frame in was.now.frames]
    assert again.commands > 100
    marks = [note.text for note in after.notes if note.source == MARK]
    assert len(marks) == json.loads(result.output)["marks"] == 9
    assert ("(removed) turned, 2.5 m/s²" in marks) == keep
    assert (marks[0] == "mark 1") != keep


def test_what_the_header_does_not_know_is_taken_out_when_it_is_named(named: Path, tmp_path: Path) -> None:
    log = tmp_path / "marked.feslog"
    with_names = lambda kind, payload: (  # noqa: E731
        encode(Note(NS_PER_S, "info", MARK, "Xanthippe on stairs"))[1]
        if kind == RecordType.NOTE and decode(kind, memoryview(payload)).source == MARK
        else payload
    )
    rewritten(named, log, with_names)
    done = anonymise(log, tmp_path / "new.feslog", names=["xanthippe"], keep_marks=True)
    assert done.left == ()
    assert {note.text for note in read_session(tmp_path / "new.feslog").notes if note.source == MARK} == {
        "(removed) on stairs"
    }


NAME = st.text(st.sampled_from("abcdefghijklmnopqrstuvwxyzABCXYZéüøłñжщд -'./\\"), min_size=4, max_size=30)


def small(path: Path, names: list[str]) -> Path:
    """A log that has each name somewhere, without what a replay needs."""
    person, place, port, operator = names
    device = {"sensor": "left_foot", "device": "xbus", "port": port, "rate_hz": 100.0, "acc_range_g": 16.0,
              "gyr_range_dps": 2000.0, "options": {"owner": operator}}  # fmt: skip
    header: dict[str, Any] = make.header(name=place, subject=person, sensors=[device])
    header["operator"] = operator
    writer = SessionWriter(path, header)
    for k, text in enumerate(name + tail for name in names for tail in ("", " turned", "'s foot")):
        writer.note(Note(k, "info", MARK, text))
        writer.note(Note(k, "warning", "session", f"cannot arm: {text.lower()} {text.upper()}"))
        writer.event(SystemFault(k, text))
        writer.event(StimAlive(k, 1, 0, text))
        writer.command(StimCommand(k, 0, False, 0.0, 0.0, 0.0, 60, f"latched: {text}"), WireFrame(k, 0x120, b"x"))
    writer.close({"ended": "complete", "by": operator, "folder": {"of": [person]}})
    return path


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=st.lists(NAME, min_size=4, max_size=4))
def test_whatever_the_names_none_is_in_the_bytes(tmp_path: Path, names: list[str]) -> None:
    for path in tmp_path.glob("*.feslog"):
        path.unlink()
    anonymise(small(tmp_path / "plain.feslog", ["Zqxa", "Zqxb", "Zqxc", "Zqxd"]), tmp_path / "bare.feslog")
    own = (tmp_path / "bare.feslog").read_bytes().decode("utf-8", "replace").casefold()
    names = [name.strip() for name in names]
    words = [word for name in names for word in (name, *name.split()) if len(word) > 3]
    assume(all(len(name) > 3 and any(map(str.isalpha, name)) for name in names) and words)
    assume(not any(word.casefold() in own for word in words))
    done = anonymise(small(tmp_path / "session.feslog", names), tmp_path / "new.feslog", keep_marks=True)
    text = (tmp_path / "new.feslog").read_bytes().decode("utf-8", "replace").casefold()
    assert [word for word in words if word.casefold() in text] == []
    assert done.left == ()


def test_nothing_is_overwritten_and_a_log_without_a_header_is_refused(named: Path, tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    with pytest.raises(SessionLogError, match="is there already"):
        anonymise(named, tmp_path / "there")
    assert (tmp_path / "there").read_text() == "mine"
    (tmp_path / "torn.feslog").write_bytes(named.read_bytes()[:20])
    with pytest.raises(SessionLogError, match="no whole header"):
        anonymise(tmp_path / "torn.feslog", tmp_path / "new.feslog")
    assert not (tmp_path / "new.feslog").exists()
