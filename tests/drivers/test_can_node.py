"""The simulated node's logic, on an injected clock."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from drivers.simulated.record import RecordEntry, RecordWriter, read_record
from drivers.simulated.stimulator import firmware as stimulator_node
from drivers.simulated.stimulator.firmware import NodeFaults, StimulatorNode, parse_faults
from drivers.stimulator import can_codec, e2e
from drivers.stimulator.can_codec import PROTOCOL_VERSION, Alive, Fault, Frame, Message, Result, Status
from fes import limits
from fes.signals import StimCommand

MS = 1_000_000
BOOT, SESSION = 77, 0x1234


def command(channel: int = 1, on: bool = True, **values: Any) -> StimCommand:
    levels: dict[str, Any] = {"current_ma": 20.0, "pulse_width_us": 300.0, "frequency_hz": 40.0, "validity_ms": 60}
    return StimCommand(t_ns=0, channel=channel, on=on, **(levels | values))


class Bench:
    """A node and its clock; numbers the commands as a controller would."""

    def __init__(self, faults: str = "", *, opened: bool = True) -> None:
        self.node = StimulatorNode(BOOT, 0, parse_faults(faults))
        self.t_ns = self.issued_ns = 0
        self.counter = 0
        self.sent: list[Frame] = []
        self.entries: list[RecordEntry] = []
        if opened:
            self.open()

    def frame(self, frame: Frame) -> list[Message]:
        self.sent.append(frame)
        return self._read(self.node.receive(self.t_ns, *frame))

    def open(
        self, session_id: int = SESSION, boot_id: int = BOOT, version: int = PROTOCOL_VERSION, validity_ms: int = 60
    ) -> Alive:
        self.counter = 0
        last = self.frame(can_codec.encode_open(boot_id, session_id, version, validity_ms))[-1]
        assert isinstance(last, Alive)
        return last

    def send(
        self, wanted: StimCommand, number: int | None = None, session_id: int = SESSION, late_ms: float = 0.0
    ) -> Result:
        """One command; the session's next, or of another number. It was issued ``late_ms`` ago."""
        own = number is None
        wanted = replace(wanted, t_ns=self.t_ns - round(late_ms * MS))
        number = self.counter if number is None else number
        statuses = [
            m for m in self.frame(can_codec.encode_command(wanted, number, session_id)) if isinstance(m, Status)
        ]
        self.counter += own
        assert (statuses[-1].channel, statuses[-1].counter) == (wanted.channel, number % 128)
        assert statuses[-1].session_id == e2e.carried(session_id, number)[0]
        return statuses[-1].result

    def run_to(self, t_ns: int) -> list[Message]:
        """Advance deadline by deadline, as the node's own process does."""
        messages: list[Message] = []
        while self.node.next_deadline_ns() <= t_ns:
            self.t_ns = max(self.t_ns, self.node.next_deadline_ns())
            messages += self._read(self.node.advance(self.t_ns))
        self.t_ns = t_ns
        return messages + self._read(self.node.advance(t_ns))

    def _read(self, frames: list[Frame]) -> list[Message]:
        self.entries += self.node.take_record()
        return [can_codec.decode(*frame) for frame in frames]

    def events(self, *kinds: str) -> list[RecordEntry]:
        return [entry for entry in self.entries if entry.event in kinds]

    def is_silent(self) -> bool:
        return not any(channel.on for channel in self.node.channels)


def test_it_boots_off_with_no_session_and_says_so_every_100_ms() -> None:
    bench = Bench(opened=False)
    alives = [message for message in bench.run_to(1000 * MS) if isinstance(message, Alive)]
    assert len(alives) == 11
    assert {(alive.boot_id, alive.session_id, alive.faults) for alive in alives} == {(BOOT, 0, 0)}
    assert [alive.counter for alive in alives] == list(range(11))
    assert bench.is_silent()


def test_the_node_s_own_limits_are_the_project_s() -> None:
    assert stimulator_node.MAX_CURRENT_MA == limits.MAX_CURRENT_MA
    assert stimulator_node.MAX_PULSE_WIDTH_US == limits.MAX_PULSE_WIDTH_US
    assert stimulator_node.MAX_FREQUENCY_HZ == limits.MAX_FREQUENCY_HZ
    assert stimulator_node.MAX_VALIDITY_MS == limits.MAX_VALIDITY_MS


def test_without_a_session_nothing_is_executed() -> None:
    bench = Bench(opened=False)
    assert bench.send(command()) is Result.BAD_SESSION
    assert bench.is_silent()
    assert bench.node.rejected == 1


