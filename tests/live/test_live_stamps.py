"""A sample is never dated before its arrival: a single date too early makes all later samples seem old for a minute."""

from __future__ import annotations

from dataclasses import dataclass, field

from live_parts import MS, Lost, Raw, SetClock, SocketImu

from fes.live.sensors import SensorStream
from fes.live.source import LiveSource
from fes.signals import Event, ImuSample, OperatorAct, OperatorAction, SystemFault

FOOT = "right_foot"


@dataclass
class Heard:
    """Keeps the arrival times that the mapping is told."""

    times: list[int] = field(default_factory=list)
    resets: int = 0

    def map(self, t_host_ns: int, t_device_ns: int) -> int:
        self.times.append(t_host_ns)
        return t_device_ns


class Order30Ms:
    """An input that makes one thing happen, with which the loop is then busy for 30 ms; meanwhile a sample comes."""

    def __init__(self, imu: SocketImu, clock: SetClock) -> None:
        self.imu = imu
        self.clock = clock
        self.given_ns = 0

    def fileno(self) -> int | None:
        return None

    def read_events(self, t_ns: int) -> list[Event]:
        return [] if self.given_ns else [OperatorAct(t_ns, OperatorAction.ARM)]

    def dealt_with(self) -> None:
        self.clock.now_ns += 30 * MS
        self.imu.give(5)
        self.given_ns = self.clock.now_ns


def test_what_came_while_an_order_was_dealt_with_is_not_dated_before_it() -> None:
    clock, imu, heard = SetClock(), SocketImu(FOOT), Heard()
    line = SensorStream(imu, lambda: heard, Lost, frozenset({FOOT}))
    slow = Order30Ms(imu, clock)
    events = iter(LiveSource([line], [slow], None, clock, lambda: False, lambda: False))
    sample: Event | None = None
    while not isinstance(sample, ImuSample):
        sample = next(events)
        if isinstance(sample, OperatorAct):
            slow.dealt_with()
    assert heard.times[0] >= slow.given_ns
    assert sample.t_ns >= slow.given_ns


def test_a_reading_that_is_held_up_dates_its_samples_afterwards() -> None:
    clock, imu, heard = SetClock(), SocketImu(FOOT), Heard()
    line = SensorStream(imu, lambda: heard, Lost, frozenset({FOOT}))
    before_ns = clock()
    imu.give(5)
    clock.now_ns += 20 * MS  # the processor was away between the look at the clock and the reading
    (sample,) = line.read(before_ns, clock)
    assert isinstance(sample, ImuSample)
    assert min(sample.t_ns, heard.times[0]) >= before_ns + 20 * MS


def test_held_up_for_long_between_looking_up_and_reading_it_is_a_stall_and_time_never_runs_back() -> None:
    class HeldUp(SocketImu):
        def read(self, t_ns: int) -> list[Raw]:
            found = super().read(t_ns)
            if found:
                clock.now_ns += 60 * MS
            return found

    clock, imu, heard = SetClock(), HeldUp(FOOT), Heard()
    line = SensorStream(imu, lambda: heard, Lost, frozenset({FOOT}))
    source = LiveSource([line], [], None, clock, lambda: False, lambda: True)
    events = iter(source)
    seen = [next(events)]
    imu.give(5)
    imu.give(6)
    while sum(isinstance(event, ImuSample) for event in seen) < 2:
        seen.append(next(events))
    times = [event.t_ns for event in seen]
    assert times == sorted(times)
    (fault,) = [event for event in seen if isinstance(event, SystemFault)]
    assert "stalled for 60 ms" in fault.text
    assert source.stalls == 1
