"""Whatever happens and whatever is asked for, nothing beyond a limit leaves the gate.

An oracle that shares no code with the gate reads the same events and the commands that came out, and checks the rules
anew, from the words of the settings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from examples import examples
from hypothesis import event as note
from hypothesis import given, settings
from hypothesis import strategies as st

from fes.config import Channel, ImuDevice
from fes.gate import SafetyGate
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimRequest,
    StimStatus,
    Tick,
)

MS = 1_000_000
AGE_MS, VALIDITY_MS = 40, 60


def make_channel(number: int, foot: str, never_with: tuple[int, ...], **limits: float) -> Channel:
    own = {
        "max_current_ma": 30.0,
        "max_pulse_width_us": 400.0,
        "max_frequency_hz": 50.0,
        "max_charge_per_phase_uc": 9.0,
        "max_charge_per_minute_mc": 6.0,
        "max_current_density_ma_per_cm2": 0.3,
        "max_rise_ma_per_s": 500.0,
        "max_on_s": 0.3,
        "min_off_s": 0.1,
    } | limits
    return Channel.model_validate(
        {
            "name": f"channel {number}",
            "number": number,
            "foot": foot,
            "electrode_area_cm2": 20.0,
            "current_ma": 20.0,
            "pulse_width_us": 300.0,
            "frequency_hz": 40.0,
            "never_with": list(never_with),
            "limits": own,
        }
    )


CHANNELS = (
    make_channel(0, "left_foot", (1,)),
    make_channel(1, "left_foot", ()),
    make_channel(2, "right_foot", (), max_on_s=3.0, max_rise_ma_per_s=2000.0, max_charge_per_minute_mc=0.1),
)
DEVICES = (ImuDevice(sensor="left_foot", device="xbus", port="tty", rate_hz=100, acc_range_g=4, gyr_range_dps=1000),)
UP = {"left_foot": (0.0, 0.0, 1.0)}
DRIVEN_BY = {"right_foot": "right_shank"}  # the right foot's phases are told by its shank
SENSORS = ("left_foot", "right_foot", "right_shank")
RELIED_ON = ("left_foot", "right_shank")  # what happens to another sensor stops nobody
LASTING_NS = 80 * MS
DRIFT_PPM = 200
ACC_END, GYR_END = 0.995 * 4 * 9.80665, 0.995 * math.radians(1000)


def grown(samples: list[ImuSample], wrong: Callable[[ImuSample], bool]) -> int:
    """For how long, up to the newest, all samples have been wrong (ns); -1 if the newest is not."""
    began_ns = -1
    for sample in reversed(samples):
        if not wrong(sample):
            break
        began_ns = sample.t_ns
    return samples[-1].t_ns - began_ns if began_ns >= 0 else -1


def force(sample: ImuSample) -> float:
    return math.hypot(*sample.acc_mps2)


def rests_turned_over(sample: ImuSample) -> bool:
    """At rest, and more than 65° from the calibrated vertical, which is the sensor's z."""
    rests = abs(force(sample) - 9.80665) <= 1.5 and max(map(abs, sample.gyr_radps)) <= 0.5
    return rests and sample.acc_mps2[2] < force(sample) * math.cos(math.radians(65))


def at_its_end(sample: ImuSample) -> bool:
    return max(map(abs, sample.acc_mps2)) >= ACC_END or max(map(abs, sample.gyr_radps)) >= GYR_END


def impossible(samples: list[ImuSample]) -> bool:
    """What the newest sample, with those before it, must latch."""
    newest = samples[-1]
    if max(map(abs, newest.gyr_radps)) > 40.0:
        return True
    lasting: list[Callable[[ImuSample], bool]] = [
        lambda s: force(s) < 2.5,
        lambda s: force(s) > 80.0,
        lambda s: (s.acc_mps2, s.gyr_radps) == (newest.acc_mps2, newest.gyr_radps),
    ]
    if newest.sensor == "left_foot":
        lasting.append(at_its_end)
    if any(grown(samples, wrong) >= LASTING_NS for wrong in lasting):
        return True
    steps = [(b.t_ns, b.t_sensor_ns - a.t_sensor_ns) for a, b in pairwise(samples)]
    recent = [step_ns for t_ns, step_ns in steps if newest.t_ns - t_ns <= 1_000 * MS]
    slips = sum(step_ns <= 0 for step_ns in recent)
    return slips >= 3 and slips > 0.05 * len(recent)


