"""A walk out of a recording, in the place of the simulated patient's: they stand, and walk on."""

from pathlib import Path
from typing import Final

import numpy as np

from fes.analysis.pipeline import analyse
from fes.calibration.recording import SensorCalibrations, save
from fes.estimation.events.offline import GaitEvents
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.hil.settings import FOOT, STANDS_S, Walker
from fes.recording import Recording, RecordingError, Track, write_recording
from fes.signals import FOOT_SENSORS, NS_PER_S, BoolArray, FloatArray

LEAVES_S: Final = 0.5  # from the end of the rest to the first foot off: the push-off is none of it
WALKS_S: Final = 10.0  # a patient who is to stand walks to the end first
SWINGS: Final = 3


def recorded_walker(recording: Recording, found: SensorCalibrations, folder: Path) -> Walker:
    """Write the files of a foot that stands for :data:`STANDS_S` and then walks for about :data:`WALKS_S`.

    Nobody knows the true phases of a recording. In their place is what its off-line analysis finds with all samples at
    hand: stance lasts from foot flat to heel rise (:func:`fes.estimation.events.offline.find_events`).

    Raises:
        RecordingError: no foot does so, or no foot is calibrated.
    """
    analysis = analyse(recording, found.calibrations)
    for foot in sorted(FOOT_SENSORS, key=lambda name: name != FOOT):
        if foot in analysis.events and (walk_ns := _walk(recording.tracks[foot], analysis.events[foot])):
            break
    else:
        raise RecordingError(
            f"{recording.path or recording.name}: no calibrated foot stands for {STANDS_S + LEAVES_S:g} s and walks "
            f"{SWINGS} strides within {WALKS_S:g} s after it; the campaign arms at rest and injects while they walk"
        )
    track = recording.tracks[foot]
    first, last = np.searchsorted(track.t_sensor_ns, walk_ns).tolist()
    part = track.part(slice(first, last))
    path, calibration = folder / "walker.parquet", folder / "walker.calibration.json"
    write_recording(Recording(recording.name, None, {foot: part}), path, overwrite=True)
    save(found, calibration)
    rate_hz = float(round(track.rate_hz))
    grid_ns = part.t_sensor_ns[0] + np.arange(int((walk_ns[1] - walk_ns[0]) * rate_hz / NS_PER_S)) * (
        NS_PER_S / rate_hz
    )
    in_stance = _in_stance(grid_ns, analysis.events[foot])
    in_stance[: round(STANDS_S * rate_hz)] = True  # they stand, which comes after no swing
    ranges = track.acc_range_mps2, track.gyr_range_radps
    return Walker(path, calibration, in_stance, foot, rate_hz, *ranges)


def _walk(track: Track, events: GaitEvents) -> tuple[int, int] | None:
    """Begin and end, of the quietest such rest with its walk; it ends in mid-stance, where a foot moves least."""
    stands_ns, leaves_ns, walks_ns = (round(s * NS_PER_S) for s in (STANDS_S, LEAVES_S, WALKS_S))
    ends_ns = np.concatenate([track.t_sensor_ns[:1], events.ic_ns])[: len(events.fo_ns)]  # of the swing before each
    found: list[tuple[float, int, int]] = []
    for off_ns in events.fo_ns[events.fo_ns - ends_ns >= stands_ns + leaves_ns].tolist():
        begin_ns = off_ns - stands_ns - leaves_ns
        middles_ns = (events.ic_ns[:-1] + events.fo_ns[1 : len(events.ic_ns)]) // 2
        middles_ns = middles_ns[(middles_ns > off_ns) & (middles_ns < off_ns + walks_ns)]
        if len(middles_ns) >= SWINGS:
            rows = slice(*np.searchsorted(track.t_sensor_ns, [begin_ns, begin_ns + stands_ns]).tolist())
            found.append((float(np.square(track.gyr_radps[rows]).sum()), begin_ns, int(middles_ns[-1])))
    return min(found)[1:] if found else None


def _in_stance(t_ns: FloatArray, events: GaitEvents) -> BoolArray:
    """Which of these moments lie between a foot flat and the next heel rise, as far as both were seen."""
    flat_ns, rise_ns = events.foot_flat_ns, events.heel_rise_ns
    assert flat_ns is not None
    assert rise_ns is not None
    ends_ns = rise_ns[1:]
    begins_ns = flat_ns[: len(ends_ns)]
    seen = (begins_ns != UNSEEN_NS) & (ends_ns != UNSEEN_NS)
    borders = np.stack([begins_ns[seen], ends_ns[seen]], axis=1).ravel()
    return np.asarray(np.searchsorted(borders, t_ns, side="right") % 2 == 1)
