"""The guards' thresholds of a session: what was set, by whom, and how this person's measures followed the strides."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from fes.config import Session
from fes.config.thresholds import changed_thresholds, describe_thresholds
from fes.estimation.sensor_choice import calibration_from_dict
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.tracking.phase_features import LEAST, MEASURES, MOST
from fes.report.quality import THRESHOLDS
from fes.walk_record import WalkRecord
from statemachine.guards import Thresholds
from statemachine.terms import unit

_VALUE: Final = re.compile(r"(\w+) ([-+.\de]+)")


@dataclass(frozen=True)
class MeasureRow:
    """One measure of one sensor's person: where it began, between which bounds it may follow, and where it went.

    ``strides`` values are in the log; least, most and last of them are the beginning's where there are none.
    """

    sensor: str
    name: str
    unit: str
    begin: float
    bounds: tuple[float, float]
    strides: int
    least: float
    most: float
    last: float


def measure_rows(record: WalkRecord, settings: Session | None) -> tuple[MeasureRow, ...]:
    """Of every sensor that the log has a calibration of, in its order."""
    calibrations = record.header.get("calibration")
    if not isinstance(calibrations, Mapping):
        return ()
    values: dict[tuple[str, str], list[float]] = {}
    for note in record.notes:
        if note.source == THRESHOLDS:
            sensor, _, text = note.text.partition(": ")
            for name, value in _VALUE.findall(text):
                values.setdefault((sensor, name), []).append(float(value))
    rows = []
    for sensor, data in calibrations.items():
        own = _at_the_beginning(data, settings)
        for name, _ in MEASURES if own is not None else ():
            begin = float(getattr(own, name))
            seen = values.get((sensor, name), [])
            ends = min(seen, default=begin), max(seen, default=begin), seen[-1] if seen else begin
            rows.append(MeasureRow(sensor, name, unit(name), begin, (LEAST * begin, MOST * begin), len(seen), *ends))
    return tuple(rows)


def thresholds_set(settings: Session | None) -> str:
    """What the session set and where it comes from, in a sentence; "" for nothing."""
    return describe_thresholds(settings.thresholds) if settings is not None else ""


def _at_the_beginning(data: Any, settings: Session | None) -> Thresholds | None:
    """What the calibration gives, and the session changes; None where the log's is none."""
    try:
        calibration = calibration_from_dict(data)
        if isinstance(calibration, ShankCalibration):
            return calibration.levels.thresholds()
        return changed_thresholds(calibration.thresholds(), settings.thresholds if settings else {})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