class Oracle:
    """Checks every command that came out against all that went before."""

    def __init__(self) -> None:
        self.armed = False
        self.trouble = False
        self.boot_id: int | None = None
        self.t_ns = -1
        self.arrived: dict[str, int] = {}
        self.sent: dict[str, int] = {}
        self.prompt: dict[str, int] = {}
        self.finite: dict[str, bool] = {}
        self.passed: dict[int, list[tuple[int, bool, float]]] = {channel.number: [] for channel in CHANNELS}
        self.samples: dict[str, list[ImuSample]] = {}
        self.charged: dict[int, list[tuple[int, float]]] = {channel.number: [] for channel in CHANNELS}
        self.stimulated = 0

    def see(self, event: Event) -> None:
        backward = event.t_ns < self.t_ns
        self.t_ns = event.t_ns
        match event:
            case ImuSample():
                ok = not any(math.isnan(v) or math.isinf(v) for v in event.acc_mps2 + event.gyr_radps)
                self.finite[event.sensor] = ok
                self.trouble |= not ok and event.sensor in RELIED_ON
                heard = self.samples.setdefault(event.sensor, [])
                heard.append(event)
                self.trouble |= impossible(heard) and event.sensor in RELIED_ON
                del heard[:-400]
                self.arrived[event.sensor] = event.t_ns
                self.sent[event.sensor] = max(event.t_sensor_ns, self.sent.get(event.sensor, -1 << 60))
                if event.t_sensor_ns == event.t_ns:
                    self.prompt[event.sensor] = event.t_ns
            case OperatorAct(action=OperatorAction.ARM):
                self.armed = self.fresh("left_foot", event.t_ns) and self.fresh("right_foot", event.t_ns)
                self.trouble &= not self.armed
            case OperatorAct(action=OperatorAction.DISARM):
                self.armed = False
            case OperatorAct(action=OperatorAction.EMERGENCY_STOP):
                self.trouble = True
            case StimStatus():
                self.trouble |= bool(event.fault)
            case StimAlive():
                self.trouble |= bool(event.fault) or self.boot_id not in (None, event.boot_id)
                self.boot_id = event.boot_id
        self.trouble |= backward

    def fresh(self, foot: str, t_ns: int) -> bool:
        """In these trials the sensors' clocks agree with the host's, so a stamp's age is the data's age.

        The gate cannot know that: since the last sample that came without delay, the clocks may have gone apart by as
        much as two crystals do, 12 ms in the minute of silence that a trial may hold.
        """
        foot = DRIVEN_BY.get(foot, foot)
        if not self.finite.get(foot, False):
            return False
        if foot in UP and grown(self.samples[foot], rests_turned_over) >= LASTING_NS:
            return False
        apart_ns = DRIFT_PPM * (t_ns - self.prompt.get(foot, t_ns)) // 1_000_000
        return t_ns - self.arrived[foot] <= AGE_MS * MS and t_ns - self.sent[foot] <= AGE_MS * MS + apart_ns

    def check(self, t_ns: int, request: StimRequest, command: StimCommand) -> None:
        assert command.t_ns == t_ns
        assert 0 < command.validity_ms <= VALIDITY_MS
        assert command.on == (request.on is True and command.refused == "")
        if not command.on:
            assert (command.current_ma, command.pulse_width_us, command.frequency_hz) == (0.0, 0.0, 0.0)
            if command.channel in self.passed:
                self.passed[command.channel].append((t_ns, False, 0.0))
                self.charged[command.channel].append((t_ns, 0.0))
            return
        self.stimulated += 1
        channel = CHANNELS[command.channel]
        assert command.channel == request.channel
        assert self.armed
        assert not self.trouble
        assert self.fresh(channel.foot, t_ns)
        self.check_pulse(channel, command)
        self.check_history(channel, t_ns, command.current_ma)
        self.check_charge(channel, t_ns)
        self.passed[channel.number].append((t_ns, True, command.current_ma))
        rate_uc_per_s = command.current_ma * command.pulse_width_us * command.frequency_hz / 1000
        self.charged[channel.number].append((t_ns, rate_uc_per_s))

    def check_charge(self, channel: Channel, t_ns: int) -> None:
        """Each command counts until the next, or until its validity ends; only the last minute counts."""
        times = self.charged[channel.number]
        ends = [then_ns for then_ns, _ in times[1:]] + [t_ns]
        spent_uc = 0.0
        for (then_ns, rate_uc_per_s), next_ns in zip(times, ends, strict=False):
            begin_ns = max(then_ns, t_ns - 60_000 * MS)
            spent_uc += rate_uc_per_s * max(min(next_ns, then_ns + VALIDITY_MS * MS) - begin_ns, 0) / 1e9
        assert spent_uc < channel.limits.max_charge_per_minute_mc * 1000 + 1e-6

    def check_pulse(self, channel: Channel, c: StimCommand) -> None:
        own = channel.limits
        assert 0 < c.current_ma <= own.max_current_ma
        assert 0 < c.pulse_width_us <= own.max_pulse_width_us
        assert 0 < c.frequency_hz <= own.max_frequency_hz
        assert c.current_ma * c.pulse_width_us / 1000 <= own.max_charge_per_phase_uc + 1e-9
        rms_ma = math.sqrt(c.current_ma**2 * 2 * c.pulse_width_us * c.frequency_hz * 1e-6)
        assert rms_ma <= own.max_current_density_ma_per_cm2 * channel.electrode_area_cm2 + 1e-9

    def check_history(self, channel: Channel, t_ns: int, current_ma: float) -> None:
        past = self.passed[channel.number]
        own = channel.limits
        # from any earlier current, or from nothing, never steeper than the limit plus one device step
        for then_ns, on, then_ma in past[-30:]:
            allowed_ma = own.max_rise_ma_per_s * (t_ns - then_ns) / 1e9 + 0.5
            assert current_ma - (then_ma if on else 0.0) <= allowed_ma + 1e-5
        # the burst that this command belongs to, with the device's own end of a command that was not renewed
        began_ns, ended_ns, held_ns = t_ns, None, t_ns
        for then_ns, on, _ in reversed(past):
            if not on:
                ended_ns = then_ns
            elif held_ns - then_ns > VALIDITY_MS * MS and ended_ns is None:
                ended_ns = then_ns + VALIDITY_MS * MS
            if on and ended_ns is not None:
                ended_ns = min(ended_ns, then_ns + VALIDITY_MS * MS)
                assert began_ns - ended_ns >= own.min_off_s * 1e9
                break
            if on:
                began_ns = held_ns = then_ns
        assert t_ns - began_ns <= own.max_on_s * 1e9
        if began_ns == t_ns and past and past[-1][0] < t_ns:
            assert current_ma <= 0.5, "a burst begins with one step at most"
        for other in CHANNELS:
            if other.number in channel.never_with or channel.number in other.never_with:
                last = self.passed[other.number][-1:]
                assert not any(on and t_ns - then_ns <= VALIDITY_MS * MS for then_ns, on, _ in last)


