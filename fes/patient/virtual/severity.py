"""Ready patients by name, and patients from a settings file."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from fes.patient.virtual.patterns import PATTERNS
from fes.patient.virtual.settings import MuscleSettings, PatientSettings, setting_names

SEVERITIES: Final[dict[str, dict[str, float]]] = {
    "healthy": {"voluntary_dorsiflexion": 1.0, "spasticity": 0.0, "asymmetry": 0.0},
    "mild": {"voluntary_dorsiflexion": 0.5, "spasticity": 0.1, "compensation": 0.6},
    "moderate": {"voluntary_dorsiflexion": 0.15, "spasticity": 0.3, "compensation": 0.6},
    "severe": {"voluntary_dorsiflexion": 0.0, "spasticity": 0.7, "compensation": 0.5, "asymmetry": 0.04},
}


def settings_for(severity: str, **others: Any) -> PatientSettings:
    """A patient of one of :data:`SEVERITIES`; ``others`` are settings by name and win.

    A pattern walks at its own speed unless ``others`` names one.

    Raises:
        ValueError: an unknown severity or setting, or a value out of range.
    """
    if severity not in SEVERITIES:
        raise ValueError(f"severity {severity!r}: choose one of {', '.join(SEVERITIES)}")
    unknown = set(others) - set(setting_names()["patient"])
    if unknown:
        raise ValueError(f"no such setting of a patient: {', '.join(sorted(unknown))}")
    values: dict[str, Any] = {**SEVERITIES[severity], **others}
    pattern = values.get("pattern", "none")
    if pattern in PATTERNS and pattern != "none":
        values.setdefault("speed_mps", PATTERNS[pattern].speed_mps)
    return PatientSettings(**values)


def load_patient(path: Path, **others: Any) -> PatientSettings:
    """A patient from a TOML file: a table ``[patient]`` with ``severity`` and any settings, ``[patient.muscle]``.

    Raises:
        ValueError: the file cannot be read, or holds what is no setting; the message names file and key.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}. Name an existing settings file.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is not valid TOML: {error}") from error
    table = data.get("patient")
    if not isinstance(table, dict) or set(data) != {"patient"}:
        raise ValueError(f"{path}: must hold one table, [patient]; it has {', '.join(data) or 'nothing'}")
    values = dict(table)
    muscle = values.pop("muscle", {})
    allowed = setting_names()
    plain = (set(allowed["patient"]) - {"muscle", "imu", "placements"}) | {"severity"}
    _refuse(path, "patient", values, plain)
    if not isinstance(muscle, dict):
        raise ValueError(f"{path}: muscle must be a table, [patient.muscle]")
    _refuse(path, "patient.muscle", muscle, set(allowed["muscle"]))
    try:
        if "sensors" in values:
            if not isinstance(values["sensors"], list):
                raise ValueError(f'sensors = {values["sensors"]!r}: must be a list of names, e.g. ["left_foot"]')
            values["sensors"] = tuple(values["sensors"])
        if muscle:
            values["muscle"] = replace(MuscleSettings(), **muscle)
        return settings_for(values.pop("severity", "moderate"), **{**values, **others})
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _refuse(path: Path, table: str, values: dict[str, Any], allowed: set[str]) -> None:
    unknown = sorted(set(values) - allowed)
    if unknown:
        raise ValueError(f"{path}: [{table}] has no {unknown[0]!r}; it knows {', '.join(sorted(allowed))}")