@pytest.mark.requirement("SR-12")
@given(validity_ms=st.integers(1, 15).map(lambda steps: 4 * steps), sent_us=st.integers(0, 200_000))
def test_lease_ends_to_the_microsecond(validity_ms: int, sent_us: int) -> None:
    bench = Bench(opened=False)
    bench.open(validity_ms=validity_ms)
    bench.run_to(sent_us * 1000)
    assert bench.send(command()) is Result.OK
    bench.run_to(sent_us * 1000 + validity_ms * MS - 1)
    assert bench.node.channels[1].on
    statuses = [m for m in bench.run_to(sent_us * 1000 + validity_ms * MS) if isinstance(m, Status)]
    assert bench.is_silent()
    assert [(s.result, s.on, s.current_ma, s.session_id) for s in statuses] == [
        (Result.LEASE_EXPIRED, False, 0.0, SESSION)
    ]
    assert [entry.t_ns for entry in bench.events("lease_expired")] == [sent_us * 1000 + validity_ms * MS]


def test_no_pulse_falls_on_the_end_of_the_lease() -> None:
    bench = Bench()
    bench.send(command(frequency_hz=50.0, validity_ms=60))
    bench.run_to(100 * MS)
    assert (bench.node.channels[1].pulses, bench.node.channels[1].last_pulse_ns) == (3, 40 * MS)


def test_a_late_command_cannot_stretch_a_lease_that_is_over() -> None:
    bench = Bench()
    bench.send(command())
    bench.t_ns = 60 * MS
    messages = bench.frame(can_codec.encode_command(command(), bench.counter, SESSION))
    results = [m.result for m in messages if isinstance(m, Status)]
    assert results == [Result.LEASE_EXPIRED, Result.OK]
    assert [entry.event for entry in bench.entries if entry.channel == 1] == ["on", "lease_expired", "on"]


def test_leases_are_each_channel_s_own() -> None:
    bench = Bench()
    bench.send(command(0))
    bench.run_to(30 * MS)
    bench.send(command(1))
    bench.run_to(60 * MS)
    assert [channel.on for channel in bench.node.channels[:2]] == [False, True]
    bench.run_to(90 * MS)
    assert bench.is_silent()


@pytest.mark.requirement("SR-12")
def test_refused_commands_keep_no_lease_alive() -> None:
    bench = Bench()
    bench.send(command())
    for step in range(1, 4):
        bench.run_to(step * 15 * MS)
        assert bench.send(command(), number=0) is Result.BAD_COUNTER
    bench.run_to(60 * MS)
    assert bench.is_silent()