class Trial:
    """Gate and oracle on one clock."""

    def __init__(self) -> None:
        self.gate = SafetyGate(
            CHANNELS,
            max_data_age_ms=AGE_MS,
            validity_ms=VALIDITY_MS,
            devices=DEVICES,
            up=UP,
            shank_phase_sensors=DRIVEN_BY,
        )
        self.oracle = Oracle()
        self.t_ns = 0
        self.turned_ns: dict[str, int] = {}

    def observe(self, event: Event) -> None:
        self.gate.observe(event)
        self.oracle.see(event)

    def feed(self, late_ms: int = 0, value: float = 9.8, feet: tuple[str, ...] = SENSORS) -> None:
        for foot in feet:
            alive = 1e-9 * (self.t_ns % 1_000_003)  # no living sensor repeats itself
            # by jerks about the vertical, or the gate would say that the foot rests
            turns_radps = 0.0 if self.t_ns - self.turned_ns.get(foot, -NS_PER_S) < 150 * MS else 1.0
            self.turned_ns[foot] = self.t_ns if turns_radps else self.turned_ns[foot]
            gyr = (0.0, 0.0, turns_radps + alive)
            self.observe(ImuSample(self.t_ns, foot, self.t_ns - late_ms * MS, (alive, 0.0, value), gyr))

    def odd(self, kind: str, sensor: str, steps: int, period_ms: int, number: int) -> None:
        """One sensor goes wrong while the others are well; a channel is asked for all the while."""
        before_ns = self.t_ns
        for _ in range(steps):
            self.t_ns += period_ms * MS
            self.feed(feet=tuple(name for name in SENSORS if name != sensor))
            alive = 1e-9 * (self.t_ns % 1_000_003)
            acc, gyr, sent_ns = ODD[kind]
            gyr = (gyr, 0.0, 0.0 if kind == "frozen" else alive)
            stamp_ns = before_ns if sent_ns == "doubled" else self.t_ns
            self.observe(ImuSample(self.t_ns, sensor, stamp_ns, (gyr[2], 0.0, acc), gyr))
            self.judge(StimRequest(number, True, 0.5, 300.0, 40.0))

    def judge(self, request: StimRequest) -> StimCommand:
        command = self.gate.judge(self.t_ns, request)
        self.oracle.check(self.t_ns, request, command)
        if self.gate.latched:
            assert not command.on
            assert not self.gate.armed
        if command.on:
            assert self.gate.armed
        return command

    def arm(self) -> None:
        self.feed()
        self.observe(OperatorAct(self.t_ns, OperatorAction.ARM))

    def stretch(self, number: int, steps: int, current_ma: float, ramp_ma: float, fed: bool, period_ms: int) -> None:
        """A plain burst: a ramp to a plateau, command after command."""
        for step in range(steps):
            self.t_ns += period_ms * MS
            if fed:
                self.feed()
            self.judge(StimRequest(number, True, min(current_ma, 0.5 + ramp_ma * step), 300.0, 40.0))


