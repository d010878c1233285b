"""Which recordings a cohort is made of, on any storage that fsspec opens, and its results as a Parquet data set.

A recording is a data file, its sidecar, and what that names: sensors' own files, a DBC. With the program that worked on
it they name its results, so that no old result passes for new. Results are ``strides/``, ``events/`` and
``recordings/``, one part a recording; its row in ``recordings/`` is written last, in one step, and says that all is
there.
"""

from __future__ import annotations

import hashlib
import json
import os
import posixpath
import re
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from secrets import token_hex
from typing import Any, Final

import fsspec
import pyarrow as pa
from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem
from pyarrow import parquet

from fes import __version__
from fes.estimation.strides.schema import TABLE
from fes.recording.can_log import CAN_SUFFIXES
from fes.recording.table import TABLE_SUFFIXES
from fes.report.text import number

SIDECAR: Final = ".toml"
LARGEST_SIDECAR: Final = 1_000_000  # bytes: a larger one is no sidecar, and is known by its size and time only
_DEEP: Final = 8  # folders that a file may lie above its sidecar, at most
PACKAGES: Final = ("fes", "drivers", "statemachine")
SUFFIXES: Final = TABLE_SUFFIXES + CAN_SUFFIXES
BY_CONTENT: Final = (".txt", ".xdf", ".h5", "")  # each is one where no other data file has its sidecar


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


RECORDINGS: Final = "recordings"
STRIDES: Final = "strides"
EVENTS: Final = "events"
ABOUT: Final = "cohort.json"

_TEXT, _NUMBER, _COUNT = pa.string(), pa.float64(), pa.int64()
_KINDS: Final = {str: _TEXT, float: _NUMBER, int: _COUNT, bool: pa.bool_()}


def columns_of(kind: pa.DataType, names: str) -> list[tuple[str, pa.DataType]]:
    """Columns of one kind for a schema."""
    return [(name, kind) for name in names.split()]


SCHEMAS: Final[Mapping[str, pa.Schema]] = {
    RECORDINGS: pa.schema(
        columns_of(_TEXT, "recording source name subject group status reason fes_version findings")
        + columns_of(_COUNT, "samples missing clipped irregular strides valid_strides")
        + columns_of(_NUMBER, "duration_s belt_speed_mps stride_length_m speed_mps stride_time_s clearance_m")
        + columns_of(_NUMBER, "cadence_per_min step_time_s swing_symmetry_percent step_time_symmetry_percent")
        + columns_of(_NUMBER, "stride_time_cv_percent stride_length_cv_percent")
    ),
    STRIDES: pa.schema(
        [*columns_of(_TEXT, "recording subject"), *((column.name, _KINDS[column.kind]) for column in TABLE)]
    ),
    EVENTS: pa.schema(
        columns_of(_TEXT, "recording subject foot")
        + columns_of(_NUMBER, "t_foot_off_s t_mid_swing_s t_initial_contact_s t_foot_off_live_s")
        + columns_of(_NUMBER, "t_initial_contact_live_s foot_strike_angle_rad")
    ),
}


