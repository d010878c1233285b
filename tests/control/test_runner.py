"""The loop in a world of its own: what goes out, in which order, and that everything is off whatever ends it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import pairwise
from typing import Any, cast

import pytest
from replays import MS, SETTINGS

from drivers.stimulator.port import StimulatorLost
from fes.config import load_session
from fes.control.controller import Controller, Decision
from fes.control.runner import Runner
from fes.gate import SafetyGate
from fes.session_log import Note
from fes.signals import (
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimRequest,
    StimStatus,
    StrideResult,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange, Transition

CHANNELS = (0, 1)
STEP_MS = 4


class World:
    """Stimulator and log in one: everything that happens, in order; ``breaks`` names calls that fail from a time on."""

    def __init__(self) -> None:
        self.happened: list[tuple[str, Any]] = []
        self.breaks: dict[str, tuple[int, Exception]] = {}
        self.replies: dict[int, list[StimStatus | StimAlive]] = {}
        self.t_ns = 0

    def _note(self, what: str, value: Any, t_ns: int) -> None:
        self.t_ns = max(self.t_ns, t_ns)
        if what in self.breaks and self.t_ns >= self.breaks[what][0] * MS:
            raise self.breaks[what][1]
        self.happened.append((what, value))

    def send(self, command: StimCommand) -> WireFrame:
        self._note(f"send {command.channel}", command, command.t_ns)
        return WireFrame(command.t_ns, 0x120, bytes([command.channel, command.on]))

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        self._note("poll", t_ns, t_ns)
        return self.replies.pop(t_ns // MS, [])

    def event(self, event: Event) -> None:
        self._note("event", event, event.t_ns)

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        self._note("command", (command, frame), command.t_ns)

    def phase(self, change: PhaseChange) -> None:
        self._note("phase", change, change.t_ns)

    def stride(self, result: StrideResult) -> None:
        self._note("stride", result, result.t_end_ns)

    def note(self, note: Note) -> None:
        self._note("note", note, note.t_ns)

    def latency(self, t_ns: int, latency_ns: int) -> None:
        self._note("latency", (t_ns, latency_ns), t_ns)

    def sent(self, channel: int | None = None) -> list[StimCommand]:
        return [
            value
            for what, value in self.happened
            if what.startswith("send") and channel in (None, cast(StimCommand, value).channel)
        ]

    def notes(self) -> list[Note]:
        return [value for what, value in self.happened if what == "note"]


class OnController:
    """Asks for both channels on every 20 ms between 100 and 2000 ms; ``at`` may break or add outcomes."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.at: dict[int, Callable[[], Decision]] = {}
        self.channels = CHANNELS
        self._next_ms = 0

    def step(self, event: Event) -> Decision:
        assert self.world.happened[-1] == ("event", event), "an event must be logged before it is handled"
        ms = event.t_ns // MS
        if ms in self.at:
            return self.at.pop(ms)()
        if ms < self._next_ms:
            return Decision()
        self._next_ms = ms // 20 * 20 + 20
        on = 100 <= ms < 2000
        ramp_ma = min(20.0, 0.5 + 0.5 * ((ms - 100) // 5)) if on else 0.0
        on = on and ramp_ma > 0
        return Decision(tuple(StimRequest(channel, on, ramp_ma, 300.0 * on, 40.0 * on) for channel in self.channels))


class WatchedGate(SafetyGate):
    """The real gate, which must not see an event before the log has it."""

    world: World

    def observe(self, event: Event) -> None:
        assert self.world.happened[-1] == ("event", event), "an event must be logged before the gate sees it"
        super().observe(event)


class Bench:
    def __init__(self, world: World | None = None) -> None:
        self.world = world or World()
        self.asks = OnController(self.world)
        channel = load_session(SETTINGS).channels[0]
        channels = (channel, channel.model_copy(update={"number": 1, "name": "Second"}))
        self.gate = WatchedGate(channels, max_data_age_ms=40, validity_ms=60)
        self.gate.world = self.world
        self.clock_ns = 0
        self.runner = Runner(cast(Controller, self.asks), self.gate, self.world, self.world, self.clock)

    def clock(self) -> int:
        self.clock_ns += 1000
        return self.clock_ns

    def run(self, source: Iterable[Event] | None = None, after: Callable[[Event], None] = lambda event: None) -> None:
        self.runner.run(armed() if source is None else source, after)

    def all_is_off(self) -> bool:
        return all(not self.world.sent(channel)[-1].on for channel in CHANNELS)


def sample(ms: int) -> ImuSample:
    turns_radps = (
        1.0 if ms % 200 < 20 else 0.0
    )  # about the vertical: by jerks, or the gate would say that the foot rests
    living = 1e-4 * (ms % 97)
    return ImuSample(ms * MS, "right_foot", ms * MS, (living, 0.0, 9.81), (0.0, 0.0, turns_radps + living))


def armed(until_ms: int = 600, acts: Iterable[OperatorAct] = ()) -> Iterator[Event]:
    by_time = sorted([OperatorAct(20 * MS, OperatorAction.ARM), *acts], key=lambda act: act.t_ns)
    for ms in range(0, until_ms, STEP_MS):
        yield sample(ms)
        while by_time and by_time[0].t_ns <= ms * MS:
            yield by_time.pop(0)


def raiser(error: BaseException) -> Callable[[], Decision]:
    def fail() -> Decision:
        raise error

    return fail


def test_the_order_of_one_event() -> None:
    """Logged, decided, sent, logged as sent, answered; the answer is an event of its own, then ``after``."""
    bench = Bench()
    status = StimStatus(0, 0, 0, False, 0.0, 0.0, 0.0)
    bench.world.replies[0] = [status]
    change = PhaseChange(0, "right_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING)
    bench.asks.at[0] = lambda: Decision((StimRequest(0, False), StimRequest(1, False)), (change,))
    bench.run([sample(0)], lambda event: bench.world.happened.append(("after", event)))
    whats = [what for what, _ in bench.world.happened]
    both = ["send 0", "command", "send 1", "command"]
    # the answer is at the same time as the sample, and this controller asks again at once
    assert whats == ["event", *both, "phase", "latency", "poll", "event", *both, "after", *both]
    assert bench.world.happened[-len(both) - 1] == ("after", sample(0))


def test_every_event_is_logged_and_every_command_as_it_went_out() -> None:
    bench = Bench()
    bench.run()
    events = [value for what, value in bench.world.happened if what == "event"]
    assert events == list(armed())
    logged = [value for what, value in bench.world.happened if what == "command"]
    assert [command for command, _ in logged] == bench.world.sent()
    assert all(frame.data == bytes([command.channel, command.on]) for command, frame in logged)
    assert [command.on for command in bench.world.sent(0)].count(True) > 20
    assert bench.all_is_off()
    latencies = [value for what, value in bench.world.happened if what == "latency"]
    assert [t_ns for t_ns, _ in latencies] == [event.t_ns for event in events if isinstance(event, ImuSample)]
    assert {latency_ns for _, latency_ns in latencies} == {1000}
    assert not bench.gate.latched


def test_a_sensor_that_drives_no_channel_is_noted_once_however_often_it_fails() -> None:
    bench = Bench()
    bad = [sample(ms)._replace(sensor="left_shank", acc_mps2=(math.nan, 0.0, 0.0)) for ms in (1, 2, 3)]
    bench.run(bad)
    (note,) = bench.world.notes()
    assert (note.t_ns, note.severity, note.source) == (1 * MS, "warning", "gate")
    assert note.text == "non-finite sample from left_shank; left_shank drives no channel, stimulation goes on"


def breaks_controller(bench: Bench) -> Exception:
    error = RuntimeError("a guard disagrees")
    bench.asks.at[300] = raiser(error)
    return error


def breaks_log(bench: Bench) -> Exception:
    error = OSError("the disk is full")
    bench.world.breaks = dict.fromkeys(("event", "command", "note", "phase", "latency"), (300, error))
    return error


def breaks_command_log(bench: Bench) -> Exception:
    error = OSError("the disk is full")
    bench.world.breaks = {"command": (300, error), "note": (300, OSError("still full"))}
    return error


def breaks_poll(bench: Bench) -> Exception:
    error = StimulatorLost("bus-off")
    bench.world.breaks = {"poll": (300, error)}
    return error


@pytest.mark.requirement("SR-19")
@pytest.mark.parametrize("breaking", [breaks_controller, breaks_log, breaks_command_log, breaks_poll])
def test_whatever_breaks_every_channel_is_switched_off(breaking: Callable[[Bench], Exception]) -> None:
    bench = Bench()
    error = breaking(bench)
    with pytest.raises(type(error)) as caught:
        bench.run()
    assert caught.value is error
    assert bench.all_is_off()
    assert str(error) in bench.gate.latched
    assert not bench.gate.armed
    last_on = max(command.t_ns for command in bench.world.sent() if command.on)
    assert 280 * MS <= last_on <= 300 * MS


@pytest.mark.parametrize("error", [ValueError("in after"), KeyboardInterrupt(), SystemExit(3)])
def test_what_the_caller_raises_switches_off_too(error: BaseException) -> None:
    bench = Bench()

    def after(event: Event) -> None:
        if event.t_ns == 300 * MS:
            raise error

    with pytest.raises(type(error)):
        bench.run(after=after)
    assert bench.all_is_off()
    assert bench.gate.latched
    (note,) = bench.world.notes()
    interrupted = isinstance(error, KeyboardInterrupt)
    assert (note.severity, note.source) == ("info" if interrupted else "fault", "runner")
    assert note.text == "interrupted" if interrupted else type(error).__name__ in note.text
    whats = [what for what, _ in bench.world.happened]
    assert whats.index("note") > max(place for place, what in enumerate(whats) if what == "send 1"), "off, then words"


def test_a_source_that_breaks_switches_off() -> None:
    def source() -> Iterator[Event]:
        yield from armed(400)
        raise ConnectionError("the radio is gone")

    bench = Bench()
    with pytest.raises(ConnectionError):
        bench.run(source())
    assert bench.all_is_off()


def test_a_lost_stimulator_does_not_hide_the_first_error_and_every_channel_is_tried() -> None:
    bench = Bench()
    bench.asks.at[300] = raiser(RuntimeError("the first"))
    bench.world.breaks = {"send 0": (300, StimulatorLost("also gone"))}
    with pytest.raises(RuntimeError, match="the first"):
        bench.run()
    assert bench.world.sent(0)[-1].on  # nothing could be done about it; its lease ends it
    assert not bench.world.sent(1)[-1].on


def test_a_send_that_fails_at_the_first_command_is_followed_by_off() -> None:
    """What failed may have gone out all the same, so the channel counts as commanded."""
    sent: list[StimCommand] = []

    class Deaf(World):
        def send(self, command: StimCommand) -> WireFrame:
            sent.append(command)
            if len(sent) == 1:
                raise StimulatorLost("no answer")
            return super().send(command)

    bench = Bench(Deaf())
    with pytest.raises(StimulatorLost):
        bench.run()
    assert [(command.channel, command.on) for command in sent] == [(0, False), (0, False)]


def test_an_orderly_end_that_cannot_switch_off_is_an_error() -> None:
    bench = Bench()
    bench.world.breaks = {"send 1": (596, StimulatorLost("gone at the end"))}
    with pytest.raises(StimulatorLost, match="gone at the end"):
        bench.run()
    assert not bench.world.sent(0)[-1].on


@pytest.mark.parametrize(
    ("reply", "says"),
    [
        (StimStatus(0, 0, 3, False, 0.0, 0.0, 0.0, fault="electrode open"), "electrode open"),
        (StimStatus(0, 1, 3, True, 120.0, 300.0, 40.0), "stimulator delivers"),
        (StimAlive(0, 7, 0, "too hot"), "too hot"),
    ],
)
def test_a_fault_switches_both_channels_off_at_that_event(reply: StimStatus | StimAlive, says: str) -> None:
    bench = Bench()
    bench.world.replies[308] = [cast(Any, type(reply))(**{**_fields(reply), "t_ns": 308 * MS})]
    bench.run()
    assert says in bench.gate.latched
    for channel in CHANNELS:
        after = [command for command in bench.world.sent(channel) if command.t_ns >= 308 * MS]
        assert after[0].t_ns == 308 * MS
        assert not any(command.on for command in after)
    faults = [note for note in bench.world.notes() if note.severity == "fault"]
    assert len(faults) == 1
    assert says in faults[0].text


def _fields(value: Any) -> dict[str, Any]:
    return {name: getattr(value, name) for name in value.__dataclass_fields__}


@pytest.mark.requirement("SR-09")
def test_silence_switches_off_within_the_data_age() -> None:
    bench = Bench()
    ticks: list[Event] = [Tick(ms * MS) for ms in range(310, 600, 10)]
    bench.run([*armed(300), *ticks])
    on = [command.t_ns // MS for command in bench.world.sent(0) if command.on]
    assert on[-1] <= 296 + 40
    assert "ms old" in bench.gate.latched


@pytest.mark.requirement("SR-16")
def test_emergency_stop_is_off_at_once_and_stays() -> None:
    bench = Bench()
    bench.run(armed(600, [OperatorAct(312 * MS, OperatorAction.EMERGENCY_STOP)]))
    for channel in CHANNELS:
        assert next(command for command in bench.world.sent(channel) if command.t_ns >= 312 * MS).t_ns == 312 * MS
        assert not any(command.on for command in bench.world.sent(channel) if command.t_ns >= 312 * MS)


def test_a_refusal_is_noted_once_though_its_numbers_change() -> None:
    """Never armed: one note a channel, not one every 20 ms. Armed again after a fault: noted, and why it ended."""
    bench = Bench()
    bench.run(sample(ms) for ms in range(0, 600, STEP_MS))
    assert [note.text for note in bench.world.notes()] == [
        "channel 0 refused: not armed",
        "channel 1 refused: not armed",
    ]
    refused = [command for command in bench.world.sent(0) if command.refused]
    assert len(refused) > 20

    bench = Bench()
    acts = [OperatorAct(300 * MS, OperatorAction.DISARM), OperatorAct(324 * MS, OperatorAction.ARM)]
    bench.run(armed(600, acts))
    texts = [note.text for note in bench.world.notes()]
    assert len({command.refused for command in bench.world.sent(0)}) > 5  # "off for 0.02 s", "off for 0.04 s" …
    assert len(texts) <= 6, texts
    assert all(one != other for one, other in pairwise(texts))


def test_arming_again_after_a_fault_is_noted() -> None:
    bench = Bench()
    acts = [OperatorAct(300 * MS, OperatorAction.EMERGENCY_STOP), OperatorAct(400 * MS, OperatorAction.ARM)]
    bench.run(armed(600, acts))
    texts = [note.text for note in bench.world.notes() if note.severity != "warning"]
    assert texts == ["off until armed again: emergency stop", "armed again"]


def test_nothing_to_do_is_nothing_done() -> None:
    bench = Bench()
    bench.run([])
    assert bench.world.happened == []


@pytest.mark.parametrize("channels", [(0, 1), (1, 0)])
def test_a_request_that_latches_takes_back_those_let_out_before_it(channels: tuple[int, int]) -> None:
    """A device that delivers all with the last one's command would give the first one's pulse after the latch."""
    bench = Bench()
    bench.asks.channels = channels
    first, last = channels

    def one_good_one_bad() -> Decision:
        return Decision((StimRequest(first, True, 20.0, 300.0, 40.0), StimRequest(last, True, math.nan, 300.0, 40.0)))

    bench.asks.at[400] = one_good_one_bad
    bench.run()
    assert {c.channel for c in bench.world.sent() if c.on and c.t_ns < 400 * MS} == set(channels)
    then = [(c.channel, c.on) for c in bench.world.sent() if c.t_ns == 400 * MS]
    assert then == [(first, False), (last, False)] * 2
    assert "nan" in bench.gate.latched
    assert not any(c.on for c in bench.world.sent() if c.t_ns >= 400 * MS)


def test_all_off_goes_out_in_the_order_in_which_channels_are_commanded() -> None:
    """What was gathered for the last one's command is gone by the time that this one comes."""
    bench = Bench()
    bench.asks.channels = (1, 0)
    bench.world.breaks["command"] = (400, OSError("the log is full"))  # between the two channels of a step
    with pytest.raises(OSError, match="full"):
        bench.run()
    at_the_end = [(c.channel, c.on) for c in bench.world.sent() if c.t_ns >= 400 * MS]
    assert at_the_end == [(1, True), (1, False), (0, False)]
