"""The node's clock, and a stimulator that waits for its answers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.simulated.record import RecordEntry, read_record
from drivers.simulated.spawn import free_bus, spawn_node, why_silent
from drivers.simulated.stimulator import lockstep
from drivers.simulated.stimulator.lockstep import FALL_BACK_NS, BusClock, LockstepStimulator, RealClock, encode_sim_time
from drivers.stimulator.bus import open_bus
from drivers.stimulator.can_codec import NODE_IDS, logged_commands
from drivers.stimulator.port import StimulatorLost
from fes.evaluation.delivered import compare_delivered
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame

MS = 1_000_000
NO_BUS = why_silent(free_bus())
needs_bus = pytest.mark.skipif(bool(NO_BUS), reason=f"no CAN between processes on this machine: {NO_BUS}")


class Real:
    """Stands in for the computer's clock."""

    def __init__(self) -> None:
        self.t_ns = 1_000 * NS_PER_S

    def monotonic_ns(self) -> int:
        return self.t_ns


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Real:
    clock = Real()
    monkeypatch.setattr(lockstep, "time", clock)
    return clock


def test_told_no_time_the_clock_is_the_computers(real: Real) -> None:
    clock = BusClock()
    begin_ns = clock.now_ns()
    real.t_ns += 37 * MS
    assert clock.now_ns() == begin_ns + 37 * MS
    assert clock.wait_s(begin_ns + 137 * MS) == pytest.approx(0.1)
    assert clock.wait_s(begin_ns) == 0.0


@pytest.mark.parametrize("origin_ns", [0, 5 * NS_PER_S, -3 * NS_PER_S, 10**18])
def test_the_first_time_told_moves_nothing_the_next_ones_advance(real: Real, origin_ns: int) -> None:
    clock = BusClock()
    begin_ns = clock.now_ns()
    clock.set_time(encode_sim_time(origin_ns))
    assert clock.now_ns() == begin_ns
    real.t_ns += 300 * MS  # the replay computes for a while: for the node no time passes
    assert clock.now_ns() == begin_ns
    clock.set_time(encode_sim_time(origin_ns + 20 * MS))
    assert clock.now_ns() == begin_ns + 20 * MS
    clock.set_time(encode_sim_time(origin_ns + 10 * NS_PER_S))  # many times faster than real time
    assert clock.now_ns() == begin_ns + 10 * NS_PER_S
    assert clock.wait_s(begin_ns) > 0.0


def test_time_told_backward_stands_still(real: Real) -> None:
    clock = BusClock()
    clock.set_time(encode_sim_time(NS_PER_S))
    now_ns = clock.now_ns()
    clock.set_time(encode_sim_time(NS_PER_S - 5 * MS))
    assert clock.now_ns() == now_ns


def test_told_no_more_the_clock_goes_on_by_itself(real: Real) -> None:
    """A replay that dies leaves a node whose leases still run out."""
    clock = BusClock()
    clock.set_time(encode_sim_time(0))
    clock.set_time(encode_sim_time(100 * MS))
    told_ns = clock.now_ns()
    real.t_ns += FALL_BACK_NS
    assert clock.now_ns() == told_ns
    real.t_ns += 1
    assert clock.now_ns() == told_ns
    real.t_ns += 60 * MS
    assert clock.now_ns() == told_ns + 60 * MS
    clock.set_time(encode_sim_time(7 * NS_PER_S))  # another replay, from another origin
    now_ns = clock.now_ns()
    clock.set_time(encode_sim_time(7 * NS_PER_S + 20 * MS))
    assert clock.now_ns() == now_ns + 20 * MS


@pytest.mark.parametrize("data", [b"", b"1234567", b"123456789"])
def test_a_time_of_another_length_is_passed_over(real: Real, data: bytes) -> None:
    clock = BusClock()
    clock.set_time(encode_sim_time(0))
    now_ns = clock.now_ns()
    clock.set_time(data)
    assert clock.now_ns() == now_ns


def test_the_real_clock_cannot_be_told(real: Real) -> None:
    clock = RealClock()
    clock.set_time(encode_sim_time(0))
    assert clock.now_ns() == real.t_ns
    assert clock.wait_s(real.t_ns + NS_PER_S) == 1.0


# --- with a node in its own process -------------------------------------------------------------------------


def session(
    tmp_path: Path, name: str, origin_ns: int = 0
) -> tuple[list[StimStatus], list[WireFrame], list[RecordEntry]]:
    """Three bursts in recorded time, as fast as it goes; statuses, frames, and the node's own record."""
    record = tmp_path / f"{name}.jsonl"
    statuses: list[StimStatus] = []
    frames: list[WireFrame] = []
    with spawn_node(record=record, boot_id=5, clock="bus") as node:
        port = LockstepStimulator(open_bus(node.bus, NODE_IDS), 9)
        port.open(origin_ns, timeout_s=10.0)
        for step in range(150):
            t_ns = origin_ns + step * 20 * MS
            on = step % 50 < 30
            frames.append(port.send(StimCommand(t_ns, 0, on, 20.0 * on, 300.0 * on, 40.0 * on, 60)))
            assert port.outstanding == 1
            replies: list[StimStatus | StimAlive] = port.poll(t_ns)
            assert port.outstanding == 0
            statuses += [reply for reply in replies if isinstance(reply, StimStatus)]
        port.close()
    return statuses, frames, read_record(record)


