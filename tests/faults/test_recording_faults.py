"""What goes wrong with the data on the way, through a whole replay: gaps, doubled samples, a sensor that freezes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from replays import MS, SETTINGS, bursts, cut, edit, keep, replay, trial, write_cut

from drivers.stimulator.can_port import ByteSink
from fes.calibration.recording import calibrate_phase_sensors
from fes.cli.common import Problem
from fes.config import load_session
from fes.control.controller import Controller
from fes.control.runner import Runner, armed_after, with_ticks
from fes.evaluation.log_comparison import ReplayOutput
from fes.gate import SafetyGate
from fes.recording import Recording, RecordingError, Track, read_recording, write_recording
from fes.recording.tracks import samples_of
from fes.session_log import SessionRecord
from fes.signals import NS_PER_S


@pytest.fixture(scope="module")
def walking() -> Recording:
    return cut(trial("negard_patient2"), 0.0, 22.0)


def looped(walking: Recording, spoiled: Recording) -> ReplayOutput:
    """What the loop makes of samples that went bad after calibration."""
    settings = load_session(SETTINGS)
    gate = SafetyGate(settings.channels, max_data_age_ms=40, validity_ms=60)
    out = ReplayOutput()
    runner = Runner(
        Controller(settings, calibrate_phase_sensors(walking).calibrations), gate, ByteSink(1), out, lambda: 0
    )
    runner.run(armed_after(with_ticks(samples_of(spoiled, {"right_foot"})), 0.5, 1.0), lambda event: None)
    return out


@pytest.fixture(scope="module")
def sound(walking: Recording, tmp_path_factory: pytest.TempPathFactory) -> SessionRecord:
    return replayed(walking, tmp_path_factory.mktemp("sound"))


def replayed(recording: Recording, folder: Path, rearm_after_s: float | None = None) -> SessionRecord:
    path = folder / "spoiled.parquet"
    write_recording(recording, path)
    return replay(path, folder, rearm_after_s=rearm_after_s)


def mid_swing_ns(record: SessionRecord, burst: int) -> int:
    begin = bursts(record.commands)[burst]
    swing_ns = next(
        change.t_ns for change in record.phases if change.destination.name == "SWING" and change.t_ns > begin.t_on_ns
    )
    return swing_ns + 100 * MS


def hole(begin_ns: int, length_ms: int) -> Callable[[Track], Track]:
    """Nothing came for a while."""
    return lambda track: keep(track, (track.t_ns <= begin_ns) | (track.t_ns > begin_ns + length_ms * MS))


@pytest.mark.requirement("SR-01", "SR-09")
def test_a_hole_of_60_ms_in_mid_swing_is_off_until_somebody_arms(
    walking: Recording, sound: SessionRecord, tmp_path: Path
) -> None:
    hole_ns = mid_swing_ns(sound, 1)
    record = replayed(edit(walking, hole(hole_ns, 60)), tmp_path)
    found = bursts(record.commands)
    assert len(bursts(sound.commands)) >= 5
    assert len(found) == 2
    assert hole_ns in walking.tracks["right_foot"].t_ns
    assert found[1].t_off_ns == hole_ns + 50 * MS  # the first tick at which the data are older than 40 ms
    refused = next(command for command in record.commands if command.refused and command.t_ns >= hole_ns)
    assert refused.refused.startswith("right_foot data ")
    assert "old, limit 40 ms" in refused.refused
    assert [note.text for note in record.notes if note.severity == "fault"] == [
        f"off until armed again: {refused.refused}"
    ]
    assert record.complete


def test_with_rearm_after_walking_is_stimulated_again_once_it_is_seen(
    walking: Recording, sound: SessionRecord, tmp_path: Path
) -> None:
    hole_ns = mid_swing_ns(sound, 1)
    record = replayed(edit(walking, hole(hole_ns, 60)), tmp_path, rearm_after_s=0.2)
    before, after = bursts(sound.commands), bursts(record.commands)
    # armed again in the same swing: what is left of it stays silent; then a whole stride must show walking again
    assert after[1].t_off_ns < before[1].t_off_ns
    others = before[:1] + before[3:]  # calibrated with the hole, a guard may fire a sample or two elsewhere
    assert len(after) == len(before) - 1
    for burst, whole in zip(after[:1] + after[2:], others, strict=True):
        assert abs(burst.t_on_ns - whole.t_on_ns) <= 10 * MS
        assert abs(burst.t_off_ns - whole.t_off_ns) <= 10 * MS
    assert "armed again" in [note.text for note in record.notes]


def test_a_hole_of_30_ms_is_bridged(walking: Recording, sound: SessionRecord, tmp_path: Path) -> None:
    hole_ns = mid_swing_ns(sound, 1)
    record = replayed(edit(walking, hole(hole_ns, 30)), tmp_path)
    for with_hole, whole in zip(bursts(record.commands)[:2], bursts(sound.commands)[:2], strict=True):
        assert (with_hole.t_on_ns, with_hole.peak_ma) == (whole.t_on_ns, whole.peak_ma)
        assert (
            abs(with_hole.t_off_ns - whole.t_off_ns) <= 10 * MS
        )  # what turned in the hole is known from its ends alone
    end_ns = walking.tracks["right_foot"].t_ns[-1]
    assert not [note for note in record.notes if note.severity == "fault" and note.t_ns <= end_ns]


def doubled(recording: Recording, every: int) -> Recording:
    return edit(
        recording,
        lambda track: keep(
            track, np.sort(np.concatenate([np.arange(track.t_ns.size), np.arange(100, track.t_ns.size, every)]))
        ),
    )


@pytest.mark.requirement("SR-10")
def test_more_than_one_doubled_sample_in_twenty_latches(walking: Recording, tmp_path: Path) -> None:
    record = replayed(doubled(walking, 7), tmp_path)
    assert not bursts(record.commands)
    assert any("time stamps are out of order" in note.text for note in record.notes)


def test_fewer_doubled_samples_change_nothing(walking: Recording, sound: SessionRecord, tmp_path: Path) -> None:
    record = replayed(doubled(walking, 40), tmp_path)
    assert bursts(record.commands) == bursts(sound.commands)
    assert record.phases == sound.phases
    count = len(range(100, walking.tracks["right_foot"].t_ns.size, 40))
    assert record.summary["samples"]["right_foot"]["doubled_or_backward"] == count


@pytest.mark.requirement("SR-10")
def test_a_sensor_that_freezes_in_mid_swing_is_off_within_a_tenth_of_a_second(
    walking: Recording, sound: SessionRecord, tmp_path: Path
) -> None:
    """The same sample over and over, stamped anew: fresh by the clock, so no data age shows it.

    The foot then seems to swing for ever. The gate notices that nothing moves, not even the noise, and latches.
    """
    freeze_ns = mid_swing_ns(sound, 3)

    def frozen(track: Track) -> Track:
        acc, gyr = track.acc_mps2.copy(), track.gyr_radps.copy()
        later = track.t_ns > freeze_ns
        row = int(np.flatnonzero(~later)[-1])
        acc[later], gyr[later] = acc[row], gyr[row]
        return replace(track, acc_mps2=acc, gyr_radps=gyr)

    with pytest.raises(Problem, match="at rest the accelerometer reads"):
        replayed(edit(walking, frozen), tmp_path)  # as a recording it is refused already; so straight into the loop
    found = bursts(looped(walking, edit(walking, frozen)).commands)
    assert found[:3] == bursts(sound.commands)[:3]
    assert len(found) == 4
    assert 0 < found[3].t_off_ns - freeze_ns <= NS_PER_S // 10


def test_late_samples_are_old_by_the_sensors_own_clock(
    walking: Recording, sound: SessionRecord, tmp_path: Path
) -> None:
    """A queue that is drained late: samples come, but 80 ms after they were taken."""
    late_from_ns = mid_swing_ns(sound, 1)

    def late(track: Track) -> Track:
        return replace(track, t_ns=track.t_ns + 80 * MS * (track.t_ns > late_from_ns))

    record = replayed(edit(walking, late), tmp_path, rearm_after_s=0.5)
    found = bursts(record.commands)
    assert len(found) == 2  # arming again is refused as long as the data are old
    assert found[1].t_off_ns <= late_from_ns + 60 * MS


def test_not_a_number_is_refused_when_read(tmp_path: Path) -> None:
    path = write_cut(tmp_path)
    recording = read_recording(path)

    def spoiled(track: Track) -> Track:
        acc = track.acc_mps2.copy()
        acc[1000, 1] = np.nan
        return replace(track, acc_mps2=acc)

    write_recording(edit(recording, spoiled), path, overwrite=True)
    with pytest.raises(RecordingError, match=r"cut\.parquet: row 1001, column 'right_foot_acc_y': nan"):
        read_recording(path)


def test_times_before_zero_are_times_like_any(walking: Recording, sound: SessionRecord, tmp_path: Path) -> None:
    shift_ns = 30 * NS_PER_S
    early = edit(
        walking, lambda track: replace(track, t_ns=track.t_ns - shift_ns, t_sensor_ns=track.t_sensor_ns - shift_ns)
    )
    found = bursts(replayed(early, tmp_path).commands)
    assert [burst.t_on_ns + shift_ns for burst in found] == [burst.t_on_ns for burst in bursts(sound.commands)]