ODD = {
    "weak": (1.0, 0.0, ""),
    "strong": (80.1, 0.0, ""),
    "at its end": (39.1, 0.0, ""),
    "fast": (9.8, 40.1, ""),
    "turned over": (-9.8, 0.0, ""),
    "frozen": (9.8, 0.0, ""),
    "doubled": (9.8, 0.0, "doubled"),
    "well": (9.8, 0.0, ""),
}

weird = st.sampled_from([math.nan, math.inf, -1.0, 0.0, 1e300, 10**400, True, None, "3"])
near = {
    "current_ma": st.floats(0.1, 32.0) | st.floats(0.1, 5.0),
    "pulse_width_us": st.floats(1.0, 450.0),
    "frequency_hz": st.floats(1.0, 60.0),
}
fitting = st.builds(StimRequest, st.integers(0, 2), st.just(True), st.floats(0.1, 10.0), st.just(300.0), st.just(40.0))
offs = st.builds(StimRequest, st.integers(0, 2), st.just(False))
nears = st.builds(StimRequest, st.integers(0, 2), st.just(True), **near)
wild = st.builds(
    StimRequest,
    st.integers(-1, 9) | weird,
    st.booleans() | st.sampled_from([1, None]),
    **{name: strategy | weird for name, strategy in near.items()},
)