@pytest.mark.parametrize("frequency_hz", [1.0, 7.0, 20.0, 40.0, 100.0])
def test_pulses_and_charge_are_those_of_the_command(frequency_hz: float) -> None:
    bench = Bench()
    pulses, charge_steps = 0, 0
    for step in range(100):
        bench.run_to(step * 20 * MS)
        bench.send(command(frequency_hz=frequency_hz))
    bench.run_to(1999 * MS)
    bench.frame(can_codec.encode_command(command(on=False), bench.counter, SESSION))
    channel = bench.node.channels[1]
    pulses, charge_steps = channel.pulses, channel.charge_steps
    period_ms = 1000 / frequency_hz
    assert abs(pulses - (1999 // period_ms + 1)) <= 1
    assert charge_steps * can_codec.CHARGE_STEP_UC == pytest.approx(pulses * 20.0 * 300.0 * 1e-3)
    bench.run_to(5000 * MS)
    assert channel.pulses == pulses


def test_no_two_pulses_come_closer_than_the_frequency_allows_whatever_is_commanded() -> None:
    bench = Bench()
    generator = random.Random(1)
    last_ns = -(10**12)
    for _ in range(2000):
        bench.run_to(bench.t_ns + generator.randrange(0, 4 * MS))
        bench.send(command(on=generator.random() < 0.7, frequency_hz=100.0))
        newest_ns = bench.node.channels[1].last_pulse_ns
        assert newest_ns == last_ns or newest_ns - last_ns >= 10 * MS or last_ns < 0
        last_ns = newest_ns


@pytest.mark.requirement("SR-14")
@given(st.integers(0, 300), st.integers(-300, 300))
@example(126, 3)
@example(127, 1)
@example(127, 4)
def test_counter_rule(start: int, step: int) -> None:
    """Up to two lost commands are forgiven; all else is refused, and nearby named for what it is."""
    bench = Bench()
    for _ in range(start + 1):
        assert bench.send(command()) is Result.OK
    offered = max(start + step, 0)
    expected = Result.OK if 1 <= offered - start <= 3 else Result.BAD_COUNTER
    if abs(offered // 128 - start // 128) > 1:
        expected = Result.BAD_SESSION
    assert bench.send(command(current_ma=10.0), number=offered) is expected
    assert bench.node.channels[1].levels[0] == (10.0 if expected is Result.OK else 20.0)


def test_wrong_counters_in_a_row_close_the_session_until_a_new_one() -> None:
    bench = Bench()
    bench.send(command())
    results = [bench.send(command(), number=0) for _ in range(5)]
    assert results == [Result.BAD_COUNTER] * 5
    assert bench.is_silent()
    assert bench.send(command()) is Result.FAULTED
    bench.t_ns += 1
    assert bench.send(command(on=False)) is Result.FAULTED
    assert bench.open(SESSION).session_id == 0
    alive = bench.open(SESSION + 1)
    assert (alive.session_id, alive.faults) == (SESSION + 1, 0)
    assert bench.send(command(), session_id=SESSION + 1) is Result.OK


@pytest.mark.parametrize(
    ("values", "result"),
    [
        ({"current_ma": 130.0, "pulse_width_us": 500.0, "frequency_hz": 100.0}, Result.OK),
        ({"current_ma": 130.5}, Result.OVER_LIMIT),
        ({"pulse_width_us": 501.0}, Result.OVER_LIMIT),
        ({"frequency_hz": 101.0}, Result.OVER_LIMIT),
    ],
)
def test_the_node_s_own_limits_turn_the_channel_off(values: dict[str, Any], result: Result) -> None:
    bench = Bench()
    assert bench.send(command()) is Result.OK
    assert bench.send(command(**values)) is result
    assert bench.node.channels[1].on == (result is Result.OK)
    assert bench.send(command()) is Result.OK


def test_a_session_without_a_validity_is_not_opened() -> None:
    alive = Bench(opened=False).open(validity_ms=0)
    assert (alive.session_id, alive.faults) == (0, can_codec.Fault.VALIDITY)
    assert "validity is 0" in can_codec.fault_text(alive.faults)


def walk(bench: Bench, commands: int, late_ms: float = 0.0, period_ms: int = 20, **values: Any) -> list[Result]:
    """Commands of one channel that the controller issues every 20 ms and the line brings so late."""
    begin_ns, results = bench.issued_ns, []
    for step in range(1, commands + 1):
        bench.issued_ns = begin_ns + step * period_ms * MS
        bench.run_to(max(bench.issued_ns + round(late_ms * MS), bench.t_ns))
        results.append(bench.send(command(**values), late_ms=(bench.t_ns - bench.issued_ns) / MS))
    return results


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("validity_ms", [40, 60])
@pytest.mark.parametrize("late_ms", [100.0, 150.0, 190.0, 236.0, 300.0, 500.0, 512.0, 2000.0])
def test_what_comes_later_than_it_is_valid_is_not_executed(late_ms: float, validity_ms: int) -> None:
    bench = Bench(opened=False)
    bench.open(validity_ms=validity_ms)
    assert set(walk(bench, 20)) == {Result.OK}
    assert set(walk(bench, 20, late_ms)) == {Result.STALE}
    assert bench.is_silent()
    assert walk(bench, 1, on=False) == [Result.OK], "off is never refused"


def test_what_is_a_little_late_is_executed_and_a_line_that_is_prompt_again_too() -> None:
    bench = Bench()
    for late_ms in (0.0, 20.0, 0.0, 40.0, 0.0):
        assert set(walk(bench, 8, late_ms)) == {Result.OK}


def test_a_delay_that_grows_is_noticed() -> None:
    bench, results = Bench(), []
    for step in range(200):
        results += walk(bench, 1, 0.5 * step, on=step % 10 > 0)  # off now and then: not for longer than it may be
    assert set(results[:80]) == {Result.OK}
    assert {result for step, result in enumerate(results[160:]) if step % 10} == {Result.STALE}


def test_clocks_that_drift_apart_are_no_delay() -> None:
    bench, results = Bench(), []
    for step in range(15_000):  # five minutes
        bench.run_to((step + 1) * 20 * MS)
        late_ms = 550e-6 * 20 * step  # 500 by NTP, 50 of the crystals
        results.append(bench.send(command(on=step % 100 != 50), late_ms=late_ms))
    assert set(results) == {Result.OK}


def test_after_a_silence_a_channel_goes_on_once_it_was_told_to_be_off() -> None:
    bench = Bench()
    walk(bench, 5)
    bench.issued_ns += 300 * MS
    assert walk(bench, 10) == [Result.STALE] * 10
    assert walk(bench, 1, on=False) == [Result.OK]
    assert walk(bench, 2) == [Result.OK, Result.OK]


@pytest.mark.requirement("SR-14")
def test_what_a_line_has_held_back_is_not_executed_though_an_off_is_among_it() -> None:
    """All comes 500 ms late; the controller has noticed that after 45 ms, and commands off from then on."""
    bench = Bench()
    walk(bench, 5)
    assert walk(bench, 1, 500.0, on=False) == [Result.OK]
    assert walk(bench, 3, 500.0) == [Result.STALE] * 3
    assert bench.is_silent()
    assert walk(bench, 12, 500.0, on=False) == [Result.OK] * 12


def test_a_clock_that_jumped_is_told_and_a_new_session_puts_it_right() -> None:
    """A command held for 70 ms just before the line was free again: 256 ms of time of issue go unseen."""
    bench = Bench()
    walk(bench, 5)
    assert bench.send(command(on=False), late_ms=0.0) is Result.OK
    for decided_ms, comes_ms in ((20, 190), (280, 290)):
        bench.run_to((100 + comes_ms) * MS)
        bench.send(command(on=False), late_ms=comes_ms - decided_ms)
    bench.issued_ns = bench.t_ns
    assert walk(bench, 20) == [Result.STALE] * 20
    assert bench.node.flags == Fault.LATE
    assert bench.open(SESSION + 7).faults == 0
    assert bench.send(command(), session_id=SESSION + 7) is Result.OK


def test_three_seconds_on_is_the_end_until_an_off_command() -> None:
    bench = Bench()
    results = []
    for step in range(160):
        bench.run_to(step * 20 * MS)
        results.append(bench.send(command()))
    assert results[:150] == [Result.OK] * 150
    assert results[150:] == [Result.ON_TIME] * 10
    assert [entry.t_ns for entry in bench.events("on_time")] == [3000 * MS]
    assert bench.is_silent()
    assert bench.send(command(on=False)) is Result.OK
    assert bench.send(command()) is Result.OK


def test_a_session_opens_only_for_this_boot_this_version_and_a_new_identifier() -> None:
    bench = Bench(opened=False)
    assert bench.open(boot_id=BOOT + 1).session_id == 0
    assert bench.open(version=PROTOCOL_VERSION - 1).session_id == 0
    assert bench.node.flags == Fault.VERSION
    assert bench.open(SESSION).session_id == SESSION
    assert bench.open(SESSION + 1).session_id == SESSION + 1
    assert bench.open(SESSION).session_id == SESSION + 1
    assert bench.node.rejected == 3


def test_the_same_open_again_is_answered_until_the_first_command_and_refused_after_it() -> None:
    bench = Bench()
    assert bench.open(SESSION).faults == 0
    bench.send(command())
    assert bench.open(SESSION).faults == Fault.SESSION_USED
    assert bench.node.channels[1].on


def test_opening_a_session_turns_everything_off_and_restarts_the_count() -> None:
    bench = Bench()
    for _ in range(9):
        bench.send(command())
    bench.open(SESSION + 1)
    assert bench.is_silent()
    assert bench.send(command(), number=9, session_id=SESSION + 1) is Result.BAD_COUNTER
    assert bench.send(command(), number=0, session_id=SESSION + 1) is Result.OK


@pytest.mark.requirement("SR-14")
def test_identifiers_that_commands_have_carried_open_no_session() -> None:
    bench = Bench()
    for number in range(3 * 128):
        bench.run_to(number * 10 * MS)
        assert bench.send(command(on=number % 2 == 0)) is Result.OK
    for used in (SESSION, SESSION + 1, SESSION + 2):
        assert (bench.open(used).session_id, bench.node.flags) == (SESSION, Fault.SESSION_USED)
    assert bench.open(SESSION + 3).session_id == SESSION + 3


@pytest.mark.requirement("SR-14")
def test_a_session_ends_before_its_count_carries_into_identifiers_used_before() -> None:
    bench = Bench()
    assert bench.send(command(7)) is Result.OK
    bench.open(SESSION - 1)
    for number in range(128):
        bench.run_to(number * 10 * MS)
        assert bench.send(command(number % 2), session_id=SESSION - 1) is Result.OK
    assert bench.send(command(3), session_id=SESSION - 1) is Result.FAULTED
    assert bench.is_silent()
    assert (bench.node.session_id, bench.node.flags) == (0, Fault.SESSION_USED)
    assert bench.send(command(3), session_id=SESSION - 1) is Result.BAD_SESSION
    assert bench.open(SESSION + 7).faults == 0


@pytest.mark.requirement("SR-14")
@pytest.mark.parametrize("closed", [False, True])
def test_a_command_that_the_last_session_sent_unheard_opens_to_no_later_one(closed: bool) -> None:
    """Sent after the identifier had gone up, lost, held somewhere, and handed over in another session."""
    bench = Bench()
    for _ in range(127):
        assert bench.send(command(on=False)) is Result.OK
    held = can_codec.encode_command(command(5), 128, SESSION)
    for _ in range(5 * closed):
        assert bench.send(command(5), number=3) is Result.BAD_COUNTER
    assert (bench.node.session_id == 0) is closed
    bench.open(SESSION + 7)
    assert bench.open(SESSION + 1).session_id == SESSION + 7
    bench.frame(held)
    assert bench.is_silent()


def test_no_command_is_of_session_0() -> None:
    """65535 and 0 are the same modulo 65535: a session 65535 must not hear what names none."""
    bench = Bench(opened=False)
    bench.open(65535)
    for number in range(3):
        _, data = can_codec.encode_command(command(), number, 65535)
        nobody = e2e.protect(can_codec.COMMAND_ID, data[:2] + bytes(2) + data[4:])
        statuses = [m for m in bench.frame((can_codec.COMMAND_ID, nobody)) if isinstance(m, Status)]
        assert [status.result for status in statuses] == [Result.BAD_SESSION]
    assert bench.is_silent()


def test_a_capture_of_the_still_open_session_is_stopped_by_the_count() -> None:
    bench = Bench()
    for step in range(32):
        bench.run_to(step * 20 * MS)
        bench.send(command(step % 2))
    capture = bench.sent[1:]
    bench.run_to(bench.t_ns + 1000 * MS)
    for frame in capture[10:]:  # any starting point but the very next counts
        bench.run_to(bench.t_ns + 20 * MS)
        bench.frame(frame)
        assert bench.is_silent()
    assert bench.node.session_id == 0


def test_reboot_comes_up_off_under_another_boot_id() -> None:
    bench = Bench("reboot=0.05")
    bench.send(command())
    bench.run_to(50 * MS)
    assert bench.is_silent()
    assert bench.node.boot_id == BOOT + 1
    assert bench.send(command()) is Result.BAD_SESSION
    assert bench.open().session_id == 0
    assert bench.open(boot_id=BOOT + 1).session_id == SESSION


def test_well_formed_random_commands_never_get_beyond_the_limits() -> None:
    """An attacker who knows session and count still cannot get more than the node's own limits."""
    bench = Bench()
    generator = random.Random(21)
    identifier, _ = can_codec.encode_command(command(), 0, SESSION)
    accepted = 0
    for number in range(5000):
        bench.run_to(bench.t_ns + generator.randrange(30 * MS))
        carried_id, count = e2e.carried(SESSION, number)
        head = bytes((0, count % 16 | generator.randrange(16) << 4)) + carried_id.to_bytes(2, "little")
        tail = generator.randbytes(3) + bytes((generator.randrange(32) | count >> 4 << 5,))
        bench.frame((identifier, e2e.protect(identifier, head + tail)))
    for entry in bench.events("on", "level"):
        accepted += 1
        assert entry.current_ma <= 130.0
        assert entry.pulse_width_us <= 500.0
        assert entry.frequency_hz <= 100.0
    assert accepted > 100


def test_the_record_survives_a_torn_last_line(tmp_path: Path) -> None:
    path = tmp_path / "node.jsonl"
    writer = RecordWriter(path)
    entries = [RecordEntry(1, "boot"), RecordEntry(2, "on", 1, 20.0, 300.0, 40.0, 2, 1, 2)]
    writer.write(entries)
    assert read_record(path) == entries
    writer.close()
    path.write_text(path.read_text() + '{"t_ns": 3, "ev')
    assert read_record(path) == entries
    path.write_text('{"nonsense": 3}\n')
    with pytest.raises(ValueError, match=r"node\.jsonl:1"):
        read_record(path)


def test_faults_are_read_and_wrong_ones_named() -> None:
    assert parse_faults(" electrode=2, reboot=1.5") == NodeFaults(electrode=2, reboot=1.5)
    assert parse_faults("") == NodeFaults()
    for text in ("electrod=2", "weak", "drop=x"):
        with pytest.raises(ValueError, match="fault"):
            parse_faults(text)
