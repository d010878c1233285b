"""A session log → one C3D file, which motion laboratories open (Mokka, Visual3D, Nexus), by the library ezc3d.

- *Analog*: each sensor's acceleration and rotation rate, its phase (0 stance, 1 pre-swing, 2 swing, 3 loading
  response), and each channel's commanded current, at the fastest sensor's rate.
- *Points*: each foot sensor's trajectory from the start of its stride (x forward, z up), invalid outside strides.
- *Events*: foot off and foot strike of each foot, as the phase machine saw them.

C3D has one rate for all and no missing analog values: sensors are interpolated onto the common times, and a channel
``….Present`` is 0 where a gap was filled with zeros.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.session_log import read_session
from fes.session_log.export.tables import ANOTHER, Exported, library_missing
from fes.session_log.framing import SessionLogError, SessionRecord, not_made
from fes.signals import BoolArray, FloatArray, IntArray, StimCommand, StrideResult
from fes.walk_record import SampleArrays
from statemachine.phases import Phase, PhaseChange

EXTRA: Final = "c3d"
MAX_FRAMES: Final = 65_535  # the format counts frames in 16 bits
LONGEST_GAP: Final = 2.5  # usual intervals; beyond it samples are missing
_EVENTS: Final = {Phase.SWING: "Foot Off", Phase.LOADING_RESPONSE: "Foot Strike", Phase.STANCE: "Foot Strike"}
_AXES: Final = "XYZ"
Channel = tuple[str, str, FloatArray]  # label, unit, values
FootEvent = tuple[float, str, str]  # s, foot, what


def to_c3d(log: Path, target: Path) -> Exported:
    """Write the C3D file ``target``.

    SessionLogError: ``target`` exists or cannot be written, the log cannot be read, holds no samples or is too long for
    the format, or the library is not there.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise library_missing("C3D", EXTRA) from error
    if target.exists():
        raise not_made(target, FileExistsError(), ANOTHER)
    record = read_session(log)
    sensors = {sensor: arrays for sensor, arrays in record.samples.items() if len(arrays.t_ns) >= 2}
    if not sensors:
        raise SessionLogError(f"{log}: holds no sensor's samples, so there is nothing to write as C3D")
    file: Any = ezc3d.c3d()
    exported = _fill(file, log, record, sensors)
    try:
        with target.open("xb"):
            pass
        file.write(str(target))
    except (OSError, RuntimeError) as error:
        target.unlink(missing_ok=True)
        raise SessionLogError(f"{target}: cannot be written: {error}; make room, or use --out") from error
    return exported


def _fill(file: Any, log: Path, record: SessionRecord, sensors: dict[str, SampleArrays]) -> Exported:
    times = {sensor: _sampled_at_s(arrays) for sensor, arrays in sensors.items()}
    begin_s = min(float(at[0]) for at in times.values())
    seconds = max(float(at[-1]) for at in times.values()) - begin_s
    rate_hz = 1.0 / min(float(np.median(np.diff(at))) for at in times.values())
    rate_hz = float(round(rate_hz)) if abs(rate_hz - round(rate_hz)) < 0.01 * rate_hz else rate_hz
    frames = math.floor(seconds * rate_hz) + 1
    per_frame = math.ceil(frames / MAX_FRAMES)
    frames = frames // per_frame
    if frames < 2 or per_frame > MAX_FRAMES:
        raise SessionLogError(f"{log}: {seconds:.3g} s at {rate_hz:.4g} Hz cannot be held by a C3D file")
    grid_s = begin_s + np.arange(frames * per_frame) / rate_hz
    channels: list[Channel] = []
    for sensor, arrays in sensors.items():
        present = _present(times[sensor], grid_s)
        for what, unit, values in (("Acc", "m/s^2", arrays.acc_mps2), ("Gyr", "rad/s", arrays.gyr_radps)):
            for axis, letter in enumerate(_AXES):
                column = np.interp(grid_s, times[sensor], np.nan_to_num(values[:, axis], posinf=0.0, neginf=0.0))
                channels.append((f"{sensor}.{what}{letter}", unit, np.where(present, column, 0.0)))
        channels.append((f"{sensor}.Present", "", present.astype(np.float64)))
    for foot in sorted({change.foot for change in record.phases}):
        changes = [change for change in record.phases if change.foot == foot]
        phases = np.array([float(change.destination) for change in changes])
        held, _ = _held(changes, phases, grid_s, before=float(changes[0].source))
        channels.append((f"{foot}.Phase", "", held))
    for number in sorted({command.channel for command in record.commands}):
        own = [command for command in record.commands if command.channel == number]
        channels.append((f"stimulation.{number}", "mA", _currents(own, grid_s)))
    frame_s = grid_s[::per_frame]
    feet = sorted({stride.foot for stride in record.strides if len(stride.pitch_rad)})
    points = np.full((4, len(feet), frames), np.nan)
    points[3] = 1.0
    for k, foot in enumerate(feet):
        points[:3, k] = _trajectories([one for one in record.strides if one.foot == foot], frame_s)
    events = sorted(
        (1e-9 * one.t_ns - begin_s, one.foot, _EVENTS[one.destination])
        for one in record.phases
        if one.destination in _EVENTS and (one.destination != Phase.STANCE or one.source == Phase.SWING)
    )
    _parameters(file, rate_hz, per_frame, feet, channels, events)
    file["data"]["points"] = points
    file["data"]["analogs"] = np.asarray([values for _, _, values in channels])[np.newaxis]
    counts = {"analog channels": len(channels), "analog samples": len(grid_s)}
    counts |= {"points": len(feet), "events": len(events)}
    return Exported(record.header, record.summary, record.complete, rows=counts, begin_ns=round(1e9 * begin_s))