@dataclass(frozen=True, slots=True)
class Measure:
    """A column that pages and tables show; ``best`` is which end of it is good, 0 where neither is."""

    name: str
    title: str
    unit: str = ""
    best: int = 0
    digits: int = 1
    factor: float = 1.0

    @property
    def axis(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def text(self, value: float | None) -> str:
        """An SI value in this unit; a dash where it is unknown."""
        return number(None if value is None else self.factor * value, self.digits)


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of results on any storage that fsspec opens.

    Args:
        url: of the folder.
        schemas: of its tables, by name.
        last: the table that is written last and says what is finished.
    """

    url: str
    schemas: Mapping[str, pa.Schema] = field(default_factory=lambda: SCHEMAS)
    last: str = RECORDINGS

    def prepare(self, about: Mapping[str, Any]) -> None:
        """Make the folder and say what is in it. CohortError: it cannot be written."""
        filesystem, root = self._open()
        try:
            for table in self.schemas:
                filesystem.makedirs(f"{root}/{table}", exist_ok=True)
            with filesystem.open(f"{root}/{ABOUT}", "wb") as file:
                file.write(json.dumps(about, indent=1, ensure_ascii=False).encode(errors="backslashreplace") + b"\n")
        except CohortError:
            raise
        except Exception as error:  # storages have errors of their own; some cannot be written to at all
            why = str(error) or f"{type(error).__name__}; this storage may be for reading only"
            raise CohortError(f"{self.url}: cannot be written: {why}. Choose another with --out.") from error

    def put(self, identity: str, tables: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
        """Keep one piece of work's rows; those of the last table last, so that a crash leaves it to be done again.

        OSError: the storage is full or gone.
        """
        filesystem, root = self._open()
        for table in sorted(tables, key=lambda name: name == self.last):
            listed = [dict(row) for row in tables[table]]
            try:
                rows = pa.Table.from_pylist(listed, schema=self.schemas[table])
            except UnicodeEncodeError:
                listed = [{key: _plain(value) for key, value in row.items()} for row in listed]
                rows = pa.Table.from_pylist(listed, schema=self.schemas[table])
            # a draft of its own: a scheduler that thinks a worker lost has its work done twice at the same time
            draft, path = f"{root}/{table}/.{identity}.{token_hex(4)}.part", f"{root}/{table}/{identity}.parquet"
            whole = pa.BufferOutputStream()  # written at once: through a Python file every piece costs a call
            parquet.write_table(rows, whole, write_page_checksum=True)
            _replace(filesystem, draft, path, whole.getvalue())

    def finished(self) -> set[str]:
        """What is complete, by identity."""
        filesystem, root = self._open()
        folder = f"{root}/{self.last}"
        if not filesystem.isdir(folder):
            return set()
        listed = filesystem.ls(folder, detail=True, refresh=True)
        # a power cut may leave a name without its bytes
        names = (str(each["name"]).rsplit("/", 1)[-1] for each in listed if each.get("size") != 0)
        return {name.removesuffix(".parquet") for name in names if name.endswith(".parquet")}

    def forget(self, identities: Iterable[str]) -> None:
        """Take these recordings' rows away, so that they are done again."""
        self._remove(identities, [self.last])

    def remove(self, identities: Iterable[str]) -> None:
        """Take all rows of these away; those of the last table last, so that a crash on the way leaves them known.

        OSError: the storage does not let it.
        """
        self._remove(identities, sorted(self.schemas, key=lambda name: name == self.last))

    def _remove(self, identities: Iterable[str], tables: Sequence[str]) -> None:
        filesystem, root = self._open()
        for identity in identities:
            for table in tables:
                with suppress(FileNotFoundError):
                    filesystem.rm_file(f"{root}/{table}/{identity}.parquet")

    def table(self, name: str, identities: Iterable[str], columns: Sequence[str] | None = None) -> pa.Table:
        """The rows of these recordings, with all columns or some; leftovers of other runs are not among them."""
        filesystem, root = self._open()
        folder = f"{root}/{name}"
        listed = filesystem.ls(folder, detail=False, refresh=True) if filesystem.isdir(folder) else ()
        there = {str(path).rsplit("/", 1)[-1] for path in listed}
        paths = [f"{folder}/{identity}.parquet" for identity in sorted(identities) if f"{identity}.parquet" in there]
        if not paths:
            empty = self.schemas[name].empty_table()
            return empty if columns is None else empty.select(list(columns))
        how: dict[str, Any] = {"schema": self.schemas[name], "filesystem": filesystem}
        how["page_checksum_verification"] = True
        try:
            return parquet.read_table(paths, columns=None if columns is None else list(columns), **how)
        except FileNotFoundError:
            raise
        except (pa.ArrowException, OSError) as error:
            for path in paths:
                try:
                    parquet.read_table(path, **how)
                except (pa.ArrowException, OSError):
                    file = path.rsplit("/", 1)[-1]
                    raise CohortError(
                        f"{self.place(name)}/{file}: is damaged: {error}. Delete {self.place(self.last)}/{file} and "
                        f"run the same command again: what it belongs to is done again."
                    ) from error
            raise

    def write(self, name: str, data: str | bytes) -> None:
        """Write a page or a file beside the tables."""
        filesystem, root = self._open()
        filesystem.makedirs(f"{root}/{name}".rsplit("/", 1)[0], exist_ok=True)
        with filesystem.open(f"{root}/{name}", "wb") as file:
            file.write(data.encode() if isinstance(data, str) else data)

    def place(self, name: str) -> str:
        """Where a page or table is, for people."""
        return f"{self.url.rstrip('/')}/{name}"

    def _open(self) -> tuple[AbstractFileSystem, str]:
        try:
            filesystem, root = fsspec.core.url_to_fs(self.url)
        except (ValueError, ImportError, OSError) as error:
            raise CohortError(f"{self.url}: no storage for the results: {error}") from error
        return filesystem, str(root).rstrip("/")


def _plain(value: object) -> object:
    """Text that every file takes: bytes of a name that are no UTF-8 as escapes."""
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


def _replace(filesystem: AbstractFileSystem, draft: str, path: str, data: pa.Buffer) -> None:
    """Write a file in one step: whoever looks at ``path`` finds all of it, or what was there before."""
    if isinstance(filesystem, LocalFileSystem):  # whose move copies where it cannot rename
        here = Path(draft)
        try:
            here.write_bytes(data)
            here.replace(path)
        except OSError:
            here.unlink(missing_ok=True)  # it would take what little room there is
            raise
        return
    with filesystem.open(draft, "wb") as file:
        file.write(data)
    filesystem.mv(draft, path)