operations: st.SearchStrategy[tuple[Any, ...]] = st.one_of(
    st.tuples(st.just("wait"), st.sampled_from([0, 1, 5, 20, 20, 20, 39, 45, 61, 110, 30_000, 61_000])),
    st.tuples(
        st.just("odd"),
        st.sampled_from(sorted(ODD)),
        st.sampled_from(SENSORS),
        st.integers(1, 15),
        st.sampled_from([2, 5, 10, 20]),
        st.integers(0, 2),
    ),
    st.tuples(st.just("feed"), st.sampled_from([0, 0, 0, 0, 5, 39, 50])),
    st.tuples(st.just("arm")),
    st.tuples(st.just("judge"), fitting | offs),
    st.tuples(st.just("judge"), nears),
    st.tuples(st.just("judge"), wild),
    st.tuples(
        st.just("stretch"),
        st.integers(0, 2),
        st.integers(1, 25),
        st.sampled_from([0.5, 5.0, 20.0, 29.0]),
        st.sampled_from([0.0, 1.0, 9.0, 11.0]),
        st.sampled_from([True, True, True, False]),
        st.sampled_from([1, 10, 20, 35]),
    ),
    st.tuples(
        st.just("event"),
        st.sampled_from(["tick", "disarm", "stop", "half", "nan", "fault", "alive", "alive fault", "restart", "past"]),
    ),
)


def play(trial: Trial, operation: tuple[Any, ...]) -> None:
    match operation:
        case ("wait", ms):
            trial.t_ns += ms * MS
        case ("feed", late_ms):
            trial.feed(late_ms)
        case ("arm",):
            trial.arm()
        case ("judge", request):
            trial.judge(request)
        case ("odd", *details):
            trial.odd(*details)
        case ("stretch", *details):
            trial.stretch(*details)
        case ("event", kind):
            happen(trial, kind)


def happen(trial: Trial, kind: str) -> None:
    t_ns = trial.t_ns
    if kind == "nan":
        trial.feed(value=math.nan)
        return
    if kind == "half":
        trial.feed(feet=("right_foot",))
        return
    events: dict[str, Event] = {
        "tick": Tick(t_ns),
        "disarm": OperatorAct(t_ns, OperatorAction.DISARM),
        "stop": OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP),
        "fault": StimStatus(t_ns, 1, 0, False, 0.0, 0.0, 0.0, fault="electrode"),
        "alive": StimAlive(t_ns, 7, 0),
        "alive fault": StimAlive(t_ns, 7, 0, "voltage"),
        "restart": StimAlive(t_ns, 8, 0),
        "past": Tick(t_ns - 1),
    }
    trial.observe(events[kind])


@pytest.mark.requirement("SR-01", "SR-04", "SR-05", "SR-06", "SR-07", "SR-08", "SR-09", "SR-10", "SR-11")
@given(st.lists(operations, max_size=40))
@settings(max_examples=examples(300, 60_000), deadline=None)
def test_nothing_beyond_a_limit_leaves_the_gate(script: list[tuple[Any, ...]]) -> None:
    trial = Trial()
    trial.arm()
    for operation in script:
        play(trial, operation)
    note("stimulated" if trial.oracle.stimulated else "silent")


@pytest.mark.requirement("SR-05", "SR-06", "SR-07")
@given(st.lists(st.tuples(st.integers(0, 25), st.integers(0, 2), st.floats(0.1, 30.0) | st.none()), max_size=80))
@settings(max_examples=examples(150, 45_000), deadline=None)
def test_with_good_data_the_times_and_slopes_hold(script: list[tuple[int, int, float | None]]) -> None:
    """A person who arms again after every fault, so that long histories of bursts come about."""
    trial = Trial()
    for ms, number, current_ma in script:
        trial.t_ns += ms * MS
        trial.feed()
        if not trial.gate.armed:
            trial.arm()
        on = current_ma is not None
        trial.judge(StimRequest(number, on, current_ma or 0.0, 300.0, 40.0) if on else StimRequest(number, False))
    note("stimulated" if trial.oracle.stimulated else "silent")


def test_trials_do_stimulate() -> None:
    """The property would hold of a gate that lets nothing through; this one does."""
    trial = Trial()
    trial.arm()
    trial.stretch(0, 14, 20.0, 9.0, True, 20)
    assert trial.oracle.stimulated == 14
    trial.judge(StimRequest(0, False))
    trial.t_ns += 100 * MS
    trial.feed()
    trial.stretch(1, 10, 20.0, 9.0, True, 20)
    assert trial.oracle.stimulated == 24
    assert trial.gate.armed


