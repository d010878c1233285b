"""What a recording is made of besides its data file: the sidecar, and what that names: sensors' own files, a DBC."""

from __future__ import annotations

import hashlib
import os
import posixpath
import tomllib
from pathlib import Path, PurePosixPath
from typing import Any, Final

SIDECAR: Final = ".toml"
LARGEST_SIDECAR: Final = 1_000_000  # bytes: a larger one is no sidecar, and is known by its size and time only
_DEEP: Final = 8  # folders that a file may lie above its sidecar, at most


def sidecar_of(path: str) -> str:
    """Where the sidecar of a data file is, on any storage."""
    return str(PurePosixPath(path).with_suffix(SIDECAR))


def named_in(sidecar: bytes) -> tuple[str, ...]:
    """The files that a sidecar names, as written there: each sensor's own, and the DBC; none if it is no sidecar."""
    try:
        data = tomllib.loads(sidecar.decode("utf-8-sig"))
    except (ValueError, RecursionError):  # told when the recording is read
        return ()
    sensors, can = data.get("sensors"), data.get("can")
    tables = list(sensors.values()) if isinstance(sensors, dict) else []
    found = [table.get("file") for table in tables if isinstance(table, dict)]
    found.append(can.get("dbc") if isinstance(can, dict) else None)
    return tuple(sorted({name for name in found if isinstance(name, str) and name}))


def mark_of_info(info: dict[str, Any]) -> str:
    """Size and time or tag of a file, as its storage tells."""
    told = [info.get(key) for key in ("size", "ETag", "etag", "CRC", "md5Hash", "sha")]
    times = [info.get(key) for key in ("mtime", "LastModified", "last_modified", "modified", "modify", "date_time")]
    if all(time is None for time in times):  # elsewhere it changes when nothing in the file does
        times = [info.get("created")]
    return "|".join(str(value) for value in (*told, *times) if value is not None) + ";"


def mark_beside(
    filesystem: Any, path: str, sidecar: bytes | None, infos: dict[str, Any], endings: tuple[str, ...]
) -> str:
    """What tells whether anything besides the data file at ``path`` has changed.

    The sidecar by what is in it; files that it names, and those of the same name with one of ``endings``, by size and
    time or tag, or by their not being there. ``infos``: what is known already, by path.
    """

    def mark(file: str) -> str:
        try:
            return mark_of_info(infos.get(file) or filesystem.info(file))
        except (OSError, ValueError):
            return "absent;"

    if sidecar is None:
        beside = mark(sidecar_of(path))
        names: tuple[str, ...] = ()
    else:
        beside = hashlib.sha256(sidecar).hexdigest() + ";"
        names = named_in(sidecar)
    folder = posixpath.dirname(path)
    marks = [f"{name}={mark(posixpath.normpath(posixpath.join(folder, name)))}" for name in names]
    marks += [f"{ending}={mark(str(PurePosixPath(path).with_suffix(ending)))}" for ending in endings]
    return beside + "".join(marks)


def fetch(filesystem: Any, path: str, folder: Path, endings: tuple[str, ...]) -> Path:
    """Copy a recording with all that belongs to it below ``folder``; where its data file is then.

    Nothing is ever written elsewhere, whatever the sidecar names: what lies too far up is left out, and reading the
    recording will say that it is missing.

    Raises:
        OSError: the storage does not answer, or the data file is gone.
    """
    other = sidecar_of(path)
    sidecar: bytes | None = filesystem.cat_file(other) if filesystem.isfile(other) else None
    names = [posixpath.normpath(name) for name in named_in(sidecar or b"")]
    above = min(max((PurePosixPath(name).parts.count("..") for name in names), default=0), _DEEP)
    here = folder.joinpath(*["down"] * above, PurePosixPath(path).name)
    here.parent.mkdir(parents=True, exist_ok=True)
    filesystem.get_file(path, str(here))
    if sidecar is not None:
        here.with_suffix(SIDECAR).write_bytes(sidecar)
    wanted = {here.with_suffix(ending): str(PurePosixPath(path).with_suffix(ending)) for ending in endings}
    for name in names:
        target = Path(os.path.normpath(here.parent / name))
        if target.is_relative_to(folder):
            wanted[target] = posixpath.normpath(posixpath.join(posixpath.dirname(path), name))
    for target, file in wanted.items():
        if not target.exists() and filesystem.isfile(file):
            target.parent.mkdir(parents=True, exist_ok=True)
            filesystem.get_file(file, str(target))
    return here