def _sampled_at_s(arrays: SampleArrays) -> FloatArray:
    """(N,) when the samples were taken, on the host's clock, increasing: the sensor's own clock, drift taken out.

    Where the sensor's clock cannot be followed (set anew, stamps doubled), the times of arrival.
    """
    arrived, stamped = 1e-9 * arrays.t_ns, 1e-9 * arrays.t_sensor_ns
    if np.all(np.diff(stamped) > 0.0):
        drift, offset = np.polyfit(stamped - stamped[0], arrived - stamped, 1)
        at: FloatArray = stamped + offset + drift * (stamped - stamped[0])
        if np.max(np.abs(arrived - at)) < 0.25:
            return at
    increasing: FloatArray = np.maximum.accumulate(arrived) + 1e-9 * np.arange(len(arrived))
    return increasing


def _present(t_s: FloatArray, grid_s: FloatArray) -> BoolArray:
    """(M,) whether a sample was there: between two that are no more than a few intervals apart."""
    after = np.clip(np.searchsorted(t_s, grid_s), 1, len(t_s) - 1)
    short = (t_s[after] - t_s[after - 1]) <= LONGEST_GAP * float(np.median(np.diff(t_s)))
    inside: BoolArray = short & (grid_s >= t_s[0] - 1e-6) & (grid_s <= t_s[-1] + 1e-6)
    return inside


def _held(
    decided: Sequence[PhaseChange | StimCommand], values: FloatArray, grid_s: FloatArray, *, before: float
) -> tuple[FloatArray, IntArray]:
    """The last value at each time of the grid, and which one that is (-1: none yet)."""
    which = np.searchsorted(np.array([1e-9 * one.t_ns for one in decided]), grid_s, side="right") - 1
    return np.where(which >= 0, values[which], before), which


def _currents(commands: Sequence[StimCommand], grid_s: FloatArray) -> FloatArray:
    """(M,) mA: what the newest command asks for while it is valid."""
    asked_ma = np.array([one.current_ma * one.on for one in commands])
    current_ma, which = _held(commands, asked_ma, grid_s, before=0.0)
    until_s = np.array([1e-9 * one.t_ns + 1e-3 * one.validity_ms for one in commands])
    return np.where((which >= 0) & (grid_s <= until_s[which]), current_ma, 0.0)


def _trajectories(strides: Sequence[StrideResult], frame_s: FloatArray) -> FloatArray:
    """(3, F) mm from each stride's start, NaN where there is none."""
    trajectories = np.full((3, len(frame_s)), np.nan)
    for stride in strides:
        k = len(stride.pitch_rad)
        if k < 2 or len(stride.trajectory_m) != k:
            continue
        t_s = np.linspace(1e-9 * stride.t_start_ns, 1e-9 * stride.t_end_ns, k)
        first, last = np.searchsorted(frame_s, [t_s[0], t_s[-1]])
        for axis in range(3):
            trajectories[axis, first:last] = 1e3 * np.interp(frame_s[first:last], t_s, stride.trajectory_m[:, axis])
    return trajectories


def _parameters(
    file: Any, rate_hz: float, per_frame: int, feet: list[str], channels: list[Channel], events: list[FootEvent]
) -> None:
    points: dict[str, list[Any]] = {"RATE": [rate_hz / per_frame], "LABELS": [f"{foot}.sensor" for foot in feet]}
    points |= {"DESCRIPTIONS": ["sensor, from the start of each stride" for _ in feet], "UNITS": ["mm"]}
    analog: dict[str, list[Any]] = {"RATE": [rate_hz], "LABELS": [label for label, _, _ in channels]}
    analog["UNITS"] = [unit for _, unit, _ in channels]
    for group, values in (("POINT", points), ("ANALOG", analog)):
        for name, value in values.items():
            file["parameters"][group][name]["value"] = value
    file.add_parameter("EVENT", "USED", [len(events)])
    if events:
        minutes = [math.floor(t_s / 60.0) for t_s, _, _ in events]
        seconds = [t_s - 60.0 * whole for whole, (t_s, _, _) in zip(minutes, events, strict=True)]
        file.add_parameter("EVENT", "CONTEXTS", [foot.split("_")[0].capitalize() for _, foot, _ in events])
        file.add_parameter("EVENT", "LABELS", [label for _, _, label in events])
        file.add_parameter("EVENT", "TIMES", np.array([minutes, seconds], np.float64))