@pytest.mark.parametrize("broken", ["current_ma", "rise", "on", "off", "partner", "stale", "disarmed"])
def test_oracle_objects_to_a_gate_that_lets_everything_through(broken: str) -> None:
    """The oracle itself is tested: each rule that is broken is noticed."""
    trial = Trial()
    trial.arm()
    oracle = trial.oracle

    def out(number: int = 0, current_ma: float = 0.5) -> None:
        request = StimRequest(number, True, current_ma, 300.0, 40.0)
        command = StimCommand(trial.t_ns, number, True, current_ma, 300.0, 40.0, VALIDITY_MS)
        oracle.check(trial.t_ns, request, command)

    def off() -> None:
        command = StimCommand(trial.t_ns, 0, False, 0.0, 0.0, 0.0, VALIDITY_MS)
        oracle.check(trial.t_ns, StimRequest(0, False), command)

    out()
    if broken == "current_ma":
        with pytest.raises(AssertionError):
            out(current_ma=31.0)
        return
    if broken == "on":
        for _ in range(15):
            trial.t_ns += 20 * MS
            trial.feed()
            out()
    elif broken == "off":
        off()
    elif broken == "disarmed":
        happen(trial, "disarm")
    if broken != "partner":
        trial.t_ns += 41 * MS
    if broken != "stale":
        trial.feed()
    with pytest.raises(AssertionError):
        out(number=1 if broken == "partner" else 0, current_ma=25.0 if broken == "rise" else 0.5)


def seen(trial: Trial, kind: str, sensor: str) -> None:
    """What the oracle alone sees of a sensor that goes wrong for 130 ms."""
    for k in range(14):
        trial.t_ns += 10 * MS
        for name in SENSORS:
            acc, gyr, sent = ODD[kind if name == sensor else "well"]
            alive = 0.0 if (kind, name) == ("frozen", sensor) else 1e-9 * (k + 1)
            stamp_ns = 0 if sent else trial.t_ns
            trial.oracle.see(ImuSample(trial.t_ns, name, stamp_ns, (0.0, 0.0, acc), (gyr, 0.0, alive)))


def passed_on(trial: Trial, number: int) -> None:
    command = StimCommand(trial.t_ns, number, True, 0.5, 300.0, 40.0, VALIDITY_MS)
    trial.oracle.check(trial.t_ns, StimRequest(number, True, 0.5, 300.0, 40.0), command)


@pytest.mark.parametrize("kind", sorted(ODD))
def test_oracle_objects_to_stimulating_on_data_that_cannot_be(kind: str) -> None:
    trial = Trial()
    trial.arm()
    seen(trial, kind, "left_foot")
    if kind == "well":
        passed_on(trial, 0)
        return
    with pytest.raises(AssertionError):
        passed_on(trial, 0)


def test_oracle_looks_at_the_sensor_that_drives() -> None:
    trial = Trial()
    trial.arm()
    trial.t_ns += 50 * MS
    trial.feed(feet=("left_foot", "right_foot"))
    with pytest.raises(AssertionError):
        passed_on(trial, 2)


def test_oracle_objects_to_more_than_a_minutes_charge() -> None:
    """10 mA, 300 µs, 40 Hz are 120 µC/s, and channel 2 may have 100 µC a minute."""
    trial = Trial()
    trial.arm()
    request = StimRequest(2, True, 10.0, 300.0, 40.0)
    command = StimCommand(0, 2, True, 10.0, 300.0, 40.0, VALIDITY_MS)
    for k in range(43):
        trial.t_ns += 20 * MS
        trial.feed()
        if k == 42:
            with pytest.raises(AssertionError):
                trial.oracle.check(trial.t_ns, request, replace(command, t_ns=trial.t_ns))
            break
        trial.oracle.check(trial.t_ns, request, replace(command, t_ns=trial.t_ns))
