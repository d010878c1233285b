"""`fes replay --dashboard`: a recording and a session log played to a browser, and stopped there."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from replays import FES, run_fes, write_cut
from replays import replay as replay_here
from websockets.sync.client import ClientConnection, connect

from fes.cli.common import INTERRUPTED, OK, UNUSABLE
from fes.cli.replay.command import repeat
from fes.live.dashboard.process import press_stop
from fes.session_log import read_session

SPEED = 8
RECORDING = Path(__file__).resolve().parents[2] / "sim_inputs" / "negard_patient2.parquet"


@contextmanager
def replay(folder: Path, *arguments: str | Path) -> Iterator[tuple[subprocess.Popen[str], str, int]]:
    """The command, the token of its link, and its port."""
    command = [*FES, "replay", *map(str, arguments), "--dashboard"]
    process = subprocess.Popen(
        command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, encoding="utf-8"
    )
    try:
        assert process.stderr is not None
        found = next((each for line in process.stderr if (each := re.search(r":(\d+)/#(\S+)", line))), None)
        assert found is not None
        yield process, found.group(2), int(found.group(1))
    finally:
        process.kill()
        process.communicate(timeout=10)


def browser(port: int) -> Any:
    """A web socket as the page opens it."""
    own = f"127.0.0.1:{port}"
    return connect(f"ws://{own}/live", additional_headers={"Origin": f"http://{own}"}, proxy=None)


def strides_of(link: ClientConnection, count: int) -> tuple[list[dict[str, Any]], list[str]]:
    """So many strides as they come, or all until the end; and the states that were told."""
    found: list[dict[str, Any]] = []
    states: list[str] = []
    while len(found) < count:
        frame = json.loads(link.recv(timeout=30))
        found += frame.get("strides", [])
        states += [frame["status"]["state"]] if "status" in frame else []
        if "ended" in frame:
            break
    return found, states


@pytest.mark.slow
def test_a_recording_is_played_at_its_speed_and_a_stop_ends_it(tmp_path: Path) -> None:
    # without a stimulator, whose lease is of real time: on a busy machine it would end in mid-burst and latch
    options = ("--speed", str(SPEED), "--stimulator", "none", "--no-report", "--out", "out")
    with replay(tmp_path, RECORDING, *options) as (process, token, port):
        with browser(port) as link:
            link.send(json.dumps({"token": token}))
            assert json.loads(link.recv(timeout=10))["hello"]["mode"] == "replay"
            shown, states = strides_of(link, 8)
            seen_s = time.time()
            link.send('{"ask":"pause"}')  # has no meaning here
            press_stop(port)
            while "ended" not in (frame := json.loads(link.recv(timeout=10))):
                pass
            assert "interrupted" in frame["ended"]
        assert process.wait(20) == INTERRUPTED
    log = tmp_path / "out" / "negard_patient2-001" / "session.feslog"
    record = read_session(log)
    logged = {stride.number: stride for stride in record.strides}
    for each in shown:
        assert each["stride_length_m"] == logged[each["number"]].stride_length_m
        assert each["clearance_m"] == logged[each["number"]].clearance_m
    assert {"armed", "running"} & set(states)
    # not as fast as it goes: by then that would be over; the page may be open long after it has begun, though
    recorded_s = (logged[shown[-1]["number"]].t_end_ns - int(record.samples["right_foot"].t_ns[0])) * 1e-9
    assert seen_s - datetime.fromisoformat(record.header["created"]).timestamp() >= recorded_s / SPEED
    assert any("stopped on the dashboard" in note.text for note in record.notes)
    assert not record.commands[-1].on
    assert repeat(log).difference == ""
    assert not list(log.parent.glob("page.*"))


@pytest.mark.slow
def test_a_session_log_is_played_too_and_then_checked(tmp_path: Path) -> None:
    replay_here(write_cut(tmp_path), tmp_path)
    (log,) = tmp_path.glob("cut-*/session.feslog")
    # ten seconds: the page must be there, and open, before it is over
    with replay(tmp_path, log, "--speed", "1.5", "--out", "out") as (process, token, port):
        with browser(port) as link:
            link.send(json.dumps({"token": token}))
            shown, _ = strides_of(link, 10_000)
        assert process.stderr is not None
        said = process.stderr.read()
        assert process.wait(30) == OK, said
        assert "same byte for byte" in said
    logged = {(each.foot, each.number): each.stride_length_m for each in read_session(log).strides}
    assert len(shown) == len(logged)
    assert all(each["stride_length_m"] == logged[each["foot"], each["number"]] for each in shown if each["valid"])


def test_a_taken_port_is_said(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run_fes("replay", RECORDING, "--dashboard", "--dashboard-port", str(port), cwd=tmp_path)
    assert done.returncode == UNUSABLE
    assert "Choose another port" in done.stderr
    assert "Traceback" not in done.stderr
