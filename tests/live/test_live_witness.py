"""The witness of a live session's foot sensors: heard after each stride, over a log that grows, told and shown."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fes.analysis.pipeline import analyse
from fes.live.inputs import WitnessInput
from fes.live.processes import HelperProcess
from fes.live.witness_process import Growing
from fes.recording import Recording, Track, read_recording
from fes.session_log import SessionWriter
from fes.signals import Event, ImuSample, OperatorAct, OperatorAction
from fes.witness.hearing import Hearing

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
FOOT = "right_foot"


def walked(late_ms: float = 0.0) -> Track:
    """A foot's sensor whose accelerometer is late."""
    track = read_recording(TRIAL).tracks[FOOT]
    at = track.t_sensor_ns - 1e6 * late_ms
    acc = np.column_stack([np.interp(at, track.t_sensor_ns, axis) for axis in track.acc_mps2.T])
    return replace(track, acc_mps2=acc)


def heard(track: Track) -> Iterator[Hearing]:
    """Stride by stride."""
    strides = analyse(Recording("walk", None, {FOOT: track})).strides
    hearing, done = Hearing(FOOT, track.rate_hz), 0
    values = np.hstack((track.acc_mps2, track.gyr_radps))
    for stride in strides:
        until = int(np.searchsorted(track.t_sensor_ns, stride.t_end_ns + 500_000_000))
        borders = [(stride.t_start_ns, stride.t_end_ns)]
        hearing.add(track.t_sensor_ns[done:until], values[done:until], borders)
        done = until
        hearing.hear()
        yield hearing


def test_a_late_accelerometer_is_told_by_how_much_and_a_sound_one_never() -> None:
    said = [hearing.lies for hearing in heard(walked(40.0))]
    assert said[10] == ""
    assert "the accelerometer is" in said[-1]
    assert 35.0 <= float(said[-1].split()[3]) <= 45.0, said[-1]
    assert {hearing.lies for hearing in heard(walked())} == {""}


def test_it_says_at_once_that_it_does_not_know_yet() -> None:
    unknown = [hearing.unknown for hearing in heard(walked())]
    assert unknown[0] == "1 of 20 strides"
    assert unknown[18] == "19 of 20 strides"


# --- over a log ------------------------------------------------------------------------------------------------------


def log_of(track: Track, path: Path) -> None:
    """What a session would have written."""
    strides = analyse(Recording("walk", None, {FOOT: track})).strides
    log, due = SessionWriter(path, {"kind": "live", "recording": {"rates_hz": {FOOT: track.rate_hz}}}), list(strides)
    for t, acc, gyr in zip(track.t_sensor_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist(), strict=True):
        log.event(ImuSample(t, FOOT, t, tuple(acc), tuple(gyr)))
        while due and due[0].t_end_ns + 300_000_000 <= t:
            log.stride(due.pop(0))
    log.close({})


def test_a_log_is_read_as_it_grows_and_every_sample_once(tmp_path: Path) -> None:
    track = walked().part(slice(0, 3000))
    log_of(track, tmp_path / "whole.feslog")
    whole = (tmp_path / "whole.feslog").read_bytes()
    path = tmp_path / "grows.feslog"
    growing, strides = Growing(path), 0
    times: list[int] = []
    for end in (0, 3, 700, len(whole) // 2, len(whole) // 2 + 11, len(whole)):
        path.write_bytes(whole[:end])
        samples, borders = growing.read_new()
        times += samples[FOOT][0].tolist() if FOOT in samples else []
        strides += len(borders.get(FOOT, []))
    assert times == track.t_sensor_ns.tolist()
    assert strides > 5
    assert growing.rates_hz == {FOOT: track.rate_hz}


def test_the_process_says_what_lies_and_ends_with_the_session(tmp_path: Path) -> None:
    log_of(walked(40.0), tmp_path / "session.feslog")
    # all of the log is there at its first look: it hears once where a session hears after each stride
    arguments = "fes.live.witness_process", str(tmp_path / "session.feslog")
    with HelperProcess(*arguments, kind=socket.SOCK_SEQPACKET) as helper:
        helper.link.settimeout(120.0)
        said = json.loads(helper.link.recv(4096))
        assert said["sensor"] == FOOT
    assert helper.process.returncode is not None  # by itself, or killed where the processors are busy


# --- what a session makes of it --------------------------------------------------------------------------------------


def test_what_lies_is_told_once_and_shown_and_a_session_goes_on_without_a_witness() -> None:
    link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    link.setblocking(False)
    told: list[str] = []

    def freeze(t_ns: int, why: str) -> list[Event]:
        told.append(why)
        return [OperatorAct(t_ns, OperatorAction.FREEZE_TUNING, why=why)]

    witness = WitnessInput(link, freeze)
    assert witness.read_events(1) == []
    for lies, unknown in (("", "3 of 20 strides"), ("it is late", ""), ("it is later", "")):
        theirs.send(json.dumps({"sensor": FOOT, "lies": lies, "unknown": unknown}).encode())
    assert witness.read_events(2) == []
    assert witness.now() == [f"{FOOT}: whether its lag, gain, bias or axes lie is not known (3 of 20 strides)"]
    assert len(witness.read_events(3)) == 1
    assert witness.read_events(4) == []
    assert told == [f"{FOOT}: it is late"]
    assert witness.now() == [f"{FOOT}: it is later; lengths and clearance are wrong"]
    theirs.close()
    assert witness.read_events(5) == []
    assert witness.fileno() is None
    assert "the witness has ended" in witness.now()[0]


@pytest.mark.parametrize("message", [b"[]", b"{}", b"\xff"])
def test_what_is_no_message_ends_it(message: bytes) -> None:
    link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.send(message)
    witness = WitnessInput(link, lambda t_ns, why: [])
    assert witness.read_events(1) == []
    assert witness.fileno() is None
