"""Exchanged feet are named in a session's first strides, and refuse to arm; feet on their own sides say nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
from live_parts import MS, EverReadable, FakeStimulator, Lost, Raw, SameClock, SetClock, SocketImu
from test_live_operator import settings
from test_live_stalls import Written

from fes.analysis.pipeline import calibrations_of
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration, stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.live.commands import CommandKind, OperatorCommand, State
from fes.live.sensor_monitor import EXCHANGED, SideCheck
from fes.live.session import LiveSession
from fes.live.source import LiveSource, LiveStimulator, SensorStream
from fes.recording import Recording, Track, read_recording
from fes.recording.tracks import samples_of
from fes.signals import (
    FOOT_SENSORS,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimStatus,
    StrideResult,
    SystemFault,
)

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs"


def recording_of_two_feet() -> tuple[Recording, Mapping[str, Calibration]]:
    recording, found = calibrations_of(read_recording(TRIAL / "both_feet_100hz.parquet"))
    return recording, found.calibrations


def exchanged(tracks: Mapping[str, Track]) -> dict[str, Track]:
    left, right = (tracks[foot] for foot in FOOT_SENSORS)
    return {"left_foot": replace(right, sensor="left_foot"), "right_foot": replace(left, sensor="right_foot")}


def followed(
    recording: Recording, calibrations: Mapping[str, Calibration], check: SideCheck | None = None
) -> tuple[SideCheck, int]:
    """The check after a walk, and how many strides it had seen when it was done."""
    check, seen = check or SideCheck(calibrations), 0
    trackers = {}
    for foot, calibration in calibrations.items():
        assert isinstance(calibration, FootCalibration)
        trackers[foot] = FootTracker(calibration, StrideMaker(foot, stride_settings(calibration)))
    for event in samples_of(recording, set(calibrations)):
        check.add_event(event)
        assert isinstance(event, ImuSample)
        for outcome in trackers[event.sensor].step(event.t_sensor_ns, event.acc_mps2, event.gyr_radps):
            if isinstance(outcome, StrideResult) and not check.done:
                seen += 1
                check.add_stride(outcome)
    return check, seen


@pytest.mark.requirement("SR-21")
def test_exchanged_feet_are_told_in_the_first_strides_and_feet_on_their_own_sides_are_not() -> None:
    recording, calibrations = recording_of_two_feet()
    check, _ = followed(recording, calibrations)
    assert check.exchanged == ""
    assert check.read_events(7) == []
    check, seen = followed(replace(recording, tracks=exchanged(recording.tracks)), calibrations)
    assert check.exchanged == EXCHANGED
    assert seen <= 24
    assert check.read_events(7) == [SystemFault(7, EXCHANGED)]
    assert check.read_events(8) == [], "once; but it goes on speaking against arming"
    assert check.exchanged == EXCHANGED


@pytest.mark.requirement("SR-21")
@pytest.mark.parametrize("paused", [True, False])
def test_feet_exchanged_in_a_pause_or_a_gap_are_told_in_the_first_strides_after_it(paused: bool) -> None:
    recording, calibrations = recording_of_two_feet()
    check, _ = followed(recording, calibrations)
    end_ns = max(int(track.t_ns[-1]) for track in recording.tracks.values())
    assert check.done
    if paused:
        check.add_event(OperatorAct(end_ns, OperatorAction.DISARM))
        assert check.done, "nothing is stimulated yet"
        check.add_event(OperatorAct(end_ns, OperatorAction.ARM))
    else:
        check.add_event(ImuSample(end_ns + 1_010_000_000, "left_foot", end_ns, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)))
    assert not check.done
    later = {
        foot: replace(track, t_ns=track.t_ns + 2 * end_ns, t_sensor_ns=track.t_sensor_ns + 2 * end_ns)
        for foot, track in exchanged(recording.tracks).items()
    }
    check, seen = followed(replace(recording, tracks=later), calibrations, check)
    assert check.exchanged == EXCHANGED
    assert seen <= 24
    check.add_event(OperatorAct(3 * end_ns, OperatorAction.ARM))
    assert check.exchanged == EXCHANGED, "no arming takes it back"


def test_one_foot_alone_is_never_told() -> None:
    recording, calibrations = recording_of_two_feet()
    check, _ = followed(
        replace(recording, tracks={"left_foot": recording.tracks["left_foot"]}),
        {"left_foot": calibrations["left_foot"]},
    )
    assert check.done
    assert check.exchanged == ""
    assert check.fileno() is None


class WalkedAgain(EverReadable):
    """A line that brings a recording; each reading moves the clock on to its next moment."""

    def __init__(self, tracks: Mapping[str, Track], clock: SetClock) -> None:
        super().__init__(*tracks)
        self._clock, self._begin_ns = clock, clock.now_ns
        self._moments = zip(*(rows_of(track) for track in tracks.values()), strict=True)

    def samples(self, t_ns: int) -> list[Raw]:
        moment = next(self._moments, None)
        if moment is None:
            return []
        self._clock.now_ns = max(self._clock.now_ns, self._begin_ns + moment[0].t_host_ns)
        return [replace(raw, t_host_ns=t_ns, t_device_ns=self._begin_ns + raw.t_device_ns) for raw in moment]


def rows_of(track: Track) -> list[Raw]:
    rows = zip(track.t_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist(), strict=True)
    return [Raw(track.sensor, t_ns, t_ns, tuple(acc), tuple(gyr)) for t_ns, acc, gyr in rows]


class Answering(FakeStimulator):
    """Says that it is alive whenever it is asked."""

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        return [StimAlive(t_ns, 1, 0)]


@pytest.mark.parametrize("is_exchanged", [True, False])
def test_a_session_in_which_the_feet_are_exchanged_latches_and_cannot_be_armed(
    tmp_path: Path, is_exchanged: bool
) -> None:
    recording, calibrations = recording_of_two_feet()
    one = settings()
    worn = one.model_copy(
        update={"sensors": tuple(one.sensors[0].model_copy(update={"sensor": foot}) for foot in FOOT_SENSORS)}
    )
    clock = SetClock(step_ns=1_000)
    stimulator = LiveStimulator(Answering(), Lost, clock)
    log = Written(tmp_path / "session.feslog", {})
    walked = WalkedAgain(exchanged(recording.tracks) if is_exchanged else recording.tracks, clock)
    line = SensorStream(walked, SameClock, Lost, frozenset(FOOT_SENSORS))
    live = LiveSession(worn, dict(calibrations), log, stimulator, clock, duration_s=64.5)
    live.run([line], [], [], [], lambda: None)
    assert live.gate.latched == (EXCHANGED if is_exchanged else "")
    assert live.operator.state is (State.FAULT if is_exchanged else State.SHADOW)
    events = live.operator.execute(OperatorCommand(CommandKind.ARM, origin="key"), clock.now_ns)  # it stands again
    acts = [event.action for event in events if isinstance(event, OperatorAct)]
    if is_exchanged:
        assert acts == []
        assert live.operator.message == f"cannot arm: {EXCHANGED}"
    else:
        assert OperatorAction.ARM in acts
    log.close(live.summary())
    line.close()


# --- A sample is never dated before its arrival ---


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
