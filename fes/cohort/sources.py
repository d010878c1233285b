"""Which recordings a cohort is made of: paths, globs and addresses on any storage that fsspec opens.

A recording is a data file, its sidecar, and what that names: sensors' own files, a DBC. With the program that worked on
it they name its results, so that no old result passes for new.
"""

import hashlib
import os
import posixpath
import re
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import Any, Final

import fsspec
from fsspec import AbstractFileSystem

from fes import __version__
from fes.recording.can_log import CAN_SUFFIXES
from fes.recording.table import TABLE_SUFFIXES

SIDECAR: Final = ".toml"
LARGEST_SIDECAR: Final = 1_000_000  # bytes: a larger one is no sidecar, and is known by its size and time only
_DEEP: Final = 8  # folders that a file may lie above its sidecar, at most
PACKAGES: Final = ("fes", "drivers", "statemachine")
SUFFIXES: Final = TABLE_SUFFIXES + CAN_SUFFIXES
BY_CONTENT: Final = (
    ".txt",
    ".xdf",
    ".h5",
    "",
)  # of names that end so, each is one where no other data file has its sidecar


@cache
def program() -> str:
    """The version, and eight digits that change with any line of this program."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        found = find_spec(package)
        for folder in (found.submodule_search_locations if found else None) or ():
            for source in sorted(Path(folder).rglob("*.py")):
                digest.update(source.relative_to(folder).as_posix().encode() + b"\0")
                digest.update(source.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:8]}"


def sidecar_of(path: str) -> str:
    """Where the sidecar of a data file is, on any storage."""
    return str(PurePosixPath(path).with_suffix(SIDECAR))


def files_named_in(sidecar: bytes) -> tuple[str, ...]:
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


def mark_of_file(info: dict[str, Any]) -> str:
    """Size and time or tag of a file, as its storage tells."""
    tags = [info.get(key) for key in ("size", "ETag", "etag", "CRC", "md5Hash", "sha")]
    times = [info.get(key) for key in ("mtime", "LastModified", "last_modified", "modified", "modify", "date_time")]
    if all(time is None for time in times):  # elsewhere it changes when nothing in the file does
        times = [info.get("created")]
    return "|".join(str(value) for value in (*tags, *times) if value is not None) + ";"


def mark_of_companions(
    filesystem: AbstractFileSystem, path: str, sidecar: bytes | None, infos: dict[str, Any], endings: tuple[str, ...]
) -> str:
    """What tells whether anything besides the data file at ``path`` has changed.

    The sidecar by what is in it; files that it names, and those of the same name with one of ``endings``, by size and
    time or tag, or by their not being there. ``infos``: what is known already, by path.
    """

    def mark(file: str) -> str:
        try:
            return mark_of_file(infos.get(file) or filesystem.info(file))
        except (OSError, ValueError):
            return "absent;"

    marks = [mark(sidecar_of(path))] if sidecar is None else [hashlib.sha256(sidecar).hexdigest() + ";"]
    folder, names = posixpath.dirname(path), files_named_in(sidecar or b"")
    marks += [f"{name}={mark(posixpath.normpath(posixpath.join(folder, name)))}" for name in names]
    marks += [f"{ending}={mark(str(PurePosixPath(path).with_suffix(ending)))}" for ending in endings]
    return "".join(marks)


def fetch(filesystem: AbstractFileSystem, path: str, folder: Path, endings: tuple[str, ...]) -> Path:
    """Copy a recording with all that belongs to it below ``folder``; where its data file is then.

    Nothing is ever written elsewhere, whatever the sidecar names: what lies too far up is left out, and reading the
    recording will say that it is missing.

    OSError: the storage does not answer, or the data file is gone.
    """
    other = sidecar_of(path)
    sidecar: bytes | None = filesystem.cat_file(other) if filesystem.isfile(other) else None
    names = [posixpath.normpath(name) for name in files_named_in(sidecar or b"")]
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


class CohortError(RuntimeError):
    """The cohort cannot be worked on; the message says what to do."""


@dataclass(frozen=True, slots=True)
class Source:
    """One recording's data file, as found, with its protocol; what a worker opens.

    ``mark``: size and time or tag of the data file, as the storage tells; what is in its sidecar; and size and time of
    all that the sidecar names. Another file, another mark. ``program``: that was asked to work on it; a worker takes
    the asker's word.
    """

    url: str
    mark: str
    program: str = field(default_factory=program)

    @property
    def path(self) -> PurePosixPath:
        """Without protocol and archive."""
        return PurePosixPath(re.sub(r"^\w+://", "", self.url.split("::", 1)[0]))

    def identity(self, settings: str) -> str:
        """The name of this recording's results: the same for the same files, settings and program."""
        text = "\n".join((self.url, self.mark, settings, self.program))
        return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:20]  # of names that are no UTF-8

    def subject(self, pattern: str) -> str:
        """What ``pattern`` (its group ``subject``, or its first) finds in the address; "" where it finds nothing."""
        found = re.search(pattern, self.url) if pattern else None
        if found is None:
            return ""
        return found.groupdict().get("subject") or (found.group(1) if found.groups() else found.group(0)) or ""


