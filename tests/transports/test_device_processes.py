"""Every kind of simulated device in its process: what it is told, what it answers, and why it is not there."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.imu.port import ImuLost
from drivers.simulated.spawn import (
    NodeFailed,
    ProcessHandle,
    free_bus,
    spawn_device,
    spawn_imu,
    spawn_link,
    spawn_node,
    why_silent,
)
from drivers.stimulator.bus import LOOPBACK
from fes.config import Bus
from fes.hil.closed_loop.bench import spawn_patient
from fes.simulation.forward import settings_for

NO_BUS = why_silent(free_bus(LOOPBACK))
needs_bus = pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")

START: dict[str, Callable[[Path], ProcessHandle]] = {
    "node": lambda folder: spawn_node(bus=free_bus(LOOPBACK), record=folder / "record.jsonl"),
    "serial": lambda folder: spawn_device("sciencemode4", record=folder / "record.jsonl"),
    "sensor": lambda folder: spawn_imu("xbus"),
    "line": lambda folder: spawn_link(free_bus(LOOPBACK), front=free_bus(LOOPBACK)),
    "patient": lambda folder: spawn_patient(folder / "pulses", WALKER),
}
WALKER = settings_for("moderate", seed=3, sensors=("right_foot",), rate_hz=100.0)
A_FAULT = {"node": "mute", "serial": "mute", "sensor": "mute", "line": "cut", "patient": "mute"}
kinds = pytest.mark.parametrize("kind", [pytest.param("node", marks=needs_bus), "serial", "sensor", "line", "patient"])


@kinds
def test_all_of_them_start_take_faults_and_end_alike(tmp_path: Path, kind: str) -> None:
    with START[kind](tmp_path) as handle:
        first_ns, second_ns = handle.inject(A_FAULT[kind]), handle.inject(A_FAULT[kind], 0.0)
        assert 0 < first_ns < second_ns
        with pytest.raises((NodeFailed, ImuLost), match=r"refused: .*smoke.* is not known"):
            handle.inject("smoke")
        with pytest.raises((NodeFailed, ImuLost), match="refused"):
            handle.request({"no": "fault"})
        assert handle.inject(A_FAULT[kind], 0.0) > second_ns  # and it goes on
        assert handle.stop() == 0
        assert handle.stop() == 0
        with pytest.raises((NodeFailed, ImuLost), match="has been stopped"):
            handle.inject("mute")
    assert [entry.event for entry in handle.entries("boot")] == (["boot"] if handle.record else [])


def test_one_that_was_killed_is_gone_and_its_status_is_told(tmp_path: Path) -> None:
    with START["serial"](tmp_path) as handle:
        handle.process.kill()
        with pytest.raises(NodeFailed, match="is gone; it said: nothing; it ended with status -9"):
            handle.inject("mute")


def test_what_a_patient_says_unasked_is_no_answer_and_none_of_it_is_lost(tmp_path: Path) -> None:
    with spawn_patient(tmp_path / "pulses", WALKER) as patient:
        strides, end_s = patient.new_strides(), time.monotonic() + 30.0
        while len(strides) < 2 and time.monotonic() < end_s:
            assert patient.punctuality()["pulses"] == 0  # an answer, whatever came before it
            strides += patient.new_strides()
        assert [stride.foot for stride in strides[:2]] == [WALKER.affected_foot] * 2
        intervals = patient.punctuality()["intervals"]
        assert patient.summary == {}
        assert patient.stop() == 0
        assert patient.summary["intervals"] >= intervals


@contextmanager
def taken_port() -> Iterator[Bus]:
    """A bus whose UDP port is another program's, which does not share it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("", 0))
        yield Bus(interface=LOOPBACK, options={"port": other.getsockname()[1]})


def test_a_port_that_is_taken_is_named() -> None:
    with taken_port() as bus:
        port = bus.options["port"]
        with pytest.raises(NodeFailed, match=rf"stimulator did not start \(.*--port {port}.*\); it said: .*in use"):
            spawn_node(bus=bus)


def test_a_recording_that_cannot_be_played_is_named(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_bytes(b"\x00\xff" * 99)
    with pytest.raises(ImuLost, match=r"sensor did not start \(.*\); it said: imu_process: .*walk.csv: is binary"):
        spawn_imu("xbus", recording=path)


def test_a_record_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(NodeFailed, match=r"it said: sciencemode2: .*No such file.*nowhere"):
        spawn_device("sciencemode2", record=tmp_path / "nowhere" / "record.jsonl")


def test_one_that_is_not_ready_in_time_is_ended_and_that_is_said(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "record.jsonl")  # it waits until somebody reads its record
    with pytest.raises(NodeFailed, match=r"it said: nothing within 0.2 s"):
        spawn_device("sciencemode4", record=tmp_path / "record.jsonl", timeout_s=0.2)