@needs_bus
def test_lockstep_is_faster_than_time_and_the_same_every_time(tmp_path: Path) -> None:
    begin_s = time.monotonic()
    statuses, frames, entries = session(tmp_path, "one")
    assert time.monotonic() - begin_s < 2.9 + 20.0  # a bound for a hang only; three recorded seconds
    truth = compare_delivered(logged_commands(frames), statuses)
    assert truth.ok
    assert (truth.commands, truth.unasked) == (150, 0)
    # 40 Hz for 600 ms three times, one pulse at each start
    assert 3 * 24 <= truth.pulses[0] <= 3 * 25
    assert truth.charge_uc[0] == pytest.approx(6.0 * truth.pulses[0])

    again, frames_again, entries_again = session(tmp_path, "two", origin_ns=-7 * NS_PER_S)
    assert [frame.data for frame in frames_again] == [frame.data for frame in frames]
    assert [_without_time(status) for status in again] == [_without_time(status) for status in statuses]

    def told(entries: list[RecordEntry]) -> list[tuple[Any, ...]]:
        begin_ns = next(entry.t_ns for entry in entries if entry.event == "on")
        rows = [entry for entry in entries if entry.channel == 0 and entry.event != "boot"]
        return [(entry.event, entry.t_ns - begin_ns, entry.current_ma, entry.pulses) for entry in rows]

    assert told(entries_again) == told(entries)
    assert [row[0] for row in told(entries)].count("on") == 3


def _without_time(status: StimStatus) -> tuple[Any, ...]:
    return (status.counter, status.on, status.current_ma, status.pulses, status.charge_uc, status.fault)


@needs_bus
def test_a_lease_runs_out_in_recorded_time(tmp_path: Path) -> None:
    with spawn_node(record=tmp_path / "node.jsonl", clock="bus") as node:
        port = LockstepStimulator(open_bus(node.bus, NODE_IDS), 9)
        port.open(0, timeout_s=10.0)
        port.send(StimCommand(0, 0, True, 20.0, 300.0, 40.0, 60))
        assert [reply.on for reply in port.poll(0) if isinstance(reply, StimStatus)] == [True]
        port.set_time(59 * MS)
        port.send(StimCommand(300 * MS, 1, False, 0.0, 0.0, 0.0, 60))
        replies = [reply for reply in port.poll(300 * MS) if isinstance(reply, StimStatus)]
        port.close()
    assert {(reply.channel, reply.on) for reply in replies} == {(0, False), (1, False)}
    entries = read_record(tmp_path / "node.jsonl")
    (ended,) = [entry for entry in entries if entry.event == "lease_expired"]
    assert ended.last_pulse_ns < ended.accepted_ns + 60 * MS


@needs_bus
def test_a_node_told_no_more_falls_silent_by_itself(tmp_path: Path) -> None:
    """The controller hangs in mid-burst: no time comes any more, so real time takes over and the lease runs out."""
    with spawn_node(record=tmp_path / "node.jsonl", clock="bus") as node:
        port = LockstepStimulator(open_bus(node.bus, NODE_IDS), 9)
        port.open(0, timeout_s=10.0)
        port.send(StimCommand(0, 0, True, 20.0, 300.0, 40.0, 60))
        port.poll(0)
        begin_s = time.monotonic()
        while not any(entry.event == "lease_expired" for entry in read_record(tmp_path / "node.jsonl")):
            assert time.monotonic() - begin_s < 10.0, "the node never fell silent"
            time.sleep(0.02)
        took_s = time.monotonic() - begin_s
        port.close()
    assert took_s > 0.9 * FALL_BACK_NS / NS_PER_S


@needs_bus
def test_a_node_that_is_gone_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lockstep, "ANSWER_WITHIN_NS", 100 * MS)
    with spawn_node(clock="bus") as node:
        port = LockstepStimulator(open_bus(node.bus, NODE_IDS), 9)
        port.open(0, timeout_s=10.0)
        node.process.kill()
        node.process.wait(10)
        port.send(StimCommand(0, 0, False, 0.0, 0.0, 0.0, 60))
        with pytest.raises(StimulatorLost, match="has its process ended"):
            port.poll(0)
        port.close()


def test_a_bus_that_takes_no_time_is_lost() -> None:
    class Broken(can.BusABC):
        def __init__(self) -> None:
            self.channel_info = "broken"

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("no buffer space")

    port = LockstepStimulator(Broken(), 1)
    with pytest.raises(StimulatorLost, match="did not take the time: no buffer"):
        port.set_time(0)