def find_sources(patterns: Sequence[str], companions: Sequence[str] = ()) -> list[Source]:
    """All recordings below folders, matching globs or named, each once, in the order of their addresses.

    In folders and globs only files that have a sidecar beside them count; a file that is named outright always does,
    so that a missing sidecar is told. ``companions``: endings of files of the same name that results rest on too.

    CohortError: a storage cannot be opened, or nothing is found.
    """
    found: dict[str, Source] = {}
    for pattern in patterns:
        try:
            filesystem, path = fsspec.core.url_to_fs(pattern)
            for source in _below(filesystem, path, pattern, tuple(companions)):
                found.setdefault(source.url, source)
        except Exception as error:  # storages have errors of their own: no rights, no such account, no package
            raise CohortError(f"{pattern}: cannot be opened: {str(error) or type(error).__name__}") from error
    if not found:
        raise CohortError(
            f"{', '.join(patterns)}: no recording ({', '.join(SUFFIXES)}, each with its sidecar {SIDECAR}) is there."
        )
    return [found[url] for url in sorted(found)]


def _below(filesystem: AbstractFileSystem, path: str, pattern: str, endings: tuple[str, ...]) -> Iterator[Source]:
    named = not any(mark in path for mark in "*?[") or filesystem.exists(path)  # a folder may be called "a[1]"
    outright = named and filesystem.isfile(path)
    below = filesystem.find if named else filesystem.glob
    infos = {path: filesystem.info(path)} if outright else below(path, detail=True)
    names = [
        name
        for name, info in infos.items()
        if outright or (info.get("type") != "directory" and PurePosixPath(name).suffix.lower() in SUFFIXES + BY_CONTENT)
    ]
    taken = {sidecar_of(name) for name in names if PurePosixPath(name).suffix.lower() in SUFFIXES}
    names = [
        name
        for name in names
        if outright or PurePosixPath(name).suffix.lower() in SUFFIXES or sidecar_of(name) not in taken
    ]
    for name in names:
        sidecar = sidecar_of(name)
        if sidecar not in infos and filesystem.isfile(sidecar):
            infos[sidecar] = filesystem.info(sidecar)
    sidecars = _texts(filesystem, {sidecar: infos[sidecar] for sidecar in map(sidecar_of, names) if sidecar in infos})
    for name in names:
        sidecar = sidecar_of(name)
        if sidecar in infos or outright:
            others = mark_of_companions(filesystem, name, sidecars.get(sidecar), infos, endings)
            head, chained, rest = pattern.partition("::")  # a chained address (zip://…::archive) keeps its archive
            inner = f"{head.split('://', 1)[0]}://{name.lstrip('/')}::{rest}"
            url = inner if chained else str(filesystem.unstrip_protocol(name))
            yield Source(url, mark_of_file(infos[name]) + others)


def _texts(filesystem: AbstractFileSystem, infos: dict[str, Any]) -> dict[str, bytes]:
    """What is in these files, all asked for at once; those that are too long or cannot be read are left out."""
    # neither a pipe nor a device, which have no end
    plain = [path for path, info in infos.items() if info.get("type") == "file" or filesystem.isfile(path)]
    paths = [path for path in plain if (infos[path].get("size") or 0) <= LARGEST_SIDECAR]
    texts = filesystem.cat_ranges(paths, None, None, on_error="return") if paths else []
    return {path: text for path, text in zip(paths, texts, strict=True) if isinstance(text, bytes)}


@contextmanager
def local_copy(source: Source, companions: Sequence[str] = ()) -> Iterator[Path]:
    """The recording as a file here, with its sidecar and what that names, for as long as it is needed.

    ``companions``: endings of further files of the same name that come too where they are there, as ``.strides.csv``.

    CohortError: it is gone, or the storage does not answer.
    """
    try:
        filesystem, path = fsspec.core.url_to_fs(source.url)
        protocol = filesystem.protocol
        if "file" in ((protocol,) if isinstance(protocol, str) else protocol):
            yield Path(path)
            return
        with tempfile.TemporaryDirectory(prefix="fes-cohort-") as folder:
            yield fetch(filesystem, path, Path(folder), tuple(companions))
    except OSError as error:
        raise CohortError(f"{source.url}: cannot be fetched: {error}") from error
