"""After a sensor's fault, arming asks for proof that it is gone: a tap that is seen when it happens."""

from __future__ import annotations

import pytest
from live_parts import MS
from test_live_operator import FOOT, RATE_HZ, Bench

from fes.live.commands import CommandKind as Kind
from fes.live.commands import State
from fes.live.operator import ASKED
from fes.signals import ImuSample, SystemFault

LOST = f"{FOOT}: sensor lost: unplugged"


class TappedBench(Bench):
    """Its sensor was lost and came back; ``late_ms`` is how late its data come since."""

    def __init__(self, late_ms: int = 0) -> None:
        super().__init__()
        self.late_ms = late_ms
        self.armed()
        self.handle(SystemFault(self.t_ns, LOST))
        assert self.operator.state is State.FAULT
        self.stand(2.0)

    def tap(self) -> None:
        """It shows for 60 ms, as late as the data come."""
        self.stand(0.001 * self.late_ms)
        for _ in range(6):
            self.t_ns += 10 * MS
            self.handle(
                ImuSample(
                    self.t_ns, FOOT, self.t_ns, (0.0, 0.0, 9.81 + 1e-12 * self.t_ns), (2.0, 1e-9 * self.t_ns, 0.0)
                )
            )

    def tap_and_press(self) -> None:
        """Both in the same moment."""
        assert self.command(Kind.ARM) == []
        self.tap()


@pytest.mark.requirement("SR-27")
def test_the_key_alone_does_not_arm_after_a_sensors_fault() -> None:
    bench = TappedBench()
    for _ in range(3):
        assert bench.command(Kind.ARM) == []
        assert ASKED in bench.operator.message
        bench.stand(3.0)
        assert "no tap" in bench.operator.message
        assert not bench.gate.armed


@pytest.mark.requirement("SR-27")
def test_a_tap_with_the_key_is_the_proof_and_then_the_key_arms() -> None:
    bench = TappedBench()
    bench.tap_and_press()
    assert "the tap was seen" in bench.operator.message
    assert not bench.gate.armed
    assert bench.command(Kind.ARM) == []
    assert "moves" in bench.operator.message, "it must rest again"
    bench.stand(1.1)
    bench.command(Kind.ARM)
    assert bench.gate.armed, bench.operator.message
    assert any("a tap seen +10 ms from the key" in note.text for note in bench.notes)
    bench.handle(SystemFault(bench.t_ns, LOST))  # and the next fault asks anew
    bench.stand(2.0)
    assert bench.command(Kind.ARM) == []


@pytest.mark.requirement("SR-27")
def test_a_tap_just_before_the_key_counts_and_one_long_before_does_not() -> None:
    bench = TappedBench()
    bench.tap()
    bench.command(Kind.ARM)
    bench.stand(0.02)
    assert "the tap was seen" in bench.operator.message
    other = TappedBench()
    other.tap()
    other.stand(0.1)
    other.command(Kind.ARM)
    other.stand(3.0)
    assert "no tap" in other.operator.message


@pytest.mark.requirement("SR-27")
@pytest.mark.parametrize("late_ms", [50, 100, 600])
def test_data_that_come_late_are_told_by_their_tap(late_ms: int) -> None:
    bench = TappedBench(late_ms)
    bench.tap_and_press()
    assert f"seen {late_ms + 10} ms after the key" in bench.operator.message
    bench.stand(1.1)
    assert bench.command(Kind.ARM) == []
    assert not bench.gate.armed


@pytest.mark.requirement("SR-27")
def test_who_taps_again_and_again_does_not_meet_a_delay_by_chance() -> None:
    bench = TappedBench()
    for number in range(20):
        bench.tap()
        bench.stand(0.54)
        if number:  # the tap before is seen now, by a line that is 0.6 s late
            bench.command(Kind.ARM)
    bench.stand(3.0)
    assert FOOT in bench.gate.doubted


@pytest.mark.requirement("SR-27")
@pytest.mark.parametrize("what", ["non-finite", "frozen", "turned"])
def test_every_fault_of_a_sensor_that_a_channel_follows_asks_for_it(what: str) -> None:
    bench = Bench().armed()
    nan = float("nan")
    for _ in range(round(0.3 * RATE_HZ)):
        bench.t_ns += 10 * MS
        force = {"non-finite": (nan, nan, nan), "frozen": (0.0, 0.0, 9.8), "turned": (0.0, 0.0, 9.8)}[what]
        rate = (0.0, 0.0, 50.0 + 1e-9 * bench.t_ns) if what == "turned" else (0.0, 0.0, 0.0)
        bench.handle(ImuSample(bench.t_ns, FOOT, bench.t_ns, force, rate))
    assert bench.gate.doubted == {FOOT}
    bench.stand(2.0)
    assert bench.command(Kind.ARM) == []


def test_a_stop_and_a_stimulators_fault_are_no_fault_of_a_sensor() -> None:
    bench = Bench().armed()
    bench.command(Kind.STOP)
    bench.handle(SystemFault(bench.t_ns, "stimulator lost: unplugged"))
    bench.stand(2.0)
    bench.command(Kind.ARM)
    assert bench.gate.armed
