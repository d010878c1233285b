"""Arrays → a recording, with the checks that a file would have to pass."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from fes.config import FootGeometry
from fes.recording.raw import MIN_DURATION_S, PLAUSIBLE_RATES_HZ, stamps_from_rate
from fes.recording.tracks import UNLABELLED_FEET, Recording, RecordingError, Track, TrackQuality
from fes.recording.units import ACC_UNITS, GYR_UNITS, acc_factor, canonical, check_units, gyr_factor
from fes.signals import SENSORS, FloatArray

Arrays = npt.ArrayLike | Mapping[str, npt.ArrayLike]


def recording_from_arrays(
    acc: Arrays,
    gyr: Arrays,
    rate_hz: float,
    sensor: str = "left_foot",
    *,
    acc_unit: str = "m/s^2",
    gyr_unit: str = "rad/s",
    name: str = "arrays",
    belt_speed_mps: float | None = None,
    geometry: Mapping[str, FootGeometry] | None = None,
) -> Recording:
    """Return a recording of one sensor, or of several that were sampled together.

    Args:
        acc: (N, 3) specific force in the sensor's axes, gravity included; or a mapping from each sensor to its array.
        gyr: (N, 3) angular rate in the same axes, likewise.
        rate_hz: samples a second, of all sensors.
        sensor: which it is, where ``acc`` and ``gyr`` are plain arrays: one of ``fes.signals.SENSORS``, or ``foot_a``
            and ``foot_b`` for feet that calibration is to tell apart.
        acc_unit: ``m/s^2``, ``g`` or ``mg``.
        gyr_unit: ``rad/s``, ``deg/s`` or ``mdeg/s``.
        name: what tables and reports call it.
        belt_speed_mps: of the treadmill, if it was one.
        geometry: where toe and heel are, by foot.

    Raises:
        RecordingError: a shape or a unit does not fit, a value is not finite, it is too short, or no such sensor.
    """
    forces = acc if isinstance(acc, Mapping) else {sensor: acc}
    rates = gyr if isinstance(gyr, Mapping) else {sensor: gyr}
    if forces.keys() != rates.keys():
        raise RecordingError(f"{name}: acc is of {', '.join(forces)}, gyr of {', '.join(rates)}: give both of each")
    lowest, highest = PLAUSIBLE_RATES_HZ
    if not lowest <= rate_hz <= highest:
        raise RecordingError(f"{name}: rate_hz = {rate_hz:g} is outside {lowest:g} to {highest:g} Hz")
    units = str(canonical(acc_unit)), str(canonical(gyr_unit))
    for unit, known, argument in zip(units, (ACC_UNITS, GYR_UNITS), ("acc_unit", "gyr_unit"), strict=True):
        if unit not in known:
            raise RecordingError(f"{name}: {argument} = {unit!r}: must be one of {', '.join(known)}")
    if unknown := [each for each in forces if each not in SENSORS + UNLABELLED_FEET]:
        raise RecordingError(f"{name}: no sensor is called {unknown[0]!r}; one of {', '.join(SENSORS)}")
    ordered = [each for each in SENSORS + UNLABELLED_FEET if each in forces]
    tracks = {each: _track(name, each, forces[each], rates[each], rate_hz, units) for each in ordered}
    if len({track.t_ns.size for track in tracks.values()}) > 1:
        sizes = ", ".join(f"{each}: {track.t_ns.size}" for each, track in tracks.items())
        raise RecordingError(f"{name}: sensors that were sampled together have as many samples ({sizes})")
    return Recording(name, None, tracks, belt_speed_mps, geometry=dict(geometry or {}))


def _track(
    name: str, sensor: str, acc: npt.ArrayLike, gyr: npt.ArrayLike, rate_hz: float, units: tuple[str, str]
) -> Track:
    where = f"{name}: {sensor}"
    force, rate = _vectors(where, "acc", acc), _vectors(where, "gyr", gyr)
    if force.shape != rate.shape:
        raise RecordingError(f"{where}: acc has {len(force)} samples, gyr {len(rate)}")
    if len(force) < MIN_DURATION_S * rate_hz:
        raise RecordingError(f"{where}: lasts {len(force) / rate_hz:.3f} s; at least {MIN_DURATION_S:g} s are needed")
    factors = acc_factor(units[0]), gyr_factor(units[1])
    check_units(where, force, rate, rate_hz, *units)
    t_ns = stamps_from_rate(len(force), rate_hz)
    quality = TrackQuality(samples=len(force))
    return Track(sensor, rate_hz, t_ns, t_ns, force * factors[0], rate * factors[1], quality=quality)


def _vectors(where: str, argument: str, values: npt.ArrayLike) -> FloatArray:
    try:
        vectors = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{where}: {argument} is no array of numbers: {error}") from error
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise RecordingError(f"{where}: {argument} has shape {vectors.shape}, must be (N, 3): a row a sample, x y z")
    bad = np.flatnonzero(~np.isfinite(vectors).all(axis=1))
    if bad.size:
        raise RecordingError(
            f"{where}: {argument} is not finite in {bad.size} samples, first in row {bad[0]}: {vectors[bad[0]]}. "
            f"Cut the recording there, or fill in the lost samples"
        )
    return vectors
